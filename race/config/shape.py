"""`Shape`: everything that the form of a compiled program depends on, besides the task."""

from dataclasses import dataclass

from race.config.settings import Base, Config, MutationDraw


@dataclass(frozen=True)
class Shape:
    """Sizes, periods and choices of operators; a static argument of the compiled programs.

    Runs of equal shapes on one task share their programs, whatever their `race.config.hyper.Hyper`
    and seeds. Settings of a run that no program reads are neither here nor there. Without a
    population, what belongs to one is 0 and has no say.
    """

    base: Base
    discrete: bool
    layer_norm: bool
    batch_size: int
    """Samples of a minibatch: transitions, or episodes."""
    policy_delay: int
    """Critic steps per policy step."""
    target_update_every: int
    """Gradient steps between copies of the targets; 0 where they follow at a rate."""
    hidden_sizes: tuple[int, ...]
    """Units of an encoder's layers; the last is the size of an embedding."""
    critic_sizes: tuple[int, int]
    """Units of the hidden layers of critics or utilities."""
    value_sizes: tuple[int, ...]
    """Units of the hidden layers of the state-value net."""
    mixer_size: int
    hypernet_size: int
    population_size: int
    tournament_size: int
    policy_embedding_size: int
    mine_size: int
    mutation_draw: MutationDraw
    elite_copy: bool

    @property
    def embedding_size(self) -> int:
        """Units of an observation embedding."""
        return self.hidden_sizes[-1]


def shape_of(config: Config) -> Shape:
    """The shape of a run of a resolved configuration."""
    assert config.base is not None
    learner, facmac, race = config.learner, config.facmac, config.race
    mixes, evolves = config.base == "facmac", config.has_population
    return Shape(
        base=config.base,
        discrete=config.discrete,
        layer_norm=facmac.layer_norm if config.discrete else learner.layer_norm,
        batch_size=facmac.batch_size if config.discrete else learner.batch_size,
        policy_delay=config.policy_delay,
        target_update_every=facmac.target_update_every if config.discrete else 0,
        hidden_sizes=(facmac.hidden_size,) if config.discrete else learner.hidden_sizes,
        critic_sizes=facmac.utility_sizes if config.discrete else learner.hidden_sizes,
        value_sizes=(facmac.value_size,) if config.discrete else learner.hidden_sizes,
        mixer_size=facmac.mixer_size if mixes else 0,
        hypernet_size=facmac.hypernet_size if mixes else 0,
        population_size=race.population_size if evolves else 0,
        tournament_size=race.tournament_size if evolves else 0,
        policy_embedding_size=race.policy_embedding_size if evolves else 0,
        mine_size=race.mine_size if evolves else 0,
        mutation_draw=race.mutation_draw if evolves else "row",
        elite_copy=race.elite_copy and evolves,
    )

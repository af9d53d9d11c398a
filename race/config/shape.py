"""`Shape`: everything that the form of a compiled program depends on, besides the task."""

from dataclasses import dataclass

from race.config.settings import (
    Base,
    Config,
    Level,
    MineNegatives,
    MutationDraw,
    PevfaTarget,
    Places,
    PolicyEmbedding,
    Selection,
    TeamDraw,
    TeamHeads,
    UtilityEmbedding,
    VmmReduction,
)


@dataclass(frozen=True)
class Shape:
    """Sizes, periods and choices of operators; a static argument of the compiled programs.

    Runs of equal shapes on one task share their programs, whatever their `race.config.hyper.Hyper`
    and seeds. Settings of a run that no program reads are neither here nor there: what belongs to a
    population, a MARL team or an evolution that is not there is 0 or empty.
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
    mine_embedding_layers: int
    mutation_draw: MutationDraw
    elite_copy: bool
    evolution: str
    crossover: Level
    mutation: Level
    selection: Selection
    places: Places
    team_draw: TeamDraw
    teams_per_batch: int
    marl_among_teams: bool
    pevfa_target: PevfaTarget
    policy_embedding: PolicyEmbedding
    utility_embedding: UtilityEmbedding
    vmm_reduction: VmmReduction
    mine_negatives: MineNegatives
    team_heads: TeamHeads
    heads_learn: bool
    """Whether the team of Eq. (2) climbs its value too."""
    one_pevfa: bool
    shared_agents: bool

    @property
    def embedding_size(self) -> int:
        """Units of an observation embedding."""
        return self.hidden_sizes[-1]


def shape_of(config: Config) -> Shape:
    """The shape of a run of a resolved configuration."""
    assert config.base is not None
    learner, facmac, race = config.learner, config.facmac, config.race
    discrete, learns, evolves = config.discrete, config.has_marl, config.has_population
    mixes = learns and config.base == "facmac"
    represents = evolves and not config.whole_teams  # encoders for all teams
    genetic = evolves and race.evolution == "ga"
    twins = config.base == "matd3"
    critic_sizes = facmac.utility_sizes if discrete else learner.hidden_sizes
    value_sizes = (facmac.value_size,) if discrete else learner.hidden_sizes
    return Shape(
        base=config.base,
        discrete=discrete,
        layer_norm=facmac.layer_norm if discrete else learner.layer_norm,
        batch_size=learns * (facmac.batch_size if discrete else learner.batch_size),
        policy_delay=config.policy_delay if learns else 1,
        target_update_every=facmac.target_update_every if discrete and learns else 0,
        hidden_sizes=(facmac.hidden_size,) if discrete else learner.hidden_sizes,
        critic_sizes=critic_sizes if learns else (0, 0),
        value_sizes=value_sizes if represents else (),
        mixer_size=facmac.mixer_size * mixes,
        hypernet_size=facmac.hypernet_size * mixes,
        population_size=race.population_size * evolves,
        tournament_size=race.tournament_size * genetic,
        policy_embedding_size=race.policy_embedding_size * represents,
        mine_size=race.mine_size * represents,
        mine_embedding_layers=race.mine_embedding_layers * represents,
        mutation_draw=race.mutation_draw if genetic and race.mutation_draw else "row",
        elite_copy=race.elite_copy and genetic,
        evolution=race.evolution if evolves else "ga",
        crossover=race.crossover if genetic and race.crossover else "agent",
        mutation=race.mutation if genetic and race.mutation else "agent",
        selection=race.selection if genetic and not config.one_head else "team",
        places=race.places if genetic and not config.one_head else "ranked",
        team_draw=race.team_draw if represents else "once",
        teams_per_batch=race.teams_per_batch * represents,
        marl_among_teams=race.marl_among_teams and represents,
        pevfa_target=race.pevfa_target if represents else "target",
        policy_embedding=race.policy_embedding if represents and twins else "shared",
        utility_embedding=(
            race.utility_embedding if represents and mixes and not config.one_head else "team"
        ),
        vmm_reduction=race.vmm_reduction if represents and discrete else "mean",
        mine_negatives=race.mine_negatives if represents and discrete else "steps",
        team_heads="shared" if config.one_head else "agent",
        heads_learn=race.head_learning_rate > 0 and represents,
        one_pevfa=race.one_pevfa and represents,
        shared_agents=learner.shared_agents and not discrete,
    )

"""Every setting of a run, with the paper's symbol beside it, and the presets.

A `Config` is frozen and passed explicitly. It is written to ``config.json`` at the start of a
run and read back by every other command, so a run directory explains itself.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Literal, get_args, get_origin, get_type_hints

from race.errors import ConfigError

Algo = Literal["race", "matd3", "maddpg"]
Base = Literal["matd3", "maddpg"]
Preset = Literal["paper", "td3", "demo"]


@dataclass(frozen=True)
class LearnerConfig:
    """The gradient learner (MATD3, MADDPG): the same with and without a population."""

    hidden_sizes: tuple[int, int] = (400, 300)
    """Units of the two layers of each encoder and critic (Table 1, Table 2)."""
    batch_size: int = 128
    """Transitions in a minibatch."""
    actor_learning_rate: float = 1e-3
    """Adam step size of the encoders and the MARL team's heads."""
    critic_learning_rate: float = 1e-3
    """Adam step size of the critic, the PeVFA, the state-value net and MINE."""
    gradient_clip: float = 10.0
    """Largest norm of a gradient: of all agents' encoders together, of all heads, of a critic."""
    discount: float = 0.99
    """Discount factor, the paper's gamma."""
    target_update_rate: float = 0.005
    """Share of the online network mixed into its target at each target update (TD3's tau)."""
    policy_delay: int = 2
    """Critic steps per policy, encoder and target step. MADDPG always uses 1."""
    exploration_noise: float = 0.1
    """Standard deviation of the noise on the MARL team's actions, as a share of their range."""
    smoothing_noise: float = 0.2
    """Standard deviation of target policy smoothing. MADDPG uses none."""
    smoothing_clip: float = 0.5
    """Largest smoothing noise."""
    replay_capacity: int = 1_000_000
    """Transitions that the replay buffer holds."""
    random_steps: int = 10_000
    """Environment steps of uniformly random actions before the first generation."""
    gradient_steps_per_env_step: float = 1.0
    """Gradient steps for each environment step collected after the random ones."""


@dataclass(frozen=True)
class RaceConfig:
    """The population, its evolution and the shared encoder's losses (Section 3, Tables 2, 3)."""

    population_size: int = 5
    """Teams of the population, the paper's n."""
    mutation_fraction: float | None = None
    """Share of a picked head's weights that mutate, the paper's alpha. None: Table 3, else 0.5."""
    vmm_weight: float | None = None
    """Weight of Value-Aware MI Maximization, the paper's beta. None: Table 3, else 0.01."""
    mutation_probability: float = 0.9
    """Probability that a team that is not the elite mutates."""
    agent_mutation_probability: float = 0.5
    """Probability that an agent of a mutating team is picked (at least one is)."""
    tournament_size: int = 3
    """Teams from which the second parent is the best."""
    policy_embedding_size: int = 64
    """Units of the policy embedding network (Table 2)."""
    mine_size: int = 128
    """Units of the MINE networks (Appendix A.1)."""


@dataclass(frozen=True)
class EnvConfig:
    """What an agent of a Multi-Agent MuJoCo task observes, and where environments run."""

    agent_obsk: int = 0
    """Observe joints up to this distance; 0 is the agent's own joints only (Section 4.1)."""
    local_categories: tuple[tuple[str, ...], ...] = (("qpos", "qvel"),)
    """What is observed of the joints at each distance 0, 1, ...; the last repeats."""
    global_categories: tuple[str, ...] = ()
    """What is observed of the torso."""
    library_observation: bool = False
    """Use gymnasium-robotics' own default observation instead of the three settings above."""
    processes: bool | None = None
    """Run each environment in a process of its own. None: where it pays (slow physics and
    enough cores)."""


@dataclass(frozen=True)
class EvaluationConfig:
    """Test episodes during training, without exploration noise."""

    every: int = 5_000
    """Environment steps between evaluations (at the next end of a generation)."""
    episodes: int = 10
    """Episodes per team and evaluation."""


@dataclass(frozen=True)
class CheckpointConfig:
    """When the whole state is written to disk."""

    minutes: float = 5.0
    """Wall time between checkpoints; 0 writes one at every opportunity (100 gradient steps)."""
    keep: int = 2
    """Newest checkpoints kept."""


@dataclass(frozen=True)
class Config:
    """A whole run."""

    task: str
    algo: Algo = "race"
    base: Base = "matd3"
    seed: int = 1
    env_steps: int = 1_000_000
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    race: RaceConfig = field(default_factory=RaceConfig)
    env: EnvConfig = field(default_factory=EnvConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)

    @property
    def has_population(self) -> bool:
        """Whether teams evolve beside the MARL team."""
        return self.algo == "race"

    @property
    def method(self) -> str:
        """The method's name as figures show it, such as ``RACE(MATD3)``."""
        return f"RACE({self.base.upper()})" if self.algo == "race" else self.algo.upper()


# Table 3: (alpha, beta) of RACE(MATD3) on Multi-Agent MuJoCo.
TABLE_3: dict[str, tuple[float, float]] = {
    "mamujoco/HalfCheetah-2x3": (0.7, 1e-1),
    "mamujoco/HalfCheetah-6x1": (0.5, 1e-2),
    "mamujoco/Ant-2x4": (0.7, 1e-2),
    "mamujoco/Ant-2x4d": (0.2, 1e-2),
    "mamujoco/Ant-4x2": (0.2, 1e-3),
    "mamujoco/Hopper-3x1": (1.0, 1e-1),
    "mamujoco/Humanoid-9x8": (0.7, 1e-2),
    "mamujoco/HumanoidStandup-9x8": (1.0, 1e-3),
}

# Presets of the gradient learner. "td3": the values of the official TD3 code. "demo": smaller
# networks and fewer random steps, to see a team learn within minutes; not for comparisons.
PRESETS: dict[str, LearnerConfig] = {
    "paper": LearnerConfig(),
    "td3": LearnerConfig(
        batch_size=256,
        actor_learning_rate=3e-4,
        critic_learning_rate=3e-4,
        random_steps=25_000,
    ),
    "demo": LearnerConfig(hidden_sizes=(160, 120), random_steps=3_000),
}


def resolve(config: Config) -> Config:
    """Fills what was left to presets and checks every value.

    ``--algo maddpg`` is the MADDPG learner whatever ``base`` says, and likewise ``matd3``.

    Raises:
        ConfigError: naming the first setting that cannot work, and what would.
    """
    alpha, beta = TABLE_3.get(config.task, (0.5, 1e-2))
    race = config.race
    if race.mutation_fraction is None:
        race = dataclasses.replace(race, mutation_fraction=alpha)
    if race.vmm_weight is None:
        race = dataclasses.replace(race, vmm_weight=beta)
    base: Base = config.base if config.algo == "race" else config.algo
    learner = config.learner
    if base == "maddpg":
        learner = dataclasses.replace(learner, policy_delay=1, smoothing_noise=0.0)
    config = dataclasses.replace(config, race=race, base=base, learner=learner)
    _check(config)
    return config


def _check(config: Config) -> None:
    learner, race = config.learner, config.race
    assert race.mutation_fraction is not None
    assert race.vmm_weight is not None
    rules: list[tuple[bool, str, Any, str]] = [
        (config.env_steps >= 1, "env-steps", config.env_steps, "at least 1"),
        (0 <= config.seed < 2**31, "seed", config.seed, "from 0 to 2147483647"),
        (min(learner.hidden_sizes) >= 1, "learner.hidden-sizes", learner.hidden_sizes, "positive"),
        (learner.batch_size >= 2, "learner.batch-size", learner.batch_size, "at least 2"),
        (
            learner.batch_size <= learner.replay_capacity,
            "learner.batch-size",
            learner.batch_size,
            f"no larger than the replay buffer (learner.replay-capacity {learner.replay_capacity})",
        ),
        (
            max(learner.random_steps, 1) <= learner.replay_capacity,
            "learner.random-steps",
            learner.random_steps,
            f"no larger than the replay buffer (learner.replay-capacity {learner.replay_capacity})",
        ),
        (learner.random_steps >= 0, "learner.random-steps", learner.random_steps, "0 or more"),
        (
            learner.actor_learning_rate > 0,
            "learner.actor-learning-rate",
            learner.actor_learning_rate,
            "above 0",
        ),
        (
            learner.critic_learning_rate > 0,
            "learner.critic-learning-rate",
            learner.critic_learning_rate,
            "above 0",
        ),
        (learner.gradient_clip > 0, "learner.gradient-clip", learner.gradient_clip, "above 0"),
        (0 <= learner.discount < 1, "learner.discount", learner.discount, "in [0, 1)"),
        (
            0 < learner.target_update_rate <= 1,
            "learner.target-update-rate",
            learner.target_update_rate,
            "in (0, 1]",
        ),
        (learner.policy_delay >= 1, "learner.policy-delay", learner.policy_delay, "at least 1"),
        (
            learner.exploration_noise >= 0,
            "learner.exploration-noise",
            learner.exploration_noise,
            "0 or more",
        ),
        (
            learner.smoothing_noise >= 0,
            "learner.smoothing-noise",
            learner.smoothing_noise,
            "0 or more",
        ),
        (
            learner.smoothing_clip >= 0,
            "learner.smoothing-clip",
            learner.smoothing_clip,
            "0 or more",
        ),
        (
            0 < learner.gradient_steps_per_env_step <= 100,
            "learner.gradient-steps-per-env-step",
            learner.gradient_steps_per_env_step,
            "in (0, 100]",
        ),
        (
            race.population_size >= 4,
            "race.population-size",
            race.population_size,
            "at least 4: an elite, a second parent, a team for their offspring and one for the "
            "injected MARL team (for no population use --algo matd3)",
        ),
        (
            0 <= race.mutation_fraction <= 1,
            "race.mutation-fraction",
            race.mutation_fraction,
            "in [0, 1]",
        ),
        (race.vmm_weight >= 0, "race.vmm-weight", race.vmm_weight, "0 or more"),
        (
            0 <= race.mutation_probability <= 1,
            "race.mutation-probability",
            race.mutation_probability,
            "in [0, 1]",
        ),
        (
            0 <= race.agent_mutation_probability <= 1,
            "race.agent-mutation-probability",
            race.agent_mutation_probability,
            "in [0, 1]",
        ),
        (race.tournament_size >= 1, "race.tournament-size", race.tournament_size, "at least 1"),
        (
            race.policy_embedding_size >= 1,
            "race.policy-embedding-size",
            race.policy_embedding_size,
            "at least 1",
        ),
        (race.mine_size >= 1, "race.mine-size", race.mine_size, "at least 1"),
        (config.env.agent_obsk >= 0, "env.agent-obsk", config.env.agent_obsk, "0 or more"),
        (config.evaluation.every >= 1, "evaluation.every", config.evaluation.every, "at least 1"),
        (
            config.evaluation.episodes >= 1,
            "evaluation.episodes",
            config.evaluation.episodes,
            "at least 1",
        ),
        (
            config.checkpoint.minutes >= 0,
            "checkpoint.minutes",
            config.checkpoint.minutes,
            "0 or more",
        ),
        (config.checkpoint.keep >= 1, "checkpoint.keep", config.checkpoint.keep, "at least 1"),
    ]
    for holds, name, value, must in rules:
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"--{name} is {value}, but it must be a finite number.")
        if not holds:
            raise ConfigError(f"--{name} is {value}, but it must be {must}.")


def to_json(config: Any) -> dict[str, Any]:
    """A config as plain JSON values; `from_json` is its inverse."""
    return dataclasses.asdict(config)


def from_json(data: dict[str, Any]) -> Config:
    """Reads back what `to_json` wrote.

    Raises:
        ConfigError: if a field is missing, unknown or of the wrong kind.
    """
    return _build(Config, data)


def _build(cls: Any, data: Any) -> Any:
    hints = get_type_hints(cls)
    names = {f.name for f in dataclasses.fields(cls)}
    if not isinstance(data, dict) or set(data) != names:
        found = sorted(data) if isinstance(data, dict) else data
        raise ConfigError(
            f"The saved configuration does not fit this version of race: {cls.__name__} has the "
            f"fields {sorted(names)}, the file has {found}."
        )
    values = {}
    for name, value in data.items():
        hint = hints[name]
        if dataclasses.is_dataclass(hint):
            values[name] = _build(hint, value)
        elif get_origin(hint) is tuple:
            values[name] = _tuple(value)
        elif get_origin(hint) is Literal and value not in get_args(hint):
            raise ConfigError(f"The saved configuration names {name} {value!r}, unknown here.")
        else:
            values[name] = value
    return cls(**values)


def _tuple(value: Any) -> Any:
    return tuple(_tuple(v) for v in value) if isinstance(value, list) else value

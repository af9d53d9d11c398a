"""Presets: the paper's alpha and beta per task, sets of learner settings, and filling them in."""

import dataclasses

from race.checks import check
from race.config import Base, Config, LearnerConfig

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
    if config.task.startswith("mamujoco/"):
        # The library spells partitions of Humanoid with a bar, the paper's tasks with an x.
        config = dataclasses.replace(config, task=config.task.replace("|", "x"))
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
    check(config)
    return config

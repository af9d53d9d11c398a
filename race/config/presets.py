"""Presets: the paper's alpha and beta per task, sets of learner settings, and filling them in."""

import dataclasses
from typing import Any

from race.config.checks import check
from race.config.settings import Base, Config, LearnerConfig, ReplayPrecision

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

# Table 4: (alpha, beta) of RACE(FACMAC) on StarCraft micromanagement.
TABLE_4: dict[str, tuple[float, float]] = {
    "micro/so_many_baneling": (0.1, 1e-3),
    "micro/2s3z": (0.05, 1e-3),
    "micro/2c_vs_64zg": (0.05, 1e-2),
    "micro/2s_vs_1sc": (0.05, 1e-2),
    "micro/MMM": (0.05, 1e-1),
    "micro/MMM2": (0.01, 1e-2),
    "micro/3s5z": (0.005, 1e-3),
    "micro/3s_vs_3z": (0.005, 1e-3),
}
TABLES = {**TABLE_3, **TABLE_4}

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


def resolve(config: Config, discrete: bool | None = None) -> Config:
    """Fills what was left to presets and checks every value.

    ``--algo maddpg`` is the MADDPG learner whatever ``base`` says, and likewise the others.

    Args:
        config: what was asked for.
        discrete: whether the task has discrete actions. None: what the config says.

    Raises:
        ConfigError: naming the first setting that cannot work, and what would.
    """
    config = filled(config, discrete)
    check(config)
    return config


def filled(config: Config, discrete: bool | None = None) -> Config:
    """What was left to presets filled in, whether it can work or not."""
    discrete = config.discrete if discrete is None else discrete
    if config.task.startswith("mamujoco/"):
        # The library spells partitions of Humanoid with a bar, the paper's tasks with an x.
        config = dataclasses.replace(config, task=config.task.replace("|", "x"))
    alpha, beta = TABLES.get(config.task, (0.05 if discrete else 0.5, 1e-2))
    race, whole = config.race, config.algo in ("merl", "ea")
    if whole:  # the genetic algorithm of Khadka and Tumer (2018)
        alpha = 0.1
    one_head = dataclasses.replace(config, discrete=discrete).one_head
    operators: dict[str, Any] = {
        "crossover": "layer" if whole else "parameter" if one_head else "agent",
        "mutation": "layer" if whole else "agent",
        "mutation_draw": "weight" if whole else "row",
    }
    unset = {name: value for name, value in operators.items() if getattr(race, name) is None}
    race = dataclasses.replace(race, **unset)
    if race.mutation_fraction is None:
        race = dataclasses.replace(race, mutation_fraction=alpha)
    if race.vmm_weight is None:
        race = dataclasses.replace(race, vmm_weight=beta)
    evaluation = config.evaluation
    if evaluation.every is None:
        evaluation = dataclasses.replace(evaluation, every=10_000 if discrete else 5_000)
    if evaluation.episodes is None:
        evaluation = dataclasses.replace(evaluation, episodes=32 if discrete else 10)
    base: Base = _usual_base(discrete)
    if config.algo == "race" or config.algo == "merl":
        base = config.base or base
    elif config.algo != "ea":
        base = config.algo
    facmac = config.facmac
    if facmac.replay_precision is None:
        precision: ReplayPrecision = "float16" if config.task.startswith("micro/") else "float32"
        facmac = dataclasses.replace(facmac, replay_precision=precision)
    learner = config.learner
    if base != "matd3":
        learner = dataclasses.replace(learner, policy_delay=1, smoothing_noise=0.0)
    return dataclasses.replace(
        config,
        race=race,
        base=base,
        discrete=discrete,
        learner=learner,
        facmac=facmac,
        evaluation=evaluation,
    )


def _usual_base(discrete: bool) -> Base:
    return "facmac" if discrete else "matd3"

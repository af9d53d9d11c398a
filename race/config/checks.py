"""Whether the values of settings can work; `race.config.rules` says of each what it must be."""

import math
from collections.abc import Iterable

from race.config.rules import LARGEST_LAYER, Rule, environments, learners, numbers, population
from race.config.settings import Config, EnvConfig
from race.errors import ConfigError

MOST_KEPT = 1000
"""Best teams of a run."""


def check(config: Config) -> None:
    """Checks every value of a configuration whose presets are filled in.

    Raises:
        ConfigError: naming the first setting that cannot work, and what would.
    """
    if config.discrete and config.base != "facmac":
        raise ConfigError(
            f"{config.method} does not work on {config.task}: its actions are discrete, which "
            "facmac alone learns to choose. Use --algo facmac, or --algo race with --base facmac."
        )
    _refuse(
        [
            *_of_all(config),
            *learners.rules(config),
            *population.rules(config),
            *environments.rules(config.env),
            *_of_runs(config),
            *numbers.rules(config),
        ]
    )


def check_env(env: EnvConfig) -> None:
    """Checks the settings of environments, before any is made.

    Raises:
        ConfigError: naming the first setting that cannot work, and what would.
    """
    _refuse(environments.rules(env))


def _of_all(config: Config) -> list[Rule]:
    learner, race, facmac = config.learner, config.race, config.facmac
    assert config.evaluation.episodes is not None
    return [
        (1 <= config.env_steps < 2**31, "env-steps", config.env_steps, "from 1 to 2147483647"),
        (
            config.discrete or not config.has_marl or config.env_steps > learner.random_steps,
            "env-steps",
            config.env_steps,
            f"more than the random steps before training (learner.random-steps "
            f"{learner.random_steps})",
        ),
        (0 <= config.seed < 2**31, "seed", config.seed, "from 0 to 2147483647"),
        *(
            (size <= LARGEST_LAYER, f"{name}", size, f"at most {LARGEST_LAYER}")
            for name, size in (
                ("learner.hidden-sizes", max(learner.hidden_sizes)),
                ("learner.batch-size", learner.batch_size),
                ("facmac.mixer-size", facmac.mixer_size),
                ("facmac.hypernet-size", facmac.hypernet_size),
                ("facmac.hidden-size", facmac.hidden_size),
                ("facmac.utility-sizes", max(facmac.utility_sizes)),
                ("facmac.value-size", facmac.value_size),
                ("facmac.batch-size", facmac.batch_size),
                ("race.policy-embedding-size", race.policy_embedding_size),
                ("race.mine-size", race.mine_size),
                ("race.population-size", race.population_size),
                ("evaluation.episodes", config.evaluation.episodes),
            )
        ),
    ]


def _of_runs(config: Config) -> list[Rule]:
    assert config.evaluation.every is not None
    assert config.evaluation.episodes is not None
    return [
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
        (
            0 <= config.checkpoint.keep_best <= MOST_KEPT,
            "checkpoint.keep-best",
            config.checkpoint.keep_best,
            f"from 0 to {MOST_KEPT}",
        ),
    ]


def _refuse(rules: Iterable[Rule]) -> None:
    for holds, name, value, must in rules:
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"--{name} is {value}, but it must be a finite number.")
        if not holds:
            raise ConfigError(f"--{name} is {value}, but it must be {must}.")

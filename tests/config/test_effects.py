"""Settings without effect are refused, and no others."""

import dataclasses
from typing import Any

import pytest

from race.config.effects import Facts, refuse_without_effect
from race.config.hyper import hyper_of
from race.config.presets import PRESETS, resolve
from race.config.settings import Config, EnvConfig, FacmacConfig, LearnerConfig, RaceConfig
from race.config.shape import shape_of
from race.errors import ConfigError

METHODS: list[tuple[dict[str, Any], bool]] = [
    *(({"algo": "race", "base": base}, False) for base in ("matd3", "maddpg", "facmac")),
    *(({"algo": algo}, False) for algo in ("matd3", "maddpg", "facmac", "ea", "merl")),
    *(({"algo": algo}, True) for algo in ("facmac", "race", "ea", "merl")),
    ({"algo": "merl", "base": "facmac"}, False),
    *(({"race": RaceConfig(evolution=name)}, True) for name in ("cem", "es", "own:operator")),
    *(({"race": RaceConfig(sharing=False)}, discrete) for discrete in (False, True)),
    ({"race": RaceConfig(team_heads="shared")}, True),
]
ON_HOST = {
    False: {
        *("exploration_noise", "replay_capacity", "random_steps", "gradient_steps_per_env_step"),
        "random_steps_owed",
    },
    True: {
        *("replay_capacity", "replay_precision", "gradient_steps_per_episode"),
        *("epsilon_start", "epsilon_finish", "epsilon_steps"),
    },
}
OTHER: dict[str, Any] = {
    **{"replay_precision": "float16", "mutation_draw": "row"},
    **{"mutation_fraction": 0.25, "vmm_weight": 0.03, "encoder_learning_rate": 0.02},
    **{"crossover": "parameter", "mutation": "parameter", "selection": "agent"},
    "places": "agent",
    **{"team_draw": "each", "evolution": "another:operator"},
    **{"pevfa_target": "online", "policy_embedding": "each", "surrogate_probability": 0.5},
    **{"own_share": 0.5, "replayed": "better", "learn_after": "episode"},
    **{"utility_embedding": "agent", "vmm_reduction": "sum", "mine_negatives": "episodes"},
    **{"population_actions": "sampled", "team_heads": "shared"},
    "head_learning_rate": 1e-3,
}
SETTINGS = [
    (group, field.name)
    for group, kind in (("learner", LearnerConfig), ("facmac", FacmacConfig), ("race", RaceConfig))
    for field in dataclasses.fields(kind)
]


def other(name: str, value: Any) -> Any:
    if name in OTHER:
        return OTHER[name]
    if isinstance(value, bool):
        return not value
    if isinstance(value, tuple):
        return tuple(size + 1 for size in value)
    return value + 1 if isinstance(value, int) else value / 2


def refused(config: Config, **facts: bool) -> str:
    defaults = {"discrete": False, "reads_env": True, "on_host": True}
    try:
        refuse_without_effect(config, PRESETS["paper"], Facts(**(defaults | facts)))
    except ConfigError as error:
        return str(error)
    return ""


def read_on_host(config: Config, group: str, name: str) -> bool:
    """Settings that neither `Shape` nor `Hyper` shows."""
    if group == "race":
        if name == "population_actions":
            return config.has_population and config.discrete
        if name == "fitness_episodes":
            return config.has_population
        if name == "fitness_generations":
            return config.has_population and config.race.evolution not in ("cem", "es")
        beside = config.has_population and config.has_marl
        return beside and (
            name in ("marl_episodes", "evolution_from", "replayed", "learn_after")
            or (name == "surrogate_probability" and not (config.discrete or config.whole_teams))
        )
    mine = group == ("facmac" if config.discrete else "learner")
    return mine and (
        (config.has_marl and name in ON_HOST[config.discrete]) or name == "replay_precision"
    )


@pytest.mark.parametrize(("method", "discrete"), METHODS)
def test_a_setting_is_refused_exactly_if_nothing_reads_it(
    method: dict[str, Any], discrete: bool
) -> None:
    plain = Config("some-task", **method)
    resolved = resolve(plain, discrete=discrete)
    assert refused(plain, discrete=discrete) == ""
    for group, name in SETTINGS:
        settings = getattr(plain, group)
        value = other(name, getattr(settings, name))
        if name == "mutation_draw":  # methods differ in what they do where nothing is said
            value = "row" if resolved.race.mutation_draw == "weight" else "weight"
        if (resolved.one_head, name) == (True, "crossover"):  # parameter is what it is
            value = "layer"
        if value == "shared" == getattr(settings, name):
            value = "agent"
        assert value != getattr(settings, name)
        changed = dataclasses.replace(
            plain, **{group: dataclasses.replace(settings, **{name: value})}
        )
        try:
            new = resolve(changed, discrete=discrete)
        except ConfigError:  # refused as what it is
            assert name == "shared_agents"
            continue
        read = (shape_of(new), str(hyper_of(new))) != (shape_of(resolved), str(hyper_of(resolved)))
        read |= read_on_host(resolved, group, name)
        told = refused(changed, discrete=discrete)
        option = f"--{group}.{name.replace('_', '-')} would have no effect"
        assert (option in told) == (not read), (group, name, told)


@pytest.mark.parametrize(
    ("env", "facts", "told"),
    [
        ({"agent_obsk": 1}, {"reads_env": False}, "--env.agent-obsk would have no effect"),
        (
            {"agent_obsk": 1, "library_observation": True},
            {},
            "--env.agent-obsk would have no effect with --env.library-observation",
        ),
        ({"agent_obsk": 1}, {}, ""),
        ({"library_observation": True}, {}, ""),
        ({"processes": False}, {"on_host": False}, "--env.processes would have no effect"),
        ({"retries": 0, "step_seconds": 3.0}, {"on_host": False}, "--env.retries and --env.step-"),
        ({"retries": 0, "step_seconds": 3.0}, {}, ""),
    ],
)
def test_settings_of_environments(env: dict[str, Any], facts: dict[str, bool], told: str) -> None:
    found = refused(Config("some-task", env=EnvConfig(**env)), **facts)
    assert told in found
    assert bool(told) == bool(found)


def test_a_base_beside_another_algorithm_is_refused() -> None:
    assert "--base would have no effect with --algo matd3" in refused(
        Config("some-task", algo="matd3", base="maddpg")
    )
    assert refused(Config("some-task", algo="matd3", base="matd3")) == ""
    assert "--base would have no effect with --algo ea" in refused(
        Config("some-task", algo="ea", base="maddpg")
    )


def test_presets_are_no_wish_of_the_users() -> None:
    config = Config("some-task", algo="maddpg", learner=PRESETS["td3"])
    task = Facts(discrete=False, reads_env=True, on_host=True)
    refuse_without_effect(config, PRESETS["td3"], task)

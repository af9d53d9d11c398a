"""Configurations as JSON: written beside a run, and read back, older ones too."""

import dataclasses
from collections.abc import Mapping
from types import UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin, get_type_hints

from race.config.compute import ComputeConfig
from race.config.settings import Config, FacmacConfig
from race.errors import ConfigError


def to_json(config: Any) -> dict[str, Any]:
    """A config as plain JSON values; `from_json` is its inverse."""
    return dataclasses.asdict(config)


def flat(values: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Settings by names such as ``race.evolution``, from groups of them as `to_json` gives them."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        within = isinstance(value, Mapping)
        found |= flat(value, f"{before}{name}.") if within else {f"{before}{name}": value}
    return found


# Settings that runs of older versions do not have in their files, and what these runs did.
_BEFORE: dict[str, Any] = {
    "facmac": FacmacConfig(layer_norm=False),
    "discrete": False,
    "layer_norm": False,
    "mutation_draw": "weight",
    "elite_copy": False,
    "retries": 3,
    "step_seconds": None,
    "vfm_marl_weight": 1.0,
    "vfm_team_weight": 1.0,
    "head_learning_rate": 0.0,
    "value_awareness": 1.0,
    "crossover_probability": 1.0,
    "injection_probability": 1.0,
    "strong_share": 0.05,
    "reset_share": 0.05,
    "strong_strength": 10.0,
    "mild_strength": 0.1,
    "largest_weight": 10.0,
    "ablation": (),
    "shared_agents": False,
    "last_layer_scale": 1.0,
    "encoder_learning_rate": None,
    "crossover": "agent",
    "mutation": "agent",
    "selection": "team",
    "places": "ranked",
    "team_draw": "once",
    "teams_per_batch": 1,
    "marl_among_teams": False,
    "pevfa_target": "target",
    "fitness_episodes": 1,
    "fitness_generations": 1,
    "surrogate_probability": 0.0,
    "surrogate_steps": 200,
    "policy_embedding": "shared",
    "utility_embedding": "team",
    "vmm_reduction": "mean",
    "mine_negatives": "steps",
    "mine_embedding_layers": 1,
    "population_actions": "greedy",
    "team_heads": "agent",
    "one_pevfa": False,
    "sharing": True,
    "evolution": "ga",
    "cem_elite_share": 0.5,
    "cem_noise_start": 1e-3,
    "cem_noise_end": 1e-5,
    "cem_noise_decay": 0.95,
    "es_noise": 0.05,
    "es_learning_rate": 0.02,
    "marl_episodes": 1,
    "evolution_from": 0,
    "own_share": None,
    "replayed": "all",
    "learn_after": "generation",
    "random_steps_owed": False,
    "compute": ComputeConfig(),
    "keep_best": 0,
    "init_from": None,
    "kwargs": "{}",
    "python": None,
    "agents": "*",
    "others": "random",
    "team_reward": "mean",
    "state": "auto",
    "episode_limit": None,
    "largest_observation": 4096,
    "reward_scale": 1.0,
    "normalise": False,
}


def from_json(data: dict[str, Any]) -> Config:
    """Reads back what `to_json` wrote, also that of an older version.

    Raises:
        ConfigError: if a field is missing, unknown or of the wrong kind.
    """
    return _build(Config, data)


def _build(cls: Any, data: Any) -> Any:
    hints = get_type_hints(cls)
    names = {f.name for f in dataclasses.fields(cls)}
    if not isinstance(data, dict) or set(data) | (set(_BEFORE) & names) != names:
        found = sorted(data) if isinstance(data, dict) else data
        raise ConfigError(
            f"The saved configuration does not fit this version of race: {cls.__name__} has the "
            f"fields {sorted(names)}, the file has {found}."
        )
    values = {name: value for name, value in _BEFORE.items() if name in names}
    for name, value in data.items():
        if dataclasses.is_dataclass(hints[name]):
            values[name] = _build(hints[name], value)
            continue
        values[name] = tupled(value)
        if not fits(values[name], hints[name]):
            raise ConfigError(
                f"The saved configuration has {name} {value!r}, which is not what this version of "
                "race understands by it."
            )
    return cls(**values)


def tupled(value: Any) -> Any:
    """Lists as tuples, also within lists."""
    return tuple(tupled(v) for v in value) if isinstance(value, list) else value


def fits(value: Any, hint: Any) -> bool:
    """Whether a value is of a field's type; a whole number is a float, too."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return value in arguments
    if origin in (UnionType, Union):
        return any(fits(value, argument) for argument in arguments)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        items = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        return len(items) == len(value) and all(map(fits, value, items))
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is (hint or type(None))


def told(hint: Any) -> str:
    """What values `fits` takes for a type, in words."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return f"one of {', '.join(map(repr, arguments))}"
    if origin in (UnionType, Union):
        return " or ".join(map(told, arguments))
    if origin is tuple and arguments[-1] is Ellipsis:
        return f"a list, each of it {told(arguments[0])}"
    if origin is tuple:
        return f"a list of {len(arguments)}: {', '.join(map(told, arguments))}"
    return _WORDS.get(hint, "None")


_WORDS: Final = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}

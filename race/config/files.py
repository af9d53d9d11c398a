"""The settings of one run from a file: a TOML by hand, or the ``config.json`` of a run.

A run's ``config.json`` holds every setting with its value. Read back, only what differs from what
presets would fill in counts as asked for; so that with other options on top (another method,
another task) the rest is again what it usually is.
"""

import dataclasses
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np

from race.config.ablations import ABLATIONS, ablated
from race.config.effects import setting
from race.config.grid import GROUPS, TOP, exact, refuse_unknown
from race.config.presets import PRESETS, filled
from race.config.saved import fits, from_json, told, tupled
from race.config.settings import Config, LearnerConfig, Preset
from race.errors import ConfigError

_ALONE = ("preset", "ablation")
_OF_ONE = ("seed", "init_from")  # a sweep has no such


class Wanted(NamedTuple):
    """What a person asks for, before presets and ablations are filled in."""

    settings: dict[str, Any]
    """By their names, such as ``learner.batch_size``; without ``preset`` and ``ablation``."""
    preset: str = "paper"
    ablation: tuple[str, ...] = ()

    @property
    def config(self) -> Config:
        """As a configuration, all else as it usually is."""
        return with_settings(
            Config(self.settings.get("task", ""), learner=PRESETS[self.preset]), self.settings
        )


def with_settings(config: Config, settings: Mapping[str, Any]) -> Config:
    """A configuration with some settings changed, by their names."""
    groups: dict[str, dict[str, Any]] = {}
    for name, value in settings.items():
        group, _, field = name.rpartition(".")
        groups.setdefault(group, {})[field] = value
    top = groups.pop("", {})
    changed = {
        group: dataclasses.replace(getattr(config, group), **values)
        for group, values in groups.items()
    }
    return dataclasses.replace(config, **top, **changed)


def read_wanted(file: Path) -> Wanted:
    """What a file asks for.

    Args:
        file: a TOML with the names of `race train`'s settings, groups as tables; or the
            ``config.json`` of a run.

    Raises:
        ConfigError: if it cannot be read, or names what there is not.
    """
    try:
        text = file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file} cannot be read: {error}.") from error
    try:
        if file.suffix.lower() == ".json":
            record = json.loads(text)
            if not isinstance(record, dict):
                raise ConfigError("it is no object")
            for name in ("run", "digest"):
                record.pop(name, None)
            return of_record(from_json(record))
        return of_mapping(tomllib.loads(text))
    except (ValueError, RecursionError) as error:
        kind = "JSON" if file.suffix.lower() == ".json" else "TOML"
        raise ConfigError(f"{file} is no {kind}: {error}.") from error
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from error


def of_mapping(description: Mapping[str, Any]) -> Wanted:
    """What a table asks for: settings by their names, groups as tables in it or as dataclasses.

    Raises:
        ConfigError: naming what is not understood.
    """
    for name in ("seeds", "sweep"):
        if name in description:
            raise ConfigError(f"{name} is for several runs, which `race sweep` trains.")
    refuse_unknown("", dict(description), (*TOP, *_OF_ONE, *_ALONE, *GROUPS))
    hints = get_type_hints(Config)
    settings: dict[str, Any] = {}
    for name in (*TOP, *_OF_ONE):
        if name in description:
            settings[name] = _value(name, description[name], hints[name])
    for group in GROUPS:
        of_group = get_type_hints(hints[group])
        table = description.get(group, {})
        if isinstance(table, hints[group]):
            default = hints[group]()
            every = {f.name: getattr(table, f.name) for f in dataclasses.fields(table)}
            table = {n: value for n, value in every.items() if value != getattr(default, n)}
        refuse_unknown(group, table, tuple(of_group))
        for name, value in table.items():
            settings[f"{group}.{name}"] = _value(f"{group}.{name}", value, of_group[name])
    preset, ablation = description.get("preset", "paper"), description.get("ablation", ())
    if preset not in get_args(Preset):
        raise ConfigError(f"There is no preset {preset!r}; there are {', '.join(PRESETS)}.")
    if not isinstance(ablation, str | list | tuple):
        raise ConfigError(f"ablation is {ablation!r}, but must be a name or several.")
    ablation = (ablation,) if isinstance(ablation, str) else tuple(ablation)
    for name in ablation:
        if name not in tuple(ABLATIONS):
            raise ConfigError(f"There is no ablation {name!r}; there are {', '.join(ABLATIONS)}.")
    return Wanted(settings, preset, ablation)


def _value(name: str, value: Any, hint: Any) -> Any:
    alone = tupled(list(value) if isinstance(value, tuple) else value)
    if isinstance(alone, np.generic):
        alone = alone.item()
    if not fits(alone, hint):
        raise ConfigError(f"{name} is {value!r}, but must be {told(hint)}.")
    return exact(alone, hint)


def of_record(config: Config) -> Wanted:
    """What to ask for to get a configuration whose presets have been filled in.

    Args:
        config: as `race.config.presets.resolve` made it.
    """
    discrete = config.discrete
    presets = ["paper"] if discrete else list(PRESETS)
    found = [_differing(config, preset) for preset in presets]
    preset, settings = min(zip(presets, found, strict=True), key=lambda pair: len(pair[1]))
    kept = {"task": config.task, "algo": config.algo, "seed": config.seed}
    kept |= {"env_steps": config.env_steps}
    kept |= {} if config.init_from is None else {"init_from": config.init_from}
    return Wanted({**kept, **settings}, preset, config.ablation)


def _differing(config: Config, preset: str) -> dict[str, Any]:
    """The settings of a configuration that a preset alone would not give it."""
    learner: LearnerConfig = PRESETS[preset]
    plain = Config(config.task, algo=config.algo, learner=learner)
    expected = filled(ablated(plain, config.ablation, config.discrete), config.discrete)
    names = ["base", *(f"{group}.{f.name}" for group in GROUPS for f in _fields(group))]
    return {
        name: setting(config, name)
        for name in names
        if setting(config, name) != setting(expected, name)
    }


def _fields(group: str) -> Any:
    return dataclasses.fields(get_type_hints(Config)[group])

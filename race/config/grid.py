"""Many settings from one description: lists and ranges of values, combined or drawn.

A description is what a TOML file holds: the settings of a run by their names, ``learner`` and the
like as tables. Where a value is a list of values, each is an alternative.
"""

import dataclasses
import difflib
import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, get_type_hints

import numpy as np

from race.config.ablations import ABLATIONS
from race.config.presets import PRESETS
from race.config.saved import fits, from_json, to_json, told, tupled
from race.config.seeds import parse_seeds
from race.config.settings import Config
from race.errors import ConfigError

GROUPS = ("learner", "facmac", "race", "env", "evaluation", "checkpoint", "compute")
TOP = ("task", "algo", "base", "env_steps")
MOST_RUNS = 10_000


class Range(NamedTuple):
    """Numbers to draw from, evenly in themselves or in their logarithms."""

    low: float
    high: float
    logarithmic: bool
    whole: bool

    def draw(self, generator: np.random.Generator) -> float | int:
        """A number of the range; of whole ones both ends are in it."""
        if self.whole:
            return int(generator.integers(int(self.low), int(self.high) + 1))
        if self.logarithmic:
            return math.exp(generator.uniform(math.log(self.low), math.log(self.high)))
        return float(generator.uniform(self.low, self.high))


class Axis(NamedTuple):
    """A setting and what it may be."""

    name: str  # with its group, such as learner.actor_learning_rate
    choices: tuple[Any, ...] | Range


class Point(NamedTuple):
    """One combination: what a person would ask for, and what tells it from the others."""

    asked: Config
    preset: str
    ablation: tuple[str, ...]
    varied: dict[str, Any]


class Grid(NamedTuple):
    """What a description says."""

    axes: tuple[Axis, ...]
    seeds: tuple[int, ...]
    draws: int | None
    """Combinations to draw at random; None: all there are."""
    draw_seed: int


def read_grid(description: Mapping[str, Any]) -> Grid:
    """The axes of a description.

    Raises:
        ConfigError: naming what is not understood.
    """
    rest = dict(description)
    sweep = rest.pop("sweep", {})
    refuse_unknown("sweep", sweep, ("draws", "seed"))
    draws, draw_seed = sweep.get("draws"), sweep.get("seed", 0)
    for name, value in (("draws", draws), ("seed", draw_seed)):
        if value is not None and not (type(value) is int and value >= (name == "draws")):
            raise ConfigError(f"sweep.{name} is {value!r}, but must be a whole number.")
    seeds = _seeds(rest.pop("seeds", [1]))
    known = (*TOP, *GROUPS, "preset", "ablation")
    refuse_unknown("", rest, known)
    if "task" not in rest:
        raise ConfigError('The file names no task, such as task = "probe/target".')
    hints = get_type_hints(Config)
    axes = [_axis(name, rest[name], hints[name], draws) for name in TOP if name in rest]
    axes += [_axis("preset", rest["preset"], str, draws)] if "preset" in rest else []
    if "ablation" in rest:
        axes.append(Axis("ablation", _ablations(rest["ablation"])))
    for group in GROUPS:
        settings = rest.get(group, {})
        of_group = get_type_hints(hints[group])
        refuse_unknown(group, settings, tuple(of_group))
        axes += [_axis(f"{group}.{n}", v, of_group[n], draws) for n, v in settings.items()]
    return Grid(tuple(axes), seeds, draws, draw_seed)


def points(grid: Grid) -> list[Point]:
    """All combinations, or as many as are to be drawn; seeds apart.

    Raises:
        ConfigError: if there are too many, or fewer than are to be drawn.
    """
    found = list(_drawn(grid) if grid.draws else itertools.product(*_choices(grid)))
    if len(found) * len(grid.seeds) > MOST_RUNS:
        raise ConfigError(
            f"That would be {len(found) * len(grid.seeds):,} runs; at most {MOST_RUNS:,} are made. "
            "Draw some of them: [sweep] draws = 20."
        )
    varying = [len(set(map(repr, values))) > 1 for values in zip(*found, strict=True)]
    return [_point(grid, values, varying) for values in found]


def _choices(grid: Grid) -> list[tuple[Any, ...]]:
    return [axis.choices for axis in grid.axes if not isinstance(axis.choices, Range)]


def _drawn(grid: Grid) -> Iterator[tuple[Any, ...]]:
    assert grid.draws is not None
    generator = np.random.default_rng(grid.draw_seed)
    finite = not any(isinstance(axis.choices, Range) for axis in grid.axes)
    if finite:
        every = math.prod(len(choices) for choices in _choices(grid))
        if grid.draws > every:
            raise ConfigError(
                f"sweep.draws is {grid.draws}, but there are {every} combinations. Leave it out to "
                "take all."
            )
        if every <= MOST_RUNS:
            combinations = list(itertools.product(*_choices(grid)))
            for i in sorted(generator.choice(every, grid.draws, replace=False).tolist()):
                yield combinations[i]
            return
    for _ in range(grid.draws):
        yield tuple(
            axis.choices.draw(generator)
            if isinstance(axis.choices, Range)
            else axis.choices[int(generator.integers(len(axis.choices)))]
            for axis in grid.axes
        )


def _point(grid: Grid, values: tuple[Any, ...], varying: list[bool]) -> Point:
    chosen = {axis.name: value for axis, value in zip(grid.axes, values, strict=True)}
    preset, ablation = chosen.pop("preset", "paper"), chosen.pop("ablation", ())
    if preset not in PRESETS:
        raise ConfigError(f"There is no preset {preset!r}; there are {', '.join(PRESETS)}.")
    data = to_json(Config(task=chosen["task"], learner=PRESETS[preset]))
    for name, value in chosen.items():
        group, dot, setting = name.partition(".")
        if dot:
            data[group][setting] = value
        else:
            data[name] = value
    varied = {
        axis.name: value
        for axis, value, varies in zip(grid.axes, values, varying, strict=True)
        if varies
    }
    return Point(from_json(data), preset, ablation, varied)


def _axis(name: str, value: Any, hint: Any, draws: int | None) -> Axis:
    if isinstance(value, dict):
        return Axis(name, _range(name, value, hint, draws))
    alone = tupled(value)
    if fits(alone, hint):
        return Axis(name, (exact(alone, hint),))
    if isinstance(value, list) and value:
        choices = tuple(map(tupled, value))
        for choice in choices:
            if not fits(choice, hint):
                raise ConfigError(
                    f"{name} has {choice!r} among its values, but each must be {told(hint)}."
                )
        if len(set(map(repr, choices))) < len(choices):
            raise ConfigError(f"{name} names a value twice: {value!r}.")
        return Axis(name, tuple(exact(choice, hint) for choice in choices))
    raise ConfigError(f"{name} is {value!r}, but must be {told(hint)}, or a list of such.")


def exact(value: Any, hint: Any) -> Any:
    """A whole number where a float is meant is one."""
    return float(value) if hint is float else value


def _range(name: str, value: dict[str, Any], hint: Any, draws: int | None) -> Range:
    refuse_unknown(name, value, ("from", "to", "scale"))
    low, high, scale = value.get("from"), value.get("to"), value.get("scale", "linear")
    numbers = all(type(v) in (int, float) for v in (low, high))
    if not numbers or not low < high or scale not in ("linear", "log"):  # type: ignore[operator]
        raise ConfigError(
            f"{name} is {value!r}; a range is written as {{ from = 1e-4, to = 1e-2 }}, with "
            'scale = "log" if it is to be drawn evenly in its logarithm.'
        )
    assert low is not None
    assert high is not None
    if scale == "log" and low <= 0:
        raise ConfigError(f'{name}: a range with scale = "log" begins above 0, not at {low}.')
    whole = not fits(0.5, hint)
    if not fits(1 if whole else 0.5, hint):
        raise ConfigError(f"{name} is no number, so it has no range.")
    if draws is None:
        raise ConfigError(f"{name} is a range; say how many to draw: [sweep] draws = 20.")
    return Range(low, high, scale == "log", whole)


def _ablations(value: Any) -> tuple[tuple[str, ...], ...]:
    """``"a"``, ``["", "a", "b"]`` (alternatives) or ``[["a", "b"], "c"]`` (two at once)."""
    alternatives = value if isinstance(value, list) else [value]
    found = []
    for one in alternatives:
        names = one if isinstance(one, list) else [one] if one else []
        if not all(isinstance(name, str) for name in names):
            raise ConfigError(f"ablation is {value!r}, but names are texts.")
        for name in set(names) - set(ABLATIONS):
            raise ConfigError(f"There is no ablation {name!r}; there are {', '.join(ABLATIONS)}.")
        found.append(tuple(names))
    return tuple(found)


def _seeds(value: Any) -> tuple[int, ...]:
    if isinstance(value, str):
        return tuple(parse_seeds(value))
    seeds = value if isinstance(value, list) else [value]
    right = all(type(seed) is int and 0 <= seed < 2**31 for seed in seeds)
    if not seeds or not right or len(set(seeds)) < len(seeds):
        raise ConfigError(f'seeds is {value!r}, but must be like "1-5" or [1, 4, 7].')
    return tuple(seeds)


def refuse_unknown(group: str, settings: Any, known: tuple[str, ...]) -> None:
    """Refuses a table with other settings than the known ones.

    Raises:
        ConfigError: naming the first, and what it may have been meant to be.
    """
    if not isinstance(settings, dict):
        raise ConfigError(f"{group} is {settings!r}, but must be a table: [{group}].")
    for name in settings:
        if name not in known:
            near = difflib.get_close_matches(name.replace("-", "_"), known, n=1)
            hint = f" Did you mean {near[0]}?" if near else f" It may be one of {', '.join(known)}."
            raise ConfigError(f"There is no setting {f'{group}.' if group else ''}{name}.{hint}")


def with_seed(config: Config, seed: int) -> Config:
    """The same with another seed."""
    return dataclasses.replace(config, seed=seed)

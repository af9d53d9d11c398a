"""Numbers of a configuration that programs can compute with: those of 32 bits."""

import dataclasses
from collections.abc import Iterator
from typing import Any

from race.config.rules import Rule
from race.config.settings import Config

MOST = 2**31 - 1
"""Largest whole number of a program."""
MOST_NOISE = 1000.0
"""Standard deviations of noise, in units of half an action's range, which clips what is beyond."""


def rules(config: Config) -> Iterator[Rule]:
    """For each number whether programs can hold it, its name and value, and what it must be."""
    for name, value in _leaves(config, ""):
        if type(value) is int:
            yield abs(value) <= MOST, name, value, f"at most {MOST}"
        elif type(value) is float:
            fits = value == 0 or 1e-37 <= abs(value) <= 1e38
            yield fits, name, value, "0, or between 1e-37 and 1e38: 32 bits hold no other number"
    learner = config.learner
    for name in ("exploration_noise", "smoothing_noise", "smoothing_clip"):
        noise = getattr(learner, name)
        option = f"learner.{name.replace('_', '-')}"
        yield noise <= MOST_NOISE, option, noise, f"at most {MOST_NOISE:g}: 1 is half the range"
    for group in ("learner", "facmac"):
        discount = getattr(config, group).discount
        told = "so far below 1 that 32 bits tell the two apart (at most 0.9999999)"
        yield discount <= 0.9999999, f"{group}.discount", discount, told


def _leaves(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            option = field.name.replace("_", "-")
            yield from _leaves(getattr(value, field.name), f"{name}.{option}" if name else option)
    elif isinstance(value, tuple):
        for entry in value:
            yield from _leaves(entry, name)
    else:
        yield name, value

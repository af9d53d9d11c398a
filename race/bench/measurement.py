"""What a measurement is, and how times are taken on a machine that does other things too."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax


class Measurement(NamedTuple):
    """A number with its unit and, where there is one, the value that is good enough.

    Rates, whose unit is ``1/s``, should reach their goal; all else should not exceed it.
    """

    name: str
    value: float
    unit: str
    goal: float | None = None

    @property
    def met(self) -> bool | None:
        """Whether the goal is met; None without a goal."""
        if self.goal is None:
            return None
        return self.value >= self.goal if self.is_rate else self.value <= self.goal

    @property
    def is_rate(self) -> bool:
        """Whether more is better."""
        return self.unit == "1/s"

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values: ``name, value, unit, goal, met``."""
        return {**self._asdict(), "met": self.met}


class Subject(NamedTuple):
    """Measurements that are taken together."""

    names: tuple[str, ...]
    measure: Callable[[], list[Measurement]]
    on_request: bool = False
    """Whether they are left out unless a pattern names them."""


def seconds(run: Callable[[], Any]) -> float:
    """Wall time of one call, its results on the device included."""
    begin = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - begin


def interleaved_best(runs: list[Callable[[], Any]], rounds: int) -> list[float]:
    """The shortest wall time of each of several calls, in seconds.

    They are called in turns, so that a busy spell of the machine hits all of them, and the
    shortest time of each is the one that it hit least.
    """
    for run in runs:
        jax.block_until_ready(run())
    times = [[seconds(run) for run in runs] for _ in range(rounds)]
    return [min(column) for column in zip(*times, strict=True)]

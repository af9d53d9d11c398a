"""What a logger is, and what of a run it gets."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from race.config import saved as configs
from race.config.settings import Config

PROJECT = "race"


@dataclass(frozen=True)
class Logged:
    """A run as loggers see it."""

    path: Path
    config: Config
    kept: dict[str, Any]
    """What the logger wants to find again when the run goes on, such as an id; JSON values."""

    @property
    def name(self) -> str:
        """Of the run, with the folder it lies in, where seeds of one experiment are together."""
        return f"{self.path.absolute().parent.name}/{self.path.absolute().name}"

    @property
    def tags(self) -> dict[str, str]:
        """By what runs are found and grouped."""
        return {
            "task": self.config.task,
            "method": self.config.method,
            "seed": str(self.config.seed),
            "cohort": self.path.absolute().parent.name,
        }

    @property
    def settings(self) -> dict[str, Any]:
        """Every setting by its name, such as ``race.mutation_fraction``."""
        return configs.flat(configs.to_json(self.config))


class Logger(Protocol):
    """A run of another program's, opened to be written to."""

    def send(self, points: Sequence["Point"]) -> None:
        """Takes numbers at environment steps that grow, or are equal."""

    def picture(self, name: str, file: Path, env_steps: int) -> None:
        """Takes a .png."""

    def close(self, finished: bool) -> None:
        """Ends this process's part; ``finished``: the run has used its whole budget."""


@dataclass(frozen=True)
class Point:
    """A row's numbers."""

    env_steps: int
    wall_seconds: float
    values: dict[str, float]


def point_of(row: Mapping[str, Any]) -> Point:
    """The numbers of a row; lineage and what is not finite is left out."""
    values = {
        key: float(value)
        for key, value in row.items()
        if isinstance(value, int | float | np.number)
        and not isinstance(value, bool)
        and key != "env_steps"
        and math.isfinite(value)
    }
    return Point(int(row["env_steps"]), values.get("wall_seconds", 0.0), values)

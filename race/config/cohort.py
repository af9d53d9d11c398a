"""Which of several runs share a process and a program."""

from dataclasses import dataclass
from typing import Literal

from race.errors import ConfigError

Batching = Literal["auto", "vmap", "map"]
"""Whether several runs are one program (vmap) or go one after the other (map); auto: one program
where there is an accelerator."""


@dataclass(frozen=True)
class CohortConfig:
    """Which runs share a process."""

    batching: Batching = "auto"
    """vmap: runs that differ in numbers and seeds alone are one program; map: they go one after the
    other in one process; auto: vmap on an accelerator, on processors a process for each run, which
    uses them best."""
    width: int | None = None
    """Most runs of a cohort. None: all that are alike, spread over the accelerators."""

    def __post_init__(self) -> None:
        if self.width is not None and self.width < 1:
            raise ConfigError(f"--cohort.width is {self.width}, but it must be at least 1.")

"""A run in progress: its fixed parts and resources."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from race.algorithms import Algorithm
from race.config.settings import Config
from race.rollouts import Rollouts
from race.runs.directory import RunDirectory
from race.runs.metrics import MetricsWriter
from race.training.clock import Clock
from race.training.interrupts import Interrupts
from race.training.run_state import Progress, statics
from race.types import AnyTask

Report = Callable[[str, Progress, dict[str, Any]], None]
"""Told what is going on: the stage, the progress, and the newest row of metrics."""


def silent(stage: str, progress: Progress, row: dict[str, Any]) -> None:
    """A report to nobody."""


@dataclass(frozen=True)
class Run:
    """What does not change during a run, and its resources."""

    config: Config
    task: AnyTask
    algorithm: Algorithm
    directory: RunDirectory
    rollouts: Rollouts
    metrics: MetricsWriter
    interrupts: Interrupts
    report: Report
    clock: Clock
    began: float  # time.perf_counter() when the process began
    identity: str | None  # of the run: its checkpoints and metrics name it

    @property
    def statics(self) -> dict[str, Any]:
        """The static arguments of the compiled programs."""
        return statics(self.config, self.task.spec, self.algorithm)


def stamped(run: Run, progress: Progress) -> Progress:
    """The progress with the wall times of now."""
    return progress.but(**run.clock.times())

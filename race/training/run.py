"""A run in progress: its fixed parts and resources, and how its state gets to disk."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from race import programs
from race.algorithms import Algorithm
from race.config.settings import Config
from race.errors import DivergenceError
from race.rollouts import Rollouts
from race.runs import checkpoints
from race.runs.directory import RunDirectory
from race.runs.metrics import MetricsWriter
from race.training.interrupts import Interrupts
from race.training.run_state import Progress, RunState, segment_rows, statics, to_arrays
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
    began: float  # time.perf_counter() when the process began

    @property
    def statics(self) -> dict[str, Any]:
        """The static arguments of the compiled programs."""
        return statics(self.config, self.task.spec, self.algorithm)


def save(run: Run, state: RunState) -> RunState:
    """Writes a checkpoint; returns the state with the metrics' length in it.

    Raises:
        DivergenceError: if a number of the algorithm's state is not finite.
        CheckpointError: if it cannot be written.
    """
    if not programs.all_finite(state.algorithm):
        raise DivergenceError(
            "A network's parameters are no longer finite numbers, though its last loss was. Start "
            "a new run with smaller learning rates (--learner.actor-learning-rate, "
            "--learner.critic-learning-rate, or of --facmac)."
        )
    run.metrics.sync()
    progress = state.progress.but(metrics_offset=run.metrics.offset)
    state = state._replace(progress=progress)
    arrays, info, rows = to_arrays(state)
    name = f"step-{progress.env_steps:012d}"
    run.report("saving", progress, {})
    checkpoints.save(
        run.directory.checkpoints,
        name,
        arrays,
        info,
        rows,
        run.config.checkpoint.keep,
        segment_rows(state.replay),
    )
    return state

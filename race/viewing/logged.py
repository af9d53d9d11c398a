"""A run told to its loggers (`race.runs.loggers`), with its curve at the end."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from race.config.settings import Config
from race.errors import RaceError
from race.runs import directory as run_directory
from race.runs.loggers.sending import Loggers, chosen
from race.training.run import Report
from race.training.run_state import Progress


@contextlib.contextmanager
def logged(path: Path, config: Config, report: Report) -> Iterator[Report]:
    """A report that tells the run's loggers too; they are closed when the block ends.

    Args:
        path: the run directory, which says which loggers there are.
        config: its configuration.
        report: who else is told.
    """
    loggers = Loggers(path, config)

    def told(stage: str, progress: Progress, row: dict[str, Any]) -> None:
        report(stage, progress, row)
        loggers.report(row)

    try:
        yield told
    finally:
        finished = run_directory.is_finished(path)
        with tempfile.TemporaryDirectory() as folder:
            pictures = _curves(path, Path(folder)) if finished and chosen(path) else {}
            loggers.end(finished=finished, pictures=pictures)


def _curves(path: Path, folder: Path) -> dict[str, Path]:
    from race.viewing.plotting import plot

    drawn = {}
    for metric in ("return_mean", "win_rate"):
        with contextlib.suppress(RaceError):  # a run may have no tests, or no wins to be had
            plot([path], folder / f"{metric}.png", metric, "all")
            drawn[f"curves/{metric}"] = folder / f"{metric}.png"
    return drawn

"""Trackio, which keeps runs on this machine unless it is told otherwise (``TRACKIO_DIR``)."""

import contextlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import final

from race.runs.loggers.base import PROJECT, Logged, Point


@final
class Trackio:
    """A `race.runs.loggers.base.Logger`; its steps are environment steps.

    The library knows one run at a time for a process.
    """

    def __init__(self, run: Logged) -> None:
        import trackio

        run.kept.setdefault("name", run.name)
        self._library = trackio
        with _silence():
            self._run = trackio.init(
                project=PROJECT,
                name=run.kept["name"],
                group=run.tags["cohort"],
                config={**run.settings, **run.tags},
                resume="allow",
                embed=False,
            )

    def send(self, points: Sequence[Point]) -> None:
        """See `Logger`."""
        for point in points:
            self._run.log(point.values, step=point.env_steps)

    def picture(self, name: str, file: Path, env_steps: int) -> None:
        """See `Logger`."""
        self._run.log({name: self._library.Image(str(file))}, step=env_steps)

    def close(self, finished: bool) -> None:
        """See `Logger`."""
        with _silence():
            self._run.finish()


def _silence() -> contextlib.AbstractContextManager[object]:
    """Standard output is the run's own; the library says there how to see what it keeps."""
    return contextlib.redirect_stdout(io.StringIO())

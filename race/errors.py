"""Errors a user can mend. Each message is one paragraph that says what to do."""

import contextlib
import traceback
from collections.abc import Iterator


class RaceError(Exception):
    """Base of every error that is shown to the user as a message, without a traceback."""


class ConfigError(RaceError):
    """A hyperparameter, or a combination of them, that cannot work."""


class TaskError(RaceError):
    """A task that is unknown, or whose description does not fit together."""


class RunDirectoryError(RaceError):
    """A run directory that already holds a run, holds none, or cannot be written."""


class CheckpointError(RaceError):
    """A checkpoint that is missing, corrupted, or was written by another program or version."""


class DivergenceError(RaceError):
    """A loss or a fitness is no longer a finite number."""


class RenderError(RaceError):
    """A video that cannot be made on this machine."""


def described(error: Exception) -> str:
    """Kind and text of somebody else's error, and the file and line that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f", in {frames[-1].filename}, line {frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}: {error}{place}"


@contextlib.contextmanager
def blamed(kind: type[RaceError], what: str) -> Iterator[None]:
    """Errors of code that is not our own become a ``kind`` that says what failed; ours pass.

    Raises:
        RaceError: of that kind, or as it was raised.
    """
    try:
        yield
    except RaceError:
        raise
    except Exception as error:
        raise kind(f"{what}: {described(error)}.") from error

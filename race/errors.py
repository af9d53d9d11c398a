"""Errors a user can mend. Each message is one paragraph that says what to do."""

import contextlib
import os
import shlex
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Final

_LONGEST: Final = 600  # characters of somebody else's message
# Files of these folders are not the user's: a line in one of them says little to a newcomer.
_OTHERS: Final = tuple(
    f"{folder}{os.sep}"
    for folder in (
        str(Path(__file__).parent),
        *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    )
)


class RaceError(Exception):
    """Base of every error that is shown to the user as a message, without a traceback."""


class ConfigError(RaceError):
    """A hyperparameter, or a combination of them, that cannot work."""


class TaskError(RaceError):
    """A task that is unknown, or whose description does not fit together."""


class HandedOverError(TaskError):
    """An environment handed over what no environment may: a mistake in it, not an accident."""


class EnvFailedError(TaskError):
    """An environment raised an error, ended its process, or did not answer in time."""


class RunDirectoryError(RaceError):
    """A run directory that already holds a run, holds none, or cannot be written."""


class CheckpointError(RaceError):
    """A checkpoint that is missing, corrupted, or was written by another program or version."""


class DivergenceError(RaceError):
    """A loss or a fitness is no longer a finite number."""


class ExportError(RaceError):
    """A file of a team that cannot be written, or would act as another team."""


class RenderError(RaceError):
    """A video that cannot be made on this machine."""


def described(error: BaseException) -> str:
    """Kind and text of somebody else's error in one line, and the place in the user's files.

    The place is the innermost line that belongs neither to race nor to Python nor to an installed
    package; without one, the line that raised the error.
    """
    if isinstance(error, SystemExit):
        text = f"it called sys.exit({'' if error.code is None else repr(error.code)})"
    else:
        try:
            said = " ".join(str(error).split())
        except Exception:  # it is somebody else's class
            said = "(its text cannot be shown)"
        if len(said) > _LONGEST:
            said = f"{said[:_LONGEST]} ..."
        text = f"{type(error).__name__}: {said}" if said else type(error).__name__
    place = _place(error)
    return f"{text}, in {place}" if place else text


def _place(error: BaseException) -> str:
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.filename}, line {error.lineno}"
    frames = traceback.extract_tb(error.__traceback__)
    theirs = [f for f in frames if not f.filename.startswith((*_OTHERS, "<"))]
    last = (theirs or frames)[-1:]
    return f"{last[0].filename}, line {last[0].lineno}" if last else ""


@contextlib.contextmanager
def blamed(kind: type[RaceError], what: str) -> Iterator[None]:
    """Errors of code that is not our own become a ``kind`` that says what failed; ours pass.

    `SystemExit` is one of them: code that is called by us has no say in when the program ends.

    Raises:
        RaceError: of that kind, or as it was raised.
    """
    try:
        yield
    except (RaceError, KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:
        raise kind(f"{what}: {described(error)}.") from error


@contextlib.contextmanager
def of_task(name: str) -> Iterator[None]:
    """Messages of what is wrong with a task begin with its name.

    Raises:
        TaskError: as it was raised, with the name.
    """
    try:
        yield
    except TaskError as error:
        text = str(error)
        raise TaskError(text if text.startswith("Task ") else f"Task {name}: {text}") from error


def command(*words: object) -> str:
    """A command line that a shell takes as it is meant, whatever the names in it."""
    safe = (f"./{w}" if isinstance(w, Path) and str(w).startswith("-") else str(w) for w in words)
    return shlex.join(safe)


def say(text: str) -> None:
    """A line to people that is no error: on standard error, if anybody listens there."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stderr.write(f"{text}\n")

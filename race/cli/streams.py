"""Words to people: on any terminal, with any names in them, and whether or not anybody listens."""

import codecs
import contextlib
import io
import os
import sys
from typing import TYPE_CHECKING, Any, Final, final

if TYPE_CHECKING:
    from rich.console import Console

_PLAIN: Final = {"±": "+-", "·": "-", "…": "..."}
_HANDLER: Final = "race-plain"


def prepare() -> None:
    """Makes standard output and error take every text, also where they are closed or know ASCII.

    A character that a terminal does not have becomes one that it has.
    """
    codecs.register_error(_HANDLER, _instead)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed before we began
            setattr(sys, name, open(os.devnull, "w"))  # noqa: PTH123, SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=_HANDLER)


def console(*, stderr: bool = False, tolerant: bool = False) -> "Console":
    """A console that takes words as they are: a path may look like markup.

    Args:
        stderr: whether it writes to standard error.
        tolerant: whether it goes on in silence where nothing can be written any more.
    """
    from rich.console import Console  # takes a while, which a listing of commands need not wait

    stream: Any = sys.stderr if stderr else sys.stdout
    file: Any = Tolerant(stream) if tolerant else None
    return Console(file=file, stderr=stderr, markup=False, emoji=False, highlight=False)


def is_terminal() -> bool:
    """Whether a person reads standard output at a terminal."""
    try:
        return sys.stdout.isatty()
    except (AttributeError, ValueError):  # it is closed
        return False


@final
class Tolerant:
    """A stream whose failures are kept: a run's files are what counts, not who reads along.

    Attributes:
        failure: what went wrong first, if anything.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.failure: OSError | ValueError | None = None

    def write(self, text: str) -> int:
        """Writes, if that is possible."""
        if self.failure is None:
            try:
                self._stream.write(text)
            except (OSError, ValueError) as error:  # ValueError: it is closed
                self._give_up(error)
        return len(text)

    def flush(self) -> None:
        """Flushes, if that is possible."""
        if self.failure is None:
            try:
                self._stream.flush()
            except (OSError, ValueError) as error:
                self._give_up(error)

    def _give_up(self, error: OSError | ValueError) -> None:
        self.failure = error
        silence(self._stream)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def silence(stream: Any) -> None:
    """Sends what a stream still holds to nowhere, so that its end is no further error."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def finish() -> OSError | None:
    """Writes out what standard output still holds; returns what went wrong."""
    try:
        sys.stdout.flush()
    except OSError as error:
        silence(sys.stdout)
        return error
    except ValueError:  # it is closed
        return None
    return None


def _instead(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    return "".join(_PLAIN.get(character, "?") for character in text), error.end

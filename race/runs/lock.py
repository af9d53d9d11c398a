"""Who may write to a run."""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from race.errors import RunDirectoryError

FILE: Final = ".lock"
"""Locked while a process writes to the run; holds that process's id."""


@contextlib.contextmanager
def lock(path: Path) -> Iterator[None]:
    """Holds the right to write to a run, so that two processes never do at once.

    The right ends with the block or with the process, however it ends.

    Raises:
        RunDirectoryError: if another holds it (names its process), or ``path`` is no directory
            that can be written.
    """
    try:
        descriptor = os.open(path / FILE, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise RunDirectoryError(
            f"The run directory {path} cannot be locked: {error}. See that it exists and is "
            "writable."
        ) from error
    _held.add(descriptor)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(descriptor, 32, 0).decode(errors="replace").strip() or "unknown"
            raise RunDirectoryError(
                f"The run in {path} is being written by another process (id {holder}). Wait until "
                "it ends, or end it, and try again; a new run needs another `--run-dir`."
            ) from error
        except OSError as error:
            raise RunDirectoryError(
                f"The run directory {path} cannot be locked: {error}. Choose a directory on a file "
                "system that has locks."
            ) from error
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        _held.discard(descriptor)
        os.close(descriptor)


# A forked child shares the lock: environment processes that outlive a killed run would keep it.
_held: set[int] = set()


def _release_in_child() -> None:
    for descriptor in _held:
        os.close(descriptor)
    _held.clear()


os.register_at_fork(after_in_child=_release_in_child)

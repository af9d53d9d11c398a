"""The rows of a run: one JSON object per line of ``metrics.jsonl``.

JSON has no NaN and no infinity: a number that is not finite is written as null.
"""

import contextlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, final

import jax
import numpy as np

from race.errors import RunDirectoryError


@final
class MetricsWriter:
    """Appends rows to a file; each is handed to the operating system before `write` returns.

    A checkpoint records `offset` after `sync`. Opened with that offset, the file loses the rows
    that were written after the checkpoint, which the resumed run writes again.

    Args:
        path: the file; made if missing.
        offset: bytes to keep of it. None keeps every complete row.

    Attributes:
        offset: bytes of the complete rows in the file.

    Raises:
        RunDirectoryError: if the file is shorter than ``offset``, has no end of row there, or
            cannot be written.
    """

    offset: int

    def __init__(self, path: Path, offset: int | None = None) -> None:
        self._path = path
        try:
            # Unbuffered, so that a failed write leaves nothing behind to be written later.
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            raise RunDirectoryError(
                f"The metrics file {path} cannot be opened for writing: {error}. See that its "
                "folder exists and is writable."
            ) from error
        try:
            self.offset = _end_of_rows(path) if offset is None else _checked(path, offset)
            self._file.truncate(self.offset)
        except BaseException:
            self._file.close()
            raise

    def write(self, row: Mapping[str, Any]) -> None:
        """Appends a row. Arrays become lists, and numbers keep their exact value.

        Raises:
            RunDirectoryError: if the row cannot be written, as on a full disk. The rows before
                it stay.
            TypeError: for a value that JSON does not know.
        """
        line = json.dumps(_plain(row), allow_nan=False).encode() + b"\n"
        rest = line
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.truncate(self.offset)
            raise RunDirectoryError(
                f"A row of {self._path} could not be written: {error}. Free some space, then run "
                f"`race resume {self._path.parent}` to go on from the newest checkpoint."
            ) from error
        self.offset += len(line)

    def forget(self, offset: int) -> None:
        """Drops the rows after ``offset``, a value that `offset` had before."""
        self._file.truncate(offset)
        self.offset = offset

    def sync(self) -> None:
        """Waits until the rows are on the disk: after it, `offset` survives a power failure."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def __enter__(self) -> "MetricsWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of a metrics file, oldest first.

    A last line without its end, left by a killed process, is ignored.

    Raises:
        RunDirectoryError: if the file cannot be read or a line is no JSON object; names the line.
    """
    try:
        lines = path.read_bytes().split(b"\n")[:-1]
    except OSError as error:
        raise RunDirectoryError(
            f"The metrics file {path} cannot be read: {error}. Give the directory of a run."
        ) from error
    return [_row(path, number, line) for number, line in enumerate(lines, 1)]


def _row(path: Path, number: int, line: bytes) -> dict[str, Any]:
    try:
        row = json.loads(line)
    except ValueError:
        row = None
    if not isinstance(row, dict):
        raise RunDirectoryError(
            f"Line {number} of {path} is no JSON object, so the file was damaged or edited. Put "
            "that line right from a copy, or remove it if you can do without its numbers."
        )
    return row


def _checked(path: Path, offset: int) -> int:
    size = path.stat().st_size
    if size < offset:
        raise RunDirectoryError(
            f"The metrics file {path} has {size} bytes, but the checkpoint was written when it had "
            f"{offset}: rows are missing. Put the file back from a copy, or start the run anew in "
            "another run directory."
        )
    if offset > 0 and _bytes(path, offset - 1, 1) != b"\n":
        raise RunDirectoryError(
            f"The metrics file {path} has no end of a row at byte {offset}, where the checkpoint "
            "was written, so it was edited or belongs to another run. Put the file back from a "
            "copy, or start the run anew in another run directory."
        )
    return offset


def _end_of_rows(path: Path) -> int:
    return path.read_bytes().rfind(b"\n") + 1


def _bytes(path: Path, start: int, count: int) -> bytes:
    with path.open("rb") as file:
        file.seek(start)
        return file.read(count)


def _plain(value: Any) -> Any:
    """The value in Python's own types, which JSON knows; numbers that are not finite are None."""
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        # tolist() turns float32 into the double of equal value, so no digit is lost.
        return _plain(np.asarray(value).tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value

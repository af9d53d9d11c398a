"""The rows of a run: one JSON object per line of ``metrics.jsonl``.

JSON has no NaN and no infinity: a number that is not finite is written as null. The first row names
the run (``run``), and each checkpoint holds a digest of the rows before it (`Extent`), so that rows
that were changed or come from another run are noticed.
"""

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, final

import jax
import numpy as np

from race.closing import Closing
from race.errors import ConfigError, RunDirectoryError, command
from race.runs.sealed import parse, parse_object

MOST_STEPS: Final = 2**53
"""Of whatever is counted, and seconds: more is no number of a run."""


class Extent(NamedTuple):
    """The beginning of a metrics file: how many bytes, and their digest (None: not known)."""

    offset: int
    digest: str | None = None


@final
class MetricsWriter(Closing):
    """Appends rows to a file; each is handed to the operating system before `write` returns.

    A checkpoint records `extent` after `sync`. Opened with it, the file loses the rows that were
    written after the checkpoint, which the resumed run writes again.

    Args:
        path: the file; made if missing.
        kept: what to keep of it. None keeps every complete row.
        run: the run's identity, which the first row names.

    Attributes:
        offset: bytes of the complete rows in the file.

    Raises:
        RunDirectoryError: if the file does not begin with what is to be kept, or cannot be
            written.
    """

    offset: int

    def __init__(self, path: Path, kept: Extent | None = None, run: str | None = None) -> None:
        self._path, self._run = path, run
        try:
            # Unbuffered, so that a failed write leaves nothing behind to be written later.
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            raise RunDirectoryError(
                f"The metrics file {path} cannot be opened for writing: {error}. See that its "
                "folder exists and is writable."
            ) from error
        try:
            content = path.read_bytes()
            if kept is None:
                self.offset = content.rfind(b"\n") + 1
            else:
                check_extent(path, content, kept)
                self.offset = kept.offset
            self._digest = hashlib.blake2b(content[: self.offset], digest_size=16)
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
        if self.offset == 0 and self._run is not None:
            row = {**row, "run": self._run}
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
                f"`{command('race', 'resume', self._path.parent)}` to go on from the newest "
                "checkpoint."
            ) from error
        self.offset += len(line)
        self._digest.update(line)

    @property
    def extent(self) -> Extent:
        """All rows of now."""
        return Extent(self.offset, self._digest.hexdigest())

    def forget(self, offset: int) -> None:
        """Drops the rows after ``offset``, a value that `offset` had before."""
        self._file.truncate(offset)
        self.offset = offset
        content = self._path.read_bytes()[:offset]
        self._digest = hashlib.blake2b(content, digest_size=16)

    def sync(self) -> None:
        """Waits until the rows are on the disk: after it, `offset` survives a power failure."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def read(path: Path, run: str | None = None, kept: Extent | None = None) -> list[dict[str, Any]]:
    """The rows of a metrics file, oldest first.

    A last line without its end, left by a killed process, is ignored.

    Args:
        path: the file.
        run: the run's identity; if the first row names another, the file is refused.
        kept: what a checkpoint says of its beginning; if it is not so, the file is refused.

    Raises:
        RunDirectoryError: if the file cannot be read, belongs to another run, or a line is no row;
            names the line.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RunDirectoryError(
            f"The metrics file {path} cannot be read: {error}. Give the directory of a run."
        ) from error
    if kept is not None:
        check_extent(path, content, kept)
    lines = content.split(b"\n")[:-1]
    found: Sequence[bytes | dict[str, Any]] = _at_once(lines) or lines
    rows = [_row(path, number, one) for number, one in enumerate(found, 1)]
    if rows and None not in (run, rows[0].get("run")) and rows[0]["run"] != run:
        raise RunDirectoryError(
            f"The metrics file {path} belongs to another run ({rows[0]['run']}) than config.json "
            f"beside it ({run}). Put each back where it was."
        )
    return rows


def _at_once(lines: list[bytes]) -> list[dict[str, Any]] | None:
    """The objects of all lines, read as one: faster, and equal names are kept once.

    None where a line is no object; zeros between them show that none goes on in the next.
    """
    try:
        values = parse(b"[" + b",0,".join(lines) + b"]")
    except ValueError:
        return None
    rows, between = values[::2], values[1::2]
    if len(rows) != len(lines) or between != [0] * len(between):
        return None
    return rows if all(type(row) is dict for row in rows) else None


def _row(path: Path, number: int, line: bytes | dict[str, Any]) -> dict[str, Any]:
    try:
        row = line if isinstance(line, dict) else parse_object(line)
        for name, value in row.items():
            if type(value) is int and abs(value) > MOST_STEPS:
                raise ValueError(f"its {name} are {str(value)[:40]}")
        steps = row.get("env_steps", 0)
        if row.get("kind") in ("generation", "evaluation"):
            # What every reader of rows takes for granted.
            if type(steps) is not int or "env_steps" not in row or not 0 <= steps < MOST_STEPS:
                raise ValueError(f"its env_steps are {row.get('env_steps')!r}")
            seconds = row.get("wall_seconds", 0)
            if not _is_number(seconds) or not 0 <= seconds < MOST_STEPS:
                raise ValueError(f"its wall_seconds are {seconds!r}")
    except ValueError as error:
        raise RunDirectoryError(
            f"Line {number} of {path} is no row of metrics ({error}), so the file was damaged or "
            "edited. Put that line right from a copy, or remove it if you can do without its "
            "numbers."
        ) from error
    return row


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def set_aside(path: Path, kept: Extent) -> Extent:
    """Puts a metrics file away that does not begin as a checkpoint says, to begin a new one.

    Returns:
        What is kept: nothing.

    Raises:
        RunDirectoryError: if the file is as it should be, so that nothing needs to be put away; or
            if it cannot be.
    """
    try:
        if path.exists():
            with contextlib.suppress(RunDirectoryError):
                check_extent(path, path.read_bytes(), kept)
                raise ConfigError(
                    f"--without-metrics has no effect: {path} is what the checkpoint says. Leave "
                    "it out."
                )
            number = len(list(path.parent.glob("metrics-lost-*.jsonl"))) + 1
            path.rename(path.with_name(f"metrics-lost-{number}.jsonl"))
    except OSError as error:
        raise RunDirectoryError(f"{path} cannot be put away: {error}.") from error
    return Extent(0)


def check_extent(path: Path, content: bytes, kept: Extent) -> None:
    """Refuses a metrics file that does not begin as a checkpoint says.

    Raises:
        RunDirectoryError: if so.
    """
    go_on = command("race", "resume", path.parent, "--without-metrics")
    advice = f"Put the file back from a copy, or go on without these rows: {go_on}"
    if len(content) < kept.offset:
        raise RunDirectoryError(
            f"The metrics file {path} has {len(content)} bytes, but the checkpoint was written "
            f"when it had {kept.offset}: rows are missing, or it belongs to another run. {advice}"
        )
    begin = content[: kept.offset]
    if begin and not begin.endswith(b"\n"):
        raise RunDirectoryError(
            f"The metrics file {path} has no end of a row at byte {kept.offset}, where the "
            f"checkpoint was written, so it was edited or belongs to another run. {advice}"
        )
    if kept.digest not in (None, hashlib.blake2b(begin, digest_size=16).hexdigest()):
        raise RunDirectoryError(
            f"The rows of {path} are not those that were there when the checkpoint was written: "
            f"the file was damaged, edited, or belongs to another run. {advice}"
        )


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

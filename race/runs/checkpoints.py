"""Checkpoints: the whole state of a run on disk, exact, checked, and never half written.

A checkpoint is a folder ``<anything>-<number>`` with

- ``arrays.safetensors``: every array of the state, by the name of its place in the pytree;
- ``<table>-<segment>-<version>.safetensors``: long tables such as the replay buffer, cut into
  segments. A segment that did not change since the checkpoint before is hard-linked from there;
- ``manifest.json``: size and digest of each file, and whatever else the caller wants to know.

It is written under a temporary name and renamed when complete, so that a process killed at any
moment leaves the checkpoints before it intact.
"""

import contextlib
import hashlib
import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from race.errors import CheckpointError, command
from race.runs.metrics import Extent
from race.runs.sealed import parse_object

FORMAT = "race-checkpoint"
VERSION = 1
SEGMENT_ROWS = 65_536

_ARRAYS = "arrays.safetensors"
_MANIFEST = "manifest.json"
_NAME = re.compile(r"[^.]*?(\d+)(?:\.(\d+))?")


@dataclass(frozen=True)
class Rows:
    """A ring buffer: row ``i`` of all ever inserted lies at place ``i % capacity``.

    Attributes:
        columns: arrays of shape [at least size, ...], of numpy or JAX. Those that `load` returns
            have exactly ``capacity`` rows, zero where nothing was inserted.
        inserted: rows ever inserted.
        capacity: rows that fit.

    Raises:
        ValueError: if a column has fewer rows than are filled.
    """

    columns: Mapping[str, NDArray[Any] | jax.Array]
    inserted: int
    capacity: int

    def __post_init__(self) -> None:
        short = [name for name, column in self.columns.items() if len(column) < self.size]
        if short:
            raise ValueError(f"columns {short} have fewer rows than the {self.size} filled")

    @property
    def size(self) -> int:
        """Rows that are filled: the only ones a checkpoint keeps."""
        return min(self.inserted, self.capacity)


@dataclass(frozen=True)
class Checkpoint:
    """What `load` brings back: the arguments of `save`."""

    path: Path
    arrays: dict[str, NDArray[Any]]
    info: dict[str, Any]
    rows: dict[str, Rows]


def list_checkpoints(directory: Path) -> list[Path]:
    """The checkpoints in a folder, oldest (smallest number) first. Contents are not checked."""
    if not directory.is_dir():
        return []
    found = [p for p in directory.iterdir() if _NAME.fullmatch(p.name) and p.is_dir()]
    return sorted(found, key=_key)


def newest(directory: Path) -> Path | None:
    """The checkpoint with the largest number, or None if there is none."""
    found = list_checkpoints(directory)
    return found[-1] if found else None


def metrics_extent(directory: Path) -> Extent | None:
    """What the newest checkpoint says of the metrics; None where nothing can be known."""
    found = newest(directory)
    if found is None:
        return None
    try:
        told = _read_manifest(found)["info"]["metrics"]
        return Extent(int(told["offset"]), str(told["digest"]))
    except (_DamagedError, OSError, KeyError, TypeError, ValueError):
        return None


def save(
    directory: Path,
    name: str,
    arrays: Mapping[str, NDArray[Any]],
    info: dict[str, Any],
    rows: Mapping[str, Rows],
    keep: int,
    segment_rows: int = SEGMENT_ROWS,
) -> Path:
    """Writes a checkpoint, then removes all but the newest ``keep``.

    Needs memory for about one segment. If a checkpoint with this number exists, the new one gets
    a suffix (``step-12.1``) and counts as newer, so that nothing is ever overwritten.

    Args:
        directory: the folder of the run's checkpoints; made if missing.
        name: ends with digits, which order checkpoints: ``step-000000012000``.
        arrays: the state, from `flatten`.
        info: anything that JSON can hold.
        rows: long tables by name.
        keep: checkpoints to keep, at least 1, the new one included.
        segment_rows: rows of a segment. Changing it only costs that nothing can be linked once.

    Returns:
        The checkpoint's folder.

    Raises:
        CheckpointError: if it cannot be written, as on a full disk. The checkpoints before it
            are untouched then and nothing of the new one is left.
        ValueError: if ``name`` does not end with digits or ``keep`` is below 1.
    """
    match = _NAME.fullmatch(name)
    if match is None or match[2] is not None or "/" in name or keep < 1:
        raise ValueError(f"save needs a name that ends with digits and keep >= 1: {name}, {keep}")
    number = int(match[1])
    temporary = directory / f".tmp-{name}-{os.getpid()}"
    needed = sum(array.nbytes for array in arrays.values())
    try:
        _make_folder(directory)
        for leftover in directory.glob(".tmp-*"):
            shutil.rmtree(leftover, ignore_errors=True)
        older = [p for p in list_checkpoints(directory) if _key(p)[0] <= number]
        same = [_key(p)[1] for p in older if _key(p)[0] == number]
        target = directory / (f"{name}.{max(same) + 1}" if same else name)
        segments = _plan(rows, older[-1] if older else None, segment_rows)
        needed += sum(s.nbytes for s in segments if s.source is None)

        temporary.mkdir()
        files = {_ARRAYS: _write(temporary / _ARRAYS, arrays)}
        for segment in segments:
            files[segment.file] = _write_segment(temporary / segment.file, segment)
        body = {
            "format": FORMAT,
            "version": VERSION,
            "info": info,
            "tables": {table: _describe(r, segment_rows) for table, r in rows.items()},
            "segments": [[s.table, s.start, s.stop, s.file] for s in segments],
            "files": files,
        }
        (temporary / _MANIFEST).write_text(_manifest_text(body))
        _sync(temporary / _MANIFEST)
        _sync(temporary)
        temporary.rename(target)
        _sync(directory)
        for old in [*older, target][:-keep]:
            # Under its own name a half deleted checkpoint would look like a damaged one.
            shutil.rmtree(old.rename(directory / f".tmp-old-{old.name}"), ignore_errors=True)
    except (OSError, SafetensorError) as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise CheckpointError(
            f"The checkpoint {directory / name} could not be written: {error}. It needs "
            f"{_megabytes(needed)} of disk space and {_megabytes(_free(directory))} are free. The "
            "checkpoints before it are untouched: free some space, see that the folder is "
            f"writable, and run `{command('race', 'resume', directory.parent)}` to go on from "
            "the newest."
        ) from error
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    return target


def load(path: Path, *, tables: bool = True) -> Checkpoint:
    """Reads a checkpoint after checking every byte of what it reads.

    Args:
        path: the checkpoint's folder.
        tables: whether to read the long tables too; a trained team does not need them.

    Raises:
        CheckpointError: if the checkpoint is missing, damaged, foreign, or of another version;
            names the next older intact one if there is any.
    """
    try:
        body = _verify(path, tables)
        rows = _read_rows(path, body) if tables else {}
        return Checkpoint(path, load_file(path / _ARRAYS), body["info"], rows)
    except (_DamagedError, OSError, SafetensorError) as error:
        raise CheckpointError(
            f"The checkpoint {path} cannot be used: {error}. {_advice(path)}"
        ) from error


class _DamagedError(Exception):
    """What is wrong with a checkpoint."""


class _Segment(NamedTuple):
    table: str
    file: str
    start: int  # rows start ... stop - 1 of the table
    stop: int
    columns: Mapping[str, NDArray[Any] | jax.Array]
    source: Path | None  # the same segment in the checkpoint before
    entry: dict[str, Any] | None  # its size and digest there

    @property
    def nbytes(self) -> int:
        per_row = (c.nbytes // len(c) for c in self.columns.values())
        return (self.stop - self.start) * sum(per_row)


def _key(path: Path) -> tuple[int, int]:
    match = _NAME.fullmatch(path.name)
    return (int(match[1]), int(match[2] or 0)) if match else (0, 0)


def _plan(rows: Mapping[str, Rows], previous: Path | None, length: int) -> list[_Segment]:
    files, tables = {}, {}
    if previous is not None:
        with contextlib.suppress(_DamagedError, OSError):
            manifest = _read_manifest(previous)
            files, tables = manifest["files"], manifest["tables"]
    segments = []
    for table, r in rows.items():
        described = {**_describe(r, length), "inserted": None}
        linkable = {**tables.get(table, {}), "inserted": None} == described
        for start in range(0, r.size, length):
            stop = min(start + length, r.size)
            file = f"{table}-{start // length:05d}-{_changed(r, start, stop)}.safetensors"
            entry = files.get(file) if linkable else None
            source = previous / file if previous is not None and entry is not None else None
            segments.append(_Segment(table, file, start, stop, r.columns, source, entry))
    return segments


def _changed(rows: Rows, start: int, stop: int) -> int:
    """Rows inserted in all when a row of the segment was last written: its version."""
    newest_place = (rows.inserted - 1) % rows.capacity
    if start <= newest_place < stop:
        return rows.inserted
    return rows.inserted - (newest_place - (stop - 1)) % rows.capacity


def _describe(rows: Rows, length: int) -> dict[str, Any]:
    columns = {c: [a.dtype.name, list(a.shape[1:])] for c, a in rows.columns.items()}
    return {
        "inserted": rows.inserted,
        "capacity": rows.capacity,
        "segment_rows": length,
        "columns": columns,
    }


def _write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    # safetensors writes the memory as it lies, whatever the strides say.
    save_file({name: np.asarray(array, order="C") for name, array in arrays.items()}, path)
    _sync(path)
    return {"bytes": path.stat().st_size, "digest": _digest(path)}


def _write_segment(path: Path, segment: _Segment) -> dict[str, Any]:
    source, entry = segment.source, segment.entry
    if source is None or entry is None or not _has_size(source, entry["bytes"]):
        chunk = {c: np.asarray(a[segment.start : segment.stop]) for c, a in segment.columns.items()}
        return _write(path, chunk)
    try:
        os.link(source, path)
    except OSError:  # a file system without hard links, or too many on this file
        shutil.copyfile(source, path)
        _sync(path)
    return entry


def _read_rows(path: Path, body: dict[str, Any]) -> dict[str, Rows]:
    tables = {}
    for table, described in body["tables"].items():
        columns: dict[str, NDArray[Any]] = {
            c: np.zeros((described["capacity"], *shape), jnp.dtype(dtype))
            for c, (dtype, shape) in described["columns"].items()
        }
        for owner, start, stop, file in body["segments"]:
            if owner == table:
                for c, values in load_file(path / file).items():
                    columns[c][start:stop] = values
        tables[table] = Rows(columns, described["inserted"], described["capacity"])
    return tables


def _verify(path: Path, tables: bool = True) -> dict[str, Any]:
    body = _read_manifest(path)
    for file, entry in body["files"].items():
        if not tables and file != _ARRAYS:
            continue
        if not (path / file).is_file():
            raise _DamagedError(f"its file {file} is missing")
        if not _has_size(path / file, entry["bytes"]):
            raise _DamagedError(f"its file {file} does not have its {entry['bytes']} bytes")
        if _digest(path / file) != entry["digest"]:
            raise _DamagedError(f"its file {file} is damaged (the digest differs)")
    return body


def _read_manifest(path: Path) -> dict[str, Any]:
    if not path.is_dir():
        raise _DamagedError("there is no such folder")
    if not (path / _MANIFEST).is_file():
        raise _DamagedError(f"it has no {_MANIFEST}, so it is no checkpoint of race")
    try:
        text = (path / _MANIFEST).read_bytes().decode()
        body = parse_object(text)
    except ValueError as error:
        raise _DamagedError(f"its {_MANIFEST} is damaged") from error
    if body.get("format") != FORMAT:
        raise _DamagedError(f"its {_MANIFEST} is damaged or was written by another program")
    if body.get("version") != VERSION:
        raise _DamagedError(
            f"it has format version {body.get('version')} and this version of race reads {VERSION} "
            "(metadata.json of the run directory names the version of race that wrote it)"
        )
    body.pop("digest", None)
    if _manifest_text(body) != text:
        raise _DamagedError(f"its {_MANIFEST} is damaged (the digest differs)")
    return body


def _manifest_text(body: dict[str, Any]) -> str:
    digest = hashlib.blake2b(json.dumps(body).encode()).hexdigest()
    return json.dumps({**body, "digest": digest}, indent=1)


def _advice(path: Path) -> str:
    older = [p for p in list_checkpoints(path.parent) if _key(p) < _key(path)]
    for candidate in reversed(older):
        with contextlib.suppress(_DamagedError, OSError):
            _verify(candidate)
            go_on = command("race", "resume", path.parent.parent)
            return (
                f"The next older checkpoint, {candidate}, is intact: remove the folder {path} and "
                f"run `{go_on}` again to go on from there."
            )
    return (
        "There is no older intact checkpoint beside it: unless you can put it right, start the "
        "run anew in another run directory."
    )


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "blake2b").hexdigest()


def _has_size(path: Path, size: int) -> bool:
    return path.is_file() and path.stat().st_size == size


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _make_folder(path: Path) -> None:
    if not path.is_dir():
        path.mkdir(parents=True)
        _sync(path.parent)


def _free(directory: Path) -> int:
    existing = next(p for p in (directory, *directory.absolute().parents) if p.exists())
    return shutil.disk_usage(existing).free


def _megabytes(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"

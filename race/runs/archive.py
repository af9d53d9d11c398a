"""Archives of results: many runs in one small file, without what only a resumed run needs.

A gzipped text file. Its first line names the format; every other line is a run: its name, settings,
origin and rows. Rows of evaluations are kept whole. Rows of generations are thinned to one per
evaluation, over the generations since the one before: what is a mean of a generation is averaged,
what counts or holds for the whole run so far is the last. Numbers that are not whole keep
`DIGITS` digits, and columns stand together, which is what makes the file small.
"""

import gzip
import json
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from race.config import saved as configs
from race.config.presets import resolve
from race.errors import ConfigError, RunDirectoryError
from race.runs.recorded import Recorded
from race.runs.sealed import parse

SUFFIX = ".jsonl.gz"
FORMAT = {"format": "race-archive", "version": 1}
DIGITS = 6
"""Significant digits of numbers that are not whole; a test return's noise is in its third."""

# Of a generation's row: what is the newest value, not a mean over generations.
_LAST = (
    *("kind", "generation", "env_steps", "gradient_steps", "wall_seconds"),
    *("injection/", "operators/", "env/"),
)
_DAMAGES = (ValueError, KeyError, TypeError, EOFError, IndexError, StopIteration, zlib.error)
# Of a run's origin: the versions that may change numbers.
_ORIGIN = (
    *("race", "algorithm_version", "git", "started", "command", "python"),
    *("platform", "processor", "backend", "devices"),
)
_LIBRARIES = ("jax", "jaxlib", "numpy", "mujoco", "gymnasium", "gymnasium-robotics", "optax")


def is_archive(path: Path) -> bool:
    """Whether a path is that of an archive, by its name."""
    return path.name.endswith(SUFFIX) and not path.is_dir()


def write(out: Path, runs: Iterable[Recorded]) -> None:
    """Writes runs, each with the key of its experiment, to ``out``; replaces what was there.

    Raises:
        RunDirectoryError: if the file cannot be written.
    """
    if not is_archive(out):
        raise RunDirectoryError(f"{out}: the name of an archive must end with {SUFFIX}.")
    temporary = out.with_name(f".tmp-{out.name}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        # Without a time of writing in it, equal runs give equal bytes.
        with (
            temporary.open("wb") as raw,
            gzip.GzipFile(fileobj=raw, mode="wb", mtime=0, filename="") as file,
        ):
            file.write(_line(FORMAT))
            for run in runs:
                file.write(_line(_packed(run)))
        temporary.rename(out)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise RunDirectoryError(f"The archive {out} cannot be written: {error}.") from error


def read(path: Path) -> list[Recorded]:
    """The runs of an archive, named after it and where they lay.

    Raises:
        RunDirectoryError: if it cannot be read, or is no archive that this version understands.
    """
    try:
        with gzip.open(path, "rt", encoding="utf-8") as file:
            head, *lines = file.read().splitlines()
        if parse(head) != FORMAT:
            raise ValueError(f"its first line is {head[:80]}")
        return [_unpacked(path, parse(line)) for line in lines]
    except OSError as error:
        raise RunDirectoryError(f"The archive {path} cannot be read: {error}.") from error
    except (*_DAMAGES, ConfigError) as error:
        raise RunDirectoryError(
            f"{path} is no archive that this version of race understands ({error}). Make it anew "
            f"from its runs: race archive DIR... --out {path.name}"
        ) from error


def thinned(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with those of generations thinned to one before each evaluation."""
    kept: list[dict[str, Any]] = []
    waiting: list[dict[str, Any]] = []
    for row in rows:
        if row.get("kind") == "generation":
            waiting.append(row)
            continue
        kept += [_one_of(waiting)] if waiting else []
        kept.append(row)
        waiting = []
    return kept + ([_one_of(waiting)] if waiting else [])


def _one_of(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    one = dict(rows[-1])
    for key in {key for row in rows for key in row}:
        values = [row[key] for row in rows if isinstance(row.get(key), int | float)]
        if not key.startswith(_LAST) and values:
            one[key] = sum(values) / len(values)
    return one


def _packed(run: Recorded) -> dict[str, Any]:
    rows = thinned(run.rows)
    tables = {}
    for kind in sorted({str(row.get("kind")) for row in rows}):
        of_kind = [row for row in rows if str(row.get("kind")) == kind]
        # Lineage is of every generation or of no use.
        names = sorted({name for row in of_kind for name in row} - {"kind", "teams"})
        columns = {name: [_short(row.get(name)) for row in of_kind] for name in names}
        tables[kind] = columns
    origin = {name: run.metadata[name] for name in _ORIGIN if name in run.metadata}
    versions = run.metadata.get("versions", {})
    origin["versions"] = {name: versions[name] for name in _LIBRARIES if name in versions}
    return {
        "run": run.name.rpartition(":")[2],
        "experiment": run.experiment,
        "config": configs.to_json(run.config),
        "metadata": origin,
        "order": "".join(str(row.get("kind"))[:1] for row in rows),
        "rows": tables,
    }


def _unpacked(path: Path, packed: dict[str, Any]) -> Recorded:
    tables = packed["rows"]
    rest = {kind: iter(_rows_of(kind, columns)) for kind, columns in tables.items()}
    kinds = {kind[:1]: kind for kind in tables}
    rows = [next(rest[kinds[letter]]) for letter in packed["order"]]
    config = resolve(configs.from_json(packed["config"]))
    return Recorded(f"{path}:{packed['run']}", config, rows, dict(packed["metadata"]))


def _rows_of(kind: str, columns: dict[str, list[Any]]) -> list[dict[str, Any]]:
    values = zip(*columns.values(), strict=True)
    return [{"kind": kind, **dict(zip(columns, row, strict=True))} for row in values]


def _short(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return int(value) if value.is_integer() else float(f"{value:.{DIGITS}g}")


def _line(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode() + b"\n"

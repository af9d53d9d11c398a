"""Runs as readers of results see them: from run directories, folders of them, or archives."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from race.config.settings import Config
from race.errors import RunDirectoryError
from race.runs import archive, metrics
from race.runs import directory as run_directory
from race.runs.directory import RunDirectory


class Recorded(NamedTuple):
    """What is known of a run without its checkpoints."""

    name: str
    """Where it lies, or lay when it was archived."""
    config: Config
    rows: list[dict[str, Any]]
    metadata: dict[str, Any]

    @property
    def algorithm_version(self) -> int:
        """`race.ALGORITHM_VERSION` of the version that began it."""
        return int(self.metadata.get("algorithm_version", 1))

    @property
    def experiment(self) -> str:
        """Equal for runs that are the same experiment with other seeds or lengths."""
        return experiment_key(self.config, self.algorithm_version)


def settings(config: Config) -> dict[str, Any]:
    """What makes two runs the same experiment: everything but seed, length and bookkeeping."""
    kept = dataclasses.asdict(config)
    for name in ("seed", "env_steps", "checkpoint"):
        del kept[name]
    del kept["env"]["processes"]
    return {
        f"{group}.{name}" if isinstance(values, dict) else group: value
        for group, values in kept.items()
        for name, value in (values.items() if isinstance(values, dict) else [("", values)])
    }


def experiment_key(config: Config, algorithm_version: int) -> str:
    """A digest of task, method, settings and version of the algorithm, as 12 hex digits."""
    text = json.dumps([settings(config), algorithm_version], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def load(paths: Sequence[Path]) -> list[Recorded]:
    """The runs of some paths, each once.

    Args:
        paths: run directories, folders that hold some (at any depth), or archives.

    Raises:
        RunDirectoryError: for a path that holds no run, or what cannot be read.
    """
    found: dict[str, Recorded] = {}
    for path in paths:
        if archive.is_archive(path):
            for kept in archive.read(path):
                found.setdefault(f"{path}:{kept.name}", Recorded(*kept))
            continue
        for place in run_directories(path):
            found.setdefault(str(place.resolve()), of_directory(place))
    return list(found.values())


def run_directories(path: Path) -> list[Path]:
    """``path`` itself if it is a run's directory, else those below it, in order of their names.

    Raises:
        RunDirectoryError: if it is no directory, or there is none below it.
    """
    if not path.is_dir():
        raise RunDirectoryError(
            f"{path} is not a directory, so it holds no run. Give the directory of a run, a folder "
            f"of runs, or an archive ({archive.SUFFIX})."
        )
    if RunDirectory(path).config.exists():
        return [path]
    inside = sorted(file.parent for file in path.rglob("config.json"))
    if not inside:
        raise RunDirectoryError(
            f"{path} is not the directory of a run, and holds none: there is no config.json in it. "
            "Give the directory that `race train` named when it started."
        )
    return inside


def of_directory(path: Path) -> Recorded:
    """The run in a run directory, which may still be young: then it has no rows.

    Raises:
        RunDirectoryError: if it cannot be read.
    """
    run = RunDirectory(path)
    config = run_directory.open_run(path)
    rows = metrics.read(run.metrics) if run.metrics.exists() else []
    return Recorded(str(path), config, rows, run_directory.read_metadata(path))

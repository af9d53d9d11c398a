"""The directory of a run: what lies where, and who may write to it."""

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from race.config import settings as configs
from race.config.presets import resolve
from race.config.settings import Config
from race.errors import ConfigError, RunDirectoryError, command
from race.runs.metadata import metadata


@dataclass(frozen=True)
class RunDirectory:
    """The paths of a run's files. Making one touches no disk."""

    path: Path

    @property
    def config(self) -> Path:
        """The run's `Config` as JSON, written once at the start."""
        return self.path / "config.json"

    @property
    def metadata(self) -> Path:
        """Versions, machine, source and command line, as JSON."""
        return self.path / "metadata.json"

    @property
    def metrics(self) -> Path:
        """One JSON object per line."""
        return self.path / "metrics.jsonl"

    @property
    def checkpoints(self) -> Path:
        """The folder of checkpoints."""
        return self.path / "checkpoints"

    @property
    def done(self) -> Path:
        """Exists once the run has used its whole budget."""
        return self.path / "DONE"

    @property
    def lock(self) -> Path:
        """Locked while a process writes to the run; holds that process's id."""
        return self.path / ".lock"


def create(
    path: Path, config: Config, environment: Mapping[str, Any] | None = None
) -> RunDirectory:
    """Starts a run directory with ``config.json`` and ``metadata.json``.

    Args:
        path: the directory; made if missing. It may hold files that are not of a run.
        config: the run's settings.
        environment: what to record of the environments, such as their ids.

    Raises:
        RunDirectoryError: if ``path`` already holds a run, is a file, or cannot be written.
    """
    run = RunDirectory(path)
    try:
        refuse_occupied(path)
        path.mkdir(parents=True, exist_ok=True)
        text = _json(metadata(environment or {}))
        # Whoever gets config.json there first owns the directory; only then is the rest written.
        _write(run.config, _json(configs.to_json(config)), exclusive=True)
        _write(run.metadata, text)
    except FileExistsError as error:
        if path.is_dir():
            raise _occupied(path) from error
        raise RunDirectoryError(
            f"{path} is a file, not a directory. Choose another directory with `--run-dir`."
        ) from error
    except OSError as error:
        raise _not_writable(path, error) from error
    return run


def refuse_occupied(path: Path) -> None:
    """Refuses a directory that holds a run, before time is spent on a new one.

    Raises:
        RunDirectoryError: if there is a run.
    """
    run = RunDirectory(path)
    try:
        occupied = any(part.exists() for part in (run.config, run.metrics, run.checkpoints))
    except OSError as error:  # such as a name that is too long
        raise _not_writable(path, error) from error
    if occupied:
        raise _occupied(path)


def _occupied(path: Path) -> RunDirectoryError:
    return RunDirectoryError(
        f"{path} already holds a run. Continue it with `{command('race', 'resume', path)}`, or "
        "choose another directory with `--run-dir`."
    )


def _not_writable(path: Path, error: OSError) -> RunDirectoryError:
    return RunDirectoryError(
        f"The run directory {path} cannot be written: {error}. Choose another directory with "
        "`--run-dir`, or see that this one is writable and the disk is not full."
    )


def change_config(path: Path, config: Config) -> None:
    """Replaces the configuration of the run in ``path``, as when a run is extended.

    Raises:
        RunDirectoryError: if it cannot be written.
    """
    file = RunDirectory(path).config
    try:
        _write(file, _json(configs.to_json(config)))
    except OSError as error:
        raise _unwritable(file, error) from error


def open_run(path: Path) -> Config:
    """The configuration of the run in ``path``.

    Raises:
        RunDirectoryError: if the directory holds no run, or its config.json cannot be read.
    """
    file = RunDirectory(path).config
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(data, dict):
            raise ValueError("no object")
        return resolve(configs.from_json(data))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise RunDirectoryError(
            f"{path} is not the directory of a run: it has no config.json. Give the directory that "
            "`race train` named when it started."
        ) from error
    except OSError as error:
        raise RunDirectoryError(
            f"{file} cannot be read: {error}. See that you may read it."
        ) from error
    except ConfigError as error:
        raise RunDirectoryError(
            f"The run in {path} cannot be opened: {error} Use the version of race that wrote it, "
            "which metadata.json names."
        ) from error
    except ValueError as error:
        raise RunDirectoryError(
            f"{file} is no JSON object ({error}), so it was damaged or edited. Put it back from a "
            "copy, or start the run anew in another directory."
        ) from error


def read_metadata(path: Path) -> dict[str, Any]:
    """What was recorded of the run's origin; nothing where that is missing or damaged."""
    try:
        data = json.loads(RunDirectory(path).metadata.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) else {}


def mark_finished(path: Path) -> None:
    """Records that the run has used its whole budget.

    Raises:
        RunDirectoryError: if that cannot be written.
    """
    try:
        _write(RunDirectory(path).done, "")
    except OSError as error:
        raise _unwritable(RunDirectory(path).done, error) from error


def is_finished(path: Path) -> bool:
    """Whether the run has used its whole budget."""
    return RunDirectory(path).done.exists()


def clear_finished(path: Path) -> None:
    """Takes `mark_finished` back, as when the budget is extended.

    Raises:
        RunDirectoryError: if that cannot be written.
    """
    try:
        RunDirectory(path).done.unlink(missing_ok=True)
        _sync_folder(path)
    except OSError as error:
        raise _unwritable(RunDirectory(path).done, error) from error


def _unwritable(file: Path, error: OSError) -> RunDirectoryError:
    return RunDirectoryError(
        f"{file} cannot be written: {error}. See that it is writable and the disk is not full."
    )


@contextlib.contextmanager
def lock(path: Path) -> Iterator[None]:
    """Holds the right to write to a run, so that two processes never do at once.

    The right ends with the block or with the process, however it ends.

    Raises:
        RunDirectoryError: if another holds it (names its process), or ``path`` is no directory
            that can be written.
    """
    try:
        descriptor = os.open(RunDirectory(path).lock, os.O_RDWR | os.O_CREAT, 0o666)
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


def _json(value: Any) -> str:
    return json.dumps(value, indent=2) + "\n"


def _write(path: Path, text: str, *, exclusive: bool = False) -> None:
    """Puts a whole file in place or none; ``exclusive``: FileExistsError if there is one."""
    temporary = path.with_name(f".tmp-{path.name}-{os.getpid()}")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        if exclusive:
            _link(temporary, path)
        else:
            temporary.rename(path)
        _sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _link(temporary: Path, path: Path) -> None:
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links: two runs at the same moment may collide
        temporary.rename(path)


def _sync_folder(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

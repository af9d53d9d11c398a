"""The directory of a run: what lies where, and who may write to it."""

import json
import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from race.config import saved as configs
from race.config.presets import resolve
from race.config.settings import Config
from race.errors import ConfigError, RunDirectoryError, command
from race.runs.lock import lock
from race.runs.metadata import metadata
from race.runs.sealed import BrokenSealError, parse_object, seal, unseal

__all__ = [
    "RunDirectory",
    "change_config",
    "clear_finished",
    "create",
    "identity_of",
    "is_finished",
    "lock",
    "mark_finished",
    "open_run",
    "read_metadata",
    "recorded_task",
    "refuse_occupied",
]


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
    def best(self) -> Path:
        """The folder of the best tested teams."""
        return self.path / "best"

    @property
    def init(self) -> Path:
        """The teams of another run that it began with."""
        return self.path / "init.safetensors"

    @property
    def done(self) -> Path:
        """Exists once the run has used its whole budget."""
        return self.path / "DONE"


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
        text = _json(metadata(environment or {}))
        path.mkdir(parents=True, exist_ok=True)
        # Whoever gets config.json there first owns the directory; only then is the rest written.
        identity = secrets.token_hex(8)
        _write(run.config, _config_text(config, identity), exclusive=True)
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
    file, identity = RunDirectory(path).config, identity_of(path)
    try:
        _write(file, _config_text(config, identity))
    except OSError as error:
        raise _unwritable(file, error) from error


def open_run(path: Path) -> Config:
    """The configuration of the run in ``path``.

    Raises:
        RunDirectoryError: if the directory holds no run, or its config.json cannot be read.
    """
    return _read_config(path)[0]


def identity_of(path: Path) -> str | None:
    """What tells the run in ``path`` from all others: its checkpoints and metrics name it too.

    Runs of older versions have none.

    Raises:
        RunDirectoryError: as `open_run`.
    """
    return _read_config(path)[1]


def _config_text(config: Config, identity: str | None) -> str:
    # A run of before there were identities stays as it is.
    body = configs.to_json(config)
    return _json(body if identity is None else seal(body | {"run": identity}))


def _read_config(path: Path) -> tuple[Config, str | None]:
    file = RunDirectory(path).config
    try:
        data, sealed = unseal(parse_object(file.read_bytes().decode()))
        identity = data.pop("run", None)
        if sealed != isinstance(identity, str):
            raise BrokenSealError("it has lost its digest or its identity")
        return resolve(configs.from_json(data)), identity
    except BrokenSealError as error:
        raise RunDirectoryError(
            f"{file} was changed since race wrote it: {error}. A run that goes on with other "
            "settings is none that could be repeated. Put it back from a copy, or begin a new run "
            "with the settings you want; only --env-steps of `race resume` extends one."
        ) from error
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
        return parse_object(RunDirectory(path).metadata.read_bytes())
    except (OSError, ValueError):
        return {}


def recorded_task(path: Path) -> dict[str, Any]:
    """What was recorded of the run's task; nothing where that is missing or damaged."""
    told = read_metadata(path).get("environment")
    return told if isinstance(told, dict) else {}


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

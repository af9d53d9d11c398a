"""Which rows a logger gets: each once, however often a run stops and goes on.

Rows written after the newest checkpoint are written again when a run goes on, and a logger has had
them already. So ``DIR/loggers.json`` keeps, for each logger, how far it was told; rows up to there
are not told again, and rows that it missed (its server was away, the process was killed) are read
from ``metrics.jsonl``. The mark is set before rows are sent: a kill or a failure at that very
moment may lose a few points of the logger's, and never doubles any.
"""

import contextlib
import importlib.util
import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, final, get_args

from race.config.loggers import LoggerName
from race.config.settings import Config
from race.errors import ConfigError, RaceError, RunDirectoryError, described, say
from race.runs import metrics
from race.runs.directory import RunDirectory
from race.runs.loggers.base import Logged, Logger, point_of
from race.runs.loggers.mlflow import MLflow
from race.runs.loggers.tensorboard import TensorBoard
from race.runs.loggers.trackio import Trackio
from race.runs.loggers.wandb import Wandb

OPENERS: Final[dict[str, tuple[str, Callable[[Logged], Logger]]]] = {
    "tensorboard": ("tensorboardX", TensorBoard),
    "wandb": ("wandb", Wandb),
    "mlflow": ("mlflow", MLflow),
    "trackio": ("trackio", Trackio),
}
"""By the name of a logger: the module it needs, and what opens a run with it."""

SEND_EVERY = 2.0
"""Seconds between two batches of rows: a row each would cost more than a short generation."""
MOST_AT_ONCE = 100
"""Rows that are lost to a logger at most if it fails while it is told of them."""
_KINDS = ("generation", "evaluation")


def refuse_missing(names: Sequence[str]) -> None:
    """Refuses loggers whose library is not installed, before a run begins.

    Raises:
        ConfigError: naming the command that installs it.
    """
    for name in names:
        if importlib.util.find_spec(OPENERS[name][0]) is None:
            raise ConfigError(
                f"--log {name} needs {OPENERS[name][0]}, which is not installed: "
                f"pip install 'race-marl[{name}]'"
            )


def choose(path: Path, names: Sequence[LoggerName]) -> None:
    """Notes in a run's directory who is told of it.

    Raises:
        RunDirectoryError: if it cannot be written.
    """
    if names:
        _write(path, {name: {} for name in dict.fromkeys(names)})


def chosen(path: Path) -> dict[str, dict[str, Any]]:
    """The loggers of a run and what is known of each; a file that is damaged is said and left."""
    file = path / "loggers.json"
    if not file.exists():
        return {}
    try:
        told = json.loads(file.read_bytes())
        known = {name: dict(told[name]) for name in get_args(LoggerName) if name in told}
    except (OSError, ValueError, TypeError) as error:
        say(f"race: {file} cannot be read ({error}), so no logger is told of this run.")
        return {}
    return known


@final
class Loggers:
    """The loggers of a run; one that fails is named once and then left alone.

    Nothing is opened before the first row: by then the rows that a run writes again are gone.
    """

    def __init__(self, path: Path, config: Config) -> None:
        self._path, self._config = path.absolute(), config
        self._kept = chosen(path)
        self._open: dict[str, Logger] | None = None
        self._waiting: list[dict[str, Any]] = []
        self._sent = time.monotonic()

    def report(self, row: Mapping[str, Any]) -> None:
        """Takes a row that was just written to ``metrics.jsonl``."""
        if not self._kept or row.get("kind") not in _KINDS:
            return
        if self._open is None:
            self._begin()
        else:
            self._waiting.append(dict(row))
        if time.monotonic() - self._sent > SEND_EVERY:
            self._send()

    def end(self, *, finished: bool, pictures: Mapping[str, Path] | None = None) -> None:
        """Sends what is left, and pictures of the whole run; closes."""
        if self._open is None:
            if not (self._kept and finished and _has_rows(self._path)):
                return
            self._begin()
        self._send()
        steps = max((int(kept.get("mark", [0])[0]) for kept in self._kept.values()), default=0)
        for name, logger in list((self._open or {}).items()):
            with self._kept_away(name):
                for title, file in (pictures or {}).items():
                    logger.picture(title, file, steps)
                logger.close(finished)
        self._open = {}

    def _begin(self) -> None:
        self._open = {}
        for name, kept in self._kept.items():
            with self._kept_away(name):
                self._open[name] = OPENERS[name][1](Logged(self._path, self._config, kept))
        try:
            # All rows so far: each logger takes those after its mark.
            self._waiting = metrics.read(RunDirectory(self._path).metrics)
        except RaceError as error:
            say(f"race: loggers are not told what they missed: {error}")
        self._send()

    def _send(self) -> None:
        rows, self._waiting, self._sent = self._waiting, [], time.monotonic()
        for name, logger in list((self._open or {}).items()):
            kept = self._kept[name]
            mark = tuple(kept.get("mark", (-1, 0)))
            fresh = [row for row in rows if row.get("kind") in _KINDS and _place(row) > mark]
            with self._kept_away(name):
                for begin in range(0, len(fresh), MOST_AT_ONCE):
                    some = fresh[begin : begin + MOST_AT_ONCE]
                    kept["mark"] = list(_place(some[-1]))
                    _write(self._path, self._kept)
                    logger.send([point_of(row) for row in some])

    def _kept_away(self, name: str) -> "contextlib.AbstractContextManager[None]":
        """Mistakes of a logger end the logger, not the run."""

        @contextlib.contextmanager
        def guard() -> Any:
            try:
                yield
            except KeyboardInterrupt:
                raise
            except BaseException as error:
                if self._open is not None:
                    self._open.pop(name, None)
                say(
                    f"race: the logger {name} failed and is told nothing more of this run: "
                    f"{described(error)}. The run goes on; all rows are in {self._path}, and when "
                    "it is resumed the logger is told the rows that were not yet being sent."
                )

        return guard()


def _place(row: Mapping[str, Any]) -> tuple[int, int]:
    """Rows of a run are in this order."""
    return int(row["env_steps"]), _KINDS.index(row["kind"])


def _has_rows(path: Path) -> bool:
    file = RunDirectory(path).metrics
    return file.exists() and file.stat().st_size > 0


def _write(path: Path, told: Mapping[str, Any]) -> None:
    file = path / "loggers.json"
    temporary = file.with_name(f".tmp-{file.name}-{os.getpid()}")
    try:
        temporary.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
        temporary.replace(file)
    except OSError as error:
        raise RunDirectoryError(f"{file} cannot be written: {error}.") from error


__all__ = ["OPENERS", "LoggerName", "Loggers", "choose", "chosen", "refuse_missing"]

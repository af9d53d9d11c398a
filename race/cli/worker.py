"""A process that trains one run or a cohort, seen from outside."""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, final, runtime_checkable

from race.config.cohort import Batching
from race.config.settings import Config
from race.runs import directory as run_directory
from race.runs.directory import RunDirectory
from race.runs.sealed import parse

INTERRUPTED = 130
LOST = -1000
"""Instead of an exit status: the machine is gone, or the process was taken from it."""
MOST_LOSSES = 3
"""Machines in a row that may be lost before a run has got any further."""
_SINGLE_THREADED = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
# JAX would give the first process three quarters of an accelerator's memory.
SHARED_ACCELERATOR = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}


@final
class Watched:
    """A run, and what it has written so far."""

    def __init__(self, path: Path, config: Config) -> None:
        self.path, self.config = path, config
        self.ended: str | None = "finished" if run_directory.is_finished(path) else None
        self.training = False
        self.row: dict[str, Any] = {}
        self.test: dict[str, Any] = {}
        self._read_to = 0  # bytes of the metrics

    def look(self) -> list[dict[str, Any]]:
        """Reads what the run has written since the last look; returns its new evaluations."""
        new = self._new_rows()
        evaluations = [row for row in new if row.get("kind") == "evaluation"]
        self.row = new[-1] if new else self.row
        self.test = evaluations[-1] if evaluations else self.test
        return evaluations

    def _new_rows(self) -> list[dict[str, Any]]:
        file = RunDirectory(self.path).metrics
        size = file.stat().st_size if file.exists() else 0
        if size <= self._read_to:
            # Shorter: the run was resumed and drops the rows written after its checkpoint.
            self._read_to = size
            return []
        with file.open("rb") as lines:
            lines.seek(self._read_to)
            whole = lines.read().rpartition(b"\n")[0]
        self._read_to += len(whole) + bool(whole)
        found = []
        for line in whole.splitlines():
            try:  # a damaged line is for the run itself to complain of
                found.append(parse(line))
            except ValueError:
                continue
        return [row for row in found if isinstance(row, dict) and "env_steps" in row]

    @property
    def stage(self) -> str:
        """What a person is told of it."""
        return self.ended or ("training" if self.training else "waiting")

    @property
    def name(self) -> str:
        """What it is called in lines and tables."""
        return self.path.name


@runtime_checkable
class Process(Protocol):
    """A process that goes on with some runs, wherever it is."""

    def poll(self) -> int | None:
        """Its exit status, None while it goes on, `LOST` if its machine is gone."""

    def interrupt(self) -> None:
        """Asks it to save and stop."""

    def end(self) -> None:
        """Ends it at once."""

    def told(self) -> str:
        """What is known of its end besides what it has written to its log."""


def command_for(paths: Sequence[Path], batching: Batching) -> list[str]:
    """What goes on with some runs in one process."""
    places = [str(path) for path in paths]
    if len(places) == 1:
        return [sys.executable, "-m", "race", "resume", *places]
    return [sys.executable, "-m", "race.cli.cohort", batching, *places]


def environment_for(core: int | None) -> dict[str, str]:
    """The variables of that process; with one thread if it is kept on one core."""
    return os.environ | SHARED_ACCELERATOR | ({} if core is None else _SINGLE_THREADED)


def start_here(
    paths: Sequence[Path], batching: Batching, log: Path, core: int | None, device: str | None
) -> "subprocess.Popen[bytes]":
    """Goes on with some runs on this machine, on one core or one accelerator if one is named."""
    environment = environment_for(core)
    if device is not None:
        environment |= {"CUDA_VISIBLE_DEVICES": device}
    with log.open("ab") as words:
        # A session of its own: Ctrl-C reaches this process, which passes it on once.
        process = subprocess.Popen(
            command_for(paths, batching),
            stdout=words,
            stderr=words,
            env=environment,
            start_new_session=True,
        )
    if core is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(process.pid, {core})
    return process


@final
class Worker:
    """One run or a cohort of some and, once started, its process.

    The words of a process go to ``log.txt`` beside the metrics of its first run.
    """

    def __init__(self, runs: Sequence[Watched], batching: Batching) -> None:
        self.runs, self.batching = list(runs), batching
        self.process: Process | None = None
        self.lost = False
        """Whether its last process was lost with its machine."""
        self._losses = 0  # since the runs last got further
        self._reached: list[int] = []
        self._told = ""

    @property
    def waiting(self) -> bool:
        """Whether something is left to do, and nobody does it."""
        return self.process is None and any(run.ended is None for run in self.runs)

    def start(self, take: Callable[[Sequence[Path], Batching, Path], Process]) -> None:
        """Goes on with the runs, wherever ``take`` does."""
        paths = [run.path for run in self.runs if run.ended is None]
        self.process, self.lost = take(paths, self.batching, self._log), False
        for run in self.runs:
            run.training = run.ended is None

    def look(self) -> list[tuple[Watched, dict[str, Any]]]:
        """Reads what the runs have written since the last look; returns new evaluations."""
        process = self.process
        code = None if process is None else process.poll()
        new = [(run, row) for run in self.runs for row in run.look()]
        if process is not None and code is not None:
            self.process, self._told = None, process.told()
            for run in [run for run in self.runs if run.ended is None]:
                run.training = False
                run.ended = {0: "finished", INTERRUPTED: "interrupted"}.get(code, "failed")
                if run_directory.is_finished(run.path):
                    run.ended = "finished"
                elif code == LOST and self._may_go_on():
                    run.ended = None
            self.lost = self.waiting
        return new

    def _may_go_on(self) -> bool:
        """Whether a lost machine was no fault of the runs: not if they get no further."""
        reached = [run.row.get("env_steps", 0) for run in self.runs]
        self._losses = self._losses + 1 if reached == self._reached else 1
        self._reached = reached
        return self._losses <= MOST_LOSSES

    @property
    def _log(self) -> Path:
        return self.runs[0].path / "log.txt"

    def complaint(self, run: Watched) -> str:
        """The last lines that were said of a failed run."""
        if self._told:
            return self._told
        lines = self._log.read_text(errors="replace").strip().splitlines()
        own = [line for line in lines if str(run.path) in line] if len(self.runs) > 1 else []
        return "\n".join((own or lines)[-3:])

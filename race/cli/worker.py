"""A process that trains one run or a cohort, seen from outside."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, final

from race.config.cohort import Batching
from race.config.settings import Config
from race.runs import directory as run_directory
from race.runs.directory import RunDirectory
from race.runs.sealed import parse

INTERRUPTED = 130
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


@final
class Worker:
    """One run or a cohort of some and, once started, its process.

    The words of a process go to ``log.txt`` beside the metrics of its first run.
    """

    def __init__(self, runs: Sequence[Watched], batching: Batching) -> None:
        self.runs, self._batching = list(runs), batching
        self.process: subprocess.Popen[bytes] | None = None
        self.core: int | None = None
        self.device: str | None = None

    @property
    def waiting(self) -> bool:
        """Whether something is left to do, and nobody does it."""
        return self.process is None and any(run.ended is None for run in self.runs)

    def start(self, core: int | None, device: str | None = None) -> None:
        """Goes on with the runs, on one core or one accelerator if one is named."""
        paths = [str(run.path) for run in self.runs if run.ended is None]
        command = [sys.executable, "-m", "race", "resume", *paths]
        if len(paths) > 1:
            command = [sys.executable, "-m", "race.cli.cohort", self._batching, *paths]
        environment = os.environ | SHARED_ACCELERATOR | ({} if core is None else _SINGLE_THREADED)
        if device is not None:
            environment |= {"CUDA_VISIBLE_DEVICES": device}
        with self._log.open("ab") as log:
            # A session of its own: Ctrl-C reaches this process, which passes it on once.
            self.process = subprocess.Popen(
                command, stdout=log, stderr=log, env=environment, start_new_session=True
            )
        self.core, self.device = core, device
        for run in self.runs:
            run.training = run.ended is None
        if core is not None and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(self.process.pid, {core})

    def look(self) -> list[tuple[Watched, dict[str, Any]]]:
        """Reads what the runs have written since the last look; returns new evaluations."""
        code = None if self.process is None else self.process.poll()
        new = [(run, row) for run in self.runs for row in run.look()]
        if code is not None:
            self.process = None
            for run in [run for run in self.runs if run.ended is None]:
                run.training = False
                run.ended = {0: "finished", INTERRUPTED: "interrupted"}.get(code, "failed")
                if run_directory.is_finished(run.path):
                    run.ended = "finished"
        return new

    @property
    def _log(self) -> Path:
        return self.runs[0].path / "log.txt"

    def complaint(self, run: Watched) -> str:
        """The last lines that were said of a failed run."""
        lines = self._log.read_text(errors="replace").strip().splitlines()
        own = [line for line in lines if str(run.path) in line] if len(self.runs) > 1 else []
        return "\n".join((own or lines)[-3:])

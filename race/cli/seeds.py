"""Several seeds of one run at once, each in a process and a directory of its own.

The directories are made here; every process is then `race resume` of one of them, so that a first
start and a later one are the same thing.
"""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, final

from rich.console import Console
from rich.live import Live
from rich.table import Table

from race.cli import streams
from race.cli.progress import duration, test_summary
from race.config.presets import resolve
from race.config.settings import Config
from race.errors import ConfigError, RunDirectoryError, command
from race.runs import directory as run_directory
from race.runs.directory import RunDirectory
from race.runs.sealed import parse

MOST_SEEDS = 1000
"""Runs of one command: more is a slip of the hand."""
LOOK_EVERY = 0.5
"""Seconds between two looks at the runs."""
_INTERRUPTED = 130
_SINGLE_THREADED = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
# JAX would give the first process three quarters of an accelerator's memory.
SHARED_ACCELERATOR = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}


def parse_seeds(text: str) -> list[int]:
    """The seeds of ``1-5``, ``1,4,7`` or ``1-3,9``.

    Raises:
        ConfigError: if it is none of these, or names a seed twice.
    """
    seeds: list[int] = []
    try:
        for part in text.split(","):
            first, dash, last = part.strip().partition("-")
            begin, end = int(first), int(last if dash else first)
            if not 0 <= end - begin < MOST_SEEDS:
                raise ValueError("an empty range, or an endless one")
            seeds += range(begin, end + 1)
    except ValueError as error:
        raise ConfigError(
            f"--seeds is {text!r}, but it must be like 1-5, or 1,4,7, or 1-3,9, "
            f"and name at most {MOST_SEEDS} seeds."
        ) from error
    if len(seeds) > MOST_SEEDS:
        raise ConfigError(f"--seeds is {text!r}, which names more than {MOST_SEEDS} seeds.")
    if len(set(seeds)) < len(seeds):
        raise ConfigError(f"--seeds is {text!r}, which names a seed twice.")
    return seeds


def check_jobs(jobs: int | None) -> None:
    """Refuses a number of jobs that is none.

    Raises:
        ConfigError: if there would be none.
    """
    if jobs is not None and jobs < 1:
        raise ConfigError(f"--jobs is {jobs}, but it must be at least 1.")


def directories_of(path: Path) -> list[Path]:
    """The runs of several seeds in ``path``, in order of their seeds; none if it holds none."""
    found = [file.parent for file in path.glob("seed*/config.json")]
    return sorted(found, key=lambda run: (len(run.name), run.name))


@final
class Worker:
    """A run and, once started, its process, whose words go to ``log.txt`` beside its metrics."""

    def __init__(self, path: Path, config: Config) -> None:
        self.path, self.config = path, config
        self.process: subprocess.Popen[bytes] | None = None
        self.core: int | None = None
        self.ended: str | None = "finished" if run_directory.is_finished(path) else None
        self.row: dict[str, Any] = {}
        self.test: dict[str, Any] = {}
        self._read_to = 0  # bytes of the metrics

    def start(self, core: int | None) -> None:
        """Goes on with the run, on one core if one is named."""
        command = [sys.executable, "-m", "race", "resume", str(self.path)]
        environment = os.environ | SHARED_ACCELERATOR | ({} if core is None else _SINGLE_THREADED)
        with (self.path / "log.txt").open("ab") as log:
            # A session of its own: Ctrl-C reaches this process, which passes it on once.
            self.process = subprocess.Popen(
                command, stdout=log, stderr=log, env=environment, start_new_session=True
            )
        self.core = core
        if core is not None and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(self.process.pid, {core})

    def look(self) -> list[dict[str, Any]]:
        """Reads what the run has written since the last look; returns its new evaluations."""
        code = None if self.process is None else self.process.poll()
        new = self._new_rows()
        evaluations = [row for row in new if row.get("kind") == "evaluation"]
        self.row = new[-1] if new else self.row
        self.test = evaluations[-1] if evaluations else self.test
        if code is not None:
            self.process = None
            self.ended = {0: "finished", _INTERRUPTED: "interrupted"}.get(code, "failed")
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
        return self.ended or ("training" if self.process else "waiting")

    def complaint(self) -> str:
        """The last lines that a failed run said."""
        lines = (self.path / "log.txt").read_text(errors="replace").strip().splitlines()
        return "\n".join(lines[-3:])


@final
class _Signals:
    """The first SIGINT, SIGTERM or SIGHUP asks the runs to save and stop; a second ends them."""

    def __init__(self, workers: Sequence[Worker]) -> None:
        self.requested = False
        self._workers = workers
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "_Signals":
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number == signal.SIGHUP and signal.getsignal(number) == signal.SIG_IGN:
                continue  # as under nohup
            self._previous[number] = signal.signal(number, self._pass_on)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        for worker in self._workers:  # none is left where all went well
            if worker.process is not None:
                worker.process.terminate()

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        for worker in self._workers:
            self.stop(worker)

    def stop(self, worker: Worker) -> None:
        """Asks one run to save and stop."""
        if worker.process is not None:
            worker.process.send_signal(signal.SIGINT)


def run_all(
    path: Path, jobs: int | None, env_steps: int | None = None, console: Console | None = None
) -> None:
    """Trains every unfinished run in ``path``, some at a time. Exits with 130 on Ctrl-C.

    Args:
        path: the folder that holds them.
        jobs: runs at a time, each kept on one core if there are several; None: as many as cores,
            or one on an accelerator.
        env_steps: a new budget for all.
        console: where it is shown.

    Raises:
        RunDirectoryError: if a run failed; the others are trained to their end first.
        ConfigError: if there would be no job at a time, or nothing to extend.
    """
    check_jobs(jobs)
    console = console or streams.console(tolerant=True)
    if env_steps is not None:
        _extend(path, env_steps)
    workers = [Worker(run, run_directory.open_run(run)) for run in directories_of(path)]
    for worker in workers:
        worker.look()
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    jobs = min(jobs or _usual_jobs(cores), len(workers))
    pinned = jobs > 1 and cores
    free: list[int | None] = [cores[k % len(cores)] if pinned else None for k in range(jobs)]
    with (
        _Signals(workers) as signals,
        Live(console=console, refresh_per_second=2, transient=True) as live,
    ):
        while True:
            waiting = [w for w in workers if w.ended is None and w.process is None]
            if waiting and free and not signals.requested:
                waiting[0].start(free.pop(0))
                if signals.requested:  # between the start and the noting of it
                    signals.stop(waiting[0])
                continue
            for worker in [worker for worker in workers if worker.process is not None]:
                for row in worker.look():
                    console.print(_line(worker, row), soft_wrap=True)
                if worker.process is None:
                    if signals.requested and worker.ended == "failed":
                        # Stopped before it could listen; nothing is lost.
                        worker.ended = "interrupted"
                    free.append(worker.core)
                    console.print(f"seed {worker.config.seed}: {worker.stage}")
            live.update(_table(workers))
            if not any(w.process for w in workers) and (signals.requested or not waiting):
                break
            time.sleep(LOOK_EVERY)
    _say_how_it_ended(path, workers, console)


def _usual_jobs(cores: Sequence[int]) -> int:
    import jax

    return max(len(cores), 1) if jax.default_backend() == "cpu" else 1


def _extend(path: Path, env_steps: int) -> None:
    """Gives every run a new budget before any goes on, so that a stop in between forgets none.

    Raises:
        ConfigError: if no run is short of it.
    """
    short = []
    for place in directories_of(path):
        worker = Worker(place, run_directory.open_run(place))
        worker.look()
        made = worker.row.get("env_steps", 0)
        if not (worker.ended and made >= env_steps):
            short.append((place, resolve(dataclasses.replace(worker.config, env_steps=env_steps))))
    if not short:
        raise ConfigError(
            f"All runs in {path} have made {env_steps:,} environment steps or more, so --env-steps "
            f"{env_steps} would not extend them. Ask for more."
        )
    for place, config in short:
        with run_directory.lock(place):
            run_directory.clear_finished(place)
            run_directory.change_config(place, config)


def _say_how_it_ended(path: Path, workers: Sequence[Worker], console: Console) -> None:
    failed = [worker for worker in workers if worker.ended == "failed"]
    if failed:
        raise RunDirectoryError(
            "\n".join(f"Seed {w.config.seed} failed, in {w.path}: {w.complaint()}" for w in failed)
        )
    if any(worker.ended != "finished" for worker in workers):
        message = f"Interrupted and saved. Go on with: {command('race', 'resume', path)}"
        console.print(message, soft_wrap=True)
        sys.exit(_INTERRUPTED)
    plot = command("race", "plot", path, "--out", "curves.png")
    console.print(f"All {len(workers)} seeds have finished. Next: {plot}", soft_wrap=True)


def _line(worker: Worker, row: dict[str, Any]) -> str:
    return (
        f"seed {worker.config.seed}: {row['env_steps']:>9,} steps, "
        f"{duration(row['wall_seconds']):>7}: test return {test_summary(row)}"
    )


def _table(workers: Sequence[Worker]) -> Table:
    table = Table("seed", "state", "steps", "time", "test return", box=None, pad_edge=False)
    for worker in workers:
        steps, total = worker.row.get("env_steps", 0), worker.config.env_steps
        table.add_row(
            str(worker.config.seed),
            worker.stage,
            f"{steps:,} of {total:,} ({min(steps / total, 1.0):.0%})",
            duration(worker.row.get("wall_seconds", 0.0)),
            test_summary(worker.test) if worker.test else "",
        )
    return table

"""A cohort on a machine of a cluster: what a task does there.

It runs the same process as `race.cli.fleet` does on one machine, kept on one core, and ends with
it. That whoever has sent it wishes it to stop, it learns from a file in the shared folder.
"""

import contextlib
import fcntl
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from race.cli.worker import INTERRUPTED, command_for, environment_for
from race.compilation import cores
from race.config.cohort import Batching
from race.errors import RunDirectoryError
from race.runs import directory as run_directory

LOOK_EVERY = 0.3
"""Seconds between two looks for the end and for the wish to stop."""
WAIT_FOR_LOCK = 60.0
"""Seconds in which a process on a machine that was lost lets go of its runs."""
STOP = "stop"
"""The file whose appearance asks all tasks to save and stop."""


def begun(folder: Path, number: int) -> Path:
    """The file that says that a task has begun."""
    return folder / f"begun-{number}"


def carry_out(
    folder: Path, number: int, paths: Sequence[Path], batching: Batching, here: Path, gpus: int
) -> int:
    """Goes on with some runs to their end; returns the exit status of the process that did.

    Args:
        folder: in the shared folder, for signs between tasks and whoever sends them.
        number: of the task.
        paths: the runs' directories.
        batching: how a cohort is computed.
        here: the working directory of whoever sends it, used where there is such a folder.
        gpus: accelerators that the task has; with some it is not kept on one core.

    Raises:
        RunDirectoryError: if this machine does not see the runs, or another process keeps them.
    """
    host = socket.gethostname()
    if missing := [path for path in paths if not (path / "config.json").exists()]:
        raise RunDirectoryError(
            f"The machine {host} sees no run in {missing[0]}. Runs of a cluster must lie in a "
            "folder that all of its machines share under one name: choose it with --run-dir, "
            "for race reproduce with --dir."
        )
    begun(folder, number).write_text(host)
    stop = folder / STOP
    with _a_core(None if gpus else cores()) as core, (paths[0] / "log.txt").open("ab") as log:
        _wait_for_locks(paths)
        if stop.exists():
            return INTERRUPTED
        tied = [sys.executable, "-m", "race.cli.tied", str(os.getpid())]
        process = subprocess.Popen(
            [*tied, *command_for(paths, batching)],
            stdout=log,
            stderr=log,
            env=environment_for(core),
            start_new_session=True,
            cwd=here if here.is_dir() else None,
        )
        try:
            if core is not None:
                os.sched_setaffinity(process.pid, {core})
            return _watched(process, stop)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()


def _watched(process: "subprocess.Popen[bytes]", stop: Path) -> int:
    asked = False
    while (code := process.poll()) is None:
        try:
            if not asked and stop.exists():
                process.send_signal(signal.SIGINT)
                asked = True
            time.sleep(LOOK_EVERY)
        except KeyboardInterrupt:  # a task that is cancelled
            process.send_signal(signal.SIGINT)
            asked = True
    return code


def _wait_for_locks(paths: Sequence[Path]) -> None:
    until = time.monotonic() + WAIT_FOR_LOCK
    for path in paths:
        while True:
            try:
                with run_directory.lock(path):
                    break
            except RunDirectoryError:
                if time.monotonic() > until:
                    raise
                time.sleep(LOOK_EVERY)


@contextlib.contextmanager
def _a_core(usable: Sequence[int] | None) -> Iterator[int | None]:
    """A core of this machine that no other task of this user has; any where there is none."""
    if not usable:
        yield None
        return
    folder = Path(tempfile.gettempdir()) / f"race-cores-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    for core in usable:
        with (folder / str(core)).open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield core
            return
    yield usable[os.getpid() % len(usable)]

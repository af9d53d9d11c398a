"""Several runs at once, each in a directory of its own, in processes of one run or of a cohort.

The directories are there before; every process is then `race resume` of one of them or of several,
so that a first start and a later one are the same thing.
"""

import dataclasses
import os
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, final

from rich.console import Console
from rich.live import Live
from rich.table import Table

from race.cli import streams
from race.cli.cluster import Cluster, check_address
from race.cli.machines import Machines, ThisMachine
from race.cli.needs import need_of
from race.cli.worker import INTERRUPTED, Watched, Worker
from race.compilation import cores
from race.config.cohort import Batching, CohortConfig
from race.config.presets import resolve
from race.errors import ConfigError, RunDirectoryError, command
from race.runs import directory as run_directory
from race.training.cohort import kind_of
from race.training.interrupts import Handlers, give_back, listen
from race.viewing.progress import duration, test_summary

LOOK_EVERY = 0.5
"""Seconds between two looks at the runs."""
MOST_SHOWN = 20
"""Runs that the display lists at once."""


def check_jobs(jobs: int | None, on: str | None = None) -> None:
    """Refuses a number of jobs that is none, and what names no cluster.

    Raises:
        ConfigError: if there would be none, or nowhere.
    """
    if on is not None:
        check_address(on)
    if jobs is not None and jobs < 1:
        raise ConfigError(f"--jobs is {jobs}, but it must be at least 1.")


def refuse_for_one_run(jobs: int | None, cohort: CohortConfig, on: str | None, told: str) -> None:
    """Refuses settings that are for several runs, where there is one.

    Raises:
        ConfigError: naming the first that was given; ``told`` says where it has no effect.
    """
    several = ("jobs", jobs is not None), ("cohort.*", cohort != CohortConfig())
    for option, given in (*several, ("on", on is not None)):
        if given:
            raise ConfigError(f"--{option} has no effect {told}")


def directories_of(path: Path) -> list[Path]:
    """The runs of several seeds or of a sweep in ``path``, in their order; none if there are none.

    Names are ordered as people count: seed2 before seed10.
    """
    found = [file.parent for file in path.glob("*/config.json")]
    return sorted(found, key=lambda run: (len(run.name), run.name))


@final
class _Signals:
    """The first SIGINT, SIGTERM or SIGHUP asks the runs to save and stop; a second ends them."""

    def __init__(self, workers: Sequence[Worker]) -> None:
        self.requested = False
        self._workers = workers
        self._previous: Handlers = {}

    def __enter__(self) -> "_Signals":
        self._previous = listen(self._pass_on)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        give_back(self._previous)
        for worker in self._workers:  # none is left where all went well
            if worker.process is not None:
                worker.process.end()

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        for worker in self._workers:
            self.stop(worker)

    def stop(self, worker: Worker) -> None:
        """Asks one run to save and stop."""
        if worker.process is not None:
            worker.process.interrupt()


def crews(
    runs: Sequence[Watched], batching: Batching, width: int | None, devices: int
) -> list[list[Watched]]:
    """Which runs are trained by one process: those of a cohort, or each by itself.

    Args:
        runs: all of them.
        batching: how cohorts are computed; auto: on processors there are none, since processes side
            by side use more of them.
        width: most runs of a cohort; None: as many as leave each device one.
        devices: accelerators, 0 where there are none.
    """
    if batching == "auto" and devices == 0:
        return [[run] for run in runs]
    kinds: dict[Any, list[Watched]] = {}
    for run in runs:
        kinds.setdefault(kind_of(run.config), []).append(run)
    made: list[list[Watched]] = []
    for alike in kinds.values():
        most = width or -(-len(alike) // max(devices, 1))
        made += [alike[i : i + most] for i in range(0, len(alike), most)]
    return made


def run_all(
    path: Path,
    places: Sequence[Path],
    *,
    jobs: int | None = None,
    env_steps: int | None = None,
    cohort: CohortConfig | None = None,
    on: str | None = None,
    console: Console | None = None,
) -> None:
    """Trains every unfinished run, some at a time. Exits with 130 on Ctrl-C.

    Args:
        path: the folder that holds them.
        places: the runs' directories.
        jobs: processes at a time, each kept on one core if there are several; None: as many as
            cores, or as accelerators.
        env_steps: a new budget for all.
        cohort: which runs share a process.
        on: the cluster that they run on (`race.cli.cluster`); None: this machine.
        console: where it is shown.

    Raises:
        RunDirectoryError: if a run failed; the others are trained to their end first.
        ConfigError: if there would be no job at a time, or nothing to extend.
        RaceError: if the cluster cannot be used.
    """
    check_jobs(jobs, on)
    cohort = cohort or CohortConfig()
    console = console or streams.console(tolerant=True)
    if env_steps is not None:
        _extend(path, places, env_steps)
    runs = [Watched(run, run_directory.open_run(run)) for run in places]
    for run in runs:
        run.look()
    with ExitStack() as stack:
        cluster: Cluster | None = None
        if on is not None and any(run.ended is None for run in runs):
            with console.status(f"connecting to {on}"):
                cluster = stack.enter_context(Cluster(on, path))
        devices = accelerators() if cluster is None else cluster.gpus
        groups = crews(runs, cohort.batching, cohort.width, devices)
        workers = [Worker(group, cohort.batching) for group in groups]
        if cluster is None:
            machines: Machines = _this_machine(jobs, len(workers), devices)
        else:
            cluster.plan({w.runs[0].path: need_of(w.runs, devices) for w in workers}, jobs)
            machines = cluster
        _watch(runs, workers, machines, console)
    _say_how_it_ended(path, workers, console)


def _watch(
    runs: Sequence[Watched], workers: Sequence[Worker], machines: Machines, console: Console
) -> None:
    """Starts processes as there is room for them, and shows how they get on, to the end."""
    with (
        _Signals(workers) as signals,
        Live(console=console, refresh_per_second=2, transient=True) as live,
    ):
        while True:
            waiting = [worker for worker in workers if worker.waiting]
            if waiting and not signals.requested and machines.room():
                waiting[0].start(machines.start)
                if signals.requested:  # between the start and the noting of it
                    signals.stop(waiting[0])
                continue
            for worker in [worker for worker in workers if worker.process is not None]:
                for run, row in worker.look():
                    console.print(_line(run, row), soft_wrap=True)
                if worker.process is None:
                    for run in worker.runs:
                        if signals.requested and run.ended in ("failed", None):
                            # Stopped before it could listen; nothing is lost.
                            run.ended = "interrupted"
                        lost = "its machine was lost; it goes on from its last checkpoint"
                        console.print(f"{run.name}: {lost if worker.lost else run.stage}")
            live.update(_table(runs))
            left = not signals.requested and any(worker.waiting for worker in workers)
            if not left and not any(worker.process for worker in workers):
                break
            time.sleep(LOOK_EVERY)


def _this_machine(jobs: int | None, processes: int, devices: int) -> ThisMachine:
    usable = cores()
    jobs = min(jobs or devices or max(len(usable), 1), processes)
    pinned = jobs > 1 and usable and not devices
    named = _names_of(devices)
    return ThisMachine(
        [
            (usable[k % len(usable)] if pinned else None, named[k % devices] if devices else None)
            for k in range(jobs)
        ]
    )


def accelerators() -> int:
    """How many there are that JAX uses; 0 where it computes on processors."""
    import jax

    return 0 if jax.default_backend() == "cpu" else jax.local_device_count()


def _names_of(devices: int) -> list[str]:
    """What the accelerators are called in ``CUDA_VISIBLE_DEVICES``."""
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    return visible or [str(k) for k in range(devices)]


def _extend(path: Path, places: Sequence[Path], env_steps: int) -> None:
    """Gives every run a new budget before any goes on, so that a stop in between forgets none.

    Raises:
        ConfigError: if no run is short of it.
    """
    short = []
    for place in places:
        run = Watched(place, run_directory.open_run(place))
        run.look()
        made = run.row.get("env_steps", 0)
        if not (run.ended and made >= env_steps):
            short.append((place, resolve(dataclasses.replace(run.config, env_steps=env_steps))))
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
    runs = [run for worker in workers for run in worker.runs]
    failed = [(w, run) for w in workers for run in w.runs if run.ended == "failed"]
    if failed:
        raise RunDirectoryError(
            "\n".join(f"{r.name} failed, in {r.path}: {w.complaint(r)}" for w, r in failed)
        )
    if any(run.ended != "finished" for run in runs):
        message = f"Interrupted and saved. Go on with: {command('race', 'resume', path)}"
        console.print(message, soft_wrap=True)
        sys.exit(INTERRUPTED)
    plot = command("race", "plot", path, "--out", "curves.png")
    console.print(f"All {len(runs)} runs have finished. Next: {plot}", soft_wrap=True)


def _line(run: Watched, row: dict[str, Any]) -> str:
    return (
        f"{run.name}: {row['env_steps']:>9,} steps, "
        f"{duration(row['wall_seconds']):>7}: test return {test_summary(row)}"
    )


def _table(runs: Sequence[Watched]) -> Table:
    table = Table("run", "state", "steps", "time", "test return", box=None, pad_edge=False)
    # A terminal's height of those that go on; the finished are counted.
    shown = [run for run in runs if run.ended != "finished"][:MOST_SHOWN] or runs[-MOST_SHOWN:]
    for run in shown:
        steps, total = run.row.get("env_steps", 0), run.config.env_steps
        table.add_row(
            run.name,
            run.stage,
            f"{steps:,} of {total:,} ({min(steps / total, 1.0):.0%})",
            duration(run.row.get("wall_seconds", 0.0)),
            test_summary(run.test) if run.test else "",
        )
    made = sum(min(run.row.get("env_steps", 0), run.config.env_steps) for run in runs)
    total = sum(run.config.env_steps for run in runs)
    finished = sum(run.ended == "finished" for run in runs)
    table.add_row("", f"{finished} of {len(runs)} finished", f"{made / total:.0%} of all", "", "")
    return table

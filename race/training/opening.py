"""A run directory to go on with: locked, read, and made a run in progress."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import jax

from race.algorithms import algorithm_of
from race.config.settings import Config
from race.envs.description import refuse_changed
from race.errors import ConfigError, command
from race.rollouts import Rollouts
from race.runs import checkpoints
from race.runs import directory as run_directory
from race.runs import metrics as metrics_file
from race.runs.directory import RunDirectory
from race.runs.metrics import MetricsWriter, set_aside
from race.training.clock import Clock
from race.training.inheriting import inherit
from race.training.interrupts import Interrupts
from race.training.records import lost_row
from race.training.run import Report, Run, silent
from race.training.run_state import Progress, RunState, fresh, is_over
from race.training.saving import (
    check_owner,
    check_version,
    from_checkpoint,
    metrics_kept,
    progress_of,
    save,
)
from race.types import AnyTask


@dataclass(frozen=True)
class Order:
    """A run directory to go on with, made by `race.runs.directory.create`."""

    path: Path
    config: Config
    """Its configuration, resolved."""
    extend: bool = False
    """Whether ``config.env_steps`` is a new budget, to be kept in the directory."""
    without_metrics: bool = False
    """Whether to go on with new metrics, because those before are lost."""
    report: Report = silent
    """Told what is going on."""


def begin(
    order: Order,
    path: Path,
    task: AnyTask,
    rollouts: Rollouts,
    interrupts: Interrupts,
    files: ExitStack,
    began: float,
) -> tuple[Run, RunState] | Progress:
    """The run of a directory, in the state of its newest checkpoint or before its first step.

    Args:
        order: the directory, as it was given.
        path: the directory, whatever the current one is by now.
        task: what it is trained on.
        rollouts: its environments.
        interrupts: wishes to stop.
        files: keeps the lock and the metrics of the run.
        began: `time.perf_counter` when the process began.

    Returns:
        Its progress alone if there is nothing to do.

    Raises:
        RaceError: if it cannot go on.
    """
    config, directory = order.config, RunDirectory(path)
    algorithm, origin = algorithm_of(config), run_directory.read_metadata(path)
    refuse_changed(run_directory.recorded_task(path), task)
    with ExitStack() as opened:
        opened.enter_context(run_directory.lock(path))
        identity = run_directory.identity_of(path)
        newest = checkpoints.newest(directory.checkpoints)
        saved = None if newest is None else checkpoints.load(newest)
        if saved is not None:
            check_owner(saved, identity)
        made = Progress() if saved is None else progress_of(saved)
        kept = metrics_kept(saved)
        if not _must_go_on(order, made):
            metrics_file.read(directory.metrics, identity, kept)
            run_directory.mark_finished(path)
            return made
        if saved is None:
            check_version(origin.get("algorithm_version", 1) if origin else None)
            state = fresh(config, task.spec, algorithm, rollouts.empty_replay(config))
            if config.init_from is not None:
                state = inherit(path, state, config, task.spec)
        else:
            # An empty buffer beside the full one would take as much memory again.
            shapes = jax.eval_shape(lambda: rollouts.empty_replay(config))
            state = from_checkpoint(saved, config, task.spec, algorithm, shapes)
        del saved  # its buffer too
        if order.without_metrics:
            kept = set_aside(directory.metrics, kept)
        run = Run(
            config=config,
            task=task,
            algorithm=algorithm,
            directory=directory,
            rollouts=rollouts,
            metrics=opened.enter_context(MetricsWriter(directory.metrics, kept, identity)),
            interrupts=interrupts,
            report=order.report,
            clock=Clock(state.progress.times, config.checkpoint.minutes),
            began=began,
            identity=identity,
        )
        if order.extend:
            # Once nothing can refuse the run any more, and in this order: a kill in between
            # leaves a run that is merely unfinished.
            run_directory.clear_finished(path)
            run_directory.change_config(path, config)
        if order.without_metrics:
            run.metrics.write(lost_row(state.progress))
            save(run, state)  # the checkpoints before know of other rows
        files.enter_context(opened.pop_all())
    return run, state


def _must_go_on(order: Order, progress: Progress) -> bool:
    path, config = order.path, order.config
    steps = f"The run in {path} has made {progress.env_steps:,} environment steps"
    if order.extend and config.env_steps <= progress.env_steps:
        raise ConfigError(
            f"{steps}, so --env-steps {config.env_steps} would not extend it. Ask for more, or "
            "leave --env-steps away to go on with what it began with."
        )
    if is_over(config, progress) and run_directory.is_finished(path):
        without = ["--without-metrics"] if order.without_metrics else []
        raise ConfigError(
            f"{steps} and has finished. To train it further, say up to how many steps: "
            + command("race", "resume", path, "--env-steps", 2 * config.env_steps, *without)
        )
    return not is_over(config, progress)

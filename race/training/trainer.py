"""Training from the start or from a checkpoint, until the budget is used up.

Everything that changes is one `RunState`; a generation maps it to the next. All randomness is
drawn by purpose and counter from the run's seed, environments are reset with explicit seeds, and
gradient steps may be split over calls in any way. So a run that goes on from a checkpoint,
wherever it was written, does what the uninterrupted run does.
"""

import time
from pathlib import Path

import jax

from race.algorithms import algorithm_of
from race.config.settings import Config
from race.envs import make_task
from race.envs.description import refuse_changed
from race.errors import ConfigError, DivergenceError, TaskError, command
from race.rollouts import rollouts_of
from race.runs import checkpoints
from race.runs import directory as run_directory
from race.runs import metrics as metrics_file
from race.runs.directory import RunDirectory
from race.runs.metrics import MetricsWriter, set_aside
from race.training.clock import Clock
from race.training.generation import advance, warm_up
from race.training.interrupts import Interrupts
from race.training.records import lost_row
from race.training.run import Report, Run, silent
from race.training.run_state import Progress, RunState, fresh
from race.training.saving import (
    check_owner,
    check_version,
    from_checkpoint,
    metrics_kept,
    progress_of,
    save,
)


def train(
    path: Path,
    config: Config,
    *,
    extend: bool = False,
    without_metrics: bool = False,
    report: Report = silent,
    began: float | None = None,
) -> Progress:
    """Trains in ``path``: from the newest checkpoint if there is one, else from the start.

    ``path`` is a run directory made by `race.runs.directory.create`. Returns how far it came:
    short of ``config.env_steps`` if it was interrupted, after saving a checkpoint.

    Args:
        path: the run directory.
        config: its configuration, resolved.
        extend: whether ``config.env_steps`` is a new budget, to be kept in the directory.
        without_metrics: whether to go on with new metrics, because those before are lost.
        report: told what is going on.
        began: `time.perf_counter` when the process began.

    Raises:
        RaceError: each with a message for the user; see the subclasses in `race.errors`.
    """
    began = time.perf_counter() if began is None else began
    # An environment may change the current directory.
    given, path = path, path.absolute()
    directory, algorithm = RunDirectory(path), algorithm_of(config)
    report("preparing the task", Progress(), {})
    task, origin = make_task(config.task, config.env), run_directory.read_metadata(path)
    refuse_changed(run_directory.recorded_task(path), task)
    with run_directory.lock(path):
        identity = run_directory.identity_of(path)
        newest = checkpoints.newest(directory.checkpoints)
        saved = None if newest is None else checkpoints.load(newest)
        if saved is not None:
            check_owner(saved, identity)
        made = Progress() if saved is None else progress_of(saved)
        kept = metrics_kept(saved)
        without = ["--without-metrics"] if without_metrics else []
        if not _must_go_on(given, config, extend, made, without):
            metrics_file.read(directory.metrics, identity, kept)
            run_directory.mark_finished(path)
            return made
        rollouts = rollouts_of(config, task, proven=made.env_steps > 0)
        if saved is None:
            check_version(origin.get("algorithm_version", 1) if origin else None)
            state = fresh(config, task.spec, algorithm, rollouts.empty_replay())
        else:
            # An empty buffer beside the full one would take as much memory again.
            shapes = jax.eval_shape(rollouts.empty_replay)
            state = from_checkpoint(saved, config, task.spec, algorithm, shapes)
        del saved  # its buffer too
        if without_metrics:
            kept = set_aside(directory.metrics, kept)
        with (
            rollouts,
            MetricsWriter(directory.metrics, kept, identity) as metrics,
            Interrupts() as interrupts,
        ):
            if extend:
                # Once nothing can refuse the run any more, and in this order: a kill in between
                # leaves a run that is merely unfinished.
                run_directory.clear_finished(path)
                run_directory.change_config(path, config)
            run = Run(
                config=config,
                task=task,
                algorithm=algorithm,
                directory=directory,
                rollouts=rollouts,
                metrics=metrics,
                interrupts=interrupts,
                report=report,
                clock=Clock(state.progress.times, config.checkpoint.minutes),
                began=began,
                identity=identity,
                repeated_before=state.progress.repeated,
            )
            try:
                if without_metrics:
                    metrics.write(lost_row(state.progress))
                    save(run, state)  # the checkpoints before know of other rows
                progress = _train(run, state).progress
            except DivergenceError as error:
                raise DivergenceError(f"{error} {_last_good(directory)}") from error
        if is_over(config, progress):
            run_directory.mark_finished(path)
    return progress


def is_over(config: Config, progress: Progress) -> bool:
    """Whether the budget is used up and the last generation complete."""
    return progress.env_steps >= config.env_steps and not progress.learning


def _must_go_on(
    path: Path, config: Config, extend: bool, progress: Progress, without: list[str]
) -> bool:
    steps = f"The run in {path} has made {progress.env_steps:,} environment steps"
    if extend and config.env_steps <= progress.env_steps:
        raise ConfigError(
            f"{steps}, so --env-steps {config.env_steps} would not extend it. Ask for more, or "
            "leave --env-steps away to go on with what it began with."
        )
    if is_over(config, progress) and run_directory.is_finished(path):
        raise ConfigError(
            f"{steps} and has finished. To train it further, say up to how many steps: "
            + command("race", "resume", path, "--env-steps", 2 * config.env_steps, *without)
        )
    return not is_over(config, progress)


def _last_good(directory: RunDirectory) -> str:
    newest = checkpoints.newest(directory.checkpoints)
    if newest is None:
        return "There is no checkpoint yet."
    return f"The last good checkpoint is {newest}; evaluate and render use it."


def _advance(run: Run, state: RunState) -> RunState:
    """`advance`; if an environment ends it, what was before is saved first.

    Raises:
        TaskError: if an environment fails, or hands over what it may not.
    """
    rows = run.metrics.offset
    try:
        return advance(run, state)
    except TaskError as error:
        run.metrics.forget(rows)  # they are written again when the run goes on
        save(run, state)
        go_on = command("race", "resume", run.directory.path)
        raise type(error)(
            f"{error} The run was saved at {state.progress.env_steps:,} environment steps; once "
            f"that is mended, go on with: {go_on}"
        ) from error


def _train(run: Run, state: RunState) -> RunState:
    if state.progress.env_steps == 0:
        try:
            state = warm_up(run, state)
        except TaskError as error:
            begin = command("race", "resume", run.directory.path)
            raise type(error)(
                f"{error} Nothing had been learned yet; once that is mended, begin again with: "
                f"{begin}"
            ) from error
        if run.interrupts.requested:
            return state  # there is nothing yet that starting again would not bring back
        save(run, state)
    while not is_over(run.config, state.progress):
        state = _advance(run, state)
        if run.interrupts.requested:
            break
        if run.clock.checkpoint_due():
            save(run, state)
    save(run, state)
    return state

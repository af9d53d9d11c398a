"""The runs of a cohort from wherever they are to their end, or until a person asks to stop.

A run that diverges, or whose directory can no longer be written, leaves the others to go on.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass

from race.errors import DivergenceError, RaceError, TaskError, command
from race.runs import checkpoints
from race.runs import directory as run_directory
from race.training.cohort import advance
from race.training.generation import warm_up
from race.training.run import Run
from race.training.run_state import Progress, RunState, is_over
from race.training.saving import save

Results = dict[int, Progress | RaceError]
"""How far each run came, or what ended it, by its place."""


@dataclass
class Member:
    """A run of a cohort: its place among the others, and how far it is."""

    place: int
    run: Run
    state: RunState

    @property
    def over(self) -> bool:
        """Whether it has nothing left to do."""
        return is_over(self.run.config, self.state.progress)


def lockstep(members: list[Member], as_one: bool, results: Results) -> None:
    """Trains until all are over, or a person asks to stop; all that was done is saved.

    Args:
        members: the runs; those that fail are taken out.
        as_one: whether they are one program.
        results: is told of each how it ended.

    Raises:
        TaskError: if an environment fails, which ends all.
        RaceError: if the only run cannot be saved, or its rows not be written.
    """
    alone = len(members) == 1
    for member in list(members):
        _warm_up(member, members, results, alone)
    while any(not m.over for m in members) and not members[0].run.interrupts.requested:
        going = [member for member in members if not member.over]
        try:
            _advance(members, as_one, results, alone)
        except TaskError as error:
            raise _saved(error, going, results) from error
        for member in [m for m in going if m in members]:
            stopping = member.run.interrupts.requested  # then all are saved below
            if member.over or (not stopping and member.run.clock.checkpoint_due()):
                _save(member, members, results, alone)
    for member in list(members):
        if not member.over:
            _save(member, members, results, alone)
    for member in members:
        results[member.place] = member.state.progress


def _warm_up(member: Member, members: list[Member], results: Results, alone: bool) -> None:
    if member.state.progress.env_steps > 0:
        return
    try:
        member.state = warm_up(member.run, member.state)
    except TaskError as error:
        path = member.run.directory.path
        begin = command("race", "resume", path if alone else path.parent)
        raise type(error)(
            f"{error} Nothing had been learned yet; once that is mended, begin again with: {begin}"
        ) from error
    if member.run.interrupts.requested:
        # There is nothing yet that starting again would not bring back.
        members.remove(member)
        results[member.place] = member.state.progress
    else:
        _save(member, members, results, alone)


def _advance(members: list[Member], as_one: bool, results: Results, alone: bool) -> None:
    """The next piece of some runs.

    Raises:
        TaskError: if an environment fails, or hands over what it may not; rows that were written
            since are dropped.
    """
    runs, rows = [m.run for m in members], [m.run.metrics.offset for m in members]
    active = [not member.over for member in members]
    try:
        after = advance(runs, [m.state for m in members], active, as_one=as_one)
    except TaskError:
        for run, kept in zip(runs, rows, strict=True):
            run.metrics.forget(kept)  # they are written again when the run goes on
        raise
    for member, outcome in zip(list(members), after, strict=True):
        if isinstance(outcome, DivergenceError):
            _dismiss(member, outcome, members, results, alone)
        elif isinstance(outcome, RaceError):
            _leave_out(member, outcome, members, results, alone)
        else:
            member.state = outcome


def _saved(error: TaskError, members: Sequence[Member], results: Results) -> TaskError:
    """The error, once all that goes on has been saved, and what else there is to say."""
    steps, words = [], []
    for member in members:
        try:
            save(member.run, member.state)
            steps.append(f"{member.state.progress.env_steps:,}")
        except RaceError as other:
            words.append(f"{member.run.directory.path} could not be saved: {other}")
    places = [member.run.directory.path for member in members]
    go_on = command("race", "resume", places[0] if len(places) == 1 else os.path.commonpath(places))
    saved = "The run was" if len(steps) == 1 else "The runs were"
    words += [f"Before that: {told}" for told in results.values() if isinstance(told, RaceError)]
    return type(error)(
        " ".join(
            [
                f"{error} {saved} saved at {', '.join(steps)} environment steps; once that is "
                f"mended, go on with: {go_on}",
                *words,
            ]
        )
    )


def _save(member: Member, members: list[Member], results: Results, alone: bool) -> None:
    """Writes a checkpoint; and, of a run that is over, that it is finished."""
    try:
        save(member.run, member.state)
    except DivergenceError as error:
        _dismiss(member, error, members, results, alone)
        return
    except RaceError as error:
        _leave_out(member, error, members, results, alone)
        return
    if member.over:
        run_directory.mark_finished(member.run.directory.path)


def _leave_out(
    member: Member, error: RaceError, members: list[Member], results: Results, alone: bool
) -> None:
    """A run whose directory cannot be written; the only one is over with its error.

    Raises:
        RaceError: the error, if it is the only one.
    """
    if alone:
        raise error
    members.remove(member)
    results[member.place] = released(error)


def _dismiss(
    member: Member, error: DivergenceError, members: list[Member], results: Results, alone: bool
) -> None:
    """A run that has diverged; its last good checkpoint stays."""
    newest = checkpoints.newest(member.run.directory.checkpoints)
    good = "There is no checkpoint yet."
    if newest is not None:
        good = f"The last good checkpoint is {newest}; evaluate and render use it."
    told = DivergenceError(f"{error} {good}")
    told.__cause__ = error if alone else None
    members.remove(member)
    results[member.place] = told
    member.run.report("diverged", member.state.progress, {})


def released(error: RaceError) -> RaceError:
    """The error without its traceback, whose frames would hold on to a run's memory."""
    error.__cause__ = error.__context__ = None
    return error.with_traceback(None)

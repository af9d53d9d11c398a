"""The gradient steps that a generation owes: lines 8, 10 and 13 of Algorithm 1.

Those of one run are one program for some of them at a time; on an accelerator those of several
runs are one program, too.
"""

import time
from collections.abc import Sequence

import numpy as np
from jaxtyping import PRNGKeyArray

from race import programs
from race.errors import DivergenceError
from race.programs import cohort
from race.randomness import Purpose, root_key
from race.replay.buffer import Layout
from race.replay.packing import layouts, widened
from race.training.generation import checked, owed
from race.training.run import Run
from race.training.run_state import Outcome, RunState

CHUNK = 100
"""Gradient steps between two looks at the clock, the progress bar and Ctrl-C."""
EPISODES_CHUNK = 12
"""The same where each is made on whole episodes and takes far longer."""


def learn(run: Run, state: RunState) -> RunState | DivergenceError:
    """Some of the gradient steps that a run owes; or how it diverged."""
    key, first = _key(run), np.int32(state.progress.gradient_steps)
    if run.config.discrete:
        # Where a generation's steps are parted depends on nothing but their number, so that a
        # resumed run parts them alike.
        count, laid = _minibatches(run, state, key)
    else:
        count, laid = _count(run, state), None
    algorithm, losses = programs.learn(
        state.algorithm,
        state.losses,
        state.replay,
        key,
        first,
        np.int32(count),
        hyper=state.hyper,
        **run.statics,
        layouts=laid,
        scaling=state.scaling,
    )
    return _after(run, state, algorithm, losses, count)


def learn_together(
    runs: Sequence[Run], states: Sequence[RunState], active: Sequence[bool]
) -> list[Outcome]:
    """The same of several runs in one program; some may have nothing to do."""
    keys = [_key(run) for run in runs]
    firsts = np.array([state.progress.gradient_steps for state in states], np.int32)
    counts = [0] * len(runs)
    if runs[0].config.discrete:
        laid: list[Layout] = []
        for c, (run, state) in enumerate(zip(runs, states, strict=True)):
            if active[c] and owed(run.config, state.progress):
                counts[c], layout = _minibatches(run, state, keys[c])
            else:
                layout = _no_minibatches(run)
            laid.append(layout)
        rows = max(layout.time.shape[2] for layout in laid)
        batches = [
            cohort.minibatches_of(state.replay, widened(layout, rows), state.scaling)
            for state, layout in zip(states, laid, strict=True)
        ]
    else:
        counts = [
            _count(run, state) if going else 0
            for run, state, going in zip(runs, states, active, strict=True)
        ]
        batches = [
            cohort.minibatches(
                state.replay,
                key,
                first,
                hyper=state.hyper,
                room=_chunk(run),
                shape=run.statics["shape"],
                scaling=state.scaling,
            )
            for run, state, key, first in zip(runs, states, keys, firsts, strict=True)
        ]
    learned, sums = cohort.learn(
        tuple(state.algorithm for state in states),
        tuple(state.losses for state in states),
        tuple(batches),
        tuple(keys),
        firsts,
        np.array(counts, np.int32),
        hypers=tuple(state.hyper for state in states),
        **runs[0].statics,
    )
    return [_after(*of_run) for of_run in zip(runs, states, learned, sums, counts, strict=True)]


def _after(
    run: Run, state: RunState, algorithm: object, losses: programs.Losses, count: int
) -> RunState | DivergenceError:
    before = state.progress
    if before.gradient_steps == 0 and count:
        run.report(
            "learning", before, {"time/first_gradient_steps": time.perf_counter() - run.began}
        )
    progress = before.but(gradient_steps=before.gradient_steps + count)
    if count:
        run.report("learning", progress, {})
    return checked(state._replace(algorithm=algorithm, losses=losses, progress=progress), before)


def _key(run: Run) -> PRNGKeyArray:
    return root_key(run.config.seed, Purpose.LEARNING)


def _chunk(run: Run) -> int:
    """Whole policy periods, at least one."""
    delay = run.config.policy_delay
    return max(CHUNK - CHUNK % delay, delay)


def _count(run: Run, state: RunState) -> int:
    return min(_chunk(run), owed(run.config, state.progress))


def _minibatches(run: Run, state: RunState, key: PRNGKeyArray) -> tuple[int, Layout]:
    """The next gradient steps on episodes: how many, and how their minibatches are laid out."""
    room = _room(run)
    count = min(room, owed(run.config, state.progress))
    first, shape = np.int32(state.progress.gradient_steps), run.statics["shape"]
    drawn = programs.draw(
        state.replay, key, first, np.int32(count), hyper=state.hyper, room=room, shape=shape
    )
    places, lengths = (np.asarray(column)[:count] for column in drawn)
    return count, layouts(places, lengths, run.task.spec.episode_limit, room)


def _no_minibatches(run: Run) -> Layout:
    shape = (_room(run), run.task.spec.episode_limit + 1, 1)
    return Layout(np.zeros(shape, np.int32), np.full(shape, -1, np.int32))


def _room(run: Run) -> int:
    return max(EPISODES_CHUNK, run.config.n_teams)

"""Several runs in lockstep: each piece of a generation for all that have come to it.

A run alone is a cohort of one. What a run computes does not depend on the others: one after the
other it is to the bit what it is alone; in one program, on an accelerator, up to rounding.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import jax

from race.config.cohort import Batching
from race.config.settings import Config
from race.config.shape import shape_of
from race.errors import DivergenceError
from race.training.generation import evolve, inject, noted, owed, test, to_play
from race.training.learning import learn, learn_together
from race.training.run import Run
from race.training.run_state import Outcome, RunState, test_due


def kind_of(config: Config) -> tuple[Any, ...]:
    """What runs of one cohort have in common: all but numbers, seeds and budgets."""
    return (
        config.task,
        config.env,
        config.algo,
        shape_of(config),
        (config.n_population_teams, config.n_marl_teams),
        config.race.population_actions,
        config.in_turns,
        config.evaluation.episodes,
        config.facmac.replay_precision,
        config.compute,
    )


class _Piece(IntEnum):
    """What a run does next; the first that any run has come to is done first."""

    LEARN = 0
    END = 1
    TEST = 2
    ROLL_OUT = 3


def together(batching: Batching, count: int) -> bool:
    """Whether so many runs are one program."""
    if batching == "auto":
        return count > 1 and jax.default_backend() != "cpu"
    return count > 1 and batching == "vmap"


def advance(
    runs: Sequence[Run], states: Sequence[RunState], active: Sequence[bool], *, as_one: bool
) -> list[Outcome]:
    """The next piece of a generation: its beginning, some gradient steps, its end, or a test.

    Between any two pieces runs can be saved and resumed. Comments name the lines of Algorithm 1.

    Args:
        runs: the runs.
        states: of each.
        active: which go on. Others are there so that programs keep their shape.
        as_one: whether all are one program.

    Returns:
        The states, or how a run diverged or why its directory could not be written.

    Raises:
        TaskError: if an environment fails, or hands over what it may not.
    """
    pieces = [_next(run, state) for run, state in zip(runs, states, strict=True)]
    piece = min(p for p, going in zip(pieces, active, strict=True) if going)
    chosen = [going and p == piece for p, going in zip(pieces, active, strict=True)]
    if piece == _Piece.ROLL_OUT:
        return _roll_out(runs, states, chosen)  # 3-6, 9
    if piece == _Piece.LEARN:  # 8, 10, 13
        if as_one:
            return learn_together(runs, states, chosen)
        return [
            learn(run, state) if here else state
            for run, state, here in zip(runs, states, chosen, strict=True)
        ]
    if piece == _Piece.TEST:
        return _test(runs, states, chosen, as_one)
    return [
        inject(run, state) if here else state  # 11
        for run, state, here in zip(runs, states, chosen, strict=True)
    ]


def _next(run: Run, state: RunState) -> _Piece:
    if not state.progress.learning:
        return _Piece.TEST if test_due(run.config, state.progress) else _Piece.ROLL_OUT
    if owed(run.config, state.progress) > 0:
        return _Piece.LEARN
    return _Piece.ROLL_OUT if state.progress.played else _Piece.END


def _roll_out(
    runs: Sequence[Run], states: Sequence[RunState], chosen: Sequence[bool]
) -> list[Outcome]:
    """Lines 3 to 6, every team plays its episodes, and 9; where teams take turns, one of them."""
    playing = [c for c, here in enumerate(chosen) if here]
    for c in playing:
        if not states[c].progress.played:
            runs[c].clock.begin_generation()
        runs[c].clock.rolling_out()
    plays = [to_play(runs[c], states[c]) for c in playing]
    results = runs[0].rollouts.play(plays)
    after: list[Outcome] = list(states)
    for c, result in zip(playing, results, strict=True):
        if isinstance(result, DivergenceError):
            after[c] = result
            continue
        replay, played = result
        state = noted(runs[c], states[c]._replace(replay=replay), played)
        after[c] = evolve(runs[c], state)
        jax.block_until_ready(replay)
        runs[c].clock.rolled_out()
    return after


def _test(
    runs: Sequence[Run], states: Sequence[RunState], chosen: Sequence[bool], as_one: bool
) -> list[Outcome]:
    """Test episodes: a piece of its own, so that what came before is safe if one fails."""
    after: list[Outcome] = list(states)
    tested = [c for c, here in enumerate(chosen) if here]
    for group in [tested] if as_one else [[c] for c in tested]:
        found = test([runs[c] for c in group], [states[c] for c in group])
        for c, state in zip(group, found, strict=True):
            after[c] = state
    return after

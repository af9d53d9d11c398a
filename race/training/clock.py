"""Wall time of a run, kept in its state so that it goes on where an interrupted run was."""

import dataclasses
import time
from typing import final

import jax

from race.training.run_state import RunState


@final
class Clock:
    """Wall time of the run, of the generation and since the last checkpoint."""

    def __init__(self, checkpoint_minutes: float) -> None:
        self._checkpoint_seconds = 60 * checkpoint_minutes
        self._last = time.perf_counter()
        self._saved = self._last
        self._generation = self._last

    def begin(self) -> None:
        """A generation begins."""
        self._generation = time.perf_counter()

    def rolled_out(self, state: RunState) -> RunState:
        """Its rollouts are over."""
        jax.block_until_ready(state.replay)
        seconds = time.perf_counter() - self._generation
        progress = state.progress.but(rollout_seconds=seconds, generation_seconds=seconds)
        return self.stamp(state._replace(progress=progress), add=False)

    def stamp(self, state: RunState, add: bool = True) -> RunState:
        """Brings the times in the state up to now."""
        now = time.perf_counter()
        passed, self._last = now - self._last, now
        progress = state.progress
        return state._replace(
            progress=dataclasses.replace(
                progress,
                wall_seconds=progress.wall_seconds + passed,
                generation_seconds=progress.generation_seconds + (passed if add else 0.0),
            )
        )

    def checkpoint_due(self) -> bool:
        """Whether enough time has passed since the last checkpoint; if so, it starts again."""
        now = time.perf_counter()
        due = now - self._saved >= self._checkpoint_seconds
        if due:
            self._saved = now
        return due

"""Wall time of a run, which goes on where an interrupted run was."""

import time
from typing import final


@final
class Clock:
    """Wall time of the run, of its current generation and since the last checkpoint.

    Args:
        times: what `times` said when the run was saved, zeros at its start.
        checkpoint_minutes: between two checkpoints.
    """

    def __init__(self, times: dict[str, float], checkpoint_minutes: float) -> None:
        self._wall = times["wall_seconds"]
        self._generation = times["generation_seconds"]
        self._rollout = times["rollout_seconds"]
        self._checkpoint_seconds = 60 * checkpoint_minutes
        self._last = self._saved = time.perf_counter()
        self._before_rollouts = self._generation

    def begin_generation(self) -> None:
        """A generation begins."""
        self._tick()
        self._generation = self._rollout = 0.0

    def rolling_out(self) -> None:
        """Rollouts of it begin."""
        self._tick()
        self._before_rollouts = self._generation

    def rolled_out(self) -> None:
        """They are over."""
        self._tick()
        self._rollout += self._generation - self._before_rollouts

    def times(self) -> dict[str, float]:
        """Seconds up to now, by the names they have in `race.training.run_state.Progress`."""
        self._tick()
        return {
            "wall_seconds": self._wall,
            "generation_seconds": self._generation,
            "rollout_seconds": self._rollout,
        }

    def checkpoint_due(self) -> bool:
        """Whether enough time has passed since the last checkpoint; if so, it starts again."""
        now = time.perf_counter()
        due = now - self._saved >= self._checkpoint_seconds
        if due:
            self._saved = now
        return due

    def _tick(self) -> None:
        now = time.perf_counter()
        passed, self._last = now - self._last, now
        self._wall += passed
        self._generation += passed

"""What training asks of rollouts, whatever kind of task they are of."""

import math
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from race.algorithms.base import Teams
from race.errors import DivergenceError
from race.replay.buffer import Replay

Steps = Callable[[int], None]
"""Told how many environment steps have been made."""


class Score(NamedTuple):
    """Undiscounted returns of one team's test episodes."""

    returns: NDArray[np.float64]  # [episodes]
    lengths: NDArray[np.int64]  # [episodes]
    won: Bool[np.ndarray, "episodes"] | None = None
    """Which were won; None where a task cannot be won."""

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(self.returns.mean())

    @property
    def std(self) -> float:
        """Standard deviation of the returns over episodes."""
        return float(self.returns.std())

    @property
    def win_rate(self) -> float | None:
        """Share of the episodes that were won; None where a task cannot be won."""
        return None if self.won is None else float(self.won.mean())


class Generation(NamedTuple):
    """What the episodes of one generation came to, one of each acting team."""

    episode_return: NDArray[np.float64]  # [T]
    env_steps: int


@runtime_checkable
class Rollouts(Protocol):
    """A task's environments, played by teams. Use it in a ``with`` statement, or call `close`."""

    @property
    def repeated(self) -> int:
        """Episodes that were begun anew because an environment failed, in this process."""
        ...

    def empty_replay(self) -> Replay:
        """A buffer for what the rollouts bring, with room for all that a run needs."""
        ...

    def warm_up(
        self, replay: Replay, report: Steps, interrupted: Callable[[], bool]
    ) -> tuple[Replay, int] | None:
        """Random episodes before the first generation.

        Returns:
            The buffer and the steps made; None if it was interrupted.

        Raises:
            TaskError: if an environment fails, or hands over what it may not.
        """
        ...

    def play(
        self, teams: Teams, n_marl: int, generation: int, env_steps: int, replay: Replay
    ) -> tuple[Replay, Generation]:
        """One episode of every team, all of whose steps go into the buffer if it has room at all.

        Args:
            teams: the population, then the MARL team, which alone explores, as often as it plays.
            n_marl: how often that is.
            generation: number of the generation, from 0.
            env_steps: made before.
            replay: the buffer.

        Raises:
            DivergenceError: if an action is not a finite number, or on the device a reward or an
                observation.
            TaskError: if an environment fails, or hands over what it may not.
        """
        ...

    def test(
        self,
        encoder: Any,
        heads: Mapping[str, Float[Array, "N H1 A"]],
        seeds: NDArray[np.int64],
    ) -> dict[str, Score]:
        """One episode per seed with each team, without exploration, all on the same seeds."""
        ...

    def close(self) -> None:
        """Closes the environments."""
        ...

    def __enter__(self) -> "Rollouts": ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


def check_returns(episode_return: Float[Any, "T"], where: str) -> None:
    """Checks the returns of all teams.

    Raises:
        DivergenceError: if one is not a finite number.
    """
    for team, value in enumerate(np.asarray(episode_return).tolist()):
        if not math.isfinite(value):
            raise DivergenceError(
                f"The return of team {team} in {where} is {value}: the environment gave a reward "
                "that is not a finite number. A fitness like that never wins, and a buffer that "
                "holds it teaches nothing, so the run stops here. Look at the task's reward."
            )

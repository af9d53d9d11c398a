"""What training asks of rollouts, whatever kind of task they are of."""

import math
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from race.algorithms.base import Teams
from race.config.settings import Config
from race.errors import DivergenceError
from race.method.normalisation import Observed, Scaling
from race.replay.buffer import Replay
from race.rollouts.beginnings import Beginnings

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


class Play(NamedTuple):
    """The teams of one run that play at once: the population, then the MARL team.

    They are those of a generation, or one of them where they take turns.

    A team that plays several episodes is there as often, the MARL team ``n_marl`` times. The MARL
    team explores, the population only where its actions are sampled
    (`RaceConfig.population_actions`). ``generation`` counts from 0, ``env_steps`` were made before;
    steps go into the buffer, if it has room at all (`keepers` says whose).
    """

    config: Config
    teams: Teams
    n_marl: int
    generation: int
    env_steps: int
    replay: Replay
    beginnings: int | None = None
    """Steps after which the population stops, which is judged by them; None: it plays to the end.
    The MARL team does so in any case."""
    turn: int = 0
    turns: int = 1
    """Which part of at most how many it is, where the teams of a generation take turns."""

    @property
    def number(self) -> int:
        """A counter of the parts that the run has played: the chance of each is its own."""
        return self.generation * self.turns + self.turn

    @property
    def n_population(self) -> int:
        """Episodes of the population; the first of ``teams`` play them."""
        return self.teams.count - self.n_marl


class Trial(NamedTuple):
    """Teams that one run tests, over the same encoders, each on all the seeds."""

    encoder: Any
    heads: Mapping[str, Float[Array, "N H1 A"]]
    seeds: NDArray[np.int64]
    scaling: Scaling | None = None
    """Of what environments show the teams; None: as it is."""

    def teams(self, times: int) -> Teams:
        """All of them, each so many times in a row."""
        heads = jnp.repeat(jnp.stack(list(self.heads.values())), times, axis=0)
        return Teams(self.encoder, heads, scaling=self.scaling)


class Generation(NamedTuple):
    """What the episodes of one generation came to, one of each acting team.

    A team that plays several counts as so many.
    """

    episode_return: NDArray[np.float64]  # [T]
    env_steps: int
    repeated: int
    """Episodes that were begun anew because an environment failed."""
    stored: int
    """Episodes that went into the buffer, or would if it had room at all."""
    observed: Observed | None = None
    """What all teams saw, where observations are normalised."""
    beginnings: Beginnings | None = None
    """Of the population, where it played no more; its returns are of what was played."""


class WarmUp(NamedTuple):
    """What the random episodes before the first generation came to."""

    replay: Replay
    env_steps: int
    observed: Observed | None = None
    """What was seen, where observations are normalised and anything was."""


@runtime_checkable
class Rollouts(Protocol):
    """A task's environments, played by the teams of one run or of several.

    What a run gets does not depend on the others. Use it in a ``with`` statement, or call `close`.
    """

    @property
    def repeated(self) -> int:
        """Episodes that were begun anew because an environment failed, in this process."""
        ...

    def empty_replay(self, config: Config) -> Replay:
        """A buffer for what the rollouts of a run bring, with room for all that it needs."""
        ...

    def warm_up(
        self, config: Config, replay: Replay, report: Steps, interrupted: Callable[[], bool]
    ) -> WarmUp | None:
        """Random episodes of one run before its first generation.

        Returns:
            What it came to; None if it was interrupted.

        Raises:
            TaskError: if an environment fails, or hands over what it may not.
        """
        ...

    def play(self, plays: Sequence[Play]) -> list[tuple[Replay, Generation] | DivergenceError]:
        """One episode of every team of every run; or how a run diverged.

        What that is: an action that is no finite number, on the device also a reward or an
        observation.

        Raises:
            TaskError: if an environment fails, or hands over what it may not.
        """
        ...

    def test(self, trials: Sequence[Trial]) -> list[dict[str, Score]]:
        """One episode per seed with each team of each trial, without exploration."""
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


def keepers(episode_return: Float[Any, "T"], play: Play) -> NDArray[np.bool_]:
    """Whose episodes go into the buffer, [T]: the MARL team's, and those of the population.

    Of the population's all, or the better half: those that returned no less than their median.
    """
    kept = np.ones(play.teams.count, bool)
    population = np.asarray(episode_return)[: play.n_population]
    if play.config.race.replayed == "better" and population.size:
        kept[: population.size] = population >= np.median(population)
    return kept


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

"""Rollouts of tasks with discrete actions: whole episodes, on the device where that can be."""

from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from race import programs
from race.algorithms.base import Teams
from race.config.settings import Config
from race.errors import DivergenceError
from race.method.exploration import epsilon
from race.randomness import Purpose, host_seeds, root_key
from race.replay.buffer import Replay, init_replay
from race.rollouts import device
from race.rollouts.base import Generation, Score, Steps, check_returns
from race.rollouts.choosing import Exploration
from race.rollouts.episodes import Played, empty_episode
from race.rollouts.host_episodes import HostEnvs
from race.rollouts.pool import EnvPool
from race.types import DiscreteTask

TESTS_AT_ONCE = 32
"""Test episodes of a team in one program; a program serves one number of them only."""
TESTS_AT_ONCE_ON_HOST = 4
"""There they are played one after the other anyway, and a game may be large."""


@final
class EpisodeRollouts:
    """A `race.rollouts.base.Rollouts`: on the device if the task can be played there."""

    def __init__(
        self, config: Config, task: DiscreteTask, on_device: bool = True, proven: bool = False
    ) -> None:
        """Nothing is made yet.

        Args:
            config: the run's configuration.
            task: the task.
            on_device: whether to play on the device if the task can be played there.
            proven: whether the run has played an episode before.
        """
        self._config, self._spec = config, task.spec
        self._env = task.device() if on_device and task.device is not None else None
        pool = EnvPool(
            task,
            max(config.n_teams, 2 * TESTS_AT_ONCE_ON_HOST),  # of two teams
            bool(config.env.processes) or config.env.step_seconds is not None,
            retries=config.env.retries,
            step_seconds=config.env.step_seconds,
            proven=proven,
        )
        self._host = HostEnvs(pool)
        self._most = TESTS_AT_ONCE if self._env is not None else TESTS_AT_ONCE_ON_HOST
        self._tests = 0  # at once, so far

    @property
    def repeated(self) -> int:
        """Episodes that were begun anew since the environments failed, in this process."""
        return self._host.pool.repeated

    def empty_replay(self) -> Replay:
        """A short run does not pay for a long one's memory: an episode has at least one step."""
        config, facmac = self._config, self._config.facmac
        most = max(config.env_steps + config.n_teams, facmac.batch_size)
        item = empty_episode(self._spec, str(facmac.replay_precision))
        return init_replay(item, min(facmac.replay_capacity, most) * config.has_marl)

    def warm_up(
        self, replay: Replay, report: Steps, interrupted: Callable[[], bool]
    ) -> tuple[Replay, int] | None:
        """There is none: exploration begins with many random actions."""
        return replay, 0

    def play(
        self, teams: Teams, n_marl: int, generation: int, env_steps: int, replay: Replay
    ) -> tuple[Replay, Generation]:
        """The MARL team chooses at random now and then; the population explores by diversity."""
        config, facmac = self._config, self._config.facmac
        share = epsilon(
            env_steps, facmac.epsilon_start, facmac.epsilon_finish, facmac.epsilon_steps
        )
        how = Exploration(
            jnp.arange(teams.count) >= teams.count - n_marl,
            jnp.float32(share),
            jax.random.fold_in(root_key(config.seed, Purpose.ROLLOUT), generation),
        )
        seeds = host_seeds(config.seed, Purpose.ROLLOUT, generation, teams.count)
        played = self._play(teams, seeds, how if n_marl else None)
        self._check_finite(played, f"generation {generation + 1}")
        if replay.capacity:
            replay = programs.store(replay, played.episodes, np.int32(teams.count))
        returns = np.asarray(played.episode_return, np.float64)
        return replay, Generation(returns, int(np.sum(played.episodes.length)))

    def test(
        self,
        encoder: Any,
        heads: Mapping[str, Float[Array, "N H1 A"]],
        seeds: NDArray[np.int64],
    ) -> dict[str, Score]:
        """At most `TESTS_AT_ONCE` episodes of each team at once."""
        names, n = list(heads), len(seeds)
        size = self._tests = max(self._tests, min(n, self._most))
        teams = Teams(encoder, jnp.repeat(jnp.stack(list(heads.values())), size, axis=0))
        parts = []
        for first in range(0, n, size):
            piece = seeds[first : first + size]
            played = self._play(teams, np.tile(np.resize(piece, size), len(names)), None)
            results = (played.episode_return, played.episodes.length, played.won)
            shape = (len(names), size)
            parts.append([np.asarray(r).reshape(shape)[:, : len(piece)] for r in results])
        returns, lengths, won = (
            np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True)
        )
        return {
            name: Score(
                returns[i].astype(np.float64),
                lengths[i].astype(np.int64),
                won[i] if self._spec.has_wins else None,
            )
            for i, name in enumerate(names)
        }

    def episode(self, encoder: Any, head: Float[Array, "N H1 A"], seed: int) -> NDArray[np.int32]:
        """The actions of one episode of a team without exploration, [steps, N]."""
        played = self._play(Teams(encoder, head[None]), np.array([seed]), None)
        steps = int(played.episodes.length[0])
        return np.asarray(played.episodes.action[0, :steps]).astype(np.int32)

    def close(self) -> None:
        """Closes the environments on the host."""
        self._host.close()

    def __enter__(self) -> "EpisodeRollouts":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _play(self, teams: Teams, seeds: NDArray[np.int64], how: Exploration | None) -> Played:
        small = (seeds % 2**31).astype(np.uint32)
        precision = str(self._config.facmac.replay_precision)
        if self._env is None:
            return self._host.play(teams, small, how, precision)
        return device.play(self._env, teams, small, how, self._spec, precision)

    def _check_finite(self, played: Played, where: str) -> None:
        check_returns(played.episode_return, where)
        shown = {"an observation": played.episodes.obs, "a state": played.episodes.state}
        if programs.all_finite(shown):
            return
        for name, column in shown.items():
            values = np.asarray(column)
            strange = np.argwhere(~np.isfinite(values))
            if len(strange) == 0:
                continue
            team, step = strange[0][:2]
            entry = values[tuple(strange[0])]
            advice = "That is no number. Look at the task."
            if not np.isnan(entry):
                advice = (
                    "The replay buffer keeps numbers up to 65504 with --facmac.replay-precision "
                    "float16, larger ones with float32; better scale what the task shows to "
                    "about 1."
                )
            raise DivergenceError(
                f"The environment of team {team} gave {name} in {where}, after {step} steps, "
                f"with the entry {entry}. {advice}"
            )

"""Episodes of tasks with discrete actions on the host, such as the real StarcraftII."""

from contextlib import AbstractContextManager
from functools import partial
from types import TracebackType
from typing import Any, final

import gymnasium
import jax
import numpy as np
from numpy.typing import NDArray

from race.algorithms.base import Teams
from race.errors import TaskError, blamed
from race.rollouts.choosing import Exploration, blank, choose
from race.rollouts.episodes import Played, empty_episode
from race.types import DiscreteTask, Observation

_choose = jax.jit(choose)
_blank = jax.jit(blank)


@final
class HostEnvs:
    """Environments of one task on the host, stepped one after the other.

    Use it in a ``with`` statement, or call `close`. They are made when they are needed.

    Attributes:
        task: the task.
    """

    def __init__(self, task: DiscreteTask) -> None:
        self.task = task
        self._envs: list[gymnasium.Env[Any, Any]] = []

    def play(
        self, teams: Teams, seeds: NDArray[np.uint32], how: Exploration | None, precision: str
    ) -> Played:
        """One episode per team; see `race.rollouts.device.play`, which does the same.

        Args:
            teams: the teams.
            seeds: of the environments' resets.
            how: who explores; None for nobody.
            precision: dtype of the observations and states of the episodes.

        Returns:
            As numpy arrays.

        Raises:
            TaskError: if an environment fails, shows something of another shape, or offers an
                agent no action.
        """
        spec, count = self.task.spec, len(seeds)
        while len(self._envs) < count:
            with self._blamed(f"making of environment {len(self._envs)}"):
                self._envs.append(self.task.make(None))
        episodes = empty_episode(spec, precision, count)
        returns, won = np.zeros(count, np.float32), np.zeros(count, bool)
        seen = Observation(
            np.zeros((count, spec.n_agents, spec.obs_size), np.float32),
            np.zeros((count, spec.state_size), np.float32),
            np.zeros((count, spec.n_agents, spec.n_actions), bool),
        )
        running = list(range(count))
        for team in running:
            self._see(seen, team, partial(self._reset, int(seeds[team])))
            _write(episodes, seen, team, 0)
        memory = _blank(teams)
        for tick in range(spec.episode_limit):
            if not running:
                break
            # A copy, because JAX may still read an array that it was given.
            shown = jax.tree.map(np.copy, seen)
            memory, chosen = _choose(teams, memory, shown, np.int32(tick), how)
            actions = np.asarray(chosen)
            for team in tuple(running):
                reward, terminated, truncated, battle_won = self._see(
                    seen, team, partial(self._step, actions[team])
                )
                episodes.action[team, tick] = actions[team]
                episodes.reward[team, tick] = reward
                episodes.terminated[team, tick] = terminated
                episodes.length[team] = tick + 1
                _write(episodes, seen, team, tick + 1)
                returns[team] += np.float32(reward)
                won[team] |= battle_won
                if terminated or truncated:
                    running.remove(team)
        return Played(episodes, returns, won)

    def close(self) -> None:
        """Closes the environments."""
        envs, self._envs = self._envs, []
        for env in envs:
            env.close()

    def __enter__(self) -> "HostEnvs":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @staticmethod
    def _reset(seed: int, env: gymnasium.Env[Any, Any]) -> tuple[Any, Any]:
        return env.reset(seed=seed)[0], None

    @staticmethod
    def _step(action: NDArray[np.int32], env: gymnasium.Env[Any, Any]) -> tuple[Any, Any]:
        observation, reward, terminated, truncated, info = env.step(action)
        battle_won = bool(info.get("battle_won", False))
        return observation, (float(reward), bool(terminated), bool(truncated), battle_won)

    def _see(self, seen: Observation, team: int, move: Any) -> Any:
        """Makes a move in a team's environment and writes down what it shows."""
        with self._blamed(f"environment {team}"):
            observation, outcome = move(self._envs[team])
            for name, column in seen._asdict().items():
                value = np.asarray(observation[name])
                if value.shape != column.shape[1:]:
                    raise TaskError(
                        f"The environment of {self.task.spec.task} shows {name} of the shape "
                        f"{value.shape}; its DiscreteSpec says {column.shape[1:]}."
                    )
                column[team] = value
        idle = np.flatnonzero(~seen.avail_actions[team].any(axis=1))
        if len(idle):
            raise TaskError(
                f"The environment of {self.task.spec.task} offers agent {idle[0]} no action. Give "
                "every agent one that does nothing, also when it is dead and after the last step."
            )
        return outcome

    def _blamed(self, what: str) -> AbstractContextManager[None]:
        # The errors of race.envs.pymarl pass: they name the task and the mistake themselves.
        return blamed(TaskError, f"The environment of {self.task.spec.task} failed ({what})")


def _write(episodes: Any, seen: Observation, team: int, place: int) -> None:
    with np.errstate(over="ignore"):  # what half precision cannot hold is found and told later
        episodes.obs[team, place] = seen.obs[team]
        episodes.state[team, place] = seen.state[team]
    episodes.avail_actions[team, place] = seen.avail_actions[team]

"""Episodes of tasks with discrete actions on the host, such as the real StarcraftII."""

from typing import final

import jax
import numpy as np
from numpy.typing import NDArray

from race.algorithms.base import Teams
from race.closing import Closing
from race.envs.contract import Step
from race.errors import EnvFailedError
from race.randomness import seed_again
from race.rollouts.choosing import Exploration, blank, choose
from race.rollouts.episodes import Played, empty_episode
from race.rollouts.pool import EnvPool
from race.types import DiscreteSpec, Observation

_choose = jax.jit(choose)
_blank = jax.jit(blank)


@final
class HostEnvs(Closing):
    """Environments of one task on the host, played by teams. Close the pool after use.

    Attributes:
        pool: the environments.
    """

    def __init__(self, pool: EnvPool) -> None:
        self.pool = pool

    def play(
        self, teams: Teams, seeds: NDArray[np.uint32], how: Exploration | None, precision: str
    ) -> Played:
        """One episode per team; see `race.rollouts.device.play`, which does the same.

        An episode whose environment fails is played anew in a fresh one after the others, if the
        pool allows it, with a seed that depends on its own and the number of the attempt.

        Args:
            teams: the teams.
            seeds: of the environments' resets.
            how: who explores; None for nobody.
            precision: dtype of the observations and states of the episodes.

        Returns:
            As numpy arrays.

        Raises:
            HandedOverError: if what an environment hands over breaks the contract.
            EnvFailedError: if an environment fails.
        """
        played = _Playing(self.pool.spec, len(seeds), precision)
        waiting = {team: int(seed) for team, seed in enumerate(seeds.tolist())}
        attempt = 0
        while waiting:
            failures = self._play(teams, waiting, how, played)
            attempt += 1
            self.pool.begin_again(failures, attempt)
            waiting = {team: seed_again(int(seeds[team]), attempt) for team in failures}
        self.pool.proven = True
        return played.result

    def _play(
        self, teams: Teams, seeds: dict[int, int], how: Exploration | None, played: "_Playing"
    ) -> dict[int, EnvFailedError]:
        """An episode of each of some teams; returns those that failed."""
        failures: dict[int, EnvFailedError] = {}
        for team, seen in self.pool.reset(seeds).items():
            if isinstance(seen, Observation):
                played.see(seen, team, 0)
            elif isinstance(seen, EnvFailedError):
                failures[team] = seen
        running = sorted(set(seeds) - set(failures))
        memory = _blank(teams)
        for tick in range(self.pool.spec.episode_limit):
            if not running:
                break
            # A copy, because JAX may still read an array that it was given.
            shown = jax.tree.map(np.copy, played.seen)
            memory, chosen = _choose(teams, memory, shown, np.int32(tick), how)
            actions = np.asarray(chosen)
            steps = self.pool.step({team: actions[team] for team in running})
            for team, step in steps.items():
                if isinstance(step, EnvFailedError):
                    failures[team] = step
                    played.forget(team)
                    running.remove(team)
                    continue
                played.add(team, tick, actions[team], step)
                if step.terminated or step.truncated:
                    running.remove(team)
        return failures

    def close(self) -> None:
        """Closes the environments."""
        self.pool.close()


class _Playing:
    """Episodes as they are played, and what their teams see now."""

    def __init__(self, spec: DiscreteSpec, count: int, precision: str) -> None:
        self.result = Played(
            empty_episode(spec, precision, count),
            np.zeros(count, np.float32),
            np.zeros(count, bool),
        )
        self.seen = Observation(
            np.zeros((count, spec.n_agents, spec.obs_size), np.float32),
            np.zeros((count, spec.state_size), np.float32),
            np.zeros((count, spec.n_agents, spec.n_actions), bool),
        )

    def see(self, seen: Observation, team: int, place: int) -> None:
        """A moment of a team's episode."""
        with np.errstate(over="ignore"):  # what half precision cannot hold is found and told later
            for name, value in seen._asdict().items():
                getattr(self.seen, name)[team] = value
                getattr(self.result.episodes, name)[team, place] = value

    def add(self, team: int, tick: int, action: NDArray[np.int32], step: Step) -> None:
        """A step of a team's episode, and the moment after it."""
        episodes = self.result.episodes
        episodes.action[team, tick] = action
        episodes.reward[team, tick] = step.reward
        episodes.terminated[team, tick] = step.terminated
        episodes.length[team] = tick + 1
        self.see(step.seen, team, tick + 1)
        self.result.episode_return[team] += np.float32(step.reward)
        self.result.won[team] |= step.won

    def forget(self, team: int) -> None:
        """A team's failed episode."""
        for column in jax.tree.leaves(self.result):
            column[team] = 0

"""A team of a PettingZoo environment as a gymnasium environment, which all the rest trains on."""

import itertools
from typing import Any, Final, final

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Float32
from numpy.typing import NDArray

from race.config.settings import TeamReward
from race.envs import contract
from race.envs.dictionary import space_of
from race.envs.pettingzoo.parallel import End, Parallel
from race.envs.pettingzoo.vectors import Choices, Reach, Sight
from race.errors import HandedOverError, described

_OTHER_STATE: Final = (
    "The observations of all agents can be the state instead: --env.state observations"
)


@final
class TeamEnv(gymnasium.Env[Any, Any]):
    """The team of a `Parallel` as one agent.

    Where the team acts by numbers, an observation is the state [S]: the environment's own followed
    by what each agent of the team observes, or what all agents observe. An action is the joint
    action [U] in the environment's units, agent after agent.

    Where it acts by choices, an observation is a dictionary of ``obs`` [N, O], padded with zeros,
    ``state`` [S] and ``avail_actions`` [N, A]; an action is a choice of each agent [N]. A choice
    that is not available becomes the lowest that is, and ``info["refused"]`` [N] tells.

    What an agent that is not there observes is 0, and what it does goes nowhere; its only choice is
    the first. The episode is over when no agent of the team is there. It was truncated if one of
    those that left last was, or at the step limit, and terminated otherwise.

    Attributes:
        parallel: the environment behind it.
        state_size: entries of the state.
        obs_size: entries of what an agent observes, padded to the one that observes most.
        n_actions: choices of the agent that has most; 0 if the team acts by numbers.
    """

    def __init__(
        self,
        parallel: Parallel,
        *,
        task: str,
        own_state: Sight | None,
        team_reward: TeamReward,
        episode_limit: int,
        render_mode: str | None = None,
    ) -> None:
        """Wraps an environment, which is closed with this one.

        Args:
            parallel: the environment.
            task: the task's name, for messages.
            own_state: how its own state becomes a vector; None: the state is what all agents
                observe.
            team_reward: whether the team is paid the mean or the sum of its agents' rewards.
            episode_limit: steps after which the episode is truncated.
            render_mode: what its `render` was made for, or None.
        """
        self.parallel, self.render_mode = parallel, render_mode
        self.metadata = dict(getattr(parallel.env, "metadata", None) or {})
        self._task, self._own_state = task, own_state
        self._team_reward, self._limit = team_reward, episode_limit
        self._steps, self._over = 0, True
        self.obs_size = max(parallel.sights[agent].size for agent in parallel.team)
        self.n_actions = max(
            (m.count for m in parallel.moves.values() if isinstance(m, Choices)), default=0
        )
        self._places = [parallel.agents.index(agent) for agent in parallel.team]
        self._reaches = [move for move in parallel.moves.values() if isinstance(move, Reach)]
        self._available: NDArray[np.bool_] | None = None
        self._last_state: NDArray[np.float32] | None = None
        if own_state is None:
            self.state_size = sum(sight.size for sight in parallel.sights.values())
        else:
            beside = [parallel.sights[agent].size for agent in parallel.team if self._reaches]
            self.state_size = own_state.size + sum(beside)
        state = spaces.Box(-np.inf, np.inf, (self.state_size,), np.float32)
        if self._reaches:
            low = np.concatenate([reach.low for reach in self._reaches])
            high = np.concatenate([reach.high for reach in self._reaches])
            exact = all(reach.exact for reach in self._reaches)
            kind: Any = np.float32 if exact else np.float64
            self.action_space = spaces.Box(low.astype(kind), high.astype(kind), dtype=kind)
            self.observation_space = state
            ends = np.cumsum([0, *(len(reach.low) for reach in self._reaches)]).tolist()
            self._parts = [slice(*pair) for pair in itertools.pairwise(ends)]
            return
        n = len(parallel.team)
        self.action_space = spaces.MultiDiscrete([self.n_actions] * n)
        self.observation_space = space_of(n, self.obs_size, self.state_size, self.n_actions)

    @property
    def team_names(self) -> list[Any]:
        """Names of the team's agents."""
        return self.parallel.team

    @property
    def team_paid(self) -> list[float]:
        """What each of them was paid in the newest step."""
        return list(self.parallel.rewards)

    @property
    def own_state_names(self) -> list[str] | None:
        """Names of the entries of the environment's own state; None if it is not in use."""
        return None if self._own_state is None else self._own_state.names()

    def obs_index(self) -> list[list[int]]:
        """For each agent of a team that acts by numbers, where in the state its observation is."""
        parallel = self.parallel
        if self._own_state is None:
            agents, start = parallel.agents, 0
        else:
            agents, start = parallel.team, self._own_state.size
        ends = start + np.cumsum([parallel.sights[agent].size for agent in agents])
        starts = dict(zip(agents, [start, *ends[:-1].tolist()], strict=True))
        return [
            list(range(starts[agent], starts[agent] + parallel.sights[agent].size))
            for agent in parallel.team
        ]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode; returns its first observation and an empty dictionary.

        Raises:
            HandedOverError: if what the environment shows breaks its interface.
        """
        super().reset(seed=seed)
        self._steps, self._over = 0, False
        try:
            self.parallel.reset(seed)
            return self._observe(), {}
        except HandedOverError as error:
            raise self._told(error, "reset") from error

    def step(self, action: NDArray[Any]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step.

        Returns:
            observation, reward of the team, terminated, truncated, and nothing, or who was refused.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset, and after the end of an episode.
            HandedOverError: if what the environment answers breaks its interface.
        """
        if self._over:
            raise gymnasium.error.ResetNeeded("The episode is over: call reset before step.")
        facts: dict[str, Any] = {}
        if self._available is None:
            actions = self._units(action)
        else:
            actions, facts["refused"] = self._chosen(np.asarray(action), self._available)
        self._steps += 1
        try:
            end = self.parallel.step(actions)
            if self._steps >= self._limit and not any(end):
                end = End(terminated=False, truncated=True)
            self._over = any(end)
            seen = self._observe(terminated=end.terminated)
        except HandedOverError as error:
            raise self._told(error, "step") from error
        reward = float(sum(self.parallel.rewards))
        if self._team_reward == "mean":
            reward /= len(self.parallel.team)
        return seen, reward, *end, facts

    def render(self) -> Any:
        """A picture of the environment as it stands; None without a render mode."""
        return None if self.render_mode is None else self.parallel.env.render()

    def close(self) -> None:
        """Closes the environment."""
        self.parallel.env.close()

    def _told(self, error: HandedOverError, method: str) -> HandedOverError:
        """What is wrong, with the task, the step and where it is written."""
        when = f"at step {self._steps}" if self._steps else "in the reset"
        return HandedOverError(
            f"Task {self._task}, {when} of an episode: {error}"
            f"{contract.place(self.parallel.env, method)}."
        )

    def _units(self, action: NDArray[Any]) -> dict[Any, Any]:
        joint = np.asarray(action)
        return {
            agent: reach.action(joint[part])
            for agent, reach, part in zip(
                self.parallel.team, self._reaches, self._parts, strict=True
            )
        }

    def _chosen(
        self, choices: NDArray[Any], available: NDArray[np.bool_]
    ) -> tuple[dict[Any, Any], NDArray[np.bool_]]:
        given: dict[Any, Any] = {}
        refused = np.zeros(len(available), np.bool_)
        moves = self.parallel.moves.items()
        for number, ((agent, move), choice) in enumerate(zip(moves, choices.tolist(), strict=True)):
            if not (0 <= choice < self.n_actions and available[number, choice]):
                refused[number] = True
                choice = int(available[number].argmax())
            assert isinstance(move, Choices)
            given[agent] = move.action(choice)
        return given, refused

    def _observe(self, *, terminated: bool = False) -> Any:
        parallel, team = self.parallel, self.parallel.team
        everybody = self._own_state is None
        seen, state = parallel.seen(parallel.agents if everybody else team)
        if self._own_state is not None:
            own = self._last_state = self._global(self._own_state, terminated=terminated)
            state = np.concatenate([own, state]) if self._reaches else own.copy()
        if self._reaches:
            return state
        obs = np.zeros((len(team), self.obs_size), np.float32)  # padded
        for row, number in zip(obs, self._places if everybody else range(len(team)), strict=True):
            row[: len(seen[number])] = seen[number]
        self._available = parallel.available()
        return {"obs": obs, "state": state, "avail_actions": self._available.copy()}

    def _global(self, sight: Sight, *, terminated: bool) -> Float32[np.ndarray, "S"]:
        try:
            value = self.parallel.env.state()
        except Exception as error:
            # Some environments cannot tell it any more once the task has ended, and what follows
            # is worth nothing in any case.
            if terminated and self._last_state is not None:
                return self._last_state
            raise HandedOverError(f"state() failed: {described(error)}. {_OTHER_STATE}") from error
        try:
            return sight(value)
        except HandedOverError as error:
            if terminated and self._last_state is not None:
                return self._last_state
            raise HandedOverError(
                f"{error}. Let it always be of one size. {_OTHER_STATE}"
            ) from error

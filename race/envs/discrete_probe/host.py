"""The rules of the probes in plain Python, behind PyMARL's interface.

Chance comes from `race.envs.discrete_probe.chance`, as on the device; everything else is written a
second time here, so that tests can compare the two. This module does not import jax before it is
needed, which takes longer than a listing of the tasks.
"""

from typing import Any, Final, Protocol, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from race.envs.discrete_probe.rules import (
    CLIMB_PAYOFFS,
    LIVES_AGENTS,
    LIVES_STEPS,
    MATCHING_ACTIONS,
    MEMORY_STEPS,
    MEMORY_WAIT,
    WINS,
)
from race.errors import TaskError


class _Rules(Protocol):
    """A probe without its interface: what happens, what is seen. ``now`` is a key of JAX."""

    n_agents: int
    n_actions: int
    episode_limit: int
    over: bool
    won: bool

    def begin(self, now: Any) -> None: ...
    def play(self, actions: list[int], now: Any) -> float: ...
    def look(self, agent: int) -> list[float]: ...
    def state(self) -> list[float]: ...
    def available(self, agent: int) -> list[int]: ...


@final
class _Matching:
    """One step; two agents; pays the share of agents that choose the action their cue names.

    An agent sees its cue as one of `MATCHING_ACTIONS` bits; the state is both. Each action but
    the right one is blocked with probability one half.
    """

    n_agents = 2
    n_actions = MATCHING_ACTIONS
    episode_limit = 1

    def __init__(self) -> None:
        self.over = self.won = False
        self.cues = [0] * self.n_agents
        self._blocked = [[False] * self.n_actions] * self.n_agents

    def begin(self, now: Any) -> None:
        cues, blocked = _chance().draw_matching(now)
        self.cues, self._blocked = cues.tolist(), blocked.tolist()
        self.over = False

    def play(self, actions: list[int], now: Any) -> float:
        self.over = True
        return _share([action == cue for action, cue in zip(actions, self.cues, strict=True)])

    def look(self, agent: int) -> list[float]:
        return _bits(self.cues[agent], self.n_actions)

    def state(self) -> list[float]:
        return [bit for agent in range(self.n_agents) for bit in self.look(agent)]

    def available(self, agent: int) -> list[int]:
        row = enumerate(self._blocked[agent])
        return [int(action == self.cues[agent] or not blocked) for action, blocked in row]


@final
class _Memory:
    """Three steps; two agents; pays the share of agents that name their cue at the last one.

    An agent sees (cue 0, cue 1, share of the steps made); the first two are zeros after the
    start. The state always shows both agents' cues. Both actions are available, but at the middle
    step only 0 is, so that an agent that is shown its last action finds nothing in it. What does
    not remember chooses at the end without knowing, and is paid one half on average whatever it
    does. Won if all are right.
    """

    n_agents = 2
    n_actions = 2
    episode_limit = MEMORY_STEPS

    def __init__(self) -> None:
        self.over = self.won = False
        self.cues = [0] * self.n_agents
        self._steps = 0

    def begin(self, now: Any) -> None:
        self.cues = _chance().draw_memory(now).tolist()
        self.over = self.won = False
        self._steps = 0

    def play(self, actions: list[int], now: Any) -> float:
        self._steps += 1
        self.over = self._steps == MEMORY_STEPS
        self.won = self.over and actions == self.cues
        right = [action == cue for action, cue in zip(actions, self.cues, strict=True)]
        return _share(right) if self.over else 0.0

    def look(self, agent: int) -> list[float]:
        cue = _bits(self.cues[agent], 2) if self._steps == 0 else [0.0, 0.0]
        return [*cue, self._steps / MEMORY_STEPS]

    def state(self) -> list[float]:
        cues = [bit for cue in self.cues for bit in _bits(cue, 2)]
        return [*cues, self._steps / MEMORY_STEPS]

    def available(self, agent: int) -> list[int]:
        return [1, int(self._steps != MEMORY_WAIT)]


@final
class _Climb:
    """One step; two agents; pays `CLIMB_PAYOFFS`. Observations and state are always (1)."""

    n_agents = 2
    n_actions = len(CLIMB_PAYOFFS)
    episode_limit = 1

    def __init__(self) -> None:
        self.over = self.won = False

    def begin(self, now: Any) -> None:
        self.over = False

    def play(self, actions: list[int], now: Any) -> float:
        self.over = True
        first, second = actions
        return CLIMB_PAYOFFS[first][second]

    def look(self, agent: int) -> list[float]:
        return [1.0]

    def state(self) -> list[float]:
        return [1.0]

    def available(self, agent: int) -> list[int]:
        return [1] * self.n_actions


@final
class _Lives:
    """Three to five steps, drawn at the start; agent i lives for its first i + 1 steps.

    A step pays the share of the living that choose what their cue (1 or 2) names, and 1 if nobody
    lives, divided by the number of steps of the episode. So whoever follows the cues has, with r
    of the n steps left, r / n to come. Cues are drawn anew at each moment. The living see (1,
    cue 1, cue 2, steps made / 5) and may not choose 0; the dead see zeros and may only choose 0.
    The state is the agents' first three entries, steps made / 5, and steps of the episode / 5.
    """

    n_agents = LIVES_AGENTS
    n_actions = 3
    episode_limit = LIVES_STEPS[1]

    def __init__(self) -> None:
        self.over = self.won = False
        self.cues = [1] * self.n_agents
        self.length = LIVES_STEPS[1]
        self._steps = 0

    def begin(self, now: Any) -> None:
        length, cues = _chance().draw_lives_start(now)
        self.length, self.cues = int(length), cues.tolist()
        self.over = False
        self._steps = 0

    def play(self, actions: list[int], now: Any) -> float:
        living = [agent for agent in range(self.n_agents) if self._lives(agent)]
        right = [actions[agent] == self.cues[agent] for agent in living]
        self.cues = _chance().draw_lives(now).tolist()
        self._steps += 1
        self.over = self._steps == self.length
        return (_share(right) if living else 1.0) / self.length

    def look(self, agent: int) -> list[float]:
        if not self._lives(agent):
            return [0.0] * 4
        return [1.0, *_bits(self.cues[agent] - 1, 2), self._steps / self.episode_limit]

    def state(self) -> list[float]:
        seen = [entry for agent in range(self.n_agents) for entry in self.look(agent)[:3]]
        return [*seen, self._steps / self.episode_limit, self.length / self.episode_limit]

    def available(self, agent: int) -> list[int]:
        return [0, 1, 1] if self._lives(agent) else [1, 0, 0]

    def _lives(self, agent: int) -> bool:
        return self._steps <= agent


_RULES: Final[dict[str, type[_Rules]]] = {
    "probe/matching": _Matching,
    "probe/memory": _Memory,
    "probe/climb": _Climb,
    "probe/lives": _Lives,
}


@final
class ProbeHost:
    """A probe behind PyMARL's interface.

    Chance: ``seed(s)`` sets a key to ``jax.random.key(s % 2**32)``; each reset and each step then
    takes ``key, now = jax.random.split(key)`` and draws with ``now`` what the functions on the
    device draw. Without a seed the operating system draws one.

    Attributes:
        rules: the probe itself, in which tests may look up the answers.
    """

    def __init__(self, task_id: str, seed: int | None = None) -> None:
        """Makes the probe of an id, a key of `PROBES`.

        Raises:
            TaskError: if there is no such probe.
        """
        if task_id not in _RULES:
            raise TaskError(
                f"There is no probe {task_id} with discrete actions. They are {', '.join(_RULES)}."
            )
        self.rules = _RULES[task_id]()
        self._tells_wins = task_id in WINS
        self._key: Any = None
        if seed is not None:
            self.seed(seed)

    def seed(self, seed: int) -> None:
        """Lets chance begin anew at the next reset."""
        import jax

        self._key = jax.random.key(seed % 2**32)

    def get_env_info(self) -> dict[str, int]:
        """The sizes."""
        return {
            "n_agents": self.rules.n_agents,
            "obs_shape": len(self.rules.look(0)),
            "state_shape": len(self.rules.state()),
            "n_actions": self.rules.n_actions,
            "episode_limit": self.rules.episode_limit,
        }

    def reset(self) -> tuple[list[NDArray[np.float32]], NDArray[np.float32]]:
        """Begins an episode; returns observations and state."""
        if self._key is None:
            self.seed(int(np.random.default_rng().integers(2**31)))
        self.rules.begin(self._next_key())
        return self.get_obs(), self.get_state()

    def get_obs(self) -> list[NDArray[np.float32]]:
        """One observation per agent, [O] each."""
        return [np.array(self.rules.look(i), np.float32) for i in range(self.rules.n_agents)]

    def get_state(self) -> NDArray[np.float32]:
        """The global state, [S]."""
        return np.array(self.rules.state(), np.float32)

    def get_avail_actions(self) -> list[list[int]]:
        """For each agent, 1 for each action that is available and 0 for others."""
        return [self.rules.available(agent) for agent in range(self.rules.n_agents)]

    def step(self, actions: list[int]) -> tuple[float, bool, dict[str, Any]]:
        """One action per agent -> reward, whether the episode is over, facts.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            TaskError: if an action is not available.
        """
        if self._key is None:
            raise gymnasium.error.ResetNeeded("Call reset before the first step.")
        for agent, row in enumerate(self.get_avail_actions()):
            if not row[actions[agent]]:
                raise TaskError(
                    f"Agent {agent} of a probe chose action {actions[agent]}, which is not "
                    f"available. Choose one where get_avail_actions()[{agent}] = {row} is 1."
                )
        reward = self.rules.play(list(actions), self._next_key())
        won = {"battle_won": self.rules.won} if self._tells_wins else {}
        return reward, self.rules.over, won

    def close(self) -> None:
        """There is nothing to give back."""

    def _next_key(self) -> Any:
        import jax

        self._key, now = jax.random.split(self._key)
        return now


def _chance() -> Any:
    from race.envs.discrete_probe import chance

    return chance


def _bits(number: int, size: int) -> list[float]:
    return [float(place == number) for place in range(size)]


def _share(facts: list[bool]) -> float:
    return sum(facts) / len(facts)

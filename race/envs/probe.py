"""Tiny tasks with known answers, on which a learner that is broken shows it at once.

All have two agents, states of float32 between -1 and 1, actions between -1 and 1, and are
deterministic given ``reset(seed=...)``. They have no picture to render.
"""

import functools
from typing import Any, Final, NamedTuple, final

import gymnasium
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from race.errors import RenderError, TaskError
from race.types import EnvSpec, Task

State = NDArray[np.float32]
Step = tuple[State, float, bool, bool, dict[str, Any]]

LIMIT: Final = 10
"""Steps after which ``probe/time-limit`` is truncated."""
LAST: Final = 5
"""Steps after which ``probe/terminates`` terminates."""
COORDINATION_LOCAL: Final = (-0.5, 0.5)
"""Both agents' action at the shallow optimum of ``probe/coordination``, and its reward."""
COORDINATION_BEST: Final = (0.6, 1.0)
"""Both agents' action at the best optimum of ``probe/coordination``, and its reward."""


class ProbeInfo(NamedTuple):
    """What a probe tests, and the return of the best team where it has a choice."""

    description: str
    optimal_return: float


PROBES: Final[dict[str, ProbeInfo]] = {
    "probe/target": ProbeInfo("one step; each agent has to match a function of what it sees", 0.0),
    "probe/chain": ProbeInfo("two steps, reward only at the end: discount and bootstrapping", 2.0),
    "probe/time-limit": ProbeInfo(
        f"reward 1 a step, truncated after {LIMIT}: worth 1 / (1 - discount) for ever", LIMIT
    ),
    "probe/terminates": ProbeInfo(
        f"reward 1 a step, terminated after {LAST}, which the state shows", LAST
    ),
    "probe/coordination": ProbeInfo(
        "one step; a shallow optimum, and a better one that both agents must move to together",
        COORDINATION_BEST[1],
    ),
}


def make_task(task_id: str) -> Task:
    """The probe of that id (a key of `PROBES`).

    Raises:
        TaskError: if there is no such probe.
    """
    obs_index: tuple[tuple[int, ...], ...] = ((0,), (1,))
    action_index: tuple[tuple[int, ...], ...] = ((0,), (1,))
    match task_id:
        case "probe/target":
            obs_index, action_index, limit = ((0, 1), (2, 3)), ((0, 1), (2,)), 1
        case "probe/chain":
            obs_index, limit = ((0, 1), (0, 1)), 2
        case "probe/time-limit":
            limit = LIMIT
        case "probe/terminates":
            limit = LAST
        case "probe/coordination":
            limit = 1
        case _:
            raise TaskError(f"There is no probe {task_id}. Probes are {', '.join(PROBES)}.")
    actions = sum(map(len, action_index))
    spec = EnvSpec(
        task=task_id,
        state_size=max(map(max, obs_index)) + 1,
        obs_index=obs_index,
        action_index=action_index,
        action_low=(-1.0,) * actions,
        action_high=(1.0,) * actions,
        episode_limit=limit,
    )
    return Task(spec, functools.partial(_make, task_id))


def _make(task_id: str, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
    if render_mode is not None:
        raise RenderError(f"{task_id} has no picture. Render a mamujoco task instead.")
    match task_id:
        case "probe/target":
            return TargetEnv()
        case "probe/chain":
            return ChainEnv()
        case "probe/time-limit":
            return CountingEnv(LIMIT, terminates=False)
        case "probe/terminates":
            return CountingEnv(LAST, terminates=True)
        case _:
            return CoordinationEnv()


def _box(size: int) -> Any:  # a Box, whose type does not fit gymnasium.Env's parameters
    return gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32)


@final
class TargetEnv(gymnasium.Env[State, State]):
    """One step: reward is minus the squared distance to `optimal_action`; state x uniform.

    Agent 0 sees x[0:2] and moves two entries of the action, agent 1 sees x[2:4] and moves one.
    """

    def __init__(self) -> None:
        self.observation_space = _box(4)
        self.action_space = _box(3)
        self._state = np.zeros(4, np.float32)

    @staticmethod
    def optimal_action(x: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 3"]:
        """The best joint action in a state; within (-0.9, 0.9)."""
        targets = (
            0.8 * np.tanh(x[..., 0] + x[..., 1]),
            0.8 * np.sin(2 * x[..., 0]),
            0.8 * x[..., 2] * x[..., 3],
        )
        return np.stack(targets, axis=-1).astype(np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[State, dict[str, Any]]:
        """Draws a state."""
        super().reset(seed=seed)
        self._state = self.np_random.uniform(-1, 1, 4).astype(np.float32)
        return self._state, {}

    def step(self, action: State) -> Step:
        """Rewards the action and terminates."""
        error = np.asarray(action, np.float64) - self.optimal_action(self._state)
        return self._state, -float(error @ error), True, False, {}


@final
class ChainEnv(gymnasium.Env[State, State]):
    """Two steps: the first action is remembered, the second decides, only the end pays.

    State: (0, 0), then (1, m) with m the mean of the first joint action. Reward 0, then
    1 + m - mean(second action ** 2). Both agents see the whole state.
    """

    def __init__(self) -> None:
        self.observation_space = _box(2)
        self.action_space = _box(2)
        self._state = np.zeros(2, np.float32)

    @staticmethod
    def optimal_q(
        state: Float[np.ndarray, "*b 2"], action: Float[np.ndarray, "*b 2"], discount: float
    ) -> Float[np.ndarray, "*b"]:
        """Discounted return of an action followed by the best ones."""
        end = 1 + state[..., 1] - np.mean(np.square(action), axis=-1)
        return np.where(state[..., 0] < 0.5, discount * (1 + np.mean(action, axis=-1)), end)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[State, dict[str, Any]]:
        """Begins at (0, 0)."""
        super().reset(seed=seed)
        self._state = np.zeros(2, np.float32)
        return self._state, {}

    def step(self, action: State) -> Step:
        """Remembers the first action, rewards the second."""
        if self._state[0] == 0:
            self._state = np.array([1.0, np.mean(action)], np.float32)
            return self._state, 0.0, False, False, {}
        reward = 1 + float(self._state[1]) - float(np.mean(np.square(action)))
        return self._state, reward, True, False, {}


@final
class CountingEnv(gymnasium.Env[State, State]):
    """Reward 1 a step, whatever is done.

    ``terminates=True``: terminated after ``steps``; both entries of the state are the share of
    steps left, so with r steps left the value is (1 - discount ** r) / (1 - discount).
    ``terminates=False``: truncated after ``steps``; the state is always 1, and since a time limit
    is not part of the task, the value is 1 / (1 - discount).
    """

    def __init__(self, steps: int, *, terminates: bool) -> None:
        self.observation_space = _box(2)
        self.action_space = _box(2)
        self._steps = steps
        self._terminates = terminates
        self._left = steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[State, dict[str, Any]]:
        """Begins with all steps left."""
        super().reset(seed=seed)
        self._left = self._steps
        return self._state(), {}

    def step(self, action: State) -> Step:
        """Counts down."""
        self._left -= 1
        over = self._left == 0
        return self._state(), 1.0, over and self._terminates, over and not self._terminates, {}

    def _state(self) -> State:
        left = self._left / self._steps if self._terminates else 1.0
        return np.full(2, left, np.float32)


@final
class CoordinationEnv(gymnasium.Env[State, State]):
    """One step: a broad hill of height 0.5 at (-0.5, -0.5), a steep one of height 1 at (0.6, 0.6).

    From the top of the broad hill no agent gains by moving alone, wherever it goes.
    """

    def __init__(self) -> None:
        self.observation_space = _box(2)
        self.action_space = _box(2)

    @staticmethod
    def reward(action: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b"]:
        """The reward of joint actions, in (0, 1]."""

        def hill(top: tuple[float, float], width: float) -> Any:
            square = np.sum(np.square(np.asarray(action, np.float64) - top[0]), axis=-1)
            return top[1] * np.exp(-square / (2 * width**2))

        return np.asarray(np.maximum(hill(COORDINATION_LOCAL, 0.5), hill(COORDINATION_BEST, 0.3)))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[State, dict[str, Any]]:
        """The state is always (1, 1)."""
        super().reset(seed=seed)
        return np.ones(2, np.float32), {}

    def step(self, action: State) -> Step:
        """Rewards the action and terminates."""
        return np.ones(2, np.float32), float(self.reward(action)), True, False, {}

"""Five steps of a random walk that take their time, for tests that kill; it imports little."""

import time
from typing import Any

import gymnasium
import numpy as np

from race.envs import factorised
from race.types import Task


class Walk(gymnasium.Env[Any, Any]):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.steps, self.at = 0, self.np_random.uniform(-1, 1, 2)
        return self.at, {}

    def step(self, action: Any) -> Any:
        time.sleep(0.002)
        self.steps += 1
        self.at = self.at + 0.1 * action + 0.01 * self.np_random.normal(size=2)
        return self.at, -float(np.square(self.at).sum()), False, self.steps == 5, {}


def task() -> Task:
    index = ((0,), (1,))
    return factorised(
        lambda mode: Walk(),
        obs_index=index,
        action_index=index,
        task="slow_walk:task",
        episode_limit=5,
    )

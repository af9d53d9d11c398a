"""An environment that fails in a chosen way, for tests in processes: it imports little."""

import os
import sys
import time
from typing import Any

import gymnasium
import numpy as np

FAILURE_AT = 2  # the step at which episodes fail


class Seeded(gymnasium.Env[Any, Any]):
    """Shows its seed and the steps made; four steps. Fails at the second step for some seeds."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    alive = most = made = 0

    def __init__(self, fails: str = "", seeds: tuple[int, ...] = ()) -> None:
        self.fails, self.seeds = fails, seeds
        kind = type(self)
        kind.alive, kind.made = kind.alive + 1, kind.made + 1
        kind.most = max(kind.most, kind.alive)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.seed, self.count = seed, 0
        return self.look(), {}

    def look(self) -> Any:
        return np.array([self.seed, self.count], float)

    def step(self, action: Any) -> Any:
        self.count += 1
        if self.count == FAILURE_AT and self.seed in self.seeds:
            match self.fails:
                case "error":
                    raise OSError("the motor is on fire")
                case "exit":
                    sys.exit()
                case "dies":
                    os._exit(7)
                case "hangs":
                    time.sleep(1000)
                case "wrong":
                    return None
        return self.look(), 1.0, False, self.count == 4, {}

    def close(self) -> None:
        type(self).alive -= 1
        if self.fails == "closing" and self.alive:
            raise ConnectionError("the simulator has gone")


class Chooser(Seeded):
    """The same with discrete actions."""

    def look(self) -> Any:
        numbers = super().look()
        return {"obs": numbers[:, None], "state": numbers, "avail_actions": np.ones((2, 3))}

    def step(self, action: Any) -> Any:
        action[:] = 0  # its own, to write to
        return super().step(action)


def make(kind: Any, fails: str, seeds: tuple[int, ...], render_mode: str | None) -> Any:
    return kind(fails, seeds)

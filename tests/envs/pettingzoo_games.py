"""Tiny parallel environments whose every answer is written down beforehand."""

import functools
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv

LIMIT = 6


class Numbers(ParallelEnv[str, Any, Any]):
    """Two agents, ``big`` and ``small``, that see the time; b's is a step behind.

    What happens is scripted: `script` holds, by step, what is to be changed of the answers.
    """

    metadata: dict[str, Any] = {"name": "numbers_v0", "render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        script: dict[int, dict[str, Any]] | None = None,
        *,
        max_cycles: int = LIMIT,
        render_mode: str | None = None,
    ) -> None:
        self.script, self.render_mode = script or {}, render_mode
        self.limit = self.max_cycles = max_cycles
        self.possible_agents = ["big", "small"]
        self.calls: list[Any] = []
        self.time = 0

    @functools.cache  # noqa: B019
    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Box(-np.inf, np.inf, (3 if agent == "big" else 2,), np.float32)

    @functools.cache  # noqa: B019
    def action_space(self, agent: str) -> spaces.Space[Any]:
        if agent == "big":
            return spaces.Box(-1.0, np.array([2.0, 4.0], np.float32), (2,))
        return spaces.Box(0.0, 1.0, (1,))

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.calls.append(("reset", seed))
        self.time, self.agents = 0, list(self.possible_agents)
        self.noise = 0 if seed is None else seed % 7
        seen, *_, infos = self._answer()
        return seen, infos

    def step(self, actions: dict[str, Any]) -> Any:
        self.calls.append(actions)
        self.time += 1
        answer = self._answer()
        self.agents = self.script.get(self.time, {}).get("agents", list(answer[0]))
        if any(answer[3].values()):
            self.agents = []
        return answer

    def render(self) -> Any:
        return np.full((4, 5, 3), self.time, np.uint8)

    def close(self) -> None:
        self.calls.append("close")

    def _answer(self) -> Any:
        told = self.script.get(self.time, {})
        over = self.time >= self.limit
        sizes = {"big": 3, "small": 2}
        seen: Any = {
            a: np.arange(n, dtype=np.float32) + 10 * self.time + self.noise
            for a, n in sizes.items()
        }
        here = told.get("there", list(seen))
        return (
            told.get("seen", {a: seen[a] for a in here}),
            told.get("rewards", {"big": 1.0, "small": 2.0 + self.time}),
            told.get("terminations", {"big": False, "small": False}),
            told.get("truncations", {"big": over, "small": over}),
            told.get("infos", {"big": {}, "small": {}}),
        )


class Choosing(Numbers):
    """The same with choices; ``big`` has 2 x 3 of them."""

    @functools.cache  # noqa: B019
    def action_space(self, agent: str) -> spaces.Space[Any]:
        if agent == "big":
            return spaces.MultiDiscrete([2, 3], start=[0, 5])
        return spaces.Discrete(4, start=1)


class Masked(Choosing):
    """``small`` has a mask beside what it sees, ``big`` one in its info."""

    @functools.cache  # noqa: B019
    def observation_space(self, agent: str) -> spaces.Space[Any]:
        inner = super().observation_space(agent)
        if agent == "big":
            return inner
        return spaces.Dict({"observation": inner, "action_mask": spaces.MultiBinary(4)})

    def _answer(self) -> Any:
        seen, rewards, terminations, truncations, _ = super()._answer()
        if "small" in seen and not isinstance(seen["small"], dict):
            mask = np.array([0, 1, 1, self.time % 2], np.int8)
            seen["small"] = {"observation": seen["small"], "action_mask": mask}
        infos = {"big": {"action_mask": np.array([1, 0, 1, 1, 0])}, "small": {}}
        return seen, rewards, terminations, truncations, infos


class WithState(Numbers):
    """Its state is nothing that its agents see."""

    def state(self) -> Any:
        return np.array([[self.time, -1.0]])


class StateOfAll(Numbers):
    """Its state is what its agents see."""

    def state(self) -> Any:
        seen = self._answer()[0]
        return np.concatenate([seen["big"], seen["small"]])


class Rivals(Numbers):
    """Two that share, and one that is paid what the first is not."""

    metadata: dict[str, Any] = {"name": "rivals_v0"}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.possible_agents = ["cat_0", "cat_1", "mouse"]

    @functools.cache  # noqa: B019
    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(2 if agent == "mouse" else 3)

    @functools.cache  # noqa: B019
    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(3)

    def step(self, actions: dict[str, Any]) -> Any:
        self.pay = float(actions["cat_0"] == actions["mouse"])
        return super().step(actions)

    def _answer(self) -> Any:
        over = self.time >= self.limit
        pay = getattr(self, "pay", 0.0)
        return (
            {a: np.int64(self.time % 2) for a in self.possible_agents},
            {"cat_0": pay, "cat_1": pay, "mouse": -pay},
            dict.fromkeys(self.possible_agents, False),
            dict.fromkeys(self.possible_agents, over),
            {a: {} for a in self.possible_agents},
        )


class Turns(AECEnv[str, Any, Any]):
    """Two agents; each in its turn names a number, and both are paid if it is the other's last."""

    metadata: dict[str, Any] = {"name": "turns_v0", "is_parallelizable": False}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__()
        self.render_mode, self.max_cycles = render_mode, 4
        self.possible_agents = ["first", "second"]

    @functools.cache  # noqa: B019
    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Dict(
            {"observation": spaces.Discrete(3), "action_mask": spaces.MultiBinary(3)}
        )

    @functools.cache  # noqa: B019
    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(3)

    def observe(self, agent: str) -> Any:
        mask = np.ones(3, np.int8) if agent == self.agent_selection else np.zeros(3, np.int8)
        return {"observation": np.int64(self.last_number), "action_mask": mask}

    def reset(self, seed: int | None = None, options: Any = None) -> None:
        self.agents = list(self.possible_agents)
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos = {agent: {} for agent in self.agents}
        self.last_number, self.moves = 0, 0
        self.agent_selection = "first"

    def step(self, action: Any) -> None:
        if self.terminations[self.agent_selection]:
            self._was_dead_step(action)
            return
        self._cumulative_rewards[self.agent_selection] = 0.0
        self.rewards = dict.fromkeys(self.agents, float(action == self.last_number))
        self.last_number, self.moves = int(action), self.moves + 1
        self.terminations = dict.fromkeys(self.agents, self.moves == self.max_cycles)
        self.agent_selection = "second" if self.agent_selection == "first" else "first"
        self._accumulate_rewards()

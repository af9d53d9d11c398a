"""Tasks that misbehave in one way each, by name: ``bad_tasks:FAULT`` (they import little)."""

import os
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from race.envs import factorised
from race.envs.pymarl import pymarl_task
from race.types import DiscreteSpec, DiscreteTask

LATE = 60
"""Steps after which late faults begin: in the random steps of a run."""
NAN, INF = float("nan"), float("inf")


class Box(gymnasium.Env[Any, Any]):
    """Continuous: four numbers, two actions, twenty steps."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    made: dict[str, int] = {}  # noqa: RUF012

    def __init__(self, fault: str) -> None:
        self.fault, self.steps, self.episodes, self.time = fault, 0, 0, 0
        Box.made[fault] = Box.made.get(fault, 0) + 1
        self.number = Box.made[fault]
        if fault == "third_make" and self.number > 2:
            raise RuntimeError("there are two licences only")
        self.action_space = _ACTIONS.get(fault, self.action_space)
        self.observation_space = _OBSERVATIONS.get(fault, self.observation_space)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.episodes, self.time = self.episodes + 1, 0
        if self.fault == "reset_late" and self.episodes > 4:
            raise ValueError("boom in reset")
        chance = np.random.default_rng() if self.fault == "unseeded" else self.np_random
        self.at = chance.uniform(-1, 1, 4)
        answer = _RESETS.get(self.fault, lambda env: (env.at, {}))(self)
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def step(self, action: Any) -> Any:
        self.time, self.steps = self.time + 1, self.steps + 1
        if self.fault == "f64_bounds":
            assert self.action_space.contains(action), repr(action)
        if self.fault == "mutates":
            action[:] = 99
        self.at[:] = 0.9 * self.at + 0.05 * self.np_random.normal(size=4)
        seen = self.at if self.fault == "reuses" else self.at.copy()
        good = (seen, -float(np.square(seen).sum()), False, self.time >= 20, {})
        name, late = self.fault.removeprefix("late_"), self.fault.startswith("late_")
        if name not in _STEPS or (late and self.steps <= LATE):
            return good
        answer = _STEPS[name](self, list(good))
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def close(self) -> None:
        if self.fault == "close_raises" and self.number > 3:
            raise ConnectionError("the simulator has gone")
        if self.fault == "close_exits" and self.number > 3:
            sys.exit(5)


def _part(index: int, value: Any) -> Callable[[Any, list[Any]], Any]:
    """A step that is good but for one of its five parts."""

    def answer(env: Any, good: list[Any]) -> Any:
        part = value(good[index]) if callable(value) else value
        return (*good[:index], part, *good[index + 1 :])

    return answer


def _raises(error: BaseException) -> Callable[..., Any]:
    return lambda *_: error


_RESETS: dict[str, Callable[[Any], Any]] = {
    "reset_alone": lambda env: env.at,
    "reset_none": lambda env: None,
    "reset_list": lambda env: [env.at],
    "reset_info_none": lambda env: (env.at, None),
    "reset_nan": lambda env: (np.full(4, NAN), {}),
    "reset_shape": lambda env: (np.zeros(5), {}),
    "reset_scalar": lambda env: (1.0, {}),
    "reset_one": lambda env: (np.zeros(1), {}),
    "reset_dict": lambda env: ({"left": np.zeros(4)}, {}),
    "reset_text": lambda env: ("abcd", {}),
    "reset_raises": lambda env: ValueError("boom in reset"),
    "reset_exits": lambda env: SystemExit(),
}
_STEPS: dict[str, Callable[[Any, list[Any]], Any]] = {
    "four": lambda env, good: (*good[:3], {}),
    "none": lambda env, good: None,
    "six": lambda env, good: (*good, 1),
    "info_list": _part(4, []),
    "obs_none": _part(0, None),
    "obs_text": _part(0, "abcd"),
    "obs_five": _part(0, np.zeros(5)),
    "obs_one": _part(0, lambda seen: seen[:1]),
    "obs_column": _part(0, lambda seen: seen[:, None]),
    "obs_square": _part(0, np.zeros((4, 4))),
    "obs_scalar": _part(0, 0.5),
    "obs_objects": _part(0, np.array([None] * 4, object)),
    "obs_complex": _part(0, np.zeros(4) + 1j),
    "obs_ragged": _part(0, [[1.0], [1.0, 2.0]]),
    "obs_dict": _part(0, {"left": np.zeros(2)}),
    "obs_nan": _part(0, np.array([0, NAN, 0, 0])),
    "obs_inf": _part(0, np.array([0, 0, 0, INF])),
    "obs_1e300": _part(0, np.full(4, 1e300)),
    "obs_1e30": _part(0, np.array([1e30, 0, 0, 0])),
    "reward_none": _part(1, None),
    "reward_text": _part(1, "1.5"),
    "reward_agents": _part(1, [1.0, 2.0]),
    "reward_dict": _part(1, {"agent_0": 1.0}),
    "reward_array": _part(1, np.array([1.0, 2.0])),
    "reward_complex": _part(1, 1j),
    "reward_nan": _part(1, NAN),
    "reward_inf": _part(1, INF),
    "reward_1e38": _part(1, 1e38),
    "done_none": _part(2, None),
    "done_text": _part(2, "False"),
    "done_agents": _part(2, lambda end: [end, end]),
    "done_array": _part(2, np.array([True, False])),
    "done_dict": _part(2, lambda end: {"agent_0": end}),
    "done_number": _part(2, 2),
    "cut_agents": _part(3, lambda end: [end, end]),
    "cut_text": _part(3, "False"),
    "raises": _raises(RuntimeError("boom in step")),
    "raises_nothing": _raises(RuntimeError()),
    "raises_lines": _raises(RuntimeError("line one\nline two\n\nline four")),
    "raises_disk": _raises(OSError(28, "No space left on device")),
    "raises_pipe": _raises(BrokenPipeError("the simulator has gone")),
    "raises_memory": _raises(MemoryError()),
    "raises_stop": _raises(StopIteration()),
    "raises_assert": _raises(AssertionError("[/red] is no markup")),
    "raises_gym": _raises(gymnasium.error.ResetNeeded("x")),
    "interrupts": _raises(KeyboardInterrupt()),
    "exits": _raises(SystemExit()),
    "exits_three": _raises(SystemExit(3)),
    "exits_text": _raises(SystemExit("bye")),
    "moves": lambda env, good: os.chdir("/") or tuple(good),
    # What is plainly meant.
    "sized_one": lambda env, good: (
        good[0][None],
        np.array([good[1]]),
        np.array([good[2]]),
        np.array([good[3]]),
        {},
    ),
    "ends_at_limit": lambda env, good: (good[0], 1.0, good[3], False, {}),
}
_ACTIONS: dict[str, Any] = {
    "act_unbounded": gymnasium.spaces.Box(-np.inf, np.inf, (2,)),
    "act_equal": gymnasium.spaces.Box(np.zeros(2, np.float32), np.zeros(2, np.float32)),
    "act_huge": gymnasium.spaces.Box(-3e38, 3e38, (2,), np.float32),
    "act_whole": gymnasium.spaces.Box(0, 5, (2,), np.int64),
    "act_discrete": gymnasium.spaces.MultiDiscrete([3, 3]),
    "act_square": gymnasium.spaces.Box(-1, 1, (1, 2), np.float32),
    "act_narrow": gymnasium.spaces.Box(1.0, 1.0 + 1e-12, (2,), np.float64),
    "f64_bounds": gymnasium.spaces.Box(-0.1, 0.1, (2,), np.float64),
}
_OBSERVATIONS: dict[str, Any] = {
    "space_dict": gymnasium.spaces.Dict({"a": Box.observation_space}),
    "space_image": gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8),
    "space_whole": gymnasium.spaces.Box(-9, 9, (4,), np.int64),
    "space_none": None,
}
_FIELDS: dict[str, dict[str, Any]] = {
    "index_overlap": {"action_index": [(0,), (0, 1)]},
    "index_nobody": {"action_index": [(0, 1), ()]},
    "index_missing": {"action_index": [(0,), (0,)]},
    "index_negative": {"obs_index": [(0, -1), (1,)]},
    "index_large": {"obs_index": [(0, 99), (1,)]},
    "index_fraction": {"obs_index": [(0.7, 1.9), (1,)]},
    "index_text": {"obs_index": ["ab", "c"]},
    "index_flat": {"obs_index": [0, 1]},
    "index_none": {"obs_index": None},
    "index_agents": {"obs_index": [(0,), (1,), (2,)]},
    "limit_zero": {"episode_limit": 0},
    "limit_negative": {"episode_limit": -5},
    "limit_fraction": {"episode_limit": 20.5},
    "limit_float": {"episode_limit": 20.0},
    "limit_text": {"episode_limit": "20"},
    "limit_none": {"episode_limit": None},
    "name_none": {"task": None},
    "name_empty": {"task": ""},
    "limit_numpy": {"episode_limit": np.int64(30)},
    "limit_short": {"episode_limit": 5},
    "limit_long": {"episode_limit": 10**12},
    "one_agent": {"obs_index": [(0, 1, 2, 3)], "action_index": [(0, 1)]},
}


def _make(fault: str, render_mode: str | None) -> Any:
    if fault == "make_raises":
        raise RuntimeError("boom in make")
    if fault == "make_exits":
        sys.exit("bye")
    return {"make_none": None, "make_text": "env"}.get(fault, Box(fault))


def _continuous(fault: str) -> Any:
    fields = {
        "obs_index": [(0, 2), (1, 3)],
        "action_index": [(0,), (1,)],
        "task": "bad",
        "episode_limit": 30,
    } | _FIELDS.get(fault, {})
    return factorised(lambda mode: _make(fault, mode), **fields)


# Discrete actions, with PyMARL's interface and as gymnasium environments.


class Game:
    """Two agents, three actions, six steps; each names the other's number."""

    def __init__(self, fault: str = "fine") -> None:
        self.fault, self.time, self.random = fault, 0, np.random.default_rng(0)

    def get_env_info(self) -> Any:
        info = {
            "n_agents": 2,
            "n_actions": 3,
            "obs_shape": 3,
            "state_shape": 6,
            "episode_limit": 6,
        }
        return _GAMES.get(self.fault, {}).get("info", lambda good: good)(info)

    def reset(self) -> None:
        self.time = 0
        self.draw()

    def draw(self) -> None:
        self.numbers = self.random.integers(3, size=2)

    def get_obs(self) -> Any:
        return self._shown("obs", [np.eye(3)[k] for k in self.numbers])

    def get_state(self) -> Any:
        return self._shown("state", np.eye(3)[self.numbers].ravel())

    def get_avail_actions(self) -> Any:
        return self._shown("avail", [[1] * 3, [1] * 3])

    def step(self, actions: Any) -> Any:
        right = np.asarray(actions) == self.numbers[::-1]
        self.time += 1
        self.draw()
        answer = self._shown("step", (float(right.mean()), self.time >= 6, {}))
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def close(self) -> None:
        self._shown("close", None)

    def _shown(self, name: str, good: Any) -> Any:
        return _GAMES.get(self.fault, {}).get(name, lambda value: value)(good)


class Seeded(Game):
    def seed(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)


class TellsSeed(Game):
    def seed(self) -> int:  # only tells
        return 0


class ResetsSeeded(Game):
    """As in EPyMARL."""

    def reset(self, seed: int | None = None, options: Any = None) -> Any:  # type: ignore[override]
        self.random = np.random.default_rng(seed)
        super().reset()
        return self.get_obs(), {}


_GAMES: dict[str, dict[str, Callable[[Any], Any]]] = {
    "g_done_agents": {"step": lambda good: (good[0], [good[1]] * 2, good[2])},
    "g_done_dict": {"step": lambda good: (good[0], {"agent_0": good[1]}, good[2])},
    "g_done_text": {"step": lambda good: (good[0], "False", good[2])},
    "g_reward_agents": {"step": lambda good: ([good[0]] * 2, *good[1:])},
    "g_reward_text": {"step": lambda good: ("1.5", *good[1:])},
    "g_reward_nan": {"step": lambda good: (NAN, *good[1:])},
    "g_limit_number": {"step": lambda good: (*good[:2], {"episode_limit": 6})},
    "g_limit_text": {"step": lambda good: (*good[:2], {"episode_limit": "no"})},
    "g_two": {"step": lambda good: good[:2]},
    "g_four": {"step": lambda good: (*good[:2], False, {})},
    "g_none": {"step": lambda good: None},
    "g_raises": {"step": lambda good: RuntimeError("boom in step")},
    "g_exits": {"step": lambda good: SystemExit(0)},
    "g_endless": {"step": lambda good: (good[0], False, {})},
    "g_obs_nan": {"obs": lambda good: [good[0] * NAN, good[1]]},
    "g_obs_short": {"obs": lambda good: [good[0]]},
    "g_obs_ragged": {"obs": lambda good: [good[0], good[1][:2]]},
    "g_obs_none": {"obs": lambda good: None},
    "g_state_inf": {"state": lambda good: np.full(6, INF)},
    "g_state_long": {"state": lambda good: np.zeros(7)},
    "g_masked": {"avail": lambda good: [[0] * 3, [1] * 3]},
    "g_mask_negative": {"avail": lambda good: [[1, 0, -1], [1, 1, 1]]},
    "g_mask_fraction": {"avail": lambda good: [[0.2, 0, 1], [1, 1, 1]]},
    "g_mask_short": {"avail": lambda good: [[1, 1, 1]]},
    "g_mask_text": {"avail": lambda good: [["yes"] * 3] * 2},
    "g_shape_tuple": {"info": lambda good: good | {"obs_shape": (3,)}},
    "g_no_limit": {"info": lambda good: {k: v for k, v in good.items() if k != "episode_limit"}},
    "g_no_agents": {"info": lambda good: good | {"n_agents": 0}},
    "g_info_none": {"info": lambda good: None},
    "g_five": {"step": lambda good: (None, *good[:2], False, good[2])},
}
_KINDS: dict[str, Any] = {
    "g_unseeded": Game,
    "g_tells_seed": TellsSeed,
    "g_resets_seeded": ResetsSeeded,
}


class Own(gymnasium.Env[Any, Any]):
    """The same as a gymnasium environment."""

    def __init__(self, fault: str = "fine") -> None:
        self.fault = fault

    def see(self) -> Any:
        good = {
            "obs": np.eye(3)[self.numbers],
            "state": np.eye(3)[self.numbers].ravel(),
            "avail_actions": np.ones((2, 3)),
        }
        return good | _SEEN.get(self.fault, {})

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.time, self.numbers = 0, self.np_random.integers(3, size=2)
        return (self.see() if self.fault != "o_array" else np.zeros(4)), {}

    def step(self, action: Any) -> Any:
        if self.fault == "o_mutates":
            action[self.numbers == 0] = 0
        self.time += 1
        right = float((action == self.numbers).mean())
        self.numbers = self.np_random.integers(3, size=2)
        cut = self.time >= 6
        if self.fault == "o_done_agents":
            return self.see(), right, [False, False], {"a": cut}, {}
        return self.see(), right, False, cut, {}


_SEEN: dict[str, dict[str, Any]] = {
    "o_mask": {"avail_actions": np.array([[1.0, 0, -1], [0.2, 0, 0]])},
    "o_idle": {"avail_actions": np.zeros((2, 3))},
    "o_obs_shape": {"obs": np.zeros((3, 2))},
    "o_state_none": {"state": None},
    "o_state_nan": {"state": np.full(6, NAN)},
}
_SPECS: dict[str, tuple[Any, ...]] = {
    "o_zero": (2, 3, 6, 3, 0),
    "o_none": (2, 3, 6, None, 6),
    "o_1e3": (2, 3, 6, 3, 1e3),
    "o_text": ("2", 3, 6, 3, 6),
    "o_numpy": (2, 3, 6, np.int64(3), 6),
    "o_short": (2, 3, 6, 3, 4),
}


def _discrete(fault: str) -> Any:
    if fault.startswith("g_"):
        kind = _KINDS.get(fault, Seeded)
        return pymarl_task(lambda: kind(fault), "bad")
    sizes: Any = _SPECS.get(fault, (2, 3, 6, 3, 6))
    return DiscreteTask(DiscreteSpec("bad", *sizes), lambda mode: Own(fault))


def task_none() -> Any:
    return None


def task_raises() -> Any:
    raise KeyError("boom")


def task_exits() -> Any:
    sys.exit("bye")


def task_exits_silently() -> Any:
    sys.exit()


def task_env() -> Any:
    return Box("fine")


def task_two(one: Any, two: Any) -> Any:
    return _continuous("fine")


def task_configured(config: Any) -> Any:
    return _continuous("fine")


not_callable = 3


def __getattr__(name: str) -> Any:
    known = (_RESETS, _ACTIONS, _OBSERVATIONS, _FIELDS, _GAMES, _KINDS, _SEEN, _SPECS)
    bare = name.removeprefix("late_")
    if bare in _STEPS or any(name in table for table in known) or name in _OTHERS:
        make = _discrete if name.startswith(("g_", "o_")) else _continuous
        return lambda: make(name)
    raise AttributeError(name)


_OTHERS = {
    *("fine", "third_make", "reset_late", "close_raises", "close_exits", "unseeded"),
    *("make_raises", "make_exits", "make_none", "make_text", "mutates", "reuses"),
    *("o_array", "o_mutates", "o_done_agents", "o_fine", "g_fine"),
}

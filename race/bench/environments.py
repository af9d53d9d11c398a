"""Steps per second of the tasks' simulators, one environment with random actions.

And what a PettingZoo environment costs as a task beside stepping it by hand.
"""

import importlib.util
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from race.bench.measurement import Measurement, Subject
from race.config.presets import TABLE_3
from race.envs import make_continuous_task, make_task
from race.envs.checked import CheckedEnv

SECONDS = 1.0
_SPREAD = ("env/simple_spread/by_hand_per_second", "env/simple_spread/steps_per_second")


def subjects() -> list[Subject]:
    """The paper's eight tasks, and PettingZoo's simple_spread where it is installed."""
    paper = [
        Subject((name,), partial(_measure, name, task))
        for task in TABLE_3
        for name in [f"env/{task.removeprefix('mamujoco/')}/steps_per_second"]
    ]
    found = importlib.util.find_spec("mpe2") is not None
    return paper + [Subject(_SPREAD, _measure_spread)] * found


def _measure(name: str, task_id: str) -> list[Measurement]:
    task = make_continuous_task(task_id)
    actions = np.random.default_rng(0).uniform(
        task.spec.action_low, task.spec.action_high, (1000, task.spec.joint_action_size)
    )
    env = task.make(None)
    try:
        env.reset(seed=0)
        steps, begin = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - begin) < SECONDS:
            _, _, terminated, truncated, _ = env.step(actions[steps % len(actions)])
            steps += 1
            if terminated or truncated:
                env.reset()
    finally:
        env.close()
    return [Measurement(name, steps / elapsed, "1/s")]


def _measure_spread() -> list[Measurement]:
    """The library's environment by hand, and as a task, in turns of a tenth of a second."""
    task = make_task("pettingzoo:mpe2.simple_spread_v3")
    env = CheckedEnv(task)
    hand: Any = CheckedEnv(task).env.parallel.env
    actions = np.random.default_rng(0).integers(5, size=(1000, 3))

    def by_hand(step: int) -> bool:
        chosen = dict(zip(hand.possible_agents, actions[step % len(actions)].tolist(), strict=True))
        hand.step(chosen)
        return not hand.agents

    def as_task(step: int) -> bool:
        made = env.step(actions[step % len(actions)])
        return made.terminated or made.truncated

    turns: list[tuple[Callable[[int], bool], Callable[[], Any]]] = [
        (by_hand, lambda: hand.reset(seed=0)),
        (as_task, lambda: env.reset(0)),
    ]
    steps, seconds = [0, 0], [0.0, 0.0]
    while sum(seconds) < 2 * SECONDS:
        for number, (step, reset) in enumerate(turns):
            reset()
            begin = time.perf_counter()
            while time.perf_counter() - begin < SECONDS / 10:
                steps[number] += 1
                if step(steps[number]):
                    reset()
            seconds[number] += time.perf_counter() - begin
    env.close()
    hand.close()
    rates = [count / spent for count, spent in zip(steps, seconds, strict=True)]
    return [Measurement(name, rate, "1/s") for name, rate in zip(_SPREAD, rates, strict=True)]

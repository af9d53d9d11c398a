"""Steps per second of the tasks' simulators, one environment with random actions."""

import time
from functools import partial

import numpy as np

from race.bench.measurement import Measurement, Subject
from race.config.presets import TABLE_3
from race.envs import make_continuous_task

SECONDS = 1.0


def subjects() -> list[Subject]:
    """The paper's eight tasks."""
    return [
        Subject((name,), partial(_measure, name, task))
        for task in TABLE_3
        for name in [f"env/{task.removeprefix('mamujoco/')}/steps_per_second"]
    ]


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

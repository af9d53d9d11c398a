"""Several runs side by side: in turns, in two processes, as one program; and their environments."""

import os
import subprocess
import sys
import time
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from race import programs
from race.bench.measurement import Measurement, Subject, interleaved_best, seconds
from race.bench.update import Updates, setting, steps_per_call
from race.compilation import cores
from race.envs import make_continuous_task
from race.programs import cohort
from race.rollouts.pool import EnvPool

TASK: Final = "HalfCheetah-2x3"
TURNS: Final = 4
GOAL_TURNS: Final = 1.05
GOAL_SIDE_BY_SIDE: Final = 2 / 1.8
"""Two processes on two cores in the time of one of them, 1.8 times as fast altogether."""
ENVS: Final = 30
GOAL_POOL: Final = 1 / 0.9
WIDTHS: Final = (1, 2, 4, 8, 10, 16)
GOALS_AS_ONE: Final = {10: 15_000.0}
"""Gradient steps per second of all runs together, on one H100 or H200."""
TRANSITIONS: Final = 20_000
ROUNDS: Final = 5
STEPS_AS_ONE: Final = 100
TICKS: Final = 20
"""Steps of every environment in one measurement; HalfCheetah's episodes take 1,000."""


def subjects() -> list[Subject]:
    """On processors runs go in turns or side by side; as one program only where it is asked for."""
    name = f"cohort/{TASK}"
    turns, side = f"{name}/map_{TURNS}_over_1", f"{name}/two_processes_over_1"
    pool = f"pool/HalfCheetah/{ENVS}_over_raw"
    found = [
        Subject((turns,), partial(_measure_turns, turns)),
        Subject((side,), partial(_measure_side_by_side, side)),
        Subject((pool,), partial(_measure_pool, pool)),
    ]
    for width in WIDTHS:
        one = f"{name}/vmap_{width}/gradient_steps_per_second"
        found.append(Subject((one,), partial(_measure_as_one, one, width), on_request=True))
    return found


def _measure_turns(name: str) -> list[Measurement]:
    """Time of a step of each of four runs over that of a single run, in one process."""
    runs = [Updates(setting(TASK, 128), TRANSITIONS) for _ in range(TURNS)]
    steps = steps_per_call(runs[0])

    def in_turns() -> Any:
        return [run(steps) for run in runs]

    one, all_of_them = interleaved_best([partial(runs[0], steps), in_turns], ROUNDS)
    return [Measurement(name, all_of_them / TURNS / one, "", GOAL_TURNS)]


def _measure_side_by_side(name: str) -> list[Measurement]:
    """Time of two processes of one core each, at once, over that of one of them alone."""
    usable = cores()
    if len(usable) < 2:
        return []

    def process(core: int) -> "subprocess.Popen[str]":
        made = subprocess.Popen(
            [sys.executable, "-m", "race.bench.cohorts"],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        os.sched_setaffinity(made.pid, {core})
        return made

    def ask(*asked: "subprocess.Popen[str]") -> float:
        for one in asked:
            assert one.stdin is not None
            one.stdin.write("\n")
            one.stdin.flush()
        return max(float(_line(one)) for one in asked)

    first, second = process(usable[0]), process(usable[1])
    with first, second:
        try:
            for one in (first, second):
                _line(one)
            alone, both = [], []
            for _ in range(ROUNDS):
                alone.append(ask(first))
                both.append(ask(first, second))
        finally:
            first.kill()
            second.kill()
    return [Measurement(name, min(both) / min(alone), "", GOAL_SIDE_BY_SIDE)]


def _line(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, "the process has ended"
    return line


def _side() -> None:
    """What each of two processes does: some gradient steps whenever it is asked, and their time."""
    updates = Updates(setting(TASK, 128), TRANSITIONS)
    steps = steps_per_call(updates)
    seconds(partial(updates, steps))
    print("ready", flush=True)
    for _ in sys.stdin:
        print(seconds(partial(updates, steps)), flush=True)


def _measure_pool(name: str) -> list[Measurement]:
    """Time of a step in a pool of many environments over that of environments alone.

    Per core: what processes gain by working at once is taken off.
    """
    task = make_continuous_task(f"mamujoco/{TASK}")
    middle = (np.array(task.spec.action_low) + np.array(task.spec.action_high)) / 2
    action = np.asarray(middle, np.float32)
    with EnvPool(task, ENVS) as pool:
        pool.reset({team: team for team in range(ENVS)})
        actions = dict.fromkeys(range(ENVS), action)
        workers = min(len(cores()), ENVS) if pool.processes else 1
        raw = task.make(None)
        raw.reset(seed=0)

        def ticks() -> float:
            begin = time.perf_counter()
            for _ in range(TICKS):
                pool.step(actions)
            return (time.perf_counter() - begin) * workers / (TICKS * ENVS)

        def steps() -> float:
            begin = time.perf_counter()
            for _ in range(ENVS * TICKS):
                raw.step(action.astype(np.float64))
            return (time.perf_counter() - begin) / (ENVS * TICKS)

        ticks()
        steps()
        times = []
        for round_ in range(ROUNDS):
            times.append((ticks(), steps()))
            pool.reset(dict.fromkeys(range(ENVS), round_))
            raw.reset(seed=round_)
        raw.close()
    in_pool, alone = (min(column) for column in zip(*times, strict=True))
    return [Measurement(name, in_pool / alone, "", GOAL_POOL)]


class Cohort:
    """Gradient steps of several fresh runs as one program, as training makes them."""

    def __init__(self, width: int) -> None:
        self._runs = [Updates(setting(TASK, 128), TRANSITIONS) for _ in range(width)]
        one = self._runs[0]
        self._statics = {"algorithm": one.algorithm, "spec": one.spec, "shape": one.shape}
        self._states = tuple(jax.tree.map(jnp.copy, run.state) for run in self._runs)
        self._sums = tuple(programs.empty_losses(one.algorithm) for _ in range(width))
        self._keys = tuple(jax.random.key(i) for i in range(width))

    def __call__(self) -> Any:
        """`STEPS_AS_ONE` gradient steps of each run."""
        width, first = len(self._runs), np.int32(0)
        shape = self._statics["shape"]
        batches = tuple(
            cohort.minibatches(
                run.replay, key, first, hyper=run.hyper, room=STEPS_AS_ONE, shape=shape
            )
            for run, key in zip(self._runs, self._keys, strict=True)
        )
        self._states, self._sums = cohort.learn(
            self._states,
            self._sums,
            batches,
            self._keys,
            np.zeros(width, np.int32),
            np.full(width, STEPS_AS_ONE, np.int32),
            hypers=tuple(run.hyper for run in self._runs),
            **self._statics,
        )
        return self._states


def _measure_as_one(name: str, width: int) -> list[Measurement]:
    """Gradient steps of all runs together, per second."""
    (best,) = interleaved_best([Cohort(width)], ROUNDS)
    return [Measurement(name, width * STEPS_AS_ONE / best, "1/s", GOALS_AS_ONE.get(width))]


if __name__ == "__main__":
    _side()

"""Environment steps per second of the micromanagement battles, and the kernels of a step.

A step is the whole step: drawing random available actions, eight game loops, observations, state,
masks, reward, and a new battle where one has ended. Everything runs in one compiled scan.

Kernels are those of `race.envs.micro.smac.step` alone, one battle, compiled with the map as an
argument, as `race.envs.micro.Battle.step` does (`race.bench.kernels` tells what counts).
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from race.bench.kernels import kernels_in
from race.bench.measurement import Measurement, Subject, interleaved_best
from race.envs.micro import Battle, make, map_names, smac
from race.envs.micro.policies import random_actions

GOALS: Final[dict[str, dict[int, float]]] = {
    "2s3z": {1: 20_000, 6: 40_000, 256: 60_000},
    "MMM2": {1: 6_000, 6: 10_000, 256: 20_000},
    "2c_vs_64zg": {1: 1_500, 6: 3_000, 256: 5_000},
    "3m": {1: 30_000, 6: 70_000, 256: 120_000},
    "corridor": {1: 3_000, 6: 5_000, 256: 8_000},
    "27m_vs_30m": {1: 1_500, 6: 2_500, 256: 4_000},
}
"""Steps per second of so many battles at once, all battles together, on two cores."""
BATTLES: Final = (1, 6, 256)
COMPILE_GOAL: Final = 15.0
"""Seconds to compile a map's program."""
STEPS: Final = {1: 2000, 6: 600, 256: 24}
"""Steps of each battle in one measurement."""
ROUNDS: Final = 5
MANY: Final = 1024
GOAL_MANY: Final = 1e6
"""Steps per second of so many battles of 2s3z at once, on one H100 or H200."""
STEPS_OF_MANY: Final = 60


def subjects() -> list[Subject]:
    """Speed and kernels of every map; those of maps without goals only when they are asked for."""
    many = f"micro/2s3z/battles_{MANY}/steps_per_second"
    found = [Subject((many,), partial(_measure_many, many), on_request=True)]
    for name in map_names():
        asked = name not in GOALS
        kernels = _kernels_name(name)
        found += [
            Subject(_names(name), partial(measure, name), on_request=asked),
            Subject((kernels,), partial(measure_kernels, name), on_request=asked),
        ]
    return found


def _names(name: str) -> tuple[str, ...]:
    rates = (f"micro/{name}/battles_{battles}/steps_per_second" for battles in BATTLES)
    return (*rates, f"micro/{name}/compile")


def _kernels_name(name: str) -> str:
    return f"micro/{name}/kernels_per_step"


def measure_kernels(name: str) -> list[Measurement]:
    """Kernels of one environment step of one battle of a map, its eight game loops included."""
    battle, key = make(name), jax.random.key(0)
    env_state, _ = jax.eval_shape(smac.reset, battle.scenario, key)
    actions = np.zeros(battle.shape.n_allies, np.int32)
    step = jax.jit(smac.step).lower(battle.scenario, env_state, actions, key).compile()
    text = step.as_text()
    assert text is not None, "this device does not show its compiled programs"
    return [Measurement(_kernels_name(name), float(kernels_in(text).total()), "kernels")]


def measure(name: str) -> list[Measurement]:
    """Speeds and compile time of a map."""
    battle = make(name)
    runs: list[Callable[[], Any]] = []
    compile_times = []
    for battles in BATTLES:
        key = jax.random.key(0)
        begin = time.perf_counter()
        run = jax.jit(partial(_play, battle, battles, STEPS[battles])).lower(key).compile()
        compile_times.append(time.perf_counter() - begin)
        runs.append(partial(run, key))
    *rate_names, compile_name = _names(name)
    rates = [
        Measurement(
            rate_name,
            battles * STEPS[battles] / seconds,
            "1/s",
            GOALS.get(name, {}).get(battles),
        )
        for rate_name, battles, seconds in zip(
            rate_names, BATTLES, interleaved_best(runs, ROUNDS), strict=True
        )
    ]
    return [*rates, Measurement(compile_name, max(compile_times), "s", COMPILE_GOAL)]


def _measure_many(name: str) -> list[Measurement]:
    """Battles for an accelerator; on a processor they wait for each other."""
    run = jax.jit(partial(_play, make("2s3z"), MANY, STEPS_OF_MANY))
    (best,) = interleaved_best([partial(run, jax.random.key(0))], ROUNDS)
    return [Measurement(name, MANY * STEPS_OF_MANY / best, "1/s", GOAL_MANY)]


def _play(battle: Battle, battles: int, steps: int, key: Key[Array, ""]) -> Any:
    """Sums over all that the steps return, so that nothing of them is left out."""

    def one(key: Key[Array, ""]) -> Any:
        fresh = smac.reset(battle.scenario, key)

        def step(carry: Any, key: Key[Array, ""]) -> Any:
            env_state, observation = carry
            act_key, step_key = jax.random.split(key)
            actions = random_actions(battle.scenario, env_state, observation, act_key)
            env_state, timestep = smac.step(battle.scenario, env_state, actions, step_key)
            seen = timestep.observation
            total = jnp.sum(seen.obs) + jnp.sum(seen.state) + timestep.reward
            carry = jax.tree.map(
                lambda new, now: jnp.where(timestep.terminated, new, now),
                fresh,
                (env_state, timestep.observation),
            )
            return carry, (total, timestep.info)

        return jax.lax.scan(step, fresh, jax.random.split(key, steps))

    return one(key) if battles == 1 else jax.vmap(one)(jax.random.split(key, battles))

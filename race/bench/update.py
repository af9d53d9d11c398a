"""Gradient steps: their time, and how far it is from that of their matrix products."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from race import programs
from race.algorithms import algorithm_of
from race.bench.measurement import Measurement, Subject, interleaved_best, seconds
from race.bench.products import operations, products_alone, products_in
from race.config.hyper import Hyper, hyper_of
from race.config.presets import resolve
from race.config.settings import Algo, Config, LearnerConfig
from race.config.shape import shape_of
from race.envs import make_continuous_task
from race.replay.buffer import Replay, sample
from race.types import EnvSpec, Transition

ROUNDS = 6
SECONDS_PER_CALL = 0.4
TRANSITIONS = 100_000
GOAL_OVER_FLOOR = 1.5
GOALS_OVER_FLOOR = {("HalfCheetah-2x3", 128): 1.6}
"""Where it is another."""
GOAL_LAYER_NORM = 1.08
"""What layer normalisation may multiply the time of a step by."""
GOALS_MS = {("HalfCheetah-2x3", 128): 9.0, ("HalfCheetah-2x3", 256): 18.0}
"""Milliseconds per RACE step on two cores."""


def subjects() -> list[Subject]:
    """Updates of RACE at both presets' batch sizes, and of MATD3."""
    found = []
    for task in ("HalfCheetah-2x3", "HalfCheetah-6x1"):
        for batch_size in (128, 256):
            name = f"update/{task}/b{batch_size}"
            names = tuple(f"{name}/{kind}" for kind in ("ms", "over_floor", "gflops"))
            found.append(Subject(names, partial(_measure_race, task, batch_size)))
    name = "update-matd3/HalfCheetah-2x3/b128/ms"
    found.append(Subject((name,), partial(_measure_matd3, name)))
    name = "update/HalfCheetah-2x3/b128/layer_norm"
    found.append(Subject((name,), partial(_measure_layer_norm, name)))
    return found


def setting(task: str, batch_size: int, algo: Algo = "race") -> Config:
    """A resolved config of a Multi-Agent MuJoCo task."""
    learner = dataclasses.replace(LearnerConfig(), batch_size=batch_size)
    return resolve(Config(task=f"mamujoco/{task}", algo=algo, learner=learner))


class Updates:
    """Runs gradient steps of a fresh learner on random transitions, as training runs them."""

    def __init__(self, config: Config, transitions: int = TRANSITIONS) -> None:
        self.config = config
        self.spec = make_continuous_task(config.task, config.env).spec
        self.algorithm = algorithm_of(config)
        self.replay = random_replay(self.spec, transitions)
        self.shape, self.hyper = shape_of(config), hyper_of(config)
        self._statics = {"algorithm": self.algorithm, "spec": self.spec, "shape": self.shape}
        self.state = programs.start(jax.random.key(0), hyper=self.hyper, **self._statics)
        self._sums = programs.empty_losses(self.algorithm)

    def __call__(self, steps: int) -> Any:
        """Makes a number of gradient steps, from an even one on."""
        self.state, self._sums = programs.learn(
            self.state,
            self._sums,
            self.replay,
            jax.random.key(1),
            np.int32(0),
            np.int32(steps),
            hyper=self.hyper,
            **self._statics,
        )
        return self.state

    def hlo(self, step: int) -> str:
        """The compiled text of the gradient step of one number, all its conditions resolved."""
        shape = self.shape

        def update(state: Any, batch: Transition, key: jax.Array, hyper: Hyper) -> Any:
            number = jnp.int32(step)
            return self.algorithm.update(state, batch, number, key, self.spec, shape, hyper)

        batch = sample(self.replay, self.config.learner.batch_size, jax.random.key(2))
        compiled = jax.jit(update).lower(self.state, batch, jax.random.key(3), self.hyper).compile()
        text = compiled.as_text()
        assert text is not None, "this backend does not show its programs"
        return text


def random_replay(spec: EnvSpec, size: int) -> Replay:
    """A full buffer of random transitions."""
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.standard_normal(shape, np.float32))

    data = Transition(
        state=normal(size, spec.state_size),
        action=jnp.tanh(normal(size, spec.joint_action_size)),
        reward=normal(size),
        terminated=jnp.zeros(size),
        next_state=normal(size, spec.state_size),
    )
    return Replay(data, jnp.asarray(size, jnp.int32))


def steps_per_call(updates: Updates) -> int:
    """Gradient steps that take about `SECONDS_PER_CALL`, a multiple of the policy delay."""
    delay = updates.config.learner.policy_delay
    jax.block_until_ready(updates(delay))
    pair = min(seconds(lambda: updates(2 * delay)) for _ in range(3)) / 2
    return delay * max(1, round(SECONDS_PER_CALL / pair))


def _measure_race(task: str, batch_size: int) -> list[Measurement]:
    updates = Updates(setting(task, batch_size))
    delay = updates.config.learner.policy_delay
    steps = steps_per_call(updates)
    # Steps 0 to delay - 2 train the critics alone, step delay - 1 the policies as well.
    products = [product for step in range(delay) for product in products_in(updates.hlo(step))]
    floor = products_alone(products)
    update_time, floor_time = interleaved_best(
        [lambda: updates(steps), lambda: floor(steps // delay)], ROUNDS
    )
    name, update_time = f"update/{task}/b{batch_size}", update_time / steps
    over_floor = update_time / (floor_time / steps)
    goal = GOALS_OVER_FLOOR.get((task, batch_size), GOAL_OVER_FLOOR)
    return [
        Measurement(f"{name}/ms", 1e3 * update_time, "ms", GOALS_MS.get((task, batch_size))),
        Measurement(f"{name}/over_floor", over_floor, "", goal),
        Measurement(f"{name}/gflops", operations(products) / delay / update_time / 1e9, "GFLOP/s"),
    ]


def _measure_matd3(name: str) -> list[Measurement]:
    updates = Updates(setting("HalfCheetah-2x3", 128, "matd3"))
    steps = steps_per_call(updates)
    (best,) = interleaved_best([lambda: updates(steps)], ROUNDS)
    return [Measurement(name, 1e3 * best / steps, "ms")]


def _measure_layer_norm(name: str) -> list[Measurement]:
    """How many times as long a step takes with normalisation as without."""
    config = setting("HalfCheetah-2x3", 128)
    plain = dataclasses.replace(config.learner, layer_norm=False)
    both = Updates(config), Updates(dataclasses.replace(config, learner=plain))
    steps = steps_per_call(both[0])
    normalised, without = interleaved_best([partial(updates, steps) for updates in both], ROUNDS)
    return [Measurement(name, normalised / without, "", GOAL_LAYER_NORM)]

"""Gradient steps on whole episodes, and a whole training run on battles."""

import tempfile
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from race import programs
from race.algorithms import algorithm_of
from race.bench.measurement import Measurement, Subject, interleaved_best
from race.bench.products import Product, products_alone, products_in
from race.config.hyper import Hyper, hyper_of
from race.config.presets import resolve
from race.config.settings import Algo, Config
from race.config.shape import shape_of
from race.replay.buffer import Replay, slots_of
from race.replay.packing import layouts
from race.rollouts.episodes import empty_episode
from race.runs import directory as run_directory
from race.training.run_state import Progress
from race.training.trainer import train
from race.types import DiscreteSpec, Episode

SHAPES: Final[dict[str, DiscreteSpec]] = {
    "2s3z": DiscreteSpec("2s3z", 5, 80, 120, 11, 60),
    "MMM2": DiscreteSpec("MMM2", 10, 176, 322, 18, 100),
}
"""Of two maps, with minibatches as long as battles of trained teams."""
GOALS_MS: Final = {("race", "2s3z"): 70.0, ("race", "MMM2"): 260.0}
"""Milliseconds per RACE step on two cores, with five teams in the population."""
GOALS_OVER_FLOOR: Final = dict.fromkeys(GOALS_MS, 1.5)
"""Over the time of the step's matrix products alone."""
STEPS: Final = 6
"""Gradient steps of a call: those of a generation of RACE."""
ROUNDS: Final = 6
TRAINED_MAP: Final = "micro/2s3z"
TRAINING_GOAL: Final = 500.0
TRAINING_STEPS: Final = 25_000
"""Environment steps of the training run, of which the second half is timed."""


def subjects() -> list[Subject]:
    """Gradient steps of RACE and FACMAC, and a training run of RACE."""
    found = []
    algos: tuple[Algo, ...] = ("race", "facmac")
    for algo in algos:
        for shape in SHAPES:
            name = f"update-episodes/{algo}/{shape}"
            names = (f"{name}/ms", f"{name}/over_floor")
            found.append(Subject(names, partial(_measure_update, name, algo, shape)))
    name = f"training/{TRAINED_MAP}/env_steps_per_second"
    return [*found, Subject((name,), partial(_measure_training, name))]


def random_episodes(spec: DiscreteSpec, count: int, precision: str) -> Episode:
    """Episodes of random numbers, the first of them as long as can be, the others shorter."""
    rng = np.random.default_rng(0)
    empty = empty_episode(spec, precision, count)
    available = rng.random(empty.avail_actions.shape) < 0.7
    available[..., 0] = True
    length = rng.integers(spec.episode_limit // 2, spec.episode_limit, count, np.int32)
    length[0] = spec.episode_limit
    return Episode(
        obs=rng.standard_normal(empty.obs.shape, np.float32).astype(precision),
        state=rng.standard_normal(empty.state.shape, np.float32).astype(precision),
        avail_actions=available,
        action=rng.integers(0, spec.n_actions, empty.action.shape, empty.action.dtype),
        reward=rng.random(empty.reward.shape, np.float32),
        terminated=empty.terminated,
        length=length,
    )


class EpisodeUpdates:
    """Runs gradient steps of a fresh learner on some episodes, as training runs them.

    `random_episodes` are longer than half a row, so that each has a row of its own.
    """

    def __init__(self, config: Config, spec: DiscreteSpec, episodes: Episode) -> None:
        algorithm = algorithm_of(config)
        self._algorithm, self._spec, self._shape = algorithm, spec, shape_of(config)
        self._statics = {"algorithm": algorithm, "spec": spec, "shape": self._shape}
        self._hyper = hyper_of(config)
        places = np.tile(np.arange(config.facmac.batch_size), (STEPS, 1))
        self._layout = layouts(places, episodes.length[places], spec.episode_limit)
        data = Episode(*map(jnp.asarray, episodes))
        self.replay = Replay(data, jnp.asarray(len(episodes.length), jnp.int32))
        fresh = programs.start(jax.random.key(0), hyper=self._hyper, **self._statics)
        self._state = jax.tree.map(jnp.copy, fresh)
        self._sums = programs.empty_losses(algorithm)

    def __call__(self, steps: int) -> Any:
        """Makes a number of gradient steps, up to `STEPS`."""
        self._state, self._sums = programs.learn(
            self._state,
            self._sums,
            self.replay,
            jax.random.key(1),
            np.int32(0),
            np.int32(steps),
            hyper=self._hyper,
            **self._statics,
            layouts=self._layout,
        )
        return self._state

    def products(self) -> list[Product]:
        """Those of one gradient step that copies no targets."""
        slots = slots_of(self.replay, jax.tree.map(lambda column: column[0], self._layout))
        of_all = self._spec, self._shape

        def update(state: Any, slots: Any, key: jax.Array, hyper: Hyper) -> Any:
            return self._algorithm.update(state, slots, jnp.int32(0), key, *of_all, hyper)

        lowered = jax.jit(update).lower(self._state, slots, jax.random.key(3), self._hyper)
        return products_in(str(lowered.compile().as_text()))


def _measure_update(name: str, algo: Algo, shape: str) -> list[Measurement]:
    spec = SHAPES[shape]
    config = resolve(Config(spec.task, algo), discrete=True)
    episodes = random_episodes(
        spec, 2 * config.facmac.batch_size, str(config.facmac.replay_precision)
    )
    updates = EpisodeUpdates(config, spec, episodes)
    # A generation of the baseline is one episode, and so one step.
    steps = STEPS if config.has_population else 1
    floor = products_alone(updates.products())
    runs: list[Callable[[], Any]] = [partial(updates, steps), partial(floor, steps)]
    best, alone = interleaved_best(runs, ROUNDS)
    goal = GOALS_OVER_FLOOR.get((algo, shape))
    return [
        Measurement(f"{name}/ms", 1e3 * best / steps, "ms", GOALS_MS.get((algo, shape))),
        Measurement(f"{name}/over_floor", best / alone, "", goal),
    ]


def _measure_training(name: str) -> list[Measurement]:
    """Rollouts, evolution, gradient steps and bookkeeping; without test episodes and compiling."""
    config = resolve(Config(TRAINED_MAP, env_steps=TRAINING_STEPS), discrete=True)
    seen: list[tuple[int, float]] = []

    def note(stage: str, progress: Progress, row: dict[str, Any]) -> None:
        if stage == "generation":
            seen.append((progress.env_steps, time.perf_counter()))

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        run_directory.create(path, config)
        train(path, config, report=note)
    return [Measurement(name, steps_per_second(seen), "1/s", TRAINING_GOAL)]


def steps_per_second(seen: list[tuple[int, float]]) -> float:
    """The rate over the second half of a run, from its generations' steps and times.

    A generation that compiled something, or before which the teams were tested, takes several
    times as long as usual; the median over generations leaves it out.
    """
    half = seen[len(seen) // 2 :]
    seconds = [after[1] - before[1] for before, after in pairwise(half)]
    steps = [after[0] - before[0] for before, after in pairwise(half)]
    return float(np.median(np.array(steps) / np.array(seconds)))

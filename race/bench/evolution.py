"""Populations of few and of many teams: their evolution, what they add to a step, their battles."""

import dataclasses
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from race import programs
from race.algorithms import algorithm_of
from race.bench.measurement import Measurement, Subject, interleaved_best, seconds
from race.bench.update import Updates, setting, steps_per_call
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config, RaceConfig
from race.config.shape import shape_of
from race.envs import make_continuous_task, make_discrete_task
from race.errors import DivergenceError
from race.rollouts.base import Play
from race.rollouts.discrete import EpisodeRollouts
from race.training.records import generation_row
from race.training.run_state import Progress

TASK: Final = "HalfCheetah-6x1"
FEW: Final = 5
MANY: Final = 500
GOALS_MS: Final = {FEW: 2.0, MANY: 50.0}
GOAL_MANY_OVER_FEW: Final = 1.05
ROUNDS: Final = 10
ROLLOUT_MAP: Final = "micro/2s3z"


def subjects() -> list[Subject]:
    """Evolution of few and many teams, gradient steps beside them, and battles of many."""
    found = [
        Subject((name,), partial(_measure_evolution, name, size))
        for size, name in ((size, f"evolution/{TASK}/teams_{size}/ms") for size in (FEW, MANY))
    ]
    name = f"update/{TASK}/b128/teams_{MANY}_over_{FEW}"
    found.append(Subject((name,), partial(_measure_update, name)))
    name = f"rollouts/{ROLLOUT_MAP}/teams_{MANY}/env_steps_per_second"
    found.append(Subject((name,), partial(_measure_rollouts, name)))
    return found


def with_teams(config: Config, size: int) -> Config:
    """A configuration with so many teams in its population."""
    race: RaceConfig = dataclasses.replace(config.race, population_size=size)
    return resolve(dataclasses.replace(config, race=race))


class Evolutions:
    """Evolves a population as training does, and writes the row that tells of it."""

    def __init__(self, config: Config) -> None:
        self._config, self._algorithm = config, algorithm_of(config)
        self._spec, self._shape = (
            make_continuous_task(config.task, config.env).spec,
            shape_of(config),
        )
        self._hyper = hyper_of(config)
        statics = {"spec": self._spec, "shape": self._shape}
        self.state = programs.start(
            jax.random.key(0), hyper=self._hyper, algorithm=self._algorithm, **statics
        )
        rng = np.random.default_rng(0)
        self._fitness = rng.standard_normal(config.race.population_size).astype(np.float32)

    def __call__(self) -> dict[str, Any]:
        """Selection, crossover, mutation, injection, lineage and statistics of a generation."""
        programs_of: dict[str, Any] = {
            "algorithm": self._algorithm,
            "shape": self._shape,
            "hyper": self._hyper,
        }
        key, fitness = jax.random.key(1), jnp.asarray(self._fitness)
        state = programs.evolve(self.state, fitness, key, spec=self._spec, **programs_of)
        self.state = programs.inject(state, key, **programs_of)
        progress = Progress(env_steps=1, fitness=tuple(self._fitness.tolist()), marl_return=0.0)
        return generation_row(self._config, self._algorithm, self.state, {}, progress)


def _measure_evolution(name: str, size: int) -> list[Measurement]:
    (best,) = interleaved_best([Evolutions(with_teams(setting(TASK, 128), size))], ROUNDS)
    return [Measurement(name, 1e3 * best, "ms", GOALS_MS[size])]


def _measure_update(name: str) -> list[Measurement]:
    """How many times as long a gradient step takes beside many teams as beside few."""
    few, many = (Updates(with_teams(setting(TASK, 128), size)) for size in (FEW, MANY))
    steps = steps_per_call(few)
    times = interleaved_best([partial(few, steps), partial(many, steps)], ROUNDS)
    return [Measurement(name, times[1] / times[0], "", GOAL_MANY_OVER_FEW)]


def _measure_rollouts(name: str) -> list[Measurement]:
    """One episode of every team, into the buffer, without compiling."""
    config = with_teams(resolve(Config(ROLLOUT_MAP), discrete=True), MANY)
    task, algorithm, shape = make_discrete_task(ROLLOUT_MAP), algorithm_of(config), shape_of(config)
    state = programs.start(
        jax.random.key(0), hyper=hyper_of(config), algorithm=algorithm, spec=task.spec, shape=shape
    )
    teams = algorithm.teams(state, task.spec, shape)
    with EpisodeRollouts(config, task) as rollouts:
        replay, made = rollouts.empty_replay(config), 0

        def play() -> Any:
            nonlocal replay, made
            (result,) = rollouts.play([Play(config, teams, 1, 0, 0, replay)])
            assert not isinstance(result, DivergenceError)
            replay, made = result[0], result[1].env_steps
            return replay

        play()
        best = min(seconds(play) for _ in range(3))
    return [Measurement(name, made / best, "1/s")]

"""How much of a training run is not gradient steps."""

import dataclasses
import statistics
import tempfile
import time
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from race.bench.measurement import Measurement, Subject
from race.bench.update import setting
from race.config.settings import Algo
from race.runs import directory as run_directory
from race.training.learning import CHUNK
from race.training.run_state import Progress
from race.training.trainer import train

GOAL = 0.10
GENERATIONS = 2
"""Generations that are timed, after the first, which compiles."""
TASK = "HalfCheetah-2x3"
EPISODE = 1000
"""Steps of every episode of the task."""


def subjects() -> list[Subject]:
    """RACE with its six teams, and MATD3 with its one."""
    race, matd3 = f"training/{TASK}/rollout_fraction", f"training-matd3/{TASK}/rollout_fraction"
    return [
        Subject((race,), partial(_measure, race, "race", 0.1)),
        Subject((matd3,), partial(_measure, matd3, "matd3", 0.4)),
    ]


class _EnoughError(Exception):
    """Ends the training run from within its report."""


class _Stopwatch:
    """A `race.training.run.Report` that notes when gradient steps were done."""

    def __init__(self) -> None:
        self._generations: list[list[float]] = []  # when each 100 steps of them were done

    def __call__(self, stage: str, progress: Progress, row: dict[str, Any]) -> None:
        if stage == "rollouts":
            if len(self._generations) == 1 + GENERATIONS:
                raise _EnoughError
            self._generations.append([])
        elif stage == "learning" and not row:
            self._generations[-1].append(time.perf_counter())

    def fraction(self, env_steps: int) -> float:
        """Share of all but gradient steps in generations of as many of both kinds of steps."""
        pairs = list(pairwise(self._generations))
        chunk = statistics.median(b - a for _, times in pairs for a, b in pairwise(times))
        # From the last steps of a generation to the first of the next, but for these themselves.
        rest = statistics.mean(times[0] - before[-1] - chunk for before, times in pairs)
        return rest / (rest + chunk * env_steps / CHUNK)


def _measure(name: str, algo: Algo, steps_per_env_step: float) -> list[Measurement]:
    # A real run with fewer gradient steps, whose time is then scaled up to one per step.
    config = setting(TASK, 128, algo)
    learner = dataclasses.replace(config.learner, gradient_steps_per_env_step=steps_per_env_step)
    evaluation = dataclasses.replace(config.evaluation, every=config.env_steps)
    config = dataclasses.replace(config, learner=learner, evaluation=evaluation)
    stopwatch = _Stopwatch()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        run_directory.create(path, config)
        try:
            train(path, config, report=stopwatch)
        except _EnoughError:
            return [Measurement(name, stopwatch.fraction(EPISODE * config.n_teams), "", GOAL)]
    raise AssertionError("training ended before the measurement did")

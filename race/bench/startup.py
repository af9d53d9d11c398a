"""The time from the start of a training command to its first gradient steps.

As a program, ``python -m race.bench.startup DIR cold|warm``, it is that command: it trains in DIR
and prints the seconds from the end of the random steps to that of the first gradient steps. The
warm run has other numbers (`race.config.hyper`) and another seed: it compiles nothing.
"""

import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

from race.bench.measurement import Measurement, Subject

GOAL_COLD, GOAL_WARM, GOAL_OTHER_NUMBERS = 40.0, 15.0, 5.0
NAMES = (
    "startup/first_gradient_step_cold",
    "startup/first_gradient_step_warm",
    "startup/other_numbers_after_random_steps",
)


def subjects() -> list[Subject]:
    """With an empty compilation cache, then with the one that the first start filled."""
    return [Subject(NAMES, _measure)]


def _measure() -> list[Measurement]:
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "XDG_CACHE_HOME": str(Path(folder) / "cache")}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        start = partial(_seconds_to_first_steps, Path(folder), environment)
        (cold, _), (warm, learned) = start("cold"), start("warm")
        goals = (GOAL_COLD, GOAL_WARM, GOAL_OTHER_NUMBERS)
        return [
            Measurement(name, seconds, "s", goal)
            for name, seconds, goal in zip(NAMES, (cold, warm, learned), goals, strict=True)
        ]


def _seconds_to_first_steps(
    folder: Path, environment: dict[str, str], run: str
) -> tuple[float, float]:
    """Seconds of the whole process, and of the part of it after the random steps."""
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "race.bench.startup", str(folder / run), run],
        env=environment,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return time.perf_counter() - begin, float(done.stdout)


def _train_until_first_steps(path: Path, run: str) -> None:
    # What `race train mamujoco/HalfCheetah-2x3 --run-dir DIR` does, with another report.
    from race.compilation import use_cache
    from race.config.presets import resolve
    from race.config.settings import Config, LearnerConfig, RaceConfig
    from race.runs import directory as run_directory
    from race.training.trainer import train

    after_random_steps = 0.0

    def report(stage: str, progress: Any, row: dict[str, Any]) -> None:
        nonlocal after_random_steps
        if stage == "saving":
            after_random_steps = time.perf_counter()
        if "time/first_gradient_steps" in row:
            print(time.perf_counter() - after_random_steps, flush=True)
            os._exit(0)

    use_cache()
    config = Config(task="mamujoco/HalfCheetah-2x3")
    if run == "warm":
        learner = LearnerConfig(actor_learning_rate=5e-4, discount=0.98, smoothing_noise=0.1)
        race = RaceConfig(mutation_fraction=0.3, vmm_weight=1e-3)
        config = Config(config.task, seed=2, learner=learner, race=race)
    config = resolve(config)
    run_directory.create(path, config)
    train(path, config, report=report)
    raise AssertionError("training ended without a gradient step")


if __name__ == "__main__":
    _train_until_first_steps(Path(sys.argv[1]), sys.argv[2])

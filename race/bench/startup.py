"""The time from the start of a training command to its first gradient steps.

As a program, ``python -m race.bench.startup DIR``, it is that command: it trains in DIR and ends
when the first gradient steps have run.
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

GOAL_COLD, GOAL_WARM = 40.0, 15.0
NAMES = ("startup/first_gradient_step_cold", "startup/first_gradient_step_warm")


def subjects() -> list[Subject]:
    """With an empty compilation cache, then with the one that the first start filled."""
    return [Subject(NAMES, _measure)]


def _measure() -> list[Measurement]:
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "XDG_CACHE_HOME": str(Path(folder) / "cache")}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        start = partial(_seconds_to_first_steps, Path(folder), environment)
        goals = (GOAL_COLD, GOAL_WARM)
        return [
            Measurement(name, start(name.rpartition("_")[2]), "s", goal)
            for name, goal in zip(NAMES, goals, strict=True)
        ]


def _seconds_to_first_steps(folder: Path, environment: dict[str, str], run: str) -> float:
    begin = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "race.bench.startup", str(folder / run)],
        env=environment,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return time.perf_counter() - begin


def _train_until_first_steps(path: Path) -> None:
    # What `race train mamujoco/HalfCheetah-2x3 --run-dir DIR` does, with another report.
    from race.compilation import use_cache
    from race.config.presets import resolve
    from race.config.settings import Config
    from race.runs import directory as run_directory
    from race.training.trainer import train

    def report(stage: str, progress: Any, row: dict[str, Any]) -> None:
        if "time/first_gradient_steps" in row:
            os._exit(0)

    use_cache()
    config = resolve(Config(task="mamujoco/HalfCheetah-2x3"))
    run_directory.create(path, config)
    train(path, config, report=report)
    raise AssertionError("training ended without a gradient step")


if __name__ == "__main__":
    _train_until_first_steps(Path(sys.argv[1]))

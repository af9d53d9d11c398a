"""What ``race train`` and ``race resume`` share: the run itself, with its display."""

import dataclasses
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from race.cli import seconds_since_start
from race.cli.progress import TrainingDisplay
from race.compilation import use_cache
from race.config.settings import Config
from race.training.trainer import is_over, train
from race.types import AnyTask, DiscreteTask


def describe(task: AnyTask) -> dict[str, Any]:
    """What metadata.json records of the environment."""
    if isinstance(task, DiscreteTask):
        return dataclasses.asdict(task.spec)
    spec = task.spec
    return {
        "task": spec.task,
        "agents": spec.n_agents,
        "obs_sizes": spec.obs_sizes,
        "action_sizes": spec.action_sizes,
        "state_size": spec.state_size,
        "episode_limit": spec.episode_limit,
        "obs_index": spec.obs_index,
        "action_index": spec.action_index,
    }


def run(path: Path, config: Config, *, extend: bool = False) -> None:
    """Trains in an existing run directory and says how it ended. Exits with 130 on Ctrl-C."""
    import time

    use_cache()
    console = Console(stderr=False)
    console.print(
        f"{config.method} on {config.task}, seed {config.seed}, in {path}",
        highlight=False,
        soft_wrap=True,
    )
    began = time.perf_counter() - seconds_since_start()
    with TrainingDisplay(config, console) as display:
        progress = train(path, config, extend=extend, report=display.report, began=began)
    if not is_over(config, progress):
        kept = f"and saved at {progress.env_steps:,} environment steps. Go on"
        if progress.env_steps == 0:
            kept = "before there was anything to save. Begin again"
        console.print(
            f"Interrupted {kept} with: race resume {path}",
            highlight=False,
            soft_wrap=True,
        )
        sys.exit(130)
    console.print(
        f"Finished after {progress.env_steps:,} environment steps. Next: race evaluate {path}, "
        f"race render {path} --out team.mp4, race plot {path} --out curves.png",
        highlight=False,
        soft_wrap=True,
    )

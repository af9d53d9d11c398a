"""``race train``."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from race.config import (
    Algo,
    Base,
    CheckpointConfig,
    Config,
    EnvConfig,
    EvaluationConfig,
    FacmacConfig,
    LearnerConfig,
    Preset,
    RaceConfig,
)
from race.presets import PRESETS, resolve
from race.types import DiscreteTask


@dataclass(frozen=True)
class Train:
    """Train a team. Ctrl-C saves; `race resume DIR` goes on exactly where it was.

    One line per evaluation is printed; everything is in DIR/metrics.jsonl. Steps of all teams
    count, and the last generation, one episode of every team, is always finished: a run ends up
    to that much after --env-steps.
    """

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    """The task, such as mamujoco/HalfCheetah-2x3 or micro/2s3z (`race list` shows all), or
    package.module:function for your own."""
    algo: Algo = "race"
    """race, or one of its baselines without a population."""
    base: Base | None = None
    """The gradient learner inside race. None: matd3, on tasks with discrete actions facmac."""
    seed: int = 1
    """Seed of everything random: the same seed gives the same run."""
    env_steps: int = 1_000_000
    """Environment steps to train for, those of all teams counted."""
    run_dir: Path | None = None
    """Where the run is kept. Default: runs/TASK-ALGO-seedN."""
    preset: Preset = "paper"
    """Learner settings to start from: the paper's, those of the official TD3 code, or small
    networks for a quick look."""
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    facmac: FacmacConfig = field(default_factory=FacmacConfig)
    race: RaceConfig = field(default_factory=RaceConfig)
    env: EnvConfig = field(default_factory=EnvConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)


def main(arguments: list[str]) -> None:
    """Parses the arguments, makes the run directory and trains."""
    chosen = _parse(arguments)
    asked = Config(
        **{
            f.name: getattr(chosen, f.name)
            for f in dataclasses.fields(Config)
            if hasattr(chosen, f.name)
        }
    )
    # Not before the arguments are parsed: these take a second to import.
    from race import run_directory
    from race.cli.training import describe, run
    from race.envs import make_task

    task = make_task(asked.task, asked.env)
    config = resolve(asked, discrete=isinstance(task, DiscreteTask))
    path = chosen.run_dir or Path("runs") / _name(config)
    run_directory.create(path, config, describe(task))
    run(path, config)


def _parse(arguments: list[str]) -> Train:
    # Twice, because the preset is itself an argument: what it sets is a default, not a command.
    first = tyro.cli(Train, args=arguments, prog="race train")
    default = Train(task=first.task, learner=PRESETS[first.preset])
    return tyro.cli(Train, args=arguments, prog="race train", default=default)


def _name(config: Config) -> str:
    task = config.task.replace("/", "-").replace(":", "-")
    return f"{task}-{config.method.replace('(', '-').replace(')', '').lower()}-seed{config.seed}"


__all__ = ["Train", "main"]

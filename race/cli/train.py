"""``race train``."""

import dataclasses
import os
from collections.abc import Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from race.config.ablations import AblationName, ablated
from race.config.presets import PRESETS, resolve
from race.config.settings import (
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
from race.errors import ConfigError, RunDirectoryError
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
    ablation: tuple[AblationName, ...] = ()
    """What to take away from race: one or several of `race list`. Each is a few settings."""
    seed: int = 1
    """Seed of everything random: the same seed gives the same run."""
    seeds: str | None = None
    """Several seeds instead, such as 1-5 or 1,4,7: a run each, in RUN_DIR/seedN, at once as far as
    there are cores. `race resume RUN_DIR` goes on with all of them."""
    jobs: int | None = None
    """With --seeds: runs at a time, each kept on one core. None: as many as cores, or one on an
    accelerator."""
    env_steps: int = 1_000_000
    """Environment steps to train for, those of all teams counted."""
    run_dir: Path | None = None
    """Where the run is kept. Default: runs/TASK-ALGO-seedN, with --seeds runs/TASK-ALGO; names of
    ablations follow ALGO."""
    preset: Preset = "paper"
    """Learner settings to start from: the paper's, those of the official TD3 code, or small
    networks for a quick look. On tasks with discrete actions there is only the paper's."""
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
    from race.cli.seeds import SHARED_ACCELERATOR, run_all
    from race.cli.training import describe, run
    from race.envs import make_task
    from race.runs import directory as run_directory

    if chosen.seeds is not None:  # this process only watches
        os.environ.update(SHARED_ACCELERATOR)
    task = make_task(asked.task, asked.env)
    discrete = isinstance(task, DiscreteTask)
    _refuse_without_effect(asked, chosen.preset, discrete)
    config = resolve(ablated(asked, chosen.ablation), discrete=discrete)
    if chosen.seeds is None:
        if chosen.jobs is not None:
            raise ConfigError("--jobs has no effect without --seeds. Leave it out.")
        path = chosen.run_dir or Path("runs") / f"{_name(config)}-seed{config.seed}"
        run_directory.create(path, config, describe(task))
        run(path, config)
        return
    path = chosen.run_dir or Path("runs") / _name(config)
    _create_all(path, config, chosen, describe(task))
    run_all(path, chosen.jobs)


def _create_all(path: Path, config: Config, chosen: Train, described: dict[str, Any]) -> None:
    """Makes the run directories of several seeds, or none."""
    from race.cli.seeds import check_jobs, parse_seeds
    from race.runs import directory as run_directory

    seeds = parse_seeds(str(chosen.seeds))
    if chosen.seed != 1:
        raise ConfigError("--seed and --seeds are two ways to say it; leave one out.")
    check_jobs(chosen.jobs)
    configs = [resolve(dataclasses.replace(config, seed=seed)) for seed in seeds]
    places = [path / f"seed{seed}" for seed in seeds]
    for place in (path, *places):
        if (place / "config.json").exists():
            raise RunDirectoryError(
                f"{place} already holds a run. Go on with all runs of {path} by `race resume "
                f"{path}`, or choose another directory with `--run-dir`."
            )
    for place, one in zip(places, configs, strict=True):
        run_directory.create(place, one, described)


def _parse(arguments: list[str]) -> Train:
    # Twice, because the preset is itself an argument: what it sets is a default, not a command.
    first = tyro.cli(Train, args=arguments, prog="race train")
    default = Train(task=first.task, learner=PRESETS[first.preset])
    return tyro.cli(Train, args=arguments, prog="race train", default=default)


def _refuse_without_effect(asked: Config, preset: Preset, discrete: bool) -> None:
    """Settings that would not be used are mistakes, and costly ones if not told."""
    if discrete and preset != "paper":
        raise ConfigError(
            f"--preset {preset} has no effect on {asked.task}: its actions are discrete, and the "
            "presets are of learners of continuous actions. Leave it out; --facmac.* are the "
            "settings of the learner on this task."
        )
    if discrete:
        unused = _changed("learner", asked.learner, LearnerConfig())
        if ":" not in asked.task:  # a task of the user's own is given these settings
            unused += _changed("env", asked.env, EnvConfig())
        kind, instead = "discrete", "--facmac.*"
    else:
        # The mixer is all that FACMAC shares with its form for continuous actions.
        mixes = "facmac" in (asked.algo, asked.base)
        used = {"mixer_size", "hypernet_size"} if mixes else set()
        unused = _changed("facmac", asked.facmac, FacmacConfig(), used)
        kind, instead = "continuous", "--learner.*"
    if unused:
        raise ConfigError(
            f"{' and '.join(unused)} would have no effect on {asked.task}. Its actions are {kind}; "
            f"the settings of its learner are {instead}. Leave out what has no effect."
        )


def _changed(group: str, asked: Any, default: Any, used: Set[str] = frozenset()) -> list[str]:
    names = [f.name for f in dataclasses.fields(asked) if f.name not in used]
    changed = [name for name in names if getattr(asked, name) != getattr(default, name)]
    return [f"--{group}.{name.replace('_', '-')}" for name in changed]


def _name(config: Config) -> str:
    task = config.task.replace("/", "-").replace(":", "-")
    method = config.method.replace("(", "-").replace(")", "").lower()
    return "-".join([task, method, *config.ablation])


__all__ = ["Train", "main"]

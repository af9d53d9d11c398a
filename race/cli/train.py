"""``race train``."""

import dataclasses
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from race.config.ablations import AblationName, ablated
from race.config.cohort import CohortConfig
from race.config.effects import refuse_without_effect
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
from race.errors import ConfigError, RunDirectoryError, command, say
from race.types import AnyTask, DiscreteTask


@dataclass(frozen=True)
class Train:
    """Train a team. Ctrl-C saves; `race resume DIR` goes on exactly where it was.

    One line per evaluation is printed; everything is in DIR/metrics.jsonl. Steps of all teams
    count, and the last generation, one episode of every team, is always finished: a run ends up
    to that much after --env-steps.

    `race train TASK --help` shows the settings that the task has, --help-all every one.
    """

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    """The task, such as mamujoco/HalfCheetah-2x3 or micro/2s3z (`race list` shows all),
    pettingzoo:MODULE.ENV, or package.module:function for your own."""
    algo: Algo = "race"
    """race, or a baseline: with a population of whole networks (merl, ea) or without one."""
    base: Base | None = None
    """The gradient learner inside race and merl. None: matd3, on discrete actions facmac."""
    ablation: tuple[AblationName, ...] = ()
    """What to take away from race: one or several of `race list`. Each is a few settings."""
    seed: int = 1
    """Seed of everything random: the same seed gives the same run."""
    seeds: str | None = None
    """Several seeds instead, such as 1-5 or 1,4,7: a run each, in RUN_DIR/seedN, at once as far as
    there are cores. `race resume RUN_DIR` goes on with all of them."""
    jobs: int | None = None
    """With --seeds: processes at a time, each kept on one core. None: as many as cores, or as
    accelerators."""
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
    cohort: CohortConfig = field(default_factory=CohortConfig)


def main(arguments: list[str]) -> None:
    """Parses the arguments, makes the run directory and trains."""
    if set(arguments) & {"-h", "--help", "--help-all"}:
        from race.cli import help as explained

        explained.show(Train, arguments)
        return
    chosen = _parse(arguments)
    asked = Config(
        **{
            f.name: getattr(chosen, f.name)
            for f in dataclasses.fields(Config)
            if hasattr(chosen, f.name)
        }
    )
    # Not before the arguments are parsed: these take a second to import.
    from race.cli.fleet import directories_of, refuse_for_one_run, run_all
    from race.cli.training import run
    from race.cli.worker import SHARED_ACCELERATOR
    from race.compilation import use_cache
    from race.envs import make_task
    from race.envs.description import describe
    from race.runs import directory as run_directory

    if chosen.seeds is not None:  # this process only watches
        os.environ.update(SHARED_ACCELERATOR)
    use_cache()
    task = make_task(asked.task, asked.env)
    config = settled(asked, chosen.preset, chosen.ablation, task)
    if chosen.seeds is None:
        refuse_for_one_run(chosen.jobs, chosen.cohort, "without --seeds. Leave it out.")
        path = chosen.run_dir or Path("runs") / f"{name_of(config)}-seed{config.seed}"
        run_directory.refuse_occupied(path)
        run_directory.create(path, config, describe(task) | tried(asked.task, task))
        run(path, config)
        return
    path = chosen.run_dir or Path("runs") / name_of(config)
    _create_all(path, config, chosen, task)
    run_all(path, directories_of(path), jobs=chosen.jobs, cohort=chosen.cohort)


def settled(
    asked: Config, preset: Preset, ablation: tuple[AblationName, ...], task: AnyTask
) -> Config:
    """What a person asks for, with ablations and all that follows from the task.

    Raises:
        ConfigError: if something is wrong, has no effect, or does not go together.
    """
    from race.algorithms.evolutions import evolution_of

    discrete = isinstance(task, DiscreteTask)
    asked = ablated(asked, ablation, discrete)
    _refuse_without_effect(asked, preset, task)
    config = resolve(asked, discrete=discrete)
    evolution_of(config.race.evolution)  # an operator that is not there is told of at once
    return config


def tried(task_id: str, task: AnyTask) -> dict[str, Any]:
    """What a first look at an environment of the user's own says; others repeat."""
    from race.cli import streams
    from race.envs import pettingzoo
    from race.envs.own import is_own
    from race.envs.trial import try_out

    foreign = task_id.startswith(pettingzoo.PREFIX)
    if not is_own(task_id) and not foreign:
        return {"repeats": True}
    with streams.console(stderr=True).status("trying the environment"):
        trial = try_out(task)
    if trial.note:
        say(trial.note)
    found: dict[str, Any] = {"repeats": trial.repeats, "conflict": trial.conflict}
    if foreign:
        found["packages"] = pettingzoo.packages(task_id.removeprefix(pettingzoo.PREFIX))
    return found


def _create_all(path: Path, config: Config, chosen: Train, task: AnyTask) -> None:
    """Makes the run directories of several seeds, or none."""
    from race.cli.fleet import check_jobs
    from race.config.seeds import parse_seeds
    from race.envs.description import describe
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
                f"{place} already holds a run. Go on with all runs of {path} by "
                f"`{command('race', 'resume', path)}`, or choose another directory with "
                "`--run-dir`."
            )
    described = describe(task) | tried(config.task, task)
    for place, one in zip(places, configs, strict=True):
        run_directory.create(place, one, described)


def _parse(arguments: list[str]) -> Train:
    # Twice, because the preset is itself an argument: what it sets is a default, not a command.
    first = tyro.cli(Train, args=arguments, prog="race train")
    default = Train(task=first.task, learner=PRESETS[first.preset])
    return tyro.cli(Train, args=arguments, prog="race train", default=default)


def _refuse_without_effect(asked: Config, preset: Preset, task: AnyTask) -> None:
    from race.envs import reads_config, reads_team

    discrete = isinstance(task, DiscreteTask)
    if discrete and preset != "paper":
        raise ConfigError(
            f"--preset {preset} has no effect on {asked.task}: its actions are discrete, and the "
            "presets are of learners of continuous actions. Leave it out; --facmac.* are the "
            "settings of the learner on this task."
        )
    refuse_without_effect(
        asked,
        PRESETS[preset],
        discrete=discrete,
        reads_env=reads_config(asked.task),
        reads_parallel=reads_team(asked.task),
        on_host=not isinstance(task, DiscreteTask) or task.device is None,
    )


def name_of(config: Config) -> str:
    """What a run is called after: its task, method and ablations."""
    task = config.task.replace("/", "-").replace(":", "-")
    method = config.method.replace("(", "-").replace(")", "").lower()
    return "-".join([task, method, *config.ablation])


__all__ = ["Train", "main"]

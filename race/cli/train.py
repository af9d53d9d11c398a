"""``race train``."""

import dataclasses
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from race.config.ablations import AblationName
from race.config.cohort import CohortConfig
from race.config.compute import ComputeConfig
from race.config.files import Wanted, read_wanted
from race.config.loggers import LoggerName
from race.config.presets import resolve
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
from race.errors import ConfigError, RunDirectoryError, command
from race.types import AnyTask


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
    pettingzoo:MODULE.ENV, jaxmarl:ENV, smac/2s3z, or package.module:function for your own."""
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
    on: Annotated[str | None, tyro.conf.arg(metavar="CLUSTER")] = None
    """With --seeds: run them on a Ray cluster: ray://HOST:PORT, or ray, which starts one of this
    machine. Runs must lie in a folder that all machines share. Needs race-marl[ray];
    docs/cluster.md."""
    env_steps: int = 1_000_000
    """Environment steps to train for, those of all teams counted."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Settings from a .toml by their names, or from the config.json of a run. Options beside it
    come on top; TASK may be left out if the file names it."""
    init_from: Annotated[str | None, tyro.conf.arg(metavar="DIR")] = None
    """Begin with the teams of another run in place of random ones: its MARL team as the MARL team,
    its champion as the first team of the population. Networks must have the same sizes."""
    log: tuple[LoggerName, ...] = ()
    """Programs that are told every row besides: tensorboard (in RUN_DIR/tensorboard), wandb,
    mlflow, trackio, each an extra of race-marl. A resumed run goes on in the same one."""
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
    compute: ComputeConfig = field(default_factory=ComputeConfig)
    cohort: CohortConfig = field(default_factory=CohortConfig)


def main(arguments: list[str]) -> None:
    """Parses the arguments, makes the run directory and trains."""
    if set(arguments) & {"-h", "--help", "--help-all"}:
        from race.cli import help as explained

        explained.show(Train, arguments)
        return
    chosen, file = _parse(arguments), _file_of(arguments)
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
    from race.runs.loggers.sending import refuse_missing
    from race.teams.creating import create_run
    from race.teams.initial import initial_teams
    from race.training.asking import name_of, settled_with_file, usual_directory

    refuse_missing(chosen.log)

    if chosen.seeds is not None:  # this process only watches
        os.environ.update(SHARED_ACCELERATOR)
    use_cache(asked.compute)
    task = make_task(asked.task, asked.env)
    name = str(chosen.config)
    config = settled_with_file(asked, chosen.preset, chosen.ablation, task, file, name)
    if chosen.seeds is None:
        refuse_for_one_run(chosen.jobs, chosen.cohort, chosen.on, "without --seeds. Leave it out.")
        path = chosen.run_dir or usual_directory(config)
        run_directory.refuse_occupied(path)
        begins_with = initial_teams(config, task)
        described = describe(task) | tried(asked.task, task)
        create_run(path, config, described, begins_with, chosen.log)
        run(path, config)
        return
    path = chosen.run_dir or Path("runs") / name_of(config)
    _create_all(path, config, chosen, file, task)
    run_all(path, directories_of(path), jobs=chosen.jobs, cohort=chosen.cohort, on=chosen.on)


def tried(task_id: str, task: AnyTask) -> dict[str, Any]:
    """`race.training.asking.tried`, with a word on what takes the time."""
    from race.cli import streams
    from race.training import asking

    if not asking.is_tried(task_id):
        return asking.tried(task_id, task)
    with streams.console(stderr=True).status("trying the environment"):
        return asking.tried(task_id, task)


def _create_all(path: Path, config: Config, chosen: Train, file: Wanted, task: AnyTask) -> None:
    """Makes the run directories of several seeds, or none."""
    from race.cli.fleet import check_jobs
    from race.config.seeds import parse_seeds
    from race.envs.description import describe
    from race.teams.creating import create_run
    from race.teams.initial import initial_teams

    seeds = parse_seeds(str(chosen.seeds))
    if chosen.seed != file.settings.get("seed", 1):
        raise ConfigError("--seed and --seeds are two ways to say it; leave one out.")
    check_jobs(chosen.jobs, chosen.on)
    configs = [resolve(dataclasses.replace(config, seed=seed)) for seed in seeds]
    places = [path / f"seed{seed}" for seed in seeds]
    for place in (path, *places):
        if (place / "config.json").exists():
            raise RunDirectoryError(
                f"{place} already holds a run. Go on with all runs of {path} by "
                f"`{command('race', 'resume', path)}`, or choose another directory with "
                "`--run-dir`."
            )
    begins_with = initial_teams(config, task)
    described = describe(task) | tried(config.task, task)
    for place, one in zip(places, configs, strict=True):
        create_run(place, one, described, begins_with, chosen.log)


def _parse(arguments: list[str]) -> Train:
    # Twice, because the preset is itself an argument: what it sets is a default, not a command.
    file = _file_of(arguments)
    first = tyro.cli(Train, args=arguments, prog="race train", default=_default(file))
    file = file._replace(preset=first.preset)
    named = file._replace(settings={**file.settings, "task": first.task})
    return tyro.cli(Train, args=arguments, prog="race train", default=_default(named))


def _file_of(arguments: list[str]) -> Wanted:
    """What the file behind ``--config`` asks for; nothing without one."""
    for place, word in enumerate(arguments):
        if word == "--config" and arguments[place + 1 :]:
            return read_wanted(Path(arguments[place + 1]))
        if word.startswith("--config="):
            return read_wanted(Path(word.removeprefix("--config=")))
    return Wanted({})


def _default(file: Wanted) -> Train:
    config = file.config
    shared = {f.name for f in dataclasses.fields(Config)} & {
        f.name for f in dataclasses.fields(Train)
    }
    values = {name: getattr(config, name) for name in shared}
    values |= {"preset": file.preset, "ablation": file.ablation}
    default = Train(**values)
    if "task" not in file.settings:
        # Past the constructor: it is no text.
        object.__setattr__(default, "task", tyro.MISSING)
    return default


__all__ = ["Train", "main"]

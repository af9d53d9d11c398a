"""``race sweep``."""

import os
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from race.config.cohort import CohortConfig
from race.config.loggers import LoggerName
from race.errors import ConfigError, RunDirectoryError, command


@dataclass(frozen=True)
class Sweep:
    """Train many runs: every combination of the settings in a file, or some drawn at random.

    The file is TOML with the settings of `race train` by their names. A list means that each of its
    values is tried:

        task = "micro/2s3z"
        algo = ["race", "facmac"]
        seeds = "1-5"
        env_steps = 200_000
        [facmac]
        actor_learning_rate = [3e-4, 1e-3]

    With [sweep] draws = 20 so many combinations are drawn, and a number may be a range to draw
    from, such as { from = 1e-4, to = 1e-2, scale = "log" }. Given again, the same command goes on
    with what is unfinished.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.toml")]
    """The settings."""
    run_dir: Path | None = None
    """Where the runs are kept. Default: runs/NAME, after the file."""
    dry_run: bool = False
    """Say what would be run, and run nothing."""
    jobs: int | None = None
    """Processes at a time, each kept on one core. None: as many as cores, or as accelerators."""
    on: Annotated[str | None, tyro.conf.arg(metavar="CLUSTER")] = None
    """Run them on a Ray cluster: ray://HOST:PORT, or ray, which starts one of this machine. Runs
    must lie in a folder that all machines share. Needs race-marl[ray]; see docs/cluster.md."""
    log: tuple[LoggerName, ...] = ()
    """Programs that new runs tell every row besides (`race train --help`)."""
    cohort: CohortConfig = field(default_factory=CohortConfig)


def main(arguments: list[str]) -> None:
    """Parses the arguments, makes the run directories and trains."""
    chosen = tyro.cli(Sweep, args=arguments, prog="race sweep")
    from race.cli.fleet import check_jobs, run_all
    from race.cli.worker import SHARED_ACCELERATOR
    from race.compilation import use_cache

    check_jobs(chosen.jobs, chosen.on)
    os.environ.update(SHARED_ACCELERATOR)  # this process only watches
    use_cache()
    runs = _planned(_read(chosen.file))
    path = chosen.run_dir or Path("runs") / chosen.file.stem
    if chosen.dry_run:
        from race.cli.planned import show_plan

        show_plan(path, runs, chosen.cohort)
        return
    create_runs(path, runs, chosen.log)
    run_all(
        path, [path / name for name in runs], jobs=chosen.jobs, cohort=chosen.cohort, on=chosen.on
    )


def _read(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(file.read_text())
    except OSError as error:
        raise ConfigError(f"{file} cannot be read: {error.strerror}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file} is no TOML: {error}.") from error


def _planned(description: dict[str, Any]) -> dict[str, Any]:
    """The resolved configurations by the names of their directories."""
    from race.config.grid import points, read_grid, with_seed
    from race.config.presets import resolve
    from race.envs import make_task
    from race.training.asking import settled

    grid, tasks, runs = read_grid(description), {}, {}
    for point in points(grid):
        asked = point.asked
        key = (asked.task, asked.env)
        if key not in tasks:
            tasks[key] = make_task(*key)
        told = ", ".join(f"{name} = {value}" for name, value in point.varied.items())
        try:
            config = settled(asked, point.preset, point.ablation, tasks[key])
        except ConfigError as error:
            raise ConfigError(f"With {told or 'these settings'}: {error}") from error
        for seed in grid.seeds:
            runs[f"{_name(config, point.varied)}-seed{seed}"] = resolve(with_seed(config, seed))
    return runs


def _name(config: Any, varied: dict[str, Any]) -> str:
    """What tells a combination from the others, in a directory's name."""
    from race.training.asking import name_of

    settings = [
        f"{name.rpartition('.')[2]}={value:.6g}"
        if isinstance(value, float)
        else f"{name.rpartition('.')[2]}={value}"
        for name, value in varied.items()
        if name not in ("task", "algo", "base", "ablation")
    ]
    plain = "-".join([name_of(config), *settings])
    return re.sub(r"[^\w.=+-]+", "_", plain).strip("_")


def create_runs(
    path: Path, runs: dict[str, Any], log: tuple[LoggerName, ...], option: str = "--run-dir"
) -> None:
    """Makes the run directories that are not there, or none if one that is there is another.

    Args:
        path: the folder.
        runs: their configurations by their names.
        log: who is told of them besides.
        option: what names the folder.

    Raises:
        RunDirectoryError: if one that is there has other settings; says which.
    """
    from race.cli.train import tried
    from race.envs import make_task
    from race.envs.description import describe
    from race.runs import directory as run_directory
    from race.runs.loggers.sending import choose, refuse_missing

    refuse_missing(log)
    missing = {}
    for name, config in runs.items():
        if not (path / name / "config.json").exists():
            missing[name] = config
        elif (there := run_directory.open_run(path / name)) != config:
            raise RunDirectoryError(
                f"{path / name} holds a run with other settings ({unlike(there, config)}). Choose "
                f"another directory with {option}, or go on with the runs as they are: "
                f"{command('race', 'resume', path)}"
            )
    described: dict[Any, Any] = {}
    for name, config in missing.items():
        key = (config.task, config.env)
        if key not in described:
            task = make_task(*key)
            described[key] = describe(task) | tried(config.task, task)
        run_directory.create(path / name, config, described[key])
        choose(path / name, log)


def unlike(there: Any, asked: Any) -> str:
    """The settings in which two runs differ, with both values."""
    from race.config.saved import flat, to_json

    others = flat(to_json(asked))
    pairs = ((name, value, others[name]) for name, value in flat(to_json(there)).items())
    return "; ".join(f"{name} {a}, asked: {b}" for name, a, b in pairs if a != b)

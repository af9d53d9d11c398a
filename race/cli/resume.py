"""``race resume``."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from race.config.cohort import CohortConfig
from race.config.presets import resolve


@dataclass(frozen=True)
class Resume:
    """Go on with a run exactly where it was, or with all of several that are unfinished.

    The newest checkpoint is loaded, rows of metrics written after it are dropped and written
    again, number for number (times excepted) as if the run had never stopped.
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The run's directory, or that of several seeds or of a sweep."""
    env_steps: int | None = None
    """Train up to this many environment steps instead of what the run began with."""
    without_metrics: bool = False
    """Go on although the rows of metrics.jsonl are lost or damaged: the file is put aside and a new
    one begins, which says so."""
    jobs: int | None = None
    """If DIR holds several runs: so many processes at a time. None: as many as cores, or as
    accelerators."""
    on: Annotated[str | None, tyro.conf.arg(metavar="CLUSTER")] = None
    """If DIR holds several runs: go on with them on a Ray cluster, ray://HOST:PORT, or ray, which
    starts one of this machine."""
    cohort: CohortConfig = field(default_factory=CohortConfig)


def main(arguments: list[str]) -> None:
    """Parses the arguments and trains."""
    chosen = tyro.cli(Resume, args=arguments, prog="race resume")
    from race.cli.fleet import directories_of, refuse_for_one_run, run_all
    from race.cli.training import run
    from race.errors import ConfigError
    from race.runs import directory as run_directory
    from race.runs.directory import RunDirectory

    if not RunDirectory(chosen.run_dir).config.exists() and directories_of(chosen.run_dir):
        if chosen.without_metrics:
            raise ConfigError("--without-metrics is for one run: name its directory.")
        run_all(
            chosen.run_dir,
            directories_of(chosen.run_dir),
            jobs=chosen.jobs,
            env_steps=chosen.env_steps,
            cohort=chosen.cohort,
            on=chosen.on,
        )
        return
    told = f"on {chosen.run_dir}, which is one run."
    refuse_for_one_run(chosen.jobs, chosen.cohort, chosen.on, told)
    config = run_directory.open_run(chosen.run_dir)
    if chosen.env_steps is not None:
        config = resolve(dataclasses.replace(config, env_steps=chosen.env_steps))
    run(
        chosen.run_dir,
        config,
        extend=chosen.env_steps is not None,
        without_metrics=chosen.without_metrics,
    )

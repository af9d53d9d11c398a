"""``race resume``."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from race.config.presets import resolve


@dataclass(frozen=True)
class Resume:
    """Go on with a run exactly where it was.

    The newest checkpoint is loaded, rows of metrics written after it are dropped and written
    again, number for number (times excepted) as if the run had never stopped.
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The run's directory."""
    env_steps: int | None = None
    """Train up to this many environment steps instead of what the run began with."""


def main(arguments: list[str]) -> None:
    """Parses the arguments and trains."""
    chosen = tyro.cli(Resume, args=arguments, prog="race resume")
    from race.cli.training import run
    from race.runs import directory as run_directory

    config = run_directory.open_run(chosen.run_dir)
    if chosen.env_steps is not None:
        config = resolve(dataclasses.replace(config, env_steps=chosen.env_steps))
    run(chosen.run_dir, config, extend=chosen.env_steps is not None)

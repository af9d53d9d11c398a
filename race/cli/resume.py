"""``race resume``."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from race.config import resolve
from race.errors import ConfigError


@dataclass(frozen=True)
class Resume:
    """Go on with a run exactly where it was.

    The newest checkpoint is loaded, rows of metrics written after it are dropped and written
    again, number for number (times excepted) as if the run had never stopped.
    """

    run_dir: Annotated[Path, tyro.conf.Positional]
    """The run's directory."""
    env_steps: int | None = None
    """Train up to this many environment steps instead of what the run began with."""


def main(arguments: list[str]) -> None:
    """Parses the arguments and trains."""
    chosen = tyro.cli(Resume, args=arguments, prog="race resume")
    from race import run_directory
    from race.cli.training import run

    path = chosen.run_dir
    config = run_directory.open_run(path)
    if chosen.env_steps is not None:
        if run_directory.is_finished(path) and chosen.env_steps <= config.env_steps:
            raise ConfigError(
                f"The run in {path} has finished its {config.env_steps:,} environment steps; to "
                f"extend it, ask for more than that with --env-steps."
            )
        config = resolve(dataclasses.replace(config, env_steps=chosen.env_steps))
        run_directory.change_config(path, config)
    elif run_directory.is_finished(path):
        raise ConfigError(
            f"The run in {path} has finished. To train it further, say up to how many steps: "
            f"race resume {path} --env-steps {2 * config.env_steps}"
        )
    run(path, config)

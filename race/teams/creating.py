"""A new run: its directory, the teams that it begins with, and who is told of it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from race.config.loggers import LoggerName
from race.config.settings import Config
from race.runs import directory as run_directory
from race.runs.loggers.sending import choose
from race.teams.initial import InitialTeams


def create_run(
    path: Path,
    config: Config,
    described: Mapping[str, Any],
    begins_with: InitialTeams,
    loggers: Sequence[LoggerName],
) -> None:
    """Makes a run directory, complete but for its first step.

    Args:
        path: the directory.
        config: all settings, presets filled in.
        described: what ``metadata.json`` says of the task.
        begins_with: from `race.teams.initial.initial_teams`.
        loggers: who is told every row besides.

    Raises:
        RunDirectoryError: if it cannot be made.
        CheckpointError: if the teams cannot be written.
    """
    run_directory.create(path, config, dict(described))
    begins_with.keep_in(path)
    choose(path, tuple(loggers))

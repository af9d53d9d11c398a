"""A run as Python sees it: its rows, its teams, and how it goes on."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import numpy as np
from rich.console import Console

from race.compilation import use_cache
from race.config.presets import resolve
from race.config.settings import Config
from race.errors import ConfigError, command
from race.runs import directory as run_directory
from race.runs.results import of_directory
from race.teams.team import Team
from race.teams.trained import Trained, load_trained, names_of_checkpoints

Row = dict[str, Any]
OnRow = Callable[[Row], bool | None]
"""Told every row of metrics as it is written; False stops the run, which is saved first."""
Directory = str | os.PathLike[str]


@final
class Rows(list[Row]):
    """Rows of metrics, oldest first."""

    def to_pandas(self) -> Any:
        """The rows as a `pandas.DataFrame`, a column for every name.

        Raises:
            ConfigError: if pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ConfigError("to_pandas needs pandas: pip install pandas") from error
        return pd.DataFrame(list(self))


@final
class Run:
    """A run directory. It is read anew by every call, so that it may be another process's.

    Attributes:
        path: the directory.
    """

    def __init__(self, path: Directory) -> None:
        self.path = Path(path)

    def __repr__(self) -> str:
        config = self.config
        return f"Run({str(self.path)!r}: {config.method} on {config.task}, seed {config.seed})"

    @property
    def config(self) -> Config:
        """All settings of the run."""
        return run_directory.open_run(self.path)

    @property
    def finished(self) -> bool:
        """Whether it has used its whole budget of steps."""
        return run_directory.is_finished(self.path)

    @property
    def checkpoints(self) -> list[str]:
        """The names of its checkpoints, oldest first, then of its best teams, best first."""
        return names_of_checkpoints(self.path)

    def rows(self, kind: str | None = None) -> Rows:
        """Its rows of metrics, oldest first, as dictionaries; none if it is young.

        Args:
            kind: ``generation`` or ``evaluation``. None: all.

        Raises:
            RunDirectoryError: if they cannot be read.
        """
        found = of_directory(self.path).rows
        return Rows(row for row in found if kind in (None, row.get("kind")))

    def trained(self, checkpoint: str | None = None) -> Trained:
        """All teams of a checkpoint, as of `team`."""
        return load_trained(self.path, checkpoint)

    def team(self, name: str = "selected", checkpoint: str | None = None) -> Team:
        """A team, ready to act.

        Args:
            name: ``marl``, the gradient learner's; ``champion``, the population's of best training
                fitness; ``selected``, of these two the one with the better training return.
            checkpoint: one of `checkpoints`, or ``best``, the best tested team that was kept.
                None: the newest checkpoint.

        Raises:
            ConfigError: if the run has no such team.
            RunDirectoryError: if there is no such checkpoint.
            CheckpointError: if it is damaged.
        """
        trained = self.trained(checkpoint)
        return Team(trained, trained.resolve(name))

    def resume(
        self,
        *,
        env_steps: int | None = None,
        on_row: OnRow | None = None,
        progress: bool = True,
    ) -> "Run":
        """Goes on exactly where the run was, as `train` does.

        Args:
            env_steps: train up to so many steps instead of what the run began with.
            on_row: as of `train`.
            progress: as of `train`.

        Raises:
            RaceError: if it cannot go on, or has finished.
            KeyboardInterrupt: after Ctrl-C, once all is saved.
        """
        config = self.config
        if env_steps is not None:
            config = resolve(dataclasses.replace(config, env_steps=env_steps))
        train_in(self.path, config, on_row, progress, extend=env_steps is not None)
        return self


def load(run_dir: Directory) -> Run:
    """A run that is there, of any process.

    Raises:
        RunDirectoryError: if the directory holds no run.
    """
    run = Run(run_dir)
    run_directory.open_run(run.path)
    return run


def train_in(
    path: Path, config: Config, on_row: OnRow | None, progress: bool, extend: bool = False
) -> None:
    """Trains in a run directory; what a callback raises is raised once the run is saved."""
    # What a team needs to be loaded is imported above; this takes as long again.
    from race.training.interrupts import Interrupts
    from race.training.run_state import Progress
    from race.training.trainer import is_over, train
    from race.viewing.logged import logged
    from race.viewing.progress import TrainingDisplay

    use_cache(config.compute)
    interrupts, failures, stopped = Interrupts(), [], False
    console = Console(markup=False, emoji=False, highlight=False, quiet=not progress)
    with TrainingDisplay(config, console) as display:

        def report(stage: str, made: Progress, row: Row) -> None:
            nonlocal stopped
            display.report(stage, made, row)
            of_metrics = "kind" in row
            if not of_metrics or on_row is None or stopped:
                return
            try:
                stopped = _says_no(on_row(row))
            except Exception as error:
                failures.append(error)
                stopped = True
            if stopped:
                interrupts.stop()

        with logged(path, config, report) as told:
            made = train(path, config, extend=extend, report=told, interrupts=interrupts)
    if failures:
        raise failures[0]
    if not is_over(config, made) and not stopped:
        raise KeyboardInterrupt(
            f"saved at {made.env_steps:,} environment steps; go on with race.load({str(path)!r})"
            f".resume(), or in a shell: {command('race', 'resume', path)}"
        )


def _says_no(answer: Any) -> bool:
    return isinstance(answer, bool | np.bool_) and not answer

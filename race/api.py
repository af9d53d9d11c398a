"""What the shell does, from Python: train, load, evaluate, render, export.

Everything here is also an attribute of `race` itself: ``race.train(...)``, ``race.load(...)``.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np
from rich.console import Console

from race.compilation import use_cache
from race.config.files import Wanted, of_mapping, read_wanted
from race.config.presets import resolve
from race.config.settings import Config
from race.envs import make_task
from race.envs.description import describe
from race.errors import ConfigError, command
from race.runs import checkpoints, metrics
from race.runs import directory as run_directory
from race.runs.directory import RunDirectory
from race.teams.evaluation import Evaluation
from race.teams.evaluation import evaluate as play
from race.teams.export import Exported, format_of
from race.teams.export import export as write
from race.teams.formats import Format
from race.teams.heirloom import heirloom_of
from race.teams.team import Team
from race.teams.trained import Trained, load_trained, names_of_checkpoints
from race.training.asking import settled_with_file, tried, usual_directory
from race.training.interrupts import Interrupts
from race.training.run_state import Progress
from race.training.trainer import is_over
from race.training.trainer import train as train_in
from race.viewing import filming
from race.viewing.logged import logged
from race.viewing.progress import TrainingDisplay
from race.viewing.wanted import check_seed, check_video

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
        run, identity = RunDirectory(self.path), run_directory.identity_of(self.path)
        kept = checkpoints.metrics_extent(run.checkpoints)
        found = metrics.read(run.metrics, identity, kept) if run.metrics.exists() else []
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
        _train(self.path, config, on_row, progress, extend=env_steps is not None)
        return self


def train(
    task: str | None = None,
    *,
    run_dir: Directory | None = None,
    config: Directory | Mapping[str, Any] | None = None,
    on_row: OnRow | None = None,
    progress: bool = True,
    **settings: Any,
) -> Run:
    """Trains a team, as `race train` does; returns when the run is over.

    Every option of `race train` is a keyword here, groups as dictionaries or as the dataclasses
    of `race.config.settings`::

        run = race.train(
            "mamujoco/HalfCheetah-2x3", algo="race", seed=1, env_steps=50_000,
            learner={"hidden_sizes": (160, 120)}, on_row=lambda row: row["wall_seconds"] < 600,
        )

    Args:
        task: the task, such as ``micro/2s3z``. None: what ``config`` says.
        run_dir: where the run is kept. None: ``runs/TASK-ALGO-seedN``.
        config: settings to begin with: a TOML file, a run's config.json, or a dictionary; keywords
            come on top.
        on_row: told every row of metrics when it is written. If it returns False, the run is saved
            and left, to be gone on with by `Run.resume`; an error that it raises is raised here
            once the run is saved.
        progress: whether to print a line per test, and a bar on a terminal.
        settings: ``algo``, ``base``, ``seed``, ``env_steps``, ``init_from``, ``preset``,
            ``ablation``, ``learner``, ``facmac``, ``race``, ``env``, ``evaluation``,
            ``checkpoint``, ``compute``.

    Raises:
        RaceError: with a message that says what to do; see `race.errors`.
        KeyboardInterrupt: after Ctrl-C, once all is saved.
    """
    if isinstance(config, Mapping):
        file, name = of_mapping(config), "config"
    else:
        file = Wanted({}) if config is None else read_wanted(Path(config))
        name = str(config)
    named = {} if task is None else {"task": task}
    over = of_mapping(named | {k: v for k, v in settings.items() if v is not None})
    merged = Wanted(
        file.settings | over.settings,
        over.preset if "preset" in settings else file.preset,
        over.ablation if "ablation" in settings else file.ablation,
    )
    asked = merged.config
    if not asked.task:
        raise ConfigError("Name a task: race.train('micro/2s3z'); `race list` shows all.")
    use_cache(asked.compute)
    made = make_task(asked.task, asked.env)
    given = {k: v for k, v in file.settings.items() if k not in over.settings}
    resolved = settled_with_file(
        asked, merged.preset, merged.ablation, made, file._replace(settings=given), name
    )
    path = usual_directory(resolved) if run_dir is None else Path(run_dir)
    run_directory.refuse_occupied(path)
    begins_with = heirloom_of(resolved, made)
    run_directory.create(path, resolved, describe(made) | tried(resolved.task, made))
    begins_with.hand_to(path)
    _train(path, resolved, on_row, progress)
    return Run(path)


def load(run_dir: Directory) -> Run:
    """A run that is there, of any process.

    Raises:
        RunDirectoryError: if the directory holds no run.
    """
    run = Run(run_dir)
    run_directory.open_run(run.path)
    return run


def evaluate(
    what: Run | Team | Directory, team: str = "selected", *, episodes: int = 10, seed: int = 0
) -> Evaluation:
    """Plays test episodes, without exploration, as `race evaluate` does.

    Args:
        what: a run, its directory, or a team.
        team: of a run, which.
        episodes: how many.
        seed: of the episodes; the same seed plays the same.

    Raises:
        RaceError: if the team is not there, or an environment fails.
    """
    trained, name = _which(what, team)
    return play(trained, name, episodes, seed)


class Video(NamedTuple):
    """What `render` wrote."""

    path: Path
    frames: int
    steps: int
    episode_return: float


def render(
    what: Run | Team | Directory,
    out: Directory = "team.mp4",
    team: str = "selected",
    *,
    seed: int = 0,
    seconds: float | None = None,
) -> Video:
    """Makes a video of a team, as `race render` does.

    Args:
        what: a run, its directory, or a team.
        out: an .mp4 or .gif.
        team: of a run, which.
        seed: of the episode.
        seconds: simulated time to show; 0 for the whole episode. None: 15, the whole of a battle.

    Raises:
        RaceError: if it cannot be played, drawn or written.
    """
    path = Path(out)
    check_video(path, seconds, seed)
    check_seed(seed)
    trained, name = _which(what, team)
    drawn = filming.film(trained, name, seed, seconds, path)
    frames = filming.write(drawn, path)
    steps, episode_return, _ = drawn.summary()
    return Video(path, frames, steps, episode_return)


def export(
    what: Run | Team | Directory,
    out: Directory = "team.onnx",
    team: str = "selected",
    *,
    format: Format | None = None,
    per_agent: bool = False,
) -> list[Exported]:
    """Writes a team to a file that runs without JAX and without race, as `race export` does.

    Args:
        what: a run, its directory, or a team.
        out: the file.
        team: of a run, which.
        format: ``onnx``, ``stablehlo`` or ``numpy``. None: what ``out`` ends with.
        per_agent: one file for each agent.

    Raises:
        RaceError: if it cannot be written, or would act as another team.
    """
    path = Path(out)
    kind = format_of(path, format)
    trained, name = _which(what, team)
    return write(Team(trained, trained.resolve(name)), path, kind, per_agent=per_agent)


def _which(what: Run | Team | Directory, team: str) -> tuple[Trained, str]:
    if isinstance(what, Team):
        return what.trained, what.name
    run = what if isinstance(what, Run) else Run(what)
    use_cache(run.config.compute)
    trained = run.trained()
    trained.resolve(team)
    return trained, team


def _train(
    path: Path, config: Config, on_row: OnRow | None, progress: bool, extend: bool = False
) -> None:
    """Trains in a run directory; what a callback raises is raised once the run is saved."""
    use_cache(config.compute)
    interrupts, failures, stopped = Interrupts(), [], False
    console = Console(markup=False, emoji=False, highlight=False, quiet=not progress)
    with TrainingDisplay(config, console) as display:

        def report(stage: str, made: Progress, row: Row) -> None:
            nonlocal stopped
            display.report(stage, made, row)
            if (
                "kind" not in row or on_row is None or stopped
            ):  # without it, it is no row of metrics
                return
            try:
                stopped = _says_no(on_row(row))
            except Exception as error:
                failures.append(error)
                stopped = True
            if stopped:
                interrupts.stop()

        with logged(path, config, report) as told:
            made = train_in(path, config, extend=extend, report=told, interrupts=interrupts)
    if failures:
        raise failures[0]
    if not is_over(config, made) and not stopped:
        raise KeyboardInterrupt(
            f"saved at {made.env_steps:,} environment steps; go on with race.load({str(path)!r})"
            f".resume(), or in a shell: {command('race', 'resume', path)}"
        )


def _says_no(answer: Any) -> bool:
    return isinstance(answer, bool | np.bool_) and not answer

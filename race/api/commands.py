"""The commands of the shell as functions."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

from race.api.run import Directory, OnRow, Run, train_in
from race.compilation import use_cache
from race.config.files import Wanted, of_mapping, read_wanted
from race.config.loggers import LoggerName
from race.envs import make_task
from race.envs.description import describe
from race.errors import ConfigError
from race.runs import directory as run_directory
from race.runs.loggers.sending import refuse_missing
from race.teams.creating import create_run
from race.teams.evaluation import Evaluation
from race.teams.evaluation import evaluate as play
from race.teams.export import Exported, format_of
from race.teams.export import export as write
from race.teams.formats import Format
from race.teams.initial import initial_teams
from race.teams.team import Team
from race.teams.trained import Trained
from race.training.asking import settled_with_file, tried, usual_directory
from race.viewing.wanted import check_seed, check_video


def train(
    task: str | None = None,
    *,
    run_dir: Directory | None = None,
    config: Directory | Mapping[str, Any] | None = None,
    on_row: OnRow | None = None,
    log: Sequence[LoggerName] | Any = (),
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
        log: who else is told every row: ``tensorboard``, ``wandb``, ``mlflow``, ``trackio``.
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
    loggers: list[Any] = [log] if isinstance(log, str) else list(log)
    for logger in loggers:
        if logger not in get_args(LoggerName):
            raise ConfigError(f"log is of {', '.join(get_args(LoggerName))}, not {logger!r}.")
    refuse_missing(loggers)
    use_cache(asked.compute)
    made = make_task(asked.task, asked.env)
    given = {k: v for k, v in file.settings.items() if k not in over.settings}
    resolved = settled_with_file(
        asked, merged.preset, merged.ablation, made, file._replace(settings=given), name
    )
    path = usual_directory(resolved) if run_dir is None else Path(run_dir)
    run_directory.refuse_occupied(path)
    begins_with = initial_teams(resolved, made)
    described = describe(made) | tried(resolved.task, made)
    create_run(path, resolved, described, begins_with, loggers)
    train_in(path, resolved, on_row, progress)
    return Run(path)


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

    MuJoCo is drawn with OpenGL, if there is one, where nothing had imported it before; else set
    ``MUJOCO_GL`` (such as ``egl``) before Python starts, or the slower built-in renderer draws.

    Raises:
        RaceError: if it cannot be played, drawn or written.
    """
    path = Path(out)
    check_video(path, seconds, seed)
    check_seed(seed)
    from race.viewing import filming  # it takes a while to import

    if not run_directory.open_run(_directory(what)).discrete:
        filming.choose_renderer()  # mujoco reads what is chosen here when it is imported
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


def _directory(what: Run | Team | Directory) -> Path:
    if isinstance(what, Team):
        return what.run_dir
    return what.path if isinstance(what, Run) else Path(what)


def _which(what: Run | Team | Directory, team: str) -> tuple[Trained, str]:
    if isinstance(what, Team):
        use_cache(what.trained.config.compute)
        return what.trained, what.name
    run = what if isinstance(what, Run) else Run(what)
    use_cache(run.config.compute)
    trained = run.trained()
    trained.resolve(team)
    return trained, team

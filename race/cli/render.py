"""``race render``."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import tyro

from race.cli import streams
from race.config.settings import TeamName
from race.errors import ConfigError, RenderError

PolicyName = Literal["scripted", "random", "nearest", "heuristic"]
_SECONDS = 15.0
MOST_SECONDS = 100_000
STEPS_PER_SECOND = 2
"""Of a battle, at the game's "normal" speed."""


@dataclass(frozen=True)
class Render:
    """Make a video of a trained team, or of a micromanagement battle, without a display.

    `race render runs/first` shows the team of a run. `race render micro/2s3z` shows a battle of
    agents that have learned nothing; `race list` names the maps, and micro/PATH.toml is your own.
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DIR|micro/MAP")]
    """The directory of a run, or a battle."""
    out: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="PATH",
            help_behavior_hint="(default: team.mp4 of a run, battle.gif of a battle)",
        ),
    ] = None
    """The video: .mp4, battles in 1920 x 1080, or .gif, in 960 x 540."""
    team: Annotated[
        TeamName | None,
        tyro.conf.arg(metavar="{marl,champion,selected}", help_behavior_hint="(default: selected)"),
    ] = None
    """For a run: the gradient learner's team, the population's team of best training fitness, or
    of these two the one with the better training return."""
    policy: Annotated[
        PolicyName | None,
        tyro.conf.arg(metavar="{scripted,random}", help_behavior_hint="(default: scripted)"),
    ] = None
    """For a battle: all attack the weakest enemy in reach, or do anything that is available."""
    seed: int = 0
    """Seed of the episode."""
    seconds: Annotated[
        float | None,
        tyro.conf.arg(
            metavar="FLOAT", help_behavior_hint="(default: 15 of a robot, the whole of a battle)"
        ),
    ] = None
    """Simulated time to show; 0 for the whole episode."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, plays an episode and writes it."""
    chosen = tyro.cli(Render, args=arguments, prog="race render")
    # A directory of that name is a run.
    battle = chosen.what.startswith("micro/") and not Path(chosen.what).is_dir()
    out = chosen.out or Path("battle.gif" if battle else "team.mp4")
    if out.suffix.lower() not in (".mp4", ".gif"):
        raise RenderError(f"{out} is no video: the name must end with .mp4 or .gif.")
    asked = chosen.seconds
    if chosen.seed < 0 or (asked is not None and not 0 <= asked <= MOST_SECONDS):
        raise ConfigError(
            f"--seed and --seconds must be 0 or more, and --seconds at most {MOST_SECONDS}."
        )
    if battle:
        _render_battle(chosen, out, asked or 0.0)
    else:
        _render_run(chosen, out)


def _render_battle(chosen: Render, out: Path, seconds: float) -> None:
    if chosen.team is not None:
        raise ConfigError(
            f"--team is for runs, and {chosen.what} is a battle that no team was trained for: "
            "leave it out, or choose --policy scripted, random, nearest or heuristic."
        )
    if chosen.seed >= 2**32:
        raise ConfigError(f"The --seed of a battle must be below {2**32}.")
    from race.compilation import use_cache
    from race.envs.micro import make
    from race.envs.micro.policies import POLICIES
    from race.envs.micro.recording import play

    use_cache()
    console, policy = streams.console(stderr=True), chosen.policy or "scripted"
    with console.status("playing the battle"):
        played = make(chosen.what.removeprefix("micro/"))
        most_steps = math.ceil(seconds * STEPS_PER_SECOND) or None
        recording = play(played, POLICIES[policy], chosen.seed, most_steps)
    _write(_recorded(played, recording, out), f"{policy} policy", out, console)


def _render_run(chosen: Render, out: Path) -> None:
    if chosen.seed >= 2**31:
        raise ConfigError(f"The --seed of an episode must be below {2**31}.")
    if chosen.policy is not None:
        raise ConfigError(
            f"--policy is for battles such as micro/2s3z, and {chosen.what} is the directory of a "
            "run: leave it out, or choose one of the run's teams with --team."
        )
    from race.compilation import use_cache
    from race.runs import directory as run_directory

    console = streams.console(stderr=True)
    config = run_directory.open_run(Path(chosen.what))
    renderer = None
    if not config.discrete:
        # mujoco reads what is chosen here when it is imported.
        from race.viewing.rendering import choose_renderer

        with console.status("looking for a renderer"):
            renderer = choose_renderer()
        console.print(f"Drawing with: {renderer.reason}", soft_wrap=True)
    from race.teams.trained import load_trained

    use_cache(config.compute)
    with console.status("loading the team"):
        trained = load_trained(Path(chosen.what))
    if renderer is None:
        drawn = _draw_discrete(chosen, trained, chosen.seconds or 0.0, out, console)
    else:
        seconds = _SECONDS if chosen.seconds is None else chosen.seconds
        drawn = _continuous(chosen, trained, seconds, renderer)
    labels = {"marl": "MARL team", "champion": "champion"}
    _write(drawn, labels[trained.resolve(chosen.team or "selected")], out, console)


class _Drawn(NamedTuple):
    """A video to be, and what is said of it once it has been drawn."""

    frames: Iterator[Any]
    total: int
    fps: float
    summary: Callable[[], tuple[int, float, str]]  # steps, return, how it ended


def _continuous(chosen: Render, trained: Any, seconds: float, renderer: Any) -> _Drawn:
    from race.viewing.rendering import Episode

    policy = trained.policy(chosen.team or "selected")
    episode = Episode(trained.task, policy, chosen.seed, seconds, renderer)
    return _Drawn(
        episode.frames(),
        episode.n_frames,
        episode.fps,
        lambda: (episode.steps, episode.episode_return, ""),
    )


def _draw_discrete(chosen: Render, trained: Any, seconds: float, out: Path, console: Any) -> _Drawn:
    if trained.config.task.startswith("micro/"):
        return _battle_of_run(chosen, trained, seconds, out, console)
    from race.viewing.stepwise import DiscreteEpisode

    policy = trained.recurrent_policy(chosen.team or "selected")
    episode = DiscreteEpisode(
        trained.task, lambda seen: policy(seen.obs, seen.avail_actions), chosen.seed, seconds
    )
    return _Drawn(
        episode.frames(),
        episode.n_frames,
        episode.fps,
        lambda: (episode.steps, episode.episode_return, ""),
    )


def _battle_of_run(chosen: Render, trained: Any, seconds: float, out: Path, console: Any) -> _Drawn:
    """A battle is a function of its seed and the actions, so it can be played twice."""
    from race.envs.micro import make
    from race.envs.micro.recording import replay
    from race.rollouts.discrete import EpisodeRollouts

    name = trained.resolve(chosen.team or "selected")
    with (
        console.status("playing the episode"),
        EpisodeRollouts(trained.config, trained.task) as rollouts,
    ):
        actions = rollouts.episode(trained.encoders[name], trained.heads[name], chosen.seed)
    if seconds > 0:
        actions = actions[: math.ceil(seconds * STEPS_PER_SECOND)]
    with console.status("playing it again"):
        played = make(trained.config.task.removeprefix("micro/"))
        recording = replay(played, actions, chosen.seed)
    return _recorded(played, recording, out)


def _recorded(played: Any, recording: Any, out: Path) -> _Drawn:
    from race.envs.micro import render
    from race.envs.micro.canvas import LARGE, SMALL

    ended = recording.verdict or "not finished"
    return _Drawn(
        render.frames(played, recording, SMALL if out.suffix.lower() == ".gif" else LARGE),
        render.n_frames(recording),
        render.FPS,
        lambda: (len(recording.returns), float(recording.returns[-1]), ended),
    )


def _write(drawn: _Drawn, who: str, out: Path, console: Any) -> None:
    from rich.progress import Progress

    from race.cli.progress import rounded
    from race.viewing.rendering import write_video

    with Progress(console=console, transient=True) as bar:
        drawing = bar.track(drawn.frames, total=drawn.total, description="drawing")
        count = write_video(iter(drawing), out, drawn.fps)
    steps, episode_return, ended = drawn.summary()
    print(
        f"{out}: {count} frames, {steps} steps of the {who}, "
        f"return {rounded(episode_return)}" + (f", {ended}" if ended else "")
    )

"""``race render``."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from race.cli import streams
from race.cli.naming import CHECKPOINT
from race.config.settings import TeamName
from race.errors import ConfigError
from race.viewing.wanted import check_seed, check_video

PolicyName = Literal["scripted", "random", "nearest", "heuristic"]


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
    """The video: .mp4, in 1280 x 720, battles in 1920 x 1080; or a .gif of half the size."""
    team: Annotated[
        TeamName | None,
        tyro.conf.arg(metavar="{marl,champion,selected}", help_behavior_hint="(default: selected)"),
    ] = None
    """For a run: the gradient learner's team, the population's team of best training fitness, or
    of these two the one with the better training return."""
    checkpoint: Annotated[str | None, CHECKPOINT] = None
    """For a run: one of its checkpoints, or of the best teams that it kept (`race show DIR` names
    them); best: the best tested of these."""
    policy: Annotated[
        PolicyName | None,
        tyro.conf.arg(
            metavar=f"{{{','.join(get_args(PolicyName))}}}",
            help_behavior_hint="(default: scripted)",
        ),
    ] = None
    """For a battle: all attack the weakest enemy in reach; do anything that is available; attack
    the nearest, as enemies do; or fight as SMAC's heuristic mode does."""
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
    check_video(out, chosen.seconds, chosen.seed)
    if battle:
        _render_battle(chosen, out, chosen.seconds or 0.0)
    else:
        _render_run(chosen, out)


def _render_battle(chosen: Render, out: Path, seconds: float) -> None:
    if chosen.team is not None or chosen.checkpoint is not None:
        given = "--checkpoint" if chosen.team is None else "--team"
        raise ConfigError(
            f"{given} is for runs, and {chosen.what} is a battle that no team was trained for: "
            "leave it out, or choose --policy scripted, random, nearest or heuristic."
        )
    if chosen.seed >= 2**32:
        raise ConfigError(f"The --seed of a battle must be below {2**32}.")
    from race.compilation import use_cache
    from race.envs.micro import make
    from race.envs.micro.policies import POLICIES
    from race.envs.micro.recording import play
    from race.viewing.filming import STEPS_PER_SECOND, is_small, of_battle

    use_cache()
    console, policy = streams.console(stderr=True), chosen.policy or "scripted"
    with console.status("playing the battle"):
        played = make(chosen.what.removeprefix("micro/"))
        most_steps = math.ceil(seconds * STEPS_PER_SECOND) or None
        recording = play(played, POLICIES[policy], chosen.seed, most_steps)
    drawn = of_battle(played, recording, policy, small=is_small(out))
    _write(drawn, f"{policy} policy", out, console)


def _render_run(chosen: Render, out: Path) -> None:
    check_seed(chosen.seed)
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
    from race.viewing.filming import LABELS, film

    use_cache(config.compute)
    team = chosen.team or "selected"
    with console.status("loading the team"):
        trained = load_trained(chosen.what, chosen.checkpoint)
    with console.status("playing the episode"):
        drawn = film(trained, team, chosen.seed, chosen.seconds, out, renderer)
    _write(drawn, LABELS[trained.resolve(team)], out, console)


def _write(drawn: Any, who: str, out: Path, console: Any) -> None:
    from rich.progress import Progress

    from race.viewing.filming import write
    from race.viewing.progress import rounded

    with Progress(console=console, transient=True) as bar:
        drawing = bar.add_task("drawing", total=drawn.total)
        count = write(drawn, out, lambda frames: bar.advance(drawing, frames))
    steps, episode_return, ended = drawn.summary()
    print(
        f"{out}: {count} frames, {steps} steps of the {who}, "
        f"return {rounded(episode_return)}" + (f", {ended}" if ended else "")
    )

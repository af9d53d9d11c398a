"""``race render``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from race.config import TeamName
from race.errors import ConfigError, RenderError


@dataclass(frozen=True)
class Render:
    """Make a video of a trained team, without a display."""

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The run's directory."""
    out: Path = Path("team.mp4")
    """The video: .mp4 or .gif."""
    team: TeamName = "selected"
    """The gradient learner's team, the population's team of best training fitness, or of these
    two the one with the better training return."""
    seed: int = 0
    """Seed of the episode."""
    seconds: float = 15.0
    """Simulated time to show; 0 for the whole episode."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, plays an episode and writes it."""
    chosen = tyro.cli(Render, args=arguments, prog="race render")
    if chosen.out.suffix.lower() not in (".mp4", ".gif"):
        raise RenderError(f"{chosen.out} is no video: the name must end with .mp4 or .gif.")
    if chosen.seed < 0 or not 0 <= chosen.seconds < float("inf"):
        raise ConfigError("--seed and --seconds must be 0 or more.")
    from rich.console import Console
    from rich.progress import Progress

    from race.rendering import Episode, choose_renderer, write_video

    console = Console(stderr=True)
    with console.status("looking for a renderer"):
        renderer = choose_renderer()
    console.print(f"Drawing with: {renderer.reason}", highlight=False, soft_wrap=True)
    from race.cli.compilation import use_cache
    from race.cli.progress import rounded
    from race.trained import load_trained

    use_cache()
    with console.status("loading the team"):
        trained = load_trained(chosen.run_dir)
        policy = trained.policy(chosen.team)
    episode = Episode(trained.task, policy, chosen.seed, chosen.seconds, renderer)
    with Progress(console=console, transient=True) as bar:
        drawing = bar.track(episode.frames(), total=episode.n_frames, description="drawing")
        count = write_video(iter(drawing), chosen.out, episode.fps)
    name = {"marl": "MARL team", "champion": "champion"}[trained.resolve(chosen.team)]
    print(
        f"{chosen.out}: {count} frames, {episode.steps} steps of the {name}, "
        f"return {rounded(episode.episode_return)}"
    )

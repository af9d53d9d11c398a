"""``race evaluate``."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from race.cli import streams
from race.cli.naming import CHECKPOINT
from race.config.settings import TeamName


@dataclass(frozen=True)
class Evaluate:
    """Play test episodes with a trained team, without exploration, and report its returns.

    The same seed plays the same episodes. Progress goes to standard error.
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The run's directory."""
    checkpoint: Annotated[str | None, CHECKPOINT] = None
    """One of the run's checkpoints, or of the best teams that it kept (`race show DIR` names them);
    best: the best tested of these."""
    team: TeamName = "selected"
    """The gradient learner's team, the population's team of best training fitness, or of these
    two the one with the better training return."""
    episodes: int = 10
    """Episodes to play."""
    seed: int = 0
    """Seed of the episodes."""
    json: bool = False
    """Print one JSON object instead of text."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, plays and prints."""
    chosen = tyro.cli(Evaluate, args=arguments, prog="race evaluate")
    from rich.progress import Progress

    from race.compilation import use_cache
    from race.runs import directory as run_directory
    from race.teams.evaluation import check_asked, evaluate
    from race.teams.trained import load_trained
    from race.viewing.progress import rounded

    check_asked(chosen.episodes, chosen.seed)
    use_cache(run_directory.open_run(chosen.run_dir).compute)
    trained = load_trained(chosen.run_dir, chosen.checkpoint)
    with Progress(console=streams.console(stderr=True), transient=True) as bar:
        playing = bar.add_task("playing", total=chosen.episodes)
        found = evaluate(
            trained,
            chosen.team,
            chosen.episodes,
            chosen.seed,
            lambda played: bar.advance(playing, played),
        )
    if chosen.json:
        json.dump(found.to_json(), sys.stdout, indent=2)
        print()
        return
    label = {"marl": "the MARL team", "champion": "the champion of the population"}[found.played]
    which = f"selected: {label}" if chosen.team == "selected" else label
    returns, lengths = found.score.returns, found.score.lengths
    print(
        f"{found.method} on {found.task}, {found.env_steps:,} environment steps, {which}\n"
        f"return over {chosen.episodes} episodes: {rounded(found.mean)} ± {rounded(found.std)} "
        f"(from {rounded(float(returns.min()))} to {rounded(float(returns.max()))}), "
        f"episode length {lengths.mean():.0f}"
        + ("" if found.win_rate is None else f", won {found.win_rate:.1%}")
    )

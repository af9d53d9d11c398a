"""``race evaluate``."""

import contextlib
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from race.cli import streams
from race.config.settings import TeamName
from race.errors import ConfigError

MOST_EPISODES = 1_000_000
BATCH = 32
"""Episodes played at the same time."""


@dataclass(frozen=True)
class Evaluate:
    """Play test episodes with a trained team, without exploration, and report its returns.

    The same seed plays the same episodes. Progress goes to standard error.
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The run's directory."""
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
    if not 1 <= chosen.episodes <= MOST_EPISODES:
        raise ConfigError(
            f"--episodes is {chosen.episodes}, but it must be at least 1 and at most "
            f"{MOST_EPISODES}."
        )
    if not 0 <= chosen.seed < 2**63:
        raise ConfigError(f"--seed is {chosen.seed}, but it must be from 0 to {2**63 - 1}.")
    import numpy as np
    from rich.progress import Progress

    from race.cli.progress import rounded
    from race.compilation import use_cache
    from race.rollouts import rollouts_of
    from race.rollouts.base import Score, Trial
    from race.runs import directory as run_directory
    from race.teams.trained import load_trained

    use_cache(run_directory.open_run(chosen.run_dir).compute)
    trained = load_trained(chosen.run_dir)
    name = trained.resolve(chosen.team)
    seeds = np.random.SeedSequence(chosen.seed).generate_state(chosen.episodes).astype(np.int64)
    batches = [seeds[i : i + BATCH] for i in range(0, len(seeds), BATCH)]
    parts: list[Score] = []
    with (
        contextlib.redirect_stdout(sys.stderr),  # what environments print is no result
        rollouts_of(trained.config, trained.task, proven=True) as rollouts,
        Progress(console=streams.console(stderr=True), transient=True) as bar,
    ):
        playing = bar.add_task("playing", total=len(seeds))
        for batch in batches:
            trial = Trial(trained.encoders[name], {name: trained.heads[name]}, batch)
            parts.append(rollouts.test([trial])[0][name])
            bar.advance(playing, len(batch))
    wins = [part.won for part in parts if part.won is not None]
    score = Score(
        np.concatenate([part.returns for part in parts]),
        np.concatenate([part.lengths for part in parts]),
        np.concatenate(wins) if wins else None,
    )
    result = {
        "task": trained.config.task,
        "method": trained.config.method,
        "env_steps": trained.progress.env_steps,
        "team": chosen.team,
        "played": name,
        "seed": chosen.seed,
        "episodes": chosen.episodes,
        **({} if score.win_rate is None else {"win_rate": score.win_rate}),
        "return_mean": score.mean,
        "return_std": score.std,
        "return_min": float(score.returns.min()),
        "return_max": float(score.returns.max()),
        "length_mean": float(score.lengths.mean()),
        "returns": score.returns.tolist(),
    }
    if chosen.json:
        json.dump(result, sys.stdout, indent=2)
        print()
        return
    label = {"marl": "the MARL team", "champion": "the champion of the population"}[name]
    which = f"selected: {label}" if chosen.team == "selected" else label
    print(
        f"{result['method']} on {result['task']}, {result['env_steps']:,} environment steps, "
        f"{which}\n"
        f"return over {chosen.episodes} episodes: {rounded(score.mean)} ± "
        f"{rounded(score.std)} (from {rounded(score.returns.min())} to "
        f"{rounded(score.returns.max())}), "
        f"episode length {result['length_mean']:.0f}"
        + ("" if score.win_rate is None else f", won {score.win_rate:.1%}")
    )

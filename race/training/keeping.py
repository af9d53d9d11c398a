"""The best tested teams of a run, kept as small files beside its checkpoints.

A file is one team: its encoders and heads. Teams are ranked by their test results, wins first where
there are any to be had. The best of many noisy results is biased upwards: test anew, with other
seeds, what is to be told of a team.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from race import ALGORITHM_VERSION
from race.algorithms.base import Tested
from race.errors import CheckpointError
from race.method.normalisation import Observed
from race.rollouts.base import Score
from race.runs import team_files
from race.runs.directory import RunDirectory
from race.runs.trees import flatten
from race.training.run import Run
from race.training.run_state import Progress


class Kept(NamedTuple):
    """A team that was kept."""

    path: Path
    rank: tuple[float, float]  # share of wins, mean return
    env_steps: int

    @property
    def name(self) -> str:
        """What it is called: ``step-000000012000-champion``."""
        return self.path.name.removesuffix(team_files.SUFFIX)


def kept_teams(run_dir: Path) -> list[Kept]:
    """The kept teams of a run, best first; damaged files are not among them."""
    found = []
    for path in RunDirectory(run_dir).best.glob(f"step-*{team_files.SUFFIX}"):
        try:
            told = team_files.info_of(path)
            rank = (float(told["win_rate"] or 0.0), float(told["return_mean"]))
            found.append(Kept(path, rank, int(told["progress"]["env_steps"])))
        except (CheckpointError, KeyError, TypeError, ValueError):
            continue
    # Of equals the older.
    return sorted(found, key=lambda kept: (*(-r for r in kept.rank), kept.env_steps, kept.name))


def keep_best(
    run: Run,
    tested: Sequence[Tested],
    scores: Mapping[str, Score],
    progress: Progress,
    observed: Observed | None = None,
) -> None:
    """Keeps those of some teams that are among the best, and forgets those that no longer are.

    A run that goes on from an older checkpoint tests the same teams again and finds their files
    there.

    Args:
        run: the run; its ``checkpoint.keep_best`` says how many.
        tested: the teams.
        scores: their results, by name.
        progress: how far the run is.
        observed: what its teams have seen, where observations are normalised.

    Raises:
        CheckpointError: if a file cannot be written.
    """
    count, folder = run.config.checkpoint.keep_best, run.directory.best
    if not count:
        return
    for encoder, heads in tested:
        for name, head in heads.items():
            score = scores[name]
            if not math.isfinite(score.mean):
                continue
            path = folder / f"step-{progress.env_steps:012d}-{name}{team_files.SUFFIX}"
            rank = (score.win_rate or 0.0, score.mean)
            others = [kept for kept in kept_teams(run.directory.path) if kept.path != path]
            if len(others) >= count and others[count - 1].rank >= rank:
                continue
            info: dict[str, Any] = {
                "run": run.identity,
                "team": name,
                "progress": dataclasses.asdict(progress),
                "algorithm_version": ALGORITHM_VERSION,
                "episodes": len(score.returns),
                "return_mean": score.mean,
                "return_std": score.std,
                "win_rate": score.win_rate,
            }
            held: dict[str, Any] = {"encoder": encoder, "head": head}
            if observed is not None:
                held["observed"] = observed
            team_files.write(path, flatten(held), info)
    for kept in kept_teams(run.directory.path)[count:]:
        kept.path.unlink(missing_ok=True)

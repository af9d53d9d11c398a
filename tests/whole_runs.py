"""Whole runs in a directory, and what they wrote."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from race.config.settings import Config
from race.rollouts.base import Play
from race.rollouts.discrete import EpisodeRollouts
from race.rollouts.transitions import TransitionRollouts
from race.runs import directory as run_directory
from race.runs import metrics
from race.training.run import Report, silent
from race.training.run_state import Progress
from race.training.trainer import train

TIMES = ("wall_seconds", "time/env_steps_per_second", "time/rollout_fraction")
PASSING = (*TIMES, "run")
"""What tells equal runs apart: times, and which of them it is."""


class KilledError(Exception):
    """Stands for the end of a process at a certain moment."""


def rows(path: Path, kind: str = "") -> list[dict[str, Any]]:
    """The rows of a run, or those of a kind, without wall-clock times and its identity."""
    found = metrics.read(path / "metrics.jsonl")
    timeless = [{k: v for k, v in row.items() if k not in PASSING} for row in found]
    return [row for row in timeless if kind in ("", row["kind"])]


def run(path: Path, config: Config, report: Report = silent) -> Progress:
    if not (path / "config.json").exists():
        run_directory.create(path, config)
    return train(path, config, report=report)


def watch_rollouts(
    monkeypatch: pytest.MonkeyPatch, note: Callable[[Play, np.ndarray, Any], None]
) -> None:
    """Tells of all that runs play: what was asked for, the teams' heads, what it came to."""
    for kind in (TransitionRollouts, EpisodeRollouts):
        usual = kind.play

        def play(self: Any, plays: Sequence[Play], usual: Any = usual) -> list[Any]:
            # Taken now: programs that learn write over them.
            heads = [np.array(play.teams.heads) for play in plays]
            results: list[Any] = usual(self, plays)
            for one, head, (_, made) in zip(plays, heads, results, strict=True):
                note(one, head, made)
            return results

        monkeypatch.setattr(kind, "play", play)

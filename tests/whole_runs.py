"""Whole runs in a directory, and what they wrote."""

from pathlib import Path
from typing import Any

from race.config.settings import Config
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

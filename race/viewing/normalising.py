"""Scores of different tasks on one scale."""

import json
import math
import tomllib
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from race.errors import RaceError
from race.viewing.grouping import name_of
from race.viewing.scores import Scores

Normalise = Literal["range", "base", "none"]


class Scale(NamedTuple):
    """What becomes 0 and what becomes 1 on a task."""

    low: float
    high: float

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Scores on the scale; they may lie outside [0, 1]."""
        return (np.asarray(values, np.float64) - self.low) / (self.high - self.low)


def scales(
    scores: Scores, how: Normalise, bases: dict[str, str], references: Path | None
) -> tuple[dict[str, Scale], str, dict[str, str]]:
    """A scale for each task.

    Args:
        scores: of all runs.
        how: ``range``: from the worst to the best final score of any run on the task, shares such
            as win rates as they are; ``base``: from 0 to the base's mean; ``none``: as they are.
        bases: the method that ``base`` means on each task.
        references: a file that says low and high of each task, instead.

    Returns:
        The scales; how they were chosen, as a sentence; tasks that have none, and why.

    Raises:
        RaceError: if the file cannot be read or says nothing of use; if there is no base.
    """
    if references is not None:
        given = _read(references)
        missing = {
            task: f"{references} says nothing of it" for task in scores.tasks() if task not in given
        }
        said = f"0 and 1 are the low and high scores of each task in {references.name}"
        return {task: given[task] for task in scores.tasks() if task in given}, said, missing
    found, without = {}, {}
    if how == "base" and not bases:
        left_out = f" Mind: {scores.differences[0]}" if scores.differences else ""
        raise RaceError(
            f"There is one method alone with scores, {scores.methods()[0]}, so nothing to be a "
            f"base: --normalise range.{left_out}"
        )
    for task in scores.tasks():
        runs = [run for run in scores.runs if run.task == task]
        finals = np.array([run.final for run in runs])
        if how == "none" or (how == "range" and all(run.metric == "win_rate" for run in runs)):
            found[task] = Scale(0.0, 1.0)
        elif how == "base":
            base = bases.get(task)
            mean = float(np.mean([run.final for run in runs if run.method == base] or [0.0]))
            if mean > 0:
                found[task] = Scale(0.0, mean)
            elif base is None:
                without[task] = "its base was not tried on it"
            else:
                without[task] = f"the mean of {base} is not above zero"
        elif finals.max() > finals.min():
            found[task] = Scale(float(finals.min()), float(finals.max()))
        else:
            without[task] = "all runs have the same score"
    said = {
        "range": "0 and 1 are the worst and the best final score of any run on the task, taken as "
        "exact (win rates as they are)",
        "base": f"0 is a score of 0, 1 the mean final score of {name_of(bases.values())} on the "
        "task, taken as exact",
        "none": "scores are not normalised",
    }[how]
    return found, said, without


def _read(path: Path) -> dict[str, Scale]:
    try:
        text = path.read_text(encoding="utf-8")
        given = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
        found = {
            task: Scale(float(ends["low"]), float(ends["high"])) for task, ends in given.items()
        }
        for task, (low, high) in found.items():
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ValueError(f"of {task}, low is not below high")
    except OSError as error:
        raise RaceError(f"The file of reference scores {path} cannot be read: {error}.") from error
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise RaceError(
            f"{path} is no file of reference scores ({error!r}). Write, in TOML or JSON, low and "
            'high for each task: "mamujoco/Hopper-3x1" = { low = 0, high = 3000 }'
        ) from error
    return found

"""Learning curves: which quantity of which runs, and what several seeds become."""

import difflib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from race.config.ablations import told_by_name
from race.config.settings import Config
from race.errors import RaceError
from race.runs.recorded import Recorded, settings
from race.statistics.intervals import mean_interval

TEAMS = ("selected", "marl", "champion")
LABELS = {
    "selected": "selected team",
    "marl": "MARL team",
    "champion": "champion",
    "best": "best of two tests",
}
LARGEST = 1e30
"""Of what can be drawn: environments pay no more than 1e15 a step."""
Axis = Literal["env_steps", "wall_time"]
# Key of the rows, and how many of its units are one on the axis.
_AXES: dict[Axis, tuple[str, float]] = {
    "env_steps": ("env_steps", 1.0),
    "wall_time": ("wall_seconds", 60.0),
}


@dataclass(frozen=True, eq=False)
class Curve:
    """One quantity of one run over environment steps, or over minutes."""

    x: NDArray[np.float64]
    values: NDArray[np.float64]
    env_steps: float
    """How far the run came."""
    seed: int = 1
    name: str = ""
    """Of the run."""


class Band(NamedTuple):
    """The mean over seeds and its 95% interval (Student's t), on a common grid."""

    x: NDArray[np.float64]
    mean: NDArray[np.float64]
    low: NDArray[np.float64]  # NaN with one seed
    high: NDArray[np.float64]
    seeds: NDArray[np.int64]
    """How many there are at each point: all, but where runs had ended early."""


def aggregate(curves: Sequence[Curve], bounds: tuple[float, float] = (-math.inf, math.inf)) -> Band:
    """The mean of several runs with a 95% interval of the mean.

    Runs are evaluated at different steps; each is interpolated linearly onto all steps at which
    any of them was evaluated. The grid is what all runs that came to the end have in common; those
    that ended early (`ended_early`) count as far as they came.
    """
    early = ended_early(curves)
    whole = [curve for curve in curves if curve not in early]
    first = max(float(curve.x[0]) for curve in whole)
    last = min(float(curve.x[-1]) for curve in whole)
    grid = np.unique(np.concatenate([curve.x for curve in curves]))
    if first <= last:  # else each is drawn where it is
        grid = grid[(grid >= first) & (grid <= last)]
    values = np.stack(
        [np.interp(grid, c.x, c.values, left=math.nan, right=math.nan) for c in curves]
    )
    reached = ~np.isnan(values)
    mean, low, high = (np.full(grid.shape, math.nan) for _ in range(3))
    # Few patterns of who reaches a point: runs end, but do not begin again.
    for pattern in np.unique(reached, axis=1).T:
        at = (reached == pattern[:, None]).all(axis=0)
        if pattern.any():
            mean[at], low[at], high[at] = mean_interval(values[np.ix_(pattern, at)], bounds)
    return Band(grid, mean, low, high, reached.sum(axis=0))


def ended_early(curves: Sequence[Curve]) -> list[Curve]:
    """The runs that made well fewer environment steps than the longest of them."""
    longest = max(curve.env_steps for curve in curves)
    return [curve for curve in curves if curve.env_steps < 0.95 * longest]


def keys(metric: str, team: str, config: Config) -> dict[str, str]:
    """Keys of the rows to draw, by the label that tells a method's curves apart."""
    if "/" in metric or metric in ("wall_seconds", "gradient_steps"):
        return {"": metric}
    if not (config.has_population and config.has_marl):  # there is one team, whatever the choice
        return {"": f"eval/{'marl' if config.has_marl else 'champion'}/{metric}"}
    if team == "all":
        return {LABELS[name]: f"eval/{name}/{metric}" for name in TEAMS}
    return {"" if team == "selected" else LABELS[team]: f"eval/{team}/{metric}"}


def names_of(runs: Sequence[Recorded]) -> list[str]:
    """Each run's method and ablations, with the settings in which runs of one method differ.

    What an ablation sets is told by its name.
    """

    def all_of(run: Recorded) -> dict[str, Any]:
        return {**settings(run.config), "algorithm version": run.algorithm_version}

    of_method: dict[tuple[str, str], list[tuple[dict[str, Any], set[str]]]] = {}
    for run in runs:
        of_method.setdefault((run.config.task, run.config.method), []).append(
            (all_of(run), told_by_name(run.config))
        )
    differing = {
        key: [
            name
            for name in rivals[0][0]
            if len({json.dumps(values[name]) for values, set_by in rivals if name not in set_by})
            > 1
        ]
        for key, rivals in of_method.items()
    }
    names = []
    for run in runs:
        mine, told = all_of(run), told_by_name(run.config)
        of_settings = differing[run.config.task, run.config.method]
        parts = [f"{key}={mine[key]}" for key in of_settings if key not in told]
        parts = [*run.config.ablation, *parts]
        names.append(" ".join([run.config.method, ", ".join(parts)]).strip())
    return names


def refuse_twins(runs: Sequence[Recorded]) -> None:
    """Refuses to count one seed twice, be it in a directory and again in an archive.

    Raises:
        RaceError: naming two runs of one experiment and one seed.
    """
    seen: dict[tuple[int, str], str] = {}
    for run in runs:
        key = run.config.seed, run.experiment
        if key in seen:
            raise RaceError(
                f"{seen[key]} and {run.name} are the same experiment with the same seed "
                f"{run.config.seed}; counted as two seeds they would make the interval too narrow. "
                "Name one of them."
            )
        seen[key] = run.name


def curve_of(run: Recorded, key: str, axis: Axis) -> Curve | None:
    """The values of a key, or None where the run has none."""
    over, unit = _AXES[axis]
    points = [
        (float(row[over]) / unit, float(row[key]))
        for row in run.rows
        if _is_number(row.get(key)) and _is_number(row.get(over))
    ]
    if not points:
        return None
    x, values = np.array(points).T
    if np.abs(values).max() > LARGEST:
        raise RaceError(
            f"A value of {key} in {run.name} is {values[np.abs(values).argmax()]:g}, which no run "
            "gives: the rows were damaged or edited. Leave the run out, or put them right."
        )
    made = max(float(steps) for row in run.rows if _is_number(steps := row.get("env_steps", 0)))
    return Curve(x, values, made, run.config.seed, run.name)


def no_values(runs: Sequence[Recorded], metric: str) -> RaceError:
    """What to say where no run has a value of the metric."""
    known = {k for run in runs for row in run.rows for k, v in row.items() if _is_number(v)}
    which = runs[0].name if len(runs) == 1 else f"any of {len(runs)} runs"
    if not known:
        return RaceError(
            f"There are no rows of metrics in {which} yet: wait until the first generation is over."
        )
    wanted = metric in ("return_mean", "return_std", "length_mean", "win_rate")
    if wanted and not any(key.startswith("eval/") for key in known):
        return RaceError(
            f"There has not been an evaluation in {which} yet. Wait for the first, or draw a "
            "training quantity such as --metric marl/return."
        )
    short = {key.removeprefix("eval/selected/") for key in known}
    near = difflib.get_close_matches(metric, sorted(known | short), n=3, cutoff=0.3)
    return RaceError(
        f"There are no values of {metric!r} in {which}. "
        + (f"Nearest: {', '.join(near)}. " if near else "")
        + f"All: {', '.join(sorted(known))}."
    )


def _is_number(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return isinstance(value, int) and not isinstance(value, bool)

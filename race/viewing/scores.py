"""One final and one mean score per run: what tables compare, and what stands in the way of it."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from race.errors import RaceError
from race.runs.recorded import Recorded
from race.viewing import curves as chosen
from race.viewing.curves import Curve, ended_early

# Versions that may change what a task pays.
_ENVIRONMENT = ("gymnasium", "gymnasium-robotics", "mujoco", "jax", "numpy")


class Scored(NamedTuple):
    """A run with its scores. Steps are environment steps of all teams."""

    task: str
    method: str
    seed: int
    name: str
    """Where the run lies."""
    metric: str
    final: float
    """At the horizon of its task, interpolated between tests as in figures."""
    area: float
    """Mean over steps up to the horizon: the area under the curve by its length (trapezoids)."""
    curve: Curve
    seconds: Curve
    """The same tests over wall seconds."""
    gradient_only: bool
    """Whether the method has no population: a base."""
    learner: str | None
    """The gradient learner that it is or is built on; None if it has none."""


class Scores(NamedTuple):
    """The runs of all tasks, and in what they are unlike."""

    runs: list[Scored]
    horizons: dict[str, float]
    """By task: the steps at which final scores are taken, as far as every method came."""
    differences: list[str]
    """What makes a comparison unfair, each a sentence."""

    def tasks(self) -> list[str]:
        """All tasks, sorted."""
        return sorted({run.task for run in self.runs})

    def methods(self, task: str | None = None) -> list[str]:
        """All methods, or those of a task, sorted."""
        return sorted({run.method for run in self.runs if task in (None, run.task)})

    def of(self, task: str, method: str) -> list[Scored]:
        """The runs of a method on a task, by seed."""
        found = [run for run in self.runs if (run.task, run.method) == (task, method)]
        return sorted(found, key=lambda run: (run.seed, run.name))


def scores_of(runs: Sequence[Recorded], metric: str = "auto", team: str = "selected") -> Scores:
    """Scores of runs, each task at the steps that all of its methods reached.

    A run that ended well before the others of its method has no final score: it is left out, and
    named among the differences.

    Args:
        runs: of any tasks and methods.
        metric: ``return_mean``, ``win_rate``, ... or ``auto``: wins where there are any to be
            had, else returns.
        team: whose tests.

    Raises:
        RaceError: if no run has a value, or two are the same.
    """
    chosen.refuse_twins(runs)
    names = chosen.names_of(runs)
    differences: list[str] = []
    found: dict[tuple[str, str], list[tuple[Recorded, str, Curve, Curve]]] = {}
    for whole_run, name in zip(runs, names, strict=True):
        run = whole_run._replace(rows=tests_and_end(whole_run.rows))
        key, wanted = _key(run, metric, team)
        curve = chosen.curve_of(run, key, "env_steps")
        minutes = chosen.curve_of(run, key, "wall_time")
        if curve is None or minutes is None:
            differences.append(f"{run.name} has no {wanted} yet and is left out.")
            continue
        seconds = Curve(60 * minutes.x, minutes.values, minutes.env_steps, minutes.seed, run.name)
        found.setdefault((run.config.task, name), []).append((run, wanted, curve, seconds))
    if not found:
        raise chosen.no_values(runs, "return_mean" if metric == "auto" else metric)
    scored, horizons = [], {}
    for task in sorted({task for task, _ in found}):
        of_task = {name: group for (at, name), group in found.items() if at == task}
        whole = {name: _whole(group, differences) for name, group in of_task.items()}
        horizon = min(float(curve.x[-1]) for group in whole.values() for *_, curve, _ in group)
        horizons[task] = horizon
        differences += _unlike(task, whole)
        for name, group in whole.items():
            for run, wanted, curve, seconds in group:
                final = float(np.interp(horizon, curve.x, curve.values))
                scored.append(
                    Scored(
                        *(task, name, run.config.seed, run.name, wanted, final),
                        *(_mean_until(curve, horizon), curve, seconds),
                        not run.config.has_population,
                        run.config.base if run.config.has_marl else None,
                    )
                )
    return Scores(scored, horizons, differences)


def tests_and_end(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What curves of tests need: the tests, and how far the run came."""
    return [row for row in rows[:-1] if row.get("kind") == "evaluation"] + rows[-1:]


def _key(run: Recorded, metric: str, team: str) -> tuple[str, str]:
    if metric == "auto":
        won = any("win_rate" in key for row in run.rows for key in row if key.startswith("eval/"))
        metric = "win_rate" if won else "return_mean"
    (key,) = chosen.keys(metric, team, run.config).values()
    if not key.startswith("eval/"):
        raise RaceError(
            f"Methods are compared by their tests, and {metric!r} is none. Give --metric "
            "return_mean, win_rate or length_mean; `race plot` draws everything else."
        )
    return key, metric


def _mean_until(curve: Curve, horizon: float) -> float:
    x = np.append(curve.x[curve.x < horizon], horizon)
    values = np.interp(x, curve.x, curve.values)
    length = float(x[-1] - x[0])
    return float(np.trapezoid(values, x)) / length if length > 0 else float(values[-1])


Group = list[tuple[Recorded, str, Curve, Curve]]


def _whole(group: Group, differences: list[str]) -> Group:
    """The runs of a method that came to its end."""
    early = ended_early([curve for _, _, curve, _ in group])
    for run, _, curve, _ in group:
        if curve in early:
            differences.append(
                f"{run.name} (seed {run.config.seed}) ended at {curve.env_steps:,.0f} steps, well "
                "before the others, and is left out: if it failed, its method looks too good."
            )
    return [entry for entry in group if entry[2] not in early]


def _unlike(task: str, methods: dict[str, Group]) -> list[str]:
    """In what the runs of a task differ that should not."""
    said = []
    seeds = {name: tuple(sorted(run.config.seed for run, *_ in g)) for name, g in methods.items()}
    if len(set(seeds.values())) > 1:
        listed = "; ".join(f"{name} {_numbers(s)}" for name, s in sorted(seeds.items()))
        said.append(f"{task}: methods have unequal seeds ({listed}).")
    steps = {n: max(curve.env_steps for *_, curve, _ in g) for n, g in methods.items()}
    if min(steps.values()) < 0.95 * max(steps.values()):
        listed = "; ".join(f"{name} {made:,.0f}" for name, made in sorted(steps.items()))
        said.append(
            f"{task}: methods made unequal numbers of steps ({listed}); all are compared where "
            "the shortest ends."
        )
    runs = [run for group in methods.values() for run, *_ in group]
    metrics = {wanted for group in methods.values() for _, wanted, *_ in group}
    if len(metrics) > 1:
        said.append(f"{task}: runs are measured in unlike quantities ({', '.join(metrics)}).")
    said += _values(task, "algorithm versions", (run.algorithm_version for run in runs))
    for library in _ENVIRONMENT:
        told = (_versions(run).get(library) for run in runs)
        said += _values(task, f"versions of {library}", told)
    for what in ("env", "evaluation"):
        said += _values(task, f"settings of {what}", (_group(run, what) for run in runs))
    described = (_described(run) for run in runs)
    said += _values(task, "environments", described)
    return said


def _values(task: str, what: str, values: Iterable[Any]) -> list[str]:
    """A sentence if the values that are known are not all the same."""
    known = sorted({str(value) for value in values if value is not None})
    if len(known) < 2:
        return []
    listed = "; ".join(text if len(text) < 200 else f"{text[:200]} ..." for text in known)
    return [f"{task}: runs have unlike {what} ({listed})."]


def _versions(run: Recorded) -> dict[str, Any]:
    told = run.metadata.get("versions")
    return told if isinstance(told, dict) else {}


def _group(run: Recorded, name: str) -> str:
    group = chosen.settings(run.config)
    return ", ".join(f"{k}={v}" for k, v in group.items() if k.startswith(f"{name}."))


def _described(run: Recorded) -> str | None:
    """Ids of environments and sizes, where they were recorded; archives leave them out."""
    told = run.metadata.get("environment")
    if not isinstance(told, dict):
        return None
    return ", ".join(f"{k}={told[k]}" for k in sorted(told) if isinstance(told[k], str | int))


def _numbers(seeds: Sequence[int]) -> str:
    """Seeds for people: ranges where they are in a row."""
    seeds = sorted(set(seeds))
    if len(seeds) > 2 and seeds[-1] - seeds[0] == len(seeds) - 1:
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds)) if seeds else "none"


def reached(curve: Curve, score: float) -> float:
    """Where a curve is first at a score, at one of its tests; infinity if it never is."""
    at = np.flatnonzero(curve.values >= score)
    return float(curve.x[at[0]]) if at.size else math.inf

"""Methods compared over seeds and tasks, as numbers: what tables, files and pages show."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from race.statistics.intervals import Estimate, bounds_of, mean_estimate
from race.statistics.separation import difference, seeds_needed, surely_apart
from race.statistics.stratified import (
    UNBOUNDED,
    bootstrap_interval,
    interquartile_mean,
    optimality_gap,
    probability_of_improvement,
    relative_gain,
    share_above,
)
from race.viewing.grouping import bases_of, families_of, name_of, pooled
from race.viewing.normalising import Normalise, Scale, scales
from race.viewing.scores import Scored, Scores, reached

POINTS_OF_A_PROFILE = 101


class TimeTo(NamedTuple):
    """How soon the runs of a method are at a score; those that never are count as infinity."""

    score: float
    reached: int
    seconds: tuple[float, float, float]
    """Median, fastest and slowest run, in wall seconds."""
    env_steps: tuple[float, float, float]


class OnTask(NamedTuple):
    """A method on a task."""

    task: str
    method: str
    seeds: tuple[int, ...]
    metric: str
    horizon: float
    final: Estimate
    area: Estimate
    time_to: TimeTo


class Pair(NamedTuple):
    """A method and the base on a task, by final scores."""

    task: str
    method: str
    base: str
    difference: Estimate
    told_apart: bool | None
    """None with too few seeds to tell."""
    seeds_needed: int | None
    """Of each, where they are not told apart; None: unknown, or more than a thousand."""


class Overall(NamedTuple):
    """A method over tasks that have the same methods, by normalised final scores."""

    tasks: tuple[str, ...]
    method: str
    runs: int
    iqm: Estimate
    gap: Estimate
    profile: list[Estimate]
    """Shares of runs above `Comparison.thresholds`."""


class Against(NamedTuple):
    """A method and the base over the tasks that both were tried on."""

    method: str
    """Or an algorithm, over one learner on some tasks and over another on others."""
    base: str
    improvement: Estimate
    tasks: tuple[str, ...]
    gain: Estimate | None
    """None where the base is nowhere clearly above zero."""
    gain_tasks: tuple[str, ...]


@dataclass(frozen=True)
class Comparison:
    """All numbers of `compare`."""

    team: str
    base: str | None
    """`race.viewing.grouping.OF_EACH_TASK` where tasks have different ones."""
    bases: dict[str, str]
    """By task."""
    normalised: str
    """How, as a sentence."""
    tasks: tuple[str, ...]
    """All of them."""
    common: tuple[str, ...]
    """Those that were tried with every method, and have a scale."""
    families: tuple[tuple[str, ...], ...]
    """Those over which methods are compared: tried with the same methods, and with a scale."""
    on_tasks: list[OnTask]
    pairs: list[Pair]
    overall: list[Overall]
    against: list[Against]
    thresholds: NDArray[np.float64]
    differences: list[str]
    notes: list[str]
    """What a reader should know besides, each a sentence."""


def compare(
    scores: Scores,
    team: str = "selected",
    base: str | None = None,
    normalise: Normalise = "range",
    references: Path | None = None,
    score: float | None = None,
) -> Comparison:
    """Compares methods.

    Args:
        scores: of all runs.
        team: whose tests they are; only said.
        base: the method that others are measured against. None: on each task the gradient learner
            that its methods are built on (`race.viewing.grouping.bases_of`).
        normalise: how scores of several tasks come to one scale (`race.viewing.normalising`).
        references: a file that says it instead.
        score: what `OnTask.time_to` is about. None: the base's mean final score on the task, or
            the lowest mean of all methods where the base was not tried.

    Raises:
        RaceError: if the base is none of the methods, or the scale cannot be had.
    """
    bases = bases_of(scores, base)
    scale, said, unscaled = scales(scores, normalise, bases, references)
    methods = scores.methods()
    families = families_of(scores, [task for task in scores.tasks() if task in scale])
    notes = [f"{task} has no normalised score: {why}." for task, why in unscaled.items()]
    notes += _lacking(scores)
    on_tasks = [
        _on_task(scores, task, method, _goal(scores, task, bases.get(task), score))
        for task in scores.tasks()
        for method in scores.methods(task)
    ]
    singles = [f"{row.method} on {row.task}" for row in on_tasks if len(row.seeds) == 1]
    if singles:
        notes.append(f"One seed has no interval: {', '.join(singles)}.")
    thresholds = _thresholds(scores, scale, [task for family in families for task in family])
    return Comparison(
        team=team,
        base=name_of(bases.values()) if bases else None,
        bases=bases,
        normalised=said,
        tasks=tuple(scores.tasks()),
        common=tuple(t for t in scores.tasks() if scores.methods(t) == methods and t in scale),
        families=families,
        on_tasks=on_tasks,
        pairs=[
            _pair(scores, task, method, base)
            for task, base in bases.items()
            for method in scores.methods(task)
            if method != base
        ],
        overall=[
            _overall(scores, method, scale, family, thresholds)
            for family in families
            for method in scores.methods(family[0])
        ],
        against=_all_against(scores, bases),
        thresholds=thresholds,
        differences=scores.differences,
        notes=notes,
    )


def _lacking(scores: Scores) -> list[str]:
    """What to say where not all methods were tried on all tasks."""
    alone = [task for task in scores.tasks() if len(scores.methods(task)) == 1]
    if all(scores.methods(task) == scores.methods() for task in scores.tasks()):
        return []
    said = ["Not all methods were tried on all tasks: each is compared over tasks with the same."]
    if alone:
        said.append(f"One method alone was tried on {', '.join(alone)}: left out over tasks.")
    return said


def _finals(runs: list[Scored]) -> NDArray[np.float64]:
    return np.array([run.final for run in runs], np.float64)


def _goal(scores: Scores, task: str, base: str | None, asked: float | None) -> float:
    if asked is not None:
        return asked
    means = {m: float(_finals(scores.of(task, m)).mean()) for m in scores.methods(task)}
    return means.get(base or "", min(means.values()))


def _on_task(scores: Scores, task: str, method: str, goal: float) -> OnTask:
    runs = scores.of(task, method)
    bounds = bounds_of(runs[0].metric)
    at = [reached(run.curve, goal) for run in runs]
    return OnTask(
        task,
        method,
        tuple(run.seed for run in runs),
        runs[0].metric,
        scores.horizons[task],
        mean_estimate(_finals(runs), bounds),
        mean_estimate([run.area for run in runs], bounds),
        TimeTo(
            goal,
            sum(map(math.isfinite, at)),
            _middle_and_ends([reached(run.seconds, goal) for run in runs]),
            _middle_and_ends(at),
        ),
    )


def _middle_and_ends(values: list[float]) -> tuple[float, float, float]:
    ordered = sorted(values)
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    middle = low if low == high else (low + high) / 2  # infinity where half never came there
    return middle, ordered[0], ordered[-1]


def _pair(scores: Scores, task: str, method: str, base: str) -> Pair:
    mine, its = _finals(scores.of(task, method)), _finals(scores.of(task, base))
    found = difference(mine, its)
    apart = None if math.isnan(found.low) else not found.low <= 0.0 <= found.high
    if found.low == found.high != 0.0 and not surely_apart(len(mine), len(its)):
        apart = None  # such as win rates that are all alike: Welch's test knows no spread
    return Pair(
        task, method, base, found, apart, seeds_needed(mine, its) if apart is False else None
    )


def _overall(
    scores: Scores,
    method: str,
    scale: dict[str, Scale],
    tasks: tuple[str, ...],
    thresholds: NDArray[np.float64],
) -> Overall:
    strata = [scale[task](_finals(scores.of(task, method))) for task in tasks]
    shares = all(run.metric == "win_rate" for t in tasks for run in scores.of(t, method))
    bounds = (0.0, 1.0) if shares and set(map(scale.get, tasks)) == {Scale(0.0, 1.0)} else UNBOUNDED
    return Overall(
        tasks,
        method,
        sum(map(len, strata)),
        bootstrap_interval(strata, interquartile_mean, bounds),
        bootstrap_interval(strata, optimality_gap, (0.0, bounds[1])),
        share_above(strata, thresholds),
    )


def _all_against(scores: Scores, bases: dict[str, str]) -> list[Against]:
    """Every method against the base, and algorithms whose methods share out the tasks."""
    tried = {
        method: [t for t, base in bases.items() if base != method and method in scores.methods(t)]
        for method in scores.methods()
    }
    members = {method: dict.fromkeys(tasks, method) for method, tasks in tried.items() if tasks}
    members |= pooled({method: tasks for method, tasks in tried.items() if tasks})
    return [_against(scores, name, methods, bases) for name, methods in members.items()]


def _against(scores: Scores, name: str, methods: dict[str, str], bases: dict[str, str]) -> Against:
    """A row about the tasks of ``methods``, which says the method of each."""
    tasks = tuple(sorted(methods))
    mine = {task: _finals(scores.of(task, methods[task])) for task in tasks}
    its = {task: _finals(scores.of(task, bases[task])) for task in tasks}
    improvement = probability_of_improvement(list(mine.values()), list(its.values()))
    positive = tuple(task for task in tasks if _clearly_positive(its[task]))
    strata = [finals[task] for finals in (mine, its) for task in positive]
    gain = bootstrap_interval(strata, relative_gain) if positive else None
    base = name_of(bases[task] for task in tasks)
    return Against(name, base, improvement, tasks, gain, positive)


def _clearly_positive(values: NDArray[np.float64]) -> bool:
    """Whether one may divide by their mean: every run is above zero, as resampled means are."""
    return bool(values.min() > 0)


def _thresholds(scores: Scores, scale: dict[str, Scale], tasks: list[str]) -> NDArray[np.float64]:
    if not tasks:
        return np.zeros(0)
    ends = [scale[run.task](np.array([run.final])) for run in scores.runs if run.task in tasks]
    return np.linspace(min(0.0, float(np.min(ends))), float(np.max(ends)), POINTS_OF_A_PROFILE)


__all__ = ["Against", "Comparison", "OnTask", "Overall", "Pair", "TimeTo", "compare"]

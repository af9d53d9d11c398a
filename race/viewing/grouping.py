"""Which method others are measured against on a task, and which tasks are taken together."""

import re
from collections.abc import Iterable, Mapping

from race.errors import RaceError
from race.viewing.scores import Scores

OF_EACH_TASK = "the base"
"""What the base is called where tasks have different ones."""


def bases_of(scores: Scores, asked: str | None) -> dict[str, str]:
    """The base of each task that has one; none at all if there is one method alone.

    Of the gradient learners without a population that were tried on the task it is the one that
    most methods there are built on, such as MATD3 beside RACE(MATD3); then the one that most tasks
    were tried with. Without any, it is the gradient learner of other tasks, or the first method.

    Args:
        scores: of all runs.
        asked: the base of all tasks, instead.

    Raises:
        RaceError: if it is none of the methods.
    """
    methods = scores.methods()
    if asked is not None and asked not in methods:
        raise RaceError(
            f"There is no method {asked!r} to be the base. There are: {'; '.join(methods)}."
        )
    if len(methods) < 2:
        return {}
    plain = sorted({run.method for run in scores.runs if run.gradient_only})
    tried = {name: sum(name in scores.methods(task) for task in scores.tasks()) for name in methods}
    plain.sort(key=lambda name: (-tried[name], len(name)))
    fallback = (plain or methods)[0]
    found = {}
    for task in scores.tasks():
        there = scores.methods(task)
        rivals = [name for name in plain if name in there]
        built = {name: _built_on(scores, task, name) for name in rivals}
        rivals.sort(key=lambda name: -built[name])
        base = asked or (rivals or [fallback])[0]
        if base in there:
            found[task] = base
    return found


def _built_on(scores: Scores, task: str, base: str) -> int:
    learners = {run.learner for run in scores.of(task, base)}
    runs = (run for run in scores.runs if run.task == task and not run.gradient_only)
    return len({run.method for run in runs if run.learner in learners})


def name_of(bases: Iterable[str]) -> str:
    """What they are called together."""
    names = set(bases)
    return names.pop() if len(names) == 1 else OF_EACH_TASK


def families_of(scores: Scores, tasks: Iterable[str]) -> tuple[tuple[str, ...], ...]:
    """Tasks that were tried with the same methods, those with most tasks first.

    Tasks with one method alone are left out, unless all are so: there is nothing to compare.
    """
    found: dict[tuple[str, ...], list[str]] = {}
    for task in tasks:
        found.setdefault(tuple(scores.methods(task)), []).append(task)
    if len(found) > 1:
        found = {methods: group for methods, group in found.items() if len(methods) > 1}
    return tuple(sorted(map(tuple, found.values()), key=lambda group: (-len(group), group)))


def pooled(tasks: Mapping[str, Iterable[str]]) -> dict[str, dict[str, str]]:
    """Algorithms that ran over one learner on some tasks and over another on others.

    Such as RACE, in the paper over MATD3 on robots and over FACMAC on battles.

    Args:
        tasks: by method.

    Returns:
        By algorithm the method of each task; only where no task has two.
    """
    members: dict[str, list[str]] = {}
    for method in tasks:
        members.setdefault(re.sub(r"\(\w+\)", "", method, count=1), []).append(method)
    found = {}
    for name, methods in members.items():
        pairs = [(task, method) for method in methods for task in tasks[method]]
        if len(methods) > 1 and len(dict(pairs)) == len(pairs):
            found[name] = dict(pairs)
    return found

"""A look at an environment before anything is trained on it: mistakes show at once."""

import contextlib
from typing import Any, NamedTuple

import numpy as np

from race.envs.checked import CheckedEnv
from race.envs.pettingzoo import conflict
from race.errors import TaskError
from race.types import AnyTask, Task


class Trial(NamedTuple):
    """What a first look found."""

    repeats: bool
    """Whether the same seed gives the same episode, as far as was seen."""
    note: str
    """What to tell people; empty if there is nothing."""
    conflict: tuple[str, str] | None = None
    """Two agents of a team that were paid for what costs the other, if there are any."""


def try_out(task: AnyTask) -> Trial:
    """Makes an environment, and twice resets it with one seed and makes a step.

    Raises:
        EnvFailedError: if the environment fails.
        HandedOverError: if what it hands over breaks the contract.
    """
    env = CheckedEnv(task)
    try:
        first, second = _begin(env, task), _begin(env, task)
        found = conflict.look(env)
    finally:
        with contextlib.suppress(TaskError):  # it would hide what was wrong; it is told in training
            env.close()
    name = task.spec.task
    repeats, notes = True, []
    if found is not None:
        picks = {_pattern(found.one), _pattern(found.other)}
        examples = sorted(picks) if len(picks) == 2 else [found.one, found.other]
        notes.append(
            f"Note: in {name}, {found.one} and {found.other} are paid for what costs the other "
            f"(correlation {found.correlation:.2f} in random play): one team of both learns to "
            "please neither. --env.agents picks the team by its agents' names "
            f"({', '.join(dict(task.facts)['agent_names'])}), such as --env.agents "
            f"'{examples[0]}' or '{examples[1]}'; the others then act by --env.others."
        )
    if not (task.seeded and env.takes_seed):
        repeats = False
        notes.append(
            f"Note: the environment of {name} has no place for a seed, so that its episodes do not "
            "repeat: a run will not be the same again, nor what is resumed of it. Let reset take "
            "a seed that decides everything random."
        )
    elif not _same(first, second):
        repeats = False
        notes.append(
            f"Note: the environment of {name} shows something else when it is reset with the same "
            "seed again: a run will not be the same again, nor what is resumed of it. Let "
            "reset(seed=...) decide everything random, also what is left of the episode before."
        )
    against = None if found is None else (found.one, found.other)
    return Trial(repeats, "\n".join(notes), against)


def _pattern(agent: str) -> str:
    """The pattern of agents of a kind, such as ``adversary_*``."""
    kind, mark, number = agent.rpartition("_")
    return f"{kind}_*" if mark and number.isdigit() else agent


def _begin(env: CheckedEnv, task: AnyTask) -> Any:
    seen: Any = env.reset(0)
    if isinstance(task, Task):
        middle = np.add(task.spec.action_low, task.spec.action_high) / 2
        return seen, env.step(middle.astype(np.float32))
    return seen, env.step(seen.avail_actions.argmax(axis=1))


def _same(one: Any, other: Any) -> bool:
    pairs = zip(_leaves(one), _leaves(other), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


def _leaves(seen: Any) -> list[Any]:
    if isinstance(seen, tuple):
        return [leaf for part in seen for leaf in _leaves(part)]
    return [seen]

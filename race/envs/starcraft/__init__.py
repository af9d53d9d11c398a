"""StarCraft II itself, through SMAC or SMACv2, in an interpreter of the user's choice.

SMAC and the game run in processes of their own (`game`, which `remote` starts); what comes out is
an environment with PyMARL's interface. What people are told when something is missing is in
`telling`.
"""

import contextlib
import functools
import json
from typing import Any, Final, NamedTuple

from race.config.settings import EnvConfig
from race.envs.checked import CheckedEnv
from race.envs.pymarl import PymarlEnv, spec_of
from race.envs.starcraft import game, scenarios, telling
from race.envs.starcraft.remote import OPENING_SECONDS, RemoteBattle, Wanted, Worker, interpreter
from race.errors import EnvFailedError, TaskError
from race.types import DiscreteTask

__all__ = ["NOTE", "Installed", "Wanted", "is_game", "look", "make_task", "names", "try_out"]

NOTE: Final = (
    "Note: StarCraft II is given its seed when it starts, not for each battle, so that a run that "
    "is resumed will not be the same as one that was not interrupted."
)
_PACKAGES: Final = ("smac", "smacv2")
_ACTIONS: Final = ("nothing (dead)", "stop", "north", "south", "east", "west")


class Installed(NamedTuple):
    """What an interpreter has of ``smac`` or ``smacv2``."""

    python: str
    facts: dict[str, Any]
    """Versions, the game and where it is; empty if anything is wrong."""
    wrong: str = ""
    """What is, and what to do."""
    there: bool = True
    """Whether there is a package of that name at all."""


def is_game(task_id: str) -> bool:
    """Whether an id names a battle of StarCraft II itself."""
    return task_id.partition("/")[0] in _PACKAGES and "/" in task_id


def make_task(task_id: str, config: EnvConfig) -> DiscreteTask:
    """The task ``smac/<map>`` or ``smacv2/<race>_<n>_vs_<m>``.

    SMAC is asked for its sizes, which starts its interpreter but no game. An episode that the
    limit ends is over, as in ``micro/*``: SMAC treats the limit as a part of the task.

    Raises:
        TaskError: if there is no such map, or SMAC or the game is not there.
    """
    package, _, name = task_id.partition("/")
    kwargs = json.loads(config.kwargs)
    if "map_name" in kwargs:
        raise TaskError(
            f"Task {task_id} names the map: leave map_name out of --env.kwargs and name another "
            "task instead."
        )
    usual = None
    if package == "smacv2" and (usual := scenarios.settings(name)) is None:
        raise TaskError(telling.refusal(task_id, "", "unknown", {"known": scenarios.NAMES}))
    python = config.python and interpreter(config.python)
    wanted = Wanted(package, name, kwargs, usual, python)
    battle = RemoteBattle(wanted)
    try:
        spec = spec_of(battle, task_id, has_wins=True)
        told = battle.told
    finally:
        battle.close()
    facts = (
        ("game", told["game"]),
        (package, told["code"]),
        ("scenario", told["scenario"] or None),
        ("env_kwargs", config.kwargs),
    )
    return DiscreteTask(spec, functools.partial(_make, wanted), facts=facts, waits=True)


def _make(wanted: Wanted, render_mode: str | None = None) -> PymarlEnv:
    battle = RemoteBattle(wanted)
    try:
        return PymarlEnv(battle, wanted.task, has_wins=True, render_mode=render_mode)
    except BaseException:
        battle.close()
        raise


def try_out(task: DiscreteTask) -> dict[str, str]:
    """Plays a step, which starts the game; the versions of the libraries that it needs.

    Raises:
        EnvFailedError: if the game cannot be started or breaks down.
        HandedOverError: if what it hands over breaks the contract.
    """
    env = CheckedEnv(task)
    try:
        seen: Any = env.reset(0)
        env.step(seen.avail_actions.argmax(axis=1))
        libraries: dict[str, str] = env.env.inner.told["libraries"]
        return libraries
    finally:
        with contextlib.suppress(TaskError):  # it would hide what was wrong; it is told in training
            env.close()


def names(env: PymarlEnv) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Entries of the state, of an observation, and actions, as SMACv2 names them; SMAC does not."""
    told, sizes = env.inner.told["names"], env.sizes
    state, obs = (
        tuple(told[what]) if len(told[what]) == size else ("",) * size
        for what, size in (("state", sizes.state_size), ("obs", sizes.obs_size))
    )
    targets = range(sizes.n_actions - len(_ACTIONS))
    return state, obs, (*_ACTIONS, *(f"target {number}" for number in targets))


def look(package: str, python: str | None = None) -> Installed:
    """What is installed for ``smac`` or ``smacv2``.

    Args:
        package: ``smac`` or ``smacv2``.
        python: the interpreter; None: this one.

    Raises:
        TaskError: if there is no such interpreter.
    """
    worker = Worker(python)
    try:
        answer, _ = worker.ask({"do": "look", "package": package}, OPENING_SECONDS)
        return Installed(worker.python, answer["found"])
    except game.RefusedError as error:
        wrong = telling.missing(package, worker.python, error.kind, error.facts)
        return Installed(worker.python, {}, wrong, error.kind != "missing")
    except EnvFailedError as error:
        return Installed(worker.python, {}, str(error))
    finally:
        worker.close()

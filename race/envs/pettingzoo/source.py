"""Where a PettingZoo environment comes from: a name, or a function of the user's."""

import contextlib
import difflib
import importlib
import importlib.metadata
import inspect
import json
import os
import pkgutil
import re
import sys
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

from race import loading
from race.envs import mamujoco
from race.errors import TaskError, blamed

PREFIX: Final = "pettingzoo:"
"""What the ids of such tasks begin with."""
_MAKERS: Final = ("parallel_env", "env", "raw_env")
"""What modules of PettingZoo's family call what makes their environment; the first is preferred."""
_LIMITS: Final = ("max_cycles", "max_steps", "max_episode_steps")
"""What environments call their step limit; the first is PettingZoo's own word."""


class Opened(NamedTuple):
    """An environment with the parallel interface. ``turns``: its agents act one after the other."""

    env: Any
    turns: bool


def maker(name: str) -> Callable[..., Any]:
    """What makes the environment of a name.

    Args:
        name: ``MODULE.ENV``: a module with ``parallel_env`` (or ``env``), or a function or class of
            a module. Modules are also looked for in the current directory.

    Raises:
        TaskError: if there is none.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # an advertisement
    with _quiet(name):
        found = _found(name)
    if callable(found):
        return found
    with blamed(TaskError, f"Task {PREFIX}{name}"):  # outdated names of PettingZoo say so here
        made = [getattr(found, one) for one in _MAKERS if callable(getattr(found, one, None))]
    if made:
        maker_: Callable[..., Any] = made[0]
        return maker_
    shown = [module for module in _modules(found) if not module.startswith("_")]
    hint = f" Its modules are {', '.join(shown)}." if shown else ""
    if versions := _versions(name):
        hint = f" Did you mean {' or '.join(versions)}?"
    raise TaskError(
        f"Task {PREFIX}{name}: {name} has no function parallel_env (or env). Name a module that "
        f"has, or a function or class that makes the environment.{hint}"
    )


def from_name(name: str, kwargs: str, render_mode: str | None = None) -> Any:
    """The environment of a name, made with keywords that are written as JSON.

    Raises:
        TaskError: if there is none, or the keywords are not its own.
    """
    given = json.loads(kwargs)
    if "render_mode" in given:
        raise TaskError(
            "render_mode is no argument for --env.kwargs: training draws nothing, and `race "
            "render` asks for pictures itself."
        )
    if render_mode is not None:
        given["render_mode"] = render_mode
    with _quiet(name):
        return maker(name)(**given)


def made(make: Callable[..., Any], render_mode: str | None) -> Any:
    """What a function of the user's makes, which need not have a place for the render mode.

    Raises:
        TaskError: if it has none and one is wanted.
    """
    try:
        parameters = list(inspect.signature(make).parameters.values())
    except (TypeError, ValueError):  # one of those that cannot be known
        parameters = []
    required = [
        p
        for p in parameters
        if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.default is p.empty
    ]
    named = any(p.name == "render_mode" or p.kind is p.VAR_KEYWORD for p in parameters)
    if len(required) == 1:  # make(render_mode), as of other tasks
        return make(render_mode)
    if render_mode is None:
        return make()
    if not named:
        raise TaskError(
            "Its make function takes no render_mode, and pictures need one. Let it take "
            "render_mode=None and hand it on to the environment."
        )
    return make(render_mode=render_mode)


def opened(env: Any) -> Opened:
    """An environment with the parallel interface, by PettingZoo's own converters if need be.

    Raises:
        TaskError: if PettingZoo is not installed.
    """
    if not hasattr(env, "agent_iter"):
        return Opened(env, type(env).__name__ == "turn_based_aec_to_parallel_wrapper")
    try:
        from pettingzoo.utils import conversions
    except ImportError as error:
        raise TaskError(
            "This environment is an AECEnv, which PettingZoo converts, and PettingZoo is not "
            "installed: pip install 'race-marl[pettingzoo]'"
        ) from error
    if (getattr(env, "metadata", None) or {}).get("is_parallelizable", False):
        return Opened(conversions.aec_to_parallel(env), False)
    return Opened(conversions.turn_based_aec_to_parallel(env), True)


def limit_of(env: Any) -> int | None:
    """The step limit that an environment tells of itself; None if it does not.

    It is looked for as ``max_cycles``, ``max_steps`` or ``max_episode_steps`` of the environment
    and of what it wraps, as ``max_cycles`` of what this holds, and in gymnasium's registration.
    """
    for holder, names in _holders(env):
        for name in names:
            limit = getattr(holder, name, None)
            if isinstance(limit, int) and limit >= 1 and not isinstance(limit, bool):
                return int(limit)
        registered = getattr(getattr(holder, "spec", None), "max_episode_steps", None)
        if registered is not None:
            return int(registered)
    return None


def packages(name: str) -> dict[str, str]:
    """Versions of what the environment of a name comes from, as far as they are known."""
    found = {}
    for package in (name.partition(".")[0], "pettingzoo"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package.replace("_", "-"))
    return found


def _quiet(name: str) -> contextlib.AbstractContextManager[None]:
    """Keeps back what a library is known to say without need."""
    ours = name.startswith("gymnasium_robotics.")
    return mamujoco.quiet() if ours else contextlib.nullcontext()


def _holders(env: Any) -> Iterator[tuple[Any, tuple[str, ...]]]:
    inner = getattr(env, "unwrapped", env)
    yield from ((env, _LIMITS), (inner, _LIMITS))
    held = getattr(inner, "__dict__", {}).values()
    yield from ((value, _LIMITS[:1]) for value in held if hasattr(value, "step"))


def _found(name: str) -> Any:
    """The module of that name, or what its last part is in the module before it."""
    parent, _, last = name.rpartition(".")
    where = f"Task {PREFIX}{name}"
    if not all(part.isidentifier() for part in name.split(".")):
        raise TaskError(
            f"{where}: write pettingzoo:MODULE.ENV, such as pettingzoo:mpe2.simple_spread_v3."
        )
    try:
        return loading.own_module(name, TaskError, where)
    except loading.NoModuleError as error:
        if not parent or error.name != name:
            raise TaskError(f"{error} {_advice(name)}".strip()) from error
        module = loading.own_module(parent, TaskError, where)
    except TaskError as error:
        raise TaskError(f"{error} {_advice(name)}".strip()) from error
    with contextlib.suppress(AttributeError, ImportError):
        return getattr(module, last)
    offered = sorted({*_modules(module), *(key for key in vars(module) if not key.startswith("_"))})
    near = difflib.get_close_matches(last, offered, n=3, cutoff=0.3)
    hint = f" The nearest are {', '.join(f'{parent}.{one}' for one in near)}." if near else ""
    raise TaskError(f"{where}: {parent} has no {last}.{hint}")


def _versions(name: str) -> list[str]:
    """The same name with a version behind it, as PettingZoo's environments have: ``NAME_v3``."""
    parent, _, last = name.rpartition(".")
    found = _modules(sys.modules.get(parent))
    return [f"{parent}.{one}" for one in found if re.fullmatch(rf"{last}_v\d+", one)]


def _modules(package: Any) -> list[str]:
    return sorted(info.name for info in pkgutil.iter_modules(getattr(package, "__path__", [])))


def _advice(name: str) -> str:
    """What to install for well-known packages."""
    first, second, *_ = [*name.split("."), ""]
    if first == "pettingzoo" and second == "mpe":
        return "These environments have moved: pip install mpe2, and use pettingzoo:mpe2.*."
    if first == "pettingzoo" and second in ("sisl", "butterfly", "classic", "atari"):
        return f"PettingZoo has an extra for them: pip install 'pettingzoo[{second}]'"
    if first in ("mpe2", "supersuit", "magent2", "vmas"):
        return f"It is a package: pip install {first}"
    return ""

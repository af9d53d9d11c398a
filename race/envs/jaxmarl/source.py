"""Which JaxMARL environment a name means, and what is installed."""

import contextlib
import difflib
import importlib.metadata
import io
import json
import sys
from collections.abc import Iterator
from typing import Any, Final

from race.errors import TaskError, described

PREFIX: Final = "jaxmarl:"
OLDEST: Final = (0, 2, 0)
"""SMAX means something else before it."""

_SMAX: Final = "SMAX/"
_OVERCOOKED: Final = "overcooked/"
_MPE: Final = "MPE/"


def packages() -> dict[str, str]:
    """Versions of jaxmarl and what it is built on, as far as they are installed."""
    found = {}
    for name in ("jaxmarl", "flax"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def made(name: str, kwargs: str) -> Any:
    """The environment of a name: ``SMAX/MAP``, ``MPE/NAME``, ``overcooked/LAYOUT``, or JaxMARL's.

    Against the units of a map of SMAX plays JaxMARL's heuristic (``HeuristicEnemySMAX``).

    Args:
        name: behind the prefix.
        kwargs: arguments of the environment, a JSON object.

    Raises:
        TaskError: if jaxmarl is missing or too old, or there is no such environment.
    """
    jaxmarl = _library(name)
    given: dict[str, Any] = json.loads(kwargs)
    wanted, parts = name, {}
    if name.startswith(_SMAX):
        maps = _maps()
        wanted, called = "HeuristicEnemySMAX", name.removeprefix(_SMAX)
        parts["scenario"] = maps[called] if called in maps else _unknown(name, jaxmarl)
    elif name.startswith(_OVERCOOKED):
        from flax.core.frozen_dict import FrozenDict

        layouts = _layouts()
        wanted, called = "overcooked", name.removeprefix(_OVERCOOKED)
        found = layouts[called] if called in layouts else _unknown(name, jaxmarl)
        parts["layout"] = FrozenDict(found)
    elif name.startswith(_MPE):
        wanted = name.replace("/", "_", 1)
    if wanted not in jaxmarl.registered_envs:
        _unknown(name, jaxmarl)
    twice = sorted(set(parts) & set(given))
    if twice:
        raise TaskError(
            f"Task {PREFIX}{name}: its name says what {twice[0]} is, and so does --env.kwargs "
            f"{kwargs}. Leave one of them out."
        )
    try:
        return jaxmarl.make(wanted, **parts, **given)
    except Exception as error:
        how = f" with --env.kwargs {kwargs}" if given else ""
        raise TaskError(
            f"Task {PREFIX}{name}: making its environment{how} failed: {described(error)}."
        ) from error


def names(jaxmarl: Any) -> list[str]:
    """All names that `made` knows."""
    others = [name for name in jaxmarl.registered_envs if not name.startswith("MPE_")]
    mpe = [name.replace("_", "/", 1) for name in jaxmarl.registered_envs if name not in others]
    maps = [f"{_SMAX}{name}" for name in _maps()]
    return [*maps, *mpe, *(f"{_OVERCOOKED}{name}" for name in _layouts()), *others]


def _library(name: str) -> Any:
    where, pip = f"Task {PREFIX}{name}", "pip install 'race-marl[jaxmarl]'"
    try:
        with _quiet():
            import jaxmarl
    except ModuleNotFoundError as error:
        if error.name == "jaxmarl":
            raise TaskError(f"{where}: jaxmarl is not installed: {pip}") from error
        raise TaskError(
            f"{where}: jaxmarl needs the module {error.name}, which is not installed: {pip}"
        ) from error
    except Exception as error:
        raise TaskError(f"{where}: importing jaxmarl failed: {described(error)}.") from error
    version = packages().get("jaxmarl", "")
    if _number(version) < OLDEST:
        raise TaskError(
            f"{where}: jaxmarl {version or 'of an unknown version'} is installed, and its SMAX "
            f"means something else than that of {'.'.join(map(str, OLDEST))} and later: {pip}"
        )
    return jaxmarl


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keeps back what is printed while jaxmarl is imported: what else is not installed.

    It also puts `sys.__stdout__` and `sys.__stderr__` in the places of whatever was there.
    """
    before, stderr = sys.__stdout__, sys.stderr
    with contextlib.redirect_stdout(io.StringIO()) as kept:
        sys.__stdout__ = kept  # type: ignore[misc, assignment]
        try:
            yield
        finally:
            sys.__stdout__, sys.stderr = before, stderr  # type: ignore[misc]


def _number(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split(".")[:3] if part.isdigit())


def _maps() -> dict[str, Any]:
    from jaxmarl.environments.smax.smax_env import MAP_NAME_TO_SCENARIO

    return dict(MAP_NAME_TO_SCENARIO)


def _layouts() -> dict[str, Any]:
    from jaxmarl.environments.overcooked.layouts import overcooked_layouts

    return dict(overcooked_layouts)


def _unknown(name: str, jaxmarl: Any) -> Any:
    near = difflib.get_close_matches(name, names(jaxmarl), n=3, cutoff=0.0)
    raise TaskError(
        f"There is no {name!r} in jaxmarl {packages()['jaxmarl']}. The nearest names are "
        f"{', '.join(PREFIX + one for one in near)}."
    )

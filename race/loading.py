"""Functions of the user's own, named ``package.module:function`` on the command line."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from race.errors import RaceError, described


class NoModuleError(RaceError):
    """There is no module of a name. ``name`` is the part of it that is missing."""

    def __init__(self, message: str, name: str) -> None:
        super().__init__(message)
        self.name = name


def own_module(name: str, kind: type[RaceError], where: str) -> ModuleType:
    """The module of that name, which is also looked for in the current directory.

    Args:
        name: dotted.
        kind: the error to raise.
        where: what messages begin with.

    Raises:
        NoModuleError: if there is none.
        RaceError: of that kind, if the module fails.
    """
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise kind(
                f"{where}: importing {name} failed, because it needs the module "
                f"{error.name}, which is not installed."
            ) from error
        raise NoModuleError(
            f"{where}: there is no module {error.name}. It is looked for in the current "
            f"directory ({Path.cwd()}) and among the installed packages; the name is that of the "
            "file without .py, with dots for folders.",
            error.name,
        ) from error
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise kind(f"{where}: importing {name} failed with {described(error)}.") from error


def own_function(name: str, kind: type[RaceError], what: str, hint: str) -> Callable[..., Any]:
    """The function of that name; modules are also looked for in the current directory.

    Args:
        name: ``module:function``.
        kind: the error to raise.
        what: what it is, such as ``Task``; messages begin with it.
        hint: what to do where the module has no such function.

    Raises:
        RaceError: of that kind, if there is no such module or function, or the module fails.
    """
    where = f"{what} {name}"
    module_name, _, function_name = name.partition(":")
    try:
        module = own_module(module_name, kind, where)
    except NoModuleError as error:
        raise kind(str(error)) from error
    function = getattr(module, function_name, None)
    if not callable(function):
        raise kind(
            f"{where}: {module_name} ({module.__file__}) has no function {function_name}. {hint}"
        )
    found: Callable[..., Any] = function
    return found

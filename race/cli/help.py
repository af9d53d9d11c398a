"""What ``race train --help`` shows: what one needs first, and only what a task has a use for."""

import ast
import contextlib
import dataclasses
import inspect
import io
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, NamedTuple, Union, get_args, get_origin

import tyro

from race.config.effects import Facts, idle
from race.config.presets import PRESETS
from race.config.settings import Config

_FIRST: Final = ("task", "algo", "env_steps", "seed", "run_dir", "seeds")
_MOST_CHOICES: Final = 8
_LEFT: Final = 36  # columns of the options' names
_EXAMPLES: Final = (
    "race train mamujoco/HalfCheetah-2x3 --env-steps 100000 --run-dir runs/first",
    "race train micro/2s3z --algo facmac --seeds 1-5",
    "race train pettingzoo:mpe2.simple_spread_v3 --env.kwargs '{\"N\": 4}'",
)


class Option(NamedTuple):
    """One option of a command line. ``name`` is that of the setting, such as ``env.agents``."""

    name: str
    flag: str
    text: str


def show(command: Any, arguments: Sequence[str]) -> None:
    """Prints the help and ends the program.

    Args:
        command: the dataclass of ``race train``.
        arguments: what was written, with ``--help`` or ``--help-all`` in it.

    Raises:
        TaskError: if the task that is named cannot be made.
    """
    words = [word for word in arguments if word not in ("-h", "--help", "--help-all")]
    asked = _asked(command, words)
    everything = "--help-all" in arguments
    lines = [*_head(command, asked), ""]
    first = list(options_of(command, "", asked))
    first.sort(key=lambda option: (*_FIRST, option.name).index(option.name))
    lines += _listed(first)
    unread = frozenset() if everything or asked is None else _idle(asked)
    for field in dataclasses.fields(command):
        if not dataclasses.is_dataclass(field.type):
            continue
        options = [
            o for o in options_of(field.type, f"{field.name}.", asked) if o.name not in unread
        ]
        about = inspect.cleandoc(field.type.__doc__ or "").partition("\n")[0]
        if not options:
            continue
        if everything or asked is not None:
            lines += ["", f"--{field.name}.*: {about}", *_listed(options)]
        else:
            lines += _row(f"--{field.name}.*", f"{len(options)} settings. {about}")
    print("\n".join(lines))
    raise SystemExit(0)


def _head(command: Any, asked: Any) -> list[str]:
    name = "TASK" if asked is None else asked.task
    about = inspect.cleandoc(command.__doc__ or "").split("\n\n")
    lines = [f"usage: race train {name} [OPTIONS]", ""]
    for part in about:
        lines += [*textwrap.wrap(" ".join(part.split()), _width()), ""]
    return [*lines, "For example:", *(f"  {example}" for example in _EXAMPLES)]


def _asked(command: Any, words: list[str]) -> Any:
    """What was asked for beside help; None without a task."""
    if not words or words[0].startswith("-"):
        return None
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        try:
            asked = tyro.cli(command, args=words, prog="race train")
        except SystemExit:  # it is not whole yet, which is why help is wanted
            asked = command(task=words[0])
    return asked


def _idle(asked: Any) -> frozenset[str]:
    """Names of the settings that a task has no use for."""
    from race.envs import (
        discrete_probe,
        make_task,
        probe,
        reads_config,
        reads_game,
        reads_team,
        starcraft,
    )
    from race.types import DiscreteTask

    task = asked.task
    if task.startswith("micro/") or task in discrete_probe.PROBES:
        discrete, on_host = True, False
    elif starcraft.is_game(task):
        discrete, on_host = True, True
    elif task.startswith("mamujoco/") or task in probe.PROBES:
        discrete, on_host = False, True
    else:  # somebody's own has to be looked at
        made = make_task(task, asked.env)
        discrete = isinstance(made, DiscreteTask)
        on_host = not isinstance(made, DiscreteTask) or made.device is None
    names = {field.name for field in dataclasses.fields(Config)}
    config = Config(**{name: getattr(asked, name) for name in names if hasattr(asked, name)})
    facts = Facts(
        discrete=discrete,
        reads_env=reads_config(task),
        on_host=on_host,
        reads_parallel=reads_team(task),
        reads_game=reads_game(task),
    )
    return idle(config, facts)


def options_of(group: Any, prefix: str = "", asked: Any = None) -> Iterator[Option]:
    """The options of a dataclass of settings, whose own groups are left out.

    Args:
        group: the dataclass.
        prefix: of the options' names, such as ``env.``.
        asked: what was asked for, whose preset then gives defaults; None: the usual ones.
    """
    texts = _texts(group)
    defaults = group() if prefix else None
    if prefix == "learner." and asked is not None:
        defaults = PRESETS[asked.preset]
    hints = inspect.get_annotations(group, eval_str=True)
    for field in dataclasses.fields(group):
        if dataclasses.is_dataclass(field.type):
            continue
        name = prefix + field.name
        default = field.default if defaults is None else getattr(defaults, field.name)
        yield Option(name, _flag(name, hints[field.name]), texts[field.name] + _default(default))


def _flag(name: str, hint: Any) -> str:
    flag = f"--{name.replace('_', '-')}"
    if hint is bool:
        group, _, last = name.rpartition(".")
        return f"{flag}, --{group}.no-{last}".replace("_", "-")
    value = _value(hint)
    return value if value == "TASK" else f"{flag} {value}"


def _value(hint: Any) -> str:
    """What a value looks like, such as INT or race|merl."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        named = [m.metavar for m in hint.__metadata__ if getattr(m, "metavar", None)]
        return str(named[0]) if named else _value(arguments[0])
    if origin is Literal:
        return "|".join(arguments) if len(arguments) <= _MOST_CHOICES else "NAME"
    if origin in (UnionType, Union):
        return "|".join(_value(argument) for argument in arguments if argument is not NoneType)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"{_value(arguments[0])}..."
        return " ".join(map(_value, arguments))
    words = {bool: "True|False", int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}
    return words[hint]


def _default(value: Any) -> str:
    if value is dataclasses.MISSING or value is None or value == ():
        return ""
    if isinstance(value, tuple):
        value = " ".join(",".join(v) if isinstance(v, tuple) else str(v) for v in value)
    if isinstance(value, int) and not isinstance(value, bool):
        value = f"{value:_}" if value >= 10_000 else value
    return f" [{value}]"


def _texts(group: Any) -> dict[str, str]:
    """The text below each field of a dataclass."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(group))).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for node, after in zip(body.body, [*body.body[1:], None], strict=True):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        text = after.value.value if _is_text(after) else ""  # type: ignore[union-attr]
        found[node.target.id] = " ".join(str(text).split())
    return found


def _is_text(node: Any) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _listed(options: Sequence[Option]) -> list[str]:
    return [line for option in options for line in _row(option.flag, option.text)]


def _row(flag: str, text: str) -> list[str]:
    """An option and what it is, beside or below it."""
    wrapped = textwrap.wrap(text, _width() - _LEFT) or [""]
    left = f"  {flag}"
    lines = [" " * _LEFT + line for line in wrapped]
    if len(left) < _LEFT:
        return [left.ljust(_LEFT) + wrapped[0], *lines[1:]]
    return [left, *lines]


def _width() -> int:
    return max(60, min(shutil.get_terminal_size((100, 24)).columns, 110))

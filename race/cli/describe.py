"""``race describe``."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from race.config.settings import EnvConfig

if TYPE_CHECKING:
    from race.envs.layout import Layout
    from race.types import AnyTask


@dataclass(frozen=True)
class Describe:
    """Show a task: who sees what and moves what, by name and by index, and where it ends.

    Indices of observations are those that policies and exported teams are given. A task of your own
    is made once, which runs its module.
    """

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    """The task, as for race train."""
    env: EnvConfig = field(default_factory=EnvConfig)
    json: bool = False
    """Print one JSON object."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, makes the task and prints."""
    chosen = tyro.cli(Describe, args=arguments, prog="race describe")
    from race.envs import make_task
    from race.envs.description import describe
    from race.envs.layout import layout
    from race.errors import TaskError, blamed
    from race.types import EnvSpec

    task = make_task(chosen.task, chosen.env)
    with blamed(TaskError, f"Task {chosen.task}: its environment failed"):
        names = layout(chosen.task, task)
    if chosen.json:
        bounds = {}
        if isinstance(task.spec, EnvSpec):
            bounds = {"action_low": task.spec.action_low, "action_high": task.spec.action_high}
        print(json.dumps(describe(task) | bounds | {"names": names._asdict()}, indent=2))
        return
    for line in _lines(task, names):
        print(line)


def _lines(task: "AnyTask", names: "Layout") -> Iterator[str]:
    from race.types import EnvSpec

    spec = task.spec
    moved = isinstance(spec, EnvSpec)
    kind = "continuous" if moved else "discrete"
    yield f"{spec.task}: {_many(spec.n_agents, 'agent')} with {kind} actions"
    yield f"an episode ends after {_many(spec.episode_limit, 'step')} at the latest"
    if not task.seeded:
        yield "its environment takes no seed: episodes do not repeat"
    for name, value in task.facts:
        if value not in (None, [], "{}"):
            yield f"{name}: {value if isinstance(value, str) else ', '.join(value)}"
    entries = _many(spec.state_size, "entry")
    yield f"\nstate, {entries}{_unnamed(names.state)}"
    yield from _numbered(names.state)
    alike = len(set(zip(names.obs, names.actions, strict=True))) == 1 and not moved
    for number, agent in enumerate(names.agents):
        if number and alike:
            break
        whose = f"every agent ({', '.join(names.agents)})" if alike else agent
        obs, actions = names.obs[number], names.actions[number]
        places = _places(spec, number)
        yield f"\n{whose} observes {_many(len(obs), 'entry')}{_unnamed((*obs, *places))}"
        yield from _numbered(obs, places)
        if moved:
            yield f"\n{whose} acts by {_many(len(actions), 'number')}"
            yield from _numbered(actions, _bounds(spec, number))
        else:
            yield f"\n{whose} chooses from {_many(len(actions), 'action')}{_unnamed(actions)}"
            yield from _numbered(actions)


def _many(count: int, what: str) -> str:
    if count == 1:
        return f"1 {what}"
    return f"{count:,} {what.removesuffix('y')}ies" if what.endswith("y") else f"{count:,} {what}s"


def _unnamed(names: tuple[str, ...]) -> str:
    return "" if any(names) else ", which have no names"


def _places(spec: Any, agent: int) -> list[str]:
    """Where in the state what an agent observes is; nothing on tasks with discrete actions."""
    index = getattr(spec, "obs_index", None)
    return [] if index is None else [f"entry {entry} of the state" for entry in index[agent]]


def _bounds(spec: Any, agent: int) -> list[str]:
    low, high = spec.action_low, spec.action_high
    return [
        f"{low[entry]:g} to {high[entry]:g}, entry {entry} of the joint action"
        for entry in spec.action_index[agent]
    ]


def _numbered(names: tuple[str, ...], notes: list[str] | None = None) -> Iterator[str]:
    if not any((*names, *(notes or []))):
        return
    widest = max((len(name) for name in names), default=0)
    for number, name in enumerate(names):
        note = f"  {notes[number]}" if notes else ""
        yield f"{number:>6}  {name.ljust(widest) if note else name}{note}".rstrip()

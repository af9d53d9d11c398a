"""Tasks: Multi-Agent MuJoCo, battles, StarCraft II, PettingZoo, JaxMARL, probes, your own.

A family of tasks may be added or changed here; whoever trains sees `race.types.AnyTask` alone.
"""

import difflib
import tomllib
from pathlib import Path
from typing import Final, NamedTuple

from race.config.checks import check_env
from race.config.presets import TABLE_4
from race.config.settings import EnvConfig
from race.envs import discrete_probe, jaxmarl, mamujoco, own, pettingzoo, probe, starcraft
from race.envs.own import factorised
from race.errors import TaskError
from race.types import AnyTask, DiscreteTask, Task

__all__ = [
    "TaskInfo",
    "describe_tasks",
    "factorised",
    "has_no_picture",
    "make_continuous_task",
    "make_discrete_task",
    "make_task",
    "reads_config",
    "reads_game",
    "reads_team",
    "task_ids",
]

_PAPER_NAMES: Final = {
    "mamujoco/HalfCheetah-2x3": "2-Agent HalfCheetah",
    "mamujoco/HalfCheetah-6x1": "6-Agent HalfCheetah",
    "mamujoco/Ant-2x4": "2-Agent Ant",
    "mamujoco/Ant-2x4d": "2-Agent Ant-v2",
    "mamujoco/Ant-4x2": "4-Agent Ant",
    "mamujoco/Hopper-3x1": "3-Agent Hopper",
    "mamujoco/Humanoid-9x8": "2-Agent Humanoid",
    "mamujoco/HumanoidStandup-9x8": "2-Agent HumanoidStandup",
}
_MICRO: Final = "micro/"
_DEFAULT: Final = EnvConfig()


class TaskInfo(NamedTuple):
    """A line of the list of tasks. ``paper_name`` is None where the paper does not use the task."""

    id: str
    description: str
    paper_name: str | None


def describe_tasks() -> tuple[TaskInfo, ...]:
    """All tasks that have a name: the paper's sixteen, other MuJoCo ones, other maps, probes."""
    known = [f"mamujoco/{s}-{p}" for s, ps in mamujoco.KNOWN_PARTITIONS.items() for p in ps]
    others = [name for name in known if name not in _PAPER_NAMES]
    battles = _describe_battles()
    return (
        *(TaskInfo(name, _describe(name), _PAPER_NAMES[name]) for name in _PAPER_NAMES),
        *(info for info in battles if info.paper_name),
        *(TaskInfo(name, _describe(name), None) for name in others),
        *(info for info in battles if not info.paper_name),
        *(TaskInfo(name, info.description, None) for name, info in probe.PROBES.items()),
        *(TaskInfo(name, info.description, None) for name, info in discrete_probe.PROBES.items()),
    )


def task_ids() -> tuple[str, ...]:
    """The ids of `describe_tasks`, in its order."""
    return tuple(info.id for info in describe_tasks())


def _describe(name: str) -> str:
    scenario, partition = name.removeprefix("mamujoco/").split("-")
    match partition:
        case "9x8":
            return f"{scenario}: upper body (9 joints) and lower body (8)"
        case "3p":
            return f"{scenario}: shoulder (3 joints), elbow (1) and wrist (3)"
        case "2x4":
            return f"{scenario}: 2 agents, 4 joints each, neighbouring legs together"
        case "2x4d":
            return f"{scenario}: 2 agents, 4 joints each, diagonal legs together"
    agents, each = partition.split("x")
    part = "segment" if scenario.startswith("ManySegment") else "joint"
    return f"{scenario}: {agents} agents, {each} {part}{'s' if each != '1' else ''} each"


def _describe_battles() -> tuple[TaskInfo, ...]:
    # Read here, because importing race.envs.micro imports jax, which takes longer than a listing.
    folder = Path(__file__).parent / "micro" / "maps"
    found = []
    for path in sorted(folder.glob("*.toml")):
        name, text = _MICRO + path.stem, tomllib.loads(path.read_text("utf-8"))["description"]
        found.append(TaskInfo(name, text, path.stem if name in TABLE_4 else None))
    return tuple(found)


def make_task(task_id: str, config: EnvConfig = _DEFAULT) -> AnyTask:
    """The task of an id.

    Args:
        task_id: one of `task_ids`; any ``mamujoco/<Scenario>-<partition>`` that
            gymnasium-robotics knows; or your own as ``package.module:function``, where the
            function, called without arguments (or with `config`, if it takes one), returns a
            `Task` or a `DiscreteTask`; or ``pettingzoo:MODULE.ENV``, or ``jaxmarl:ENV``. Modules
            are also looked for in the current directory. Or ``smac/<map>``, or
            ``smacv2/<race>_<n>_vs_<m>``.
        config: what agents of Multi-Agent MuJoCo observe, who is the team of an environment of
            PettingZoo or JaxMARL, and who plays StarCraft II; its defaults, if not given.

    Raises:
        TaskError: if there is no such task; the message names the nearest ones.
        ConfigError: if a setting of environments cannot work.
    """
    check_env(config)
    if task_id.startswith(_MICRO):
        return make_discrete_task(task_id)
    if task_id.startswith(pettingzoo.PREFIX):
        return pettingzoo.make_task(task_id, config)
    if starcraft.is_game(task_id):
        return starcraft.make_task(task_id, config)
    if task_id.startswith(jaxmarl.PREFIX):
        return jaxmarl.make_task(task_id, config)
    if own.is_own(task_id):
        return own.own_task(task_id, config)
    if task_id.startswith("mamujoco/"):
        return mamujoco.make_task(task_id, config)
    if task_id in probe.PROBES:
        return probe.make_task(task_id)
    if task_id in discrete_probe.PROBES:
        return discrete_probe.make_task(task_id)
    nearest = difflib.get_close_matches(task_id, task_ids(), n=3, cutoff=0.0)
    raise TaskError(
        f"There is no task {task_id!r}. The nearest names are {', '.join(nearest)}; `race list` "
        "shows all, and a task of your own is named package.module:function."
    )


def make_continuous_task(task_id: str, config: EnvConfig = _DEFAULT) -> Task:
    """`make_task` of a task with continuous actions.

    Raises:
        TaskError: if there is no such task, or its actions are discrete.
    """
    task = make_task(task_id, config)
    if not isinstance(task, Task):
        raise TaskError(f"Task {task_id} has discrete actions; this needs continuous ones.")
    return task


def make_discrete_task(task_id: str) -> DiscreteTask:
    """The task with discrete actions of an id.

    Args:
        task_id: ``micro/<map>``, one of `task_ids`, ``micro/<path>.toml`` for a map of your own,
            or a probe.

    Raises:
        TaskError: if there is no such map, its file is wrong, or the task is of another kind.
    """
    if task_id.startswith(_MICRO):
        from race.envs.micro import environment  # imports jax

        return environment.make_task(task_id)
    if task_id in discrete_probe.PROBES:
        return discrete_probe.make_task(task_id)
    battles = [info.id for info in _describe_battles()]
    nearest = difflib.get_close_matches(task_id, battles, n=3, cutoff=0.0)
    raise TaskError(
        f"There is no task {task_id!r} with discrete actions. The nearest names are "
        f"{', '.join(nearest)}; race.envs.make_task makes tasks with continuous actions."
    )


def reads_config(task_id: str) -> bool:
    """Whether a task that there is reads what agents observe from an `EnvConfig`."""
    return task_id.startswith("mamujoco/") or _own_reads_config(task_id)


def reads_team(task_id: str) -> bool:
    """Whether a task that there is reads who is the team of an environment of others."""
    return task_id.startswith((pettingzoo.PREFIX, jaxmarl.PREFIX)) or _own_reads_config(task_id)


def reads_game(task_id: str) -> bool:
    """Whether a task that there is reads which interpreter plays StarCraft II."""
    return starcraft.is_game(task_id) or _own_reads_config(task_id)


def has_no_picture(task_id: str) -> bool:
    """Whether it is known of a task that it cannot be drawn; of one's own nothing is."""
    probes = (*probe.PROBES, *discrete_probe.PROBES)
    return task_id in probes or task_id.startswith(jaxmarl.PREFIX)


def _own_reads_config(task_id: str) -> bool:
    return own.is_own(task_id) and own.takes_config(own.own_function(task_id))

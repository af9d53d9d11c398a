"""Tasks: Multi-Agent MuJoCo, micromanagement battles, probes with known answers, and your own.

A family of tasks may be added or changed here; whoever trains sees `race.types.AnyTask` alone.
"""

import contextlib
import difflib
import importlib
import inspect
import re
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import gymnasium
import numpy as np

from race.config.presets import TABLE_4
from race.config.settings import EnvConfig
from race.envs import contract, discrete_probe, mamujoco, probe
from race.envs.checked import takes
from race.errors import HandedOverError, TaskError, blamed, described
from race.types import AnyTask, DiscreteTask, EnvSpec, Name, Task, Whole

__all__ = [
    "TaskInfo",
    "describe_tasks",
    "factorised",
    "make_continuous_task",
    "make_discrete_task",
    "make_task",
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
            `Task` or a `DiscreteTask`. The module is also looked for in the current directory.
        config: what agents of Multi-Agent MuJoCo observe; its defaults, if not given.

    Raises:
        TaskError: if there is no such task; the message names the nearest ones.
    """
    if task_id.startswith(_MICRO):
        return make_discrete_task(task_id)
    if re.fullmatch(r"[\w.]+:\w+", task_id):
        return _own_task(task_id, config)
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


def _own_task(task_id: str, config: EnvConfig) -> AnyTask:
    module_name, function_name = task_id.split(":")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise TaskError(
                f"Task {task_id}: importing {module_name} failed, because it needs the module "
                f"{error.name}, which is not installed."
            ) from error
        raise TaskError(
            f"Task {task_id}: there is no module {error.name}. It is looked for in the current "
            f"directory ({Path.cwd()}) and among the installed packages; the name is that of the "
            "file without .py, with dots for folders."
        ) from error
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise TaskError(
            f"Task {task_id}: importing {module_name} failed with {described(error)}."
        ) from error
    function = getattr(module, function_name, None)
    if not callable(function):
        raise TaskError(
            f"Task {task_id}: {module_name} ({module.__file__}) has no function {function_name}. "
            "Define one that returns a race.types.Task, for example with race.envs.factorised."
        )
    required = any(
        parameter.default is parameter.empty
        and parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        for parameter in inspect.signature(function).parameters.values()
    )
    with blamed(TaskError, f"Task {task_id}: {function_name} failed"):
        task = function(config) if required else function()
    if not isinstance(task, Task | DiscreteTask):
        raise TaskError(
            f"Task {task_id}: {function_name} returned {type(task).__name__} instead of a "
            "race.types.Task or DiscreteTask; race.envs.factorised builds the one from a gymnasium "
            "environment, race.envs.pymarl.pymarl_task the other from a PyMARL-style one."
        )
    return task


def factorised(
    make: Callable[[str | None], gymnasium.Env[Any, Any]],
    *,
    obs_index: Sequence[Sequence[int]] | Any,
    action_index: Sequence[Sequence[int]] | Any,
    task: Name,
    episode_limit: Whole | None = None,
) -> Task:
    """A task out of a gymnasium environment: who sees which entries, who moves which.

    Args:
        make: ``make(render_mode)`` returns the environment, with an observation of shape [S] (the
            global state) and an action of shape [U] (the joint action). Let it be a function of a
            module: worker processes import it by name.
        obs_index: for each agent, the entries of the state it observes.
        action_index: for each agent, the entries of the joint action it moves; every entry must
            belong to exactly one agent.
        task: the name of the task.
        episode_limit: steps after which the environment truncates an episode. None: the limit
            that the environment was registered with. This describes the environment's own limit
            and imposes none.

    Raises:
        TaskError: if spaces are not flat boxes, actions are unbounded, no limit is known, or the
            indices do not fit.
    """
    with blamed(TaskError, f"Task {task}: make(None) failed"):
        env = make(None)
    if not all(hasattr(env, name) for name in ("observation_space", "action_space", "reset")):
        raise TaskError(
            f"Task {task}: make(None) returned {contract.came(env)} instead of a gymnasium "
            "environment. Let it return one."
        )
    try:
        state_size = _flat_box(env.observation_space, "observation", task).shape[0]
        actions = _flat_box(env.action_space, "action", task)
        try:
            contract.refuse_whole(actions)
        except HandedOverError as error:
            raise TaskError(f"Task {task}: {error}.") from error
        if not (np.isfinite(actions.low).all() and np.isfinite(actions.high).all()):
            raise TaskError(
                f"Task {task}: the action space {actions} has no finite bounds. Give each entry a "
                "lowest and a highest value, for example with gymnasium.wrappers.RescaleAction or "
                "in the environment's Box."
            )
        if episode_limit is None:
            registered = getattr(env, "spec", None)
            episode_limit = registered.max_episode_steps if registered is not None else None
        if episode_limit is None:
            raise TaskError(
                f"Task {task}: the environment is registered with no time limit. Wrap it in "
                "gymnasium.wrappers.TimeLimit and pass the same number as episode_limit."
            )
        seeded = takes(env.reset, seed=0)
    finally:
        with contextlib.suppress(Exception, SystemExit):  # it would hide what was wrong before
            env.close()
    spec = EnvSpec(
        task=task,
        state_size=state_size,
        obs_index=obs_index,
        action_index=action_index,
        action_low=tuple(actions.low.tolist()),
        action_high=tuple(actions.high.tolist()),
        episode_limit=episode_limit,
    )
    return Task(spec, make, seeded)


def _flat_box(space: Any, what: str, task: str) -> gymnasium.spaces.Box:
    if isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1:
        return space
    raise TaskError(
        f"Task {task}: the {what} space must be a Box with one axis, and it is {space}. "
        "gymnasium.wrappers.FlattenObservation flattens observations; a task with discrete actions "
        "is a race.types.DiscreteTask, which race.envs.pymarl.pymarl_task makes."
    )

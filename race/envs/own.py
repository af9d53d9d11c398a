"""Tasks of the user's own: modules that define them, and gymnasium environments made into them."""

import contextlib
import inspect
import re
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np

from race import loading
from race.config.settings import EnvConfig
from race.envs import contract
from race.envs.checked import takes
from race.errors import HandedOverError, TaskError, blamed
from race.types import AnyTask, DiscreteTask, EnvSpec, Name, Task, Whole


def is_own(task_id: str) -> bool:
    """Whether an id names a function of a module of the user's."""
    return re.fullmatch(r"(?!pettingzoo:|jaxmarl:)[\w.]+:\w+", task_id) is not None


def own_function(task_id: str) -> Callable[..., Any]:
    """The function that an id names; its module is also looked for in the current directory.

    Raises:
        TaskError: if there is none, or its module cannot be imported.
    """
    return loading.own_function(
        task_id,
        TaskError,
        "Task",
        "Define one that returns a race.types.Task, for example with race.envs.factorised.",
    )


def takes_config(function: Callable[..., Any]) -> bool:
    """Whether a function wants an `EnvConfig`."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # one of those that cannot be known
        return False
    return any(
        parameter.default is parameter.empty
        and parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        for parameter in parameters
    )


def own_task(task_id: str, config: EnvConfig) -> AnyTask:
    """The task that a function of a module returns; see `race.envs.make_task`.

    Raises:
        TaskError: if there is no such function, or it fails or returns something else.
    """
    function = own_function(task_id)
    name = task_id.rpartition(":")[2]
    with blamed(TaskError, f"Task {task_id}: {name} failed"):
        task = function(config) if takes_config(function) else function()
    if not isinstance(task, Task | DiscreteTask):
        raise TaskError(
            f"Task {task_id}: {name} returned {contract.came(task)} instead of a "
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
        episode_limit: steps after which an episode ends at the latest. None: the limit that the
            environment was registered with. Training, tests and evaluation cut an episode off
            there (it is truncated, and bootstraps) if the environment has not ended it before;
            one that ends its episodes itself should do so at the same step, by `truncated`. The
            environment that ``make`` returns is not changed: stepped by hand, it goes on.

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


def _flat_box(space: Any, what: str, task: Name) -> gymnasium.spaces.Box:
    if isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1:
        return space
    raise TaskError(
        f"Task {task}: the {what} space must be a Box with one axis, and it is {space}. "
        "gymnasium.wrappers.FlattenObservation flattens observations; a task with discrete actions "
        "is a race.types.DiscreteTask, which race.envs.pymarl.pymarl_task makes."
    )

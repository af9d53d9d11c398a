"""PettingZoo environments as tasks: continuous or discrete, parallel or one agent after the other.

What an agent sees and does is turned into vectors and numbers here, and nobody else knows of
PettingZoo: what comes out is a gymnasium environment that goes through `race.envs.contract`.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from race import loading
from race.config.settings import EnvConfig
from race.envs.checked import takes
from race.envs.members import picked
from race.envs.pettingzoo import source
from race.envs.pettingzoo.environment import TeamEnv
from race.envs.pettingzoo.parallel import Other, Parallel
from race.envs.pettingzoo.source import PREFIX, packages
from race.envs.pettingzoo.states import own_state, refuse_large
from race.envs.pettingzoo.vectors import Sight
from race.errors import TaskError, blamed, of_task
from race.types import AnyTask, DiscreteSpec, DiscreteTask, EnvSpec, Name, Task

__all__ = ["PREFIX", "TeamEnv", "make_task", "packages", "parallel_task"]

_DEFAULT = EnvConfig()


def make_task(task_id: str, config: EnvConfig) -> AnyTask:
    """The task of an id such as ``pettingzoo:mpe2.simple_spread_v3``.

    Raises:
        TaskError: if there is no such environment, or it is none that can be learned.
    """
    name = task_id.removeprefix(PREFIX)
    source.maker(name)
    make = functools.partial(source.from_name, name, config.kwargs)
    return parallel_task(make, task_id, config)


def parallel_task(
    make: Callable[..., Any], task: Name | None = None, config: EnvConfig = _DEFAULT
) -> AnyTask:
    """A task out of a PettingZoo environment, parallel or AEC.

    Args:
        make: makes the environment: ``make()``, ``make(render_mode)`` or
            ``make(render_mode=...)``, such as ``simple_spread_v3.parallel_env``. Let it be a
            function of a module (or a `functools.partial` of one): worker processes import it by
            name.
        task: the name of the task; None: the environment's.
        config: who is the team, what it is paid, what the state is, the step limit and the largest
            observation; its ``kwargs`` are not read.

    Returns:
        A `Task` if the team's actions are boxes, a `DiscreteTask` if they are discrete. The state
        is the environment's own ``state()``, if there is one; a task with continuous actions
        appends what its agents observe. Otherwise, and where ``state()`` is nothing but that, it is
        what all agents observe, one after the other.

    Raises:
        TaskError: if the environment is none that can be learned, or its step limit is not known.
    """
    called = str(task or getattr(make, "__name__", "of yours"))
    how = f" with --env.kwargs {config.kwargs}" if called.startswith(PREFIX) else ""
    with blamed(TaskError, f"Task {called}: making its environment{how} failed"), of_task(called):
        env = source.made(make, None)
    try:
        name = task or str((getattr(env, "metadata", None) or {}).get("name", type(env).__name__))
        with blamed(TaskError, f"Task {name}: its environment failed"), of_task(name):
            return _task(make, env, name, config)
    finally:
        with contextlib.suppress(Exception, SystemExit):  # it would hide what was wrong before
            env.close()


def _task(make: Callable[..., Any], env: Any, name: str, config: EnvConfig) -> AnyTask:
    parallel = _parallel(env, config)
    limit = config.episode_limit or source.limit_of(parallel.env)
    if limit is None:
        raise TaskError(
            "after how many steps do its episodes end? It has no max_cycles that says so: name a "
            "number with --env.episode-limit (EnvConfig.episode_limit). Episodes are cut off "
            "(truncated) there."
        )
    for agent in parallel.team:
        refuse_large(parallel.sights[agent].size, f"the observation of {agent}", config)
    own = own_state(parallel, config)
    if own is None:
        for agent in parallel.others:
            refuse_large(parallel.sights[agent].size, f"the observation of {agent}", config)
    settled = dataclasses.replace(
        config,
        episode_limit=limit,
        state="observations" if own is None else "environment",
    )
    team = _team_env(name, parallel, own, settled)
    made = functools.partial(_make, make, name, own, settled)
    facts = (
        ("agent_names", [str(agent) for agent in parallel.team]),
        ("other_agents", [str(agent) for agent in parallel.others]),
        ("others_act", config.others if parallel.others else None),
        ("team_reward", config.team_reward),
        ("state_is", settled.state),
        ("env_kwargs", config.kwargs),
    )
    if isinstance(team.action_space, spaces.Box):
        sizes = [len(reach.low) for reach in parallel.moves.values()]  # type: ignore[union-attr]
        ends = np.cumsum(sizes)
        spec = EnvSpec(
            task=name,
            state_size=team.state_size,
            obs_index=team.obs_index(),
            action_index=[range(end - size, end) for size, end in zip(sizes, ends, strict=True)],
            action_low=team.action_space.low.tolist(),
            action_high=team.action_space.high.tolist(),
            episode_limit=limit,
        )
        return Task(spec, made, parallel.seeded, facts)
    sizes_only = DiscreteSpec(
        task=name,
        n_agents=len(parallel.team),
        obs_size=team.obs_size,
        state_size=team.state_size,
        n_actions=team.n_actions,
        episode_limit=limit,
    )
    return DiscreteTask(sizes_only, made, None, parallel.seeded, facts)


def _make(
    make: Callable[..., Any],
    name: str,
    own_state: Sight | None,
    config: EnvConfig,
    render_mode: str | None = None,
) -> TeamEnv:
    """The environment of a task whose settings are all settled."""
    env = source.made(make, render_mode)
    return _team_env(name, _parallel(env, config), own_state, config, render_mode)


def _team_env(
    name: str,
    parallel: Parallel,
    own_state: Sight | None,
    config: EnvConfig,
    render_mode: str | None = None,
) -> TeamEnv:
    assert config.episode_limit is not None
    return TeamEnv(
        parallel,
        task=name,
        own_state=own_state,
        team_reward=config.team_reward,
        episode_limit=config.episode_limit,
        render_mode=render_mode,
    )


def _parallel(env: Any, config: EnvConfig) -> Parallel:
    other: Other | None = None
    if config.others != "random":
        other = loading.own_function(
            config.others,
            TaskError,
            "--env.others",
            "Define one that takes (agent, observation, action_space, random) and returns an "
            "action.",
        )
        if not takes(other, None, None, None, None):
            raise TaskError(
                f"--env.others {config.others} takes other arguments: let it be a function of "
                "(agent, observation, action_space, random) that returns an action."
            )
    found = source.opened(env)
    team = functools.partial(picked, patterns=config.agents)
    parallel = Parallel(found.env, team, other, turns=found.turns)
    if other is not None and not parallel.others:
        raise TaskError(
            f"--env.others {config.others} has no effect: all agents are the team. Pick those that "
            f"are with --env.agents, out of {', '.join(map(str, parallel.agents))}, or leave it "
            "out."
        )
    return parallel

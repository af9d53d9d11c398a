"""What the entries of states, observations and actions are called, for people."""

import contextlib
from collections.abc import Iterator
from itertools import chain
from typing import Any, Final, NamedTuple

import gymnasium

from race.envs import jaxmarl, starcraft
from race.envs.pettingzoo import TeamEnv
from race.envs.pettingzoo.vectors import Choices, Sight, leaves, named
from race.errors import TaskError
from race.types import AnyTask, DiscreteSpec, EnvSpec

_POSITIONS: Final = {0: ("x", "y", "z", "qw", "qx", "qy", "qz"), 1: ("qw", "qx", "qy", "qz")}
_VELOCITIES: Final = {0: ("vx", "vy", "vz", "wx", "wy", "wz"), 1: ("wx", "wy", "wz")}
"""Of free and of ball joints, by their numbers in MuJoCo; others have one of each."""


class Layout(NamedTuple):
    """Names of entries, in their order; empty texts where nothing is known of one."""

    agents: tuple[str, ...]
    state: tuple[str, ...]
    obs: tuple[tuple[str, ...], ...]
    """Of each agent, without padding."""
    actions: tuple[tuple[str, ...], ...]
    """Of each agent: entries of its action, or what it has to choose from."""


def layout(task_id: str, task: AnyTask) -> Layout:
    """The names of a task's entries.

    Args:
        task_id: its id.
        task: the task, one environment of which is made and closed.

    Raises:
        TaskError: if its environment fails.
    """
    if task_id.startswith("micro/"):
        from race.envs.micro import naming  # imports jax

        return Layout(*naming.names(task_id.removeprefix("micro/")))
    env: Any = task.make(None)
    try:
        if isinstance(env, TeamEnv):
            return _of_team(env)
        if starcraft.is_game(task_id):
            return _of_game(task_id, env)
        if task_id.startswith("mamujoco/"):
            state, moved = _of_robot(env)
        elif task_id.startswith(jaxmarl.PREFIX) and env.names is not None:
            shown, *each = env.names
            return Layout(
                tuple(env.team_names), tuple(shown), *(tuple(map(tuple, one)) for one in each)
            )
        else:
            state, moved = _flattened(env), []
    finally:
        with contextlib.suppress(Exception, SystemExit):
            env.close()
    return _of_spec(task, state, moved)


def _of_spec(task: AnyTask, state: list[str], moved: list[str]) -> Layout:
    spec = task.spec
    if not isinstance(spec, EnvSpec):
        each = ("",) * spec.obs_size, ("",) * spec.n_actions
        agents = tuple(f"agent {number}" for number in range(spec.n_agents))
        agents = tuple(dict(task.facts).get("agent_names", agents))
        return Layout(
            agents, ("",) * spec.state_size, (each[0],) * len(agents), (each[1],) * len(agents)
        )
    agents = tuple(f"agent {number}" for number in range(spec.n_agents))
    state += [""] * (spec.state_size - len(state))
    moved += [""] * (spec.joint_action_size - len(moved))
    return Layout(
        agents,
        tuple(state),
        tuple(tuple(state[entry] for entry in agent) for agent in spec.obs_index),
        tuple(tuple(moved[entry] for entry in agent) for agent in spec.action_index),
    )


def _of_game(task_id: str, env: Any) -> Layout:
    sizes: DiscreteSpec = env.sizes
    package, _, map_name = task_id.partition("/")
    if package == "smac":
        from race.envs.micro import naming  # imports jax

        with contextlib.suppress(TaskError):  # not one of those that micro/* has
            found = Layout(*naming.names(map_name))
            if (len(found.state), len(found.obs[0])) == (sizes.state_size, sizes.obs_size):
                return found
    state, obs, actions = starcraft.names(env)
    agents = tuple(f"agent {number}" for number in range(sizes.n_agents))
    return Layout(agents, state, (obs,) * len(agents), (actions,) * len(agents))


def _of_team(env: TeamEnv) -> Layout:
    parallel = env.parallel
    obs = {agent: tuple(sight.names()) for agent, sight in parallel.sights.items()}
    own, shown = env.own_state_names, parallel.team
    if own is None:
        own, shown = [], parallel.agents
    elif not isinstance(env.action_space, gymnasium.spaces.Box):
        shown = []
    seen = [f"{agent}: {name}" for agent in shown for name in obs[agent]]
    actions = []
    for agent, move in parallel.moves.items():
        if isinstance(move, Choices):
            actions.append(tuple(move.names()))
        else:
            space = parallel.env.action_space(agent)
            actions.append(tuple(Sight(space, "the action").names()))
    return Layout(
        tuple(map(str, parallel.team)),
        (*(f"state{name}" for name in own), *seen),
        tuple(obs[agent] for agent in parallel.team),
        tuple(actions),
    )


def _flattened(env: Any) -> list[str]:
    """Names of what gymnasium's FlattenObservation made one array of; nothing without one."""
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, gymnasium.wrappers.FlattenObservation):
            space = env.env.observation_space
            if any(named(leaf.path) for leaf in leaves(space)):
                return Sight(space, "the observation").names()
            return []
        env = env.env
    return []


def _of_robot(env: Any) -> tuple[list[str], list[str]]:
    """Names of a robot's observation and action, from its model; fewer where it does not tell."""
    import mujoco

    inner = env.unwrapped
    model = inner.model

    def name(kind: Any, number: int) -> str:
        return str(mujoco.mj_id2name(model, kind, number) or number)

    joints = [name(mujoco.mjtObj.mjOBJ_JOINT, number) for number in range(model.njnt)]
    kinds = model.jnt_type.tolist()
    position = _of_joints(joints, kinds, _POSITIONS, "position")
    velocity = _of_joints(joints, kinds, _VELOCITIES, "velocity")
    bodies = [name(mujoco.mjtObj.mjOBJ_BODY, number) for number in range(1, model.nbody)]
    structure: dict[str, int] = getattr(inner, "observation_structure", None) or {}
    found: list[str] = []
    for key, size in structure.items():
        if key == "qpos":
            found += position[structure.get("skipped_qpos", 0) :]
        elif key == "qvel":
            found += velocity
        elif key != "skipped_qpos" and size and size % len(bodies) == 0:
            each = range(size // len(bodies))
            found += [f"{body}: {key}[{entry}]" for body in bodies for entry in each]
        elif key != "skipped_qpos":
            found += [f"{key}[{entry}]" for entry in range(size)]
    moved = [joints[joint] for joint in model.actuator_trnid[:, 0].tolist()]
    return found, moved


def _of_joints(
    joints: list[str], kinds: list[int], names: dict[int, tuple[str, ...]], plain: str
) -> list[str]:
    def each(joint: str, kind: int) -> Iterator[str]:
        yield from (f"{joint} {part}" for part in names.get(kind, (plain,)))

    return list(chain.from_iterable(map(each, joints, kinds)))

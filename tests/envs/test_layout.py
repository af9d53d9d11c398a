"""Names of entries, against the simulators themselves."""

import functools
from typing import Any

import gymnasium
import numpy as np
import pettingzoo_games as games
import pytest

from race.config.settings import EnvConfig
from race.envs import factorised, make_task, task_ids
from race.envs.layout import Layout, layout
from race.envs.pettingzoo import parallel_task
from race.types import AnyTask, Task


def fits(task: AnyTask, names: Layout) -> bool:
    spec = task.spec
    sizes = (len(names.agents), len(names.state), len(names.obs), len(names.actions))
    if isinstance(task, Task):
        each = [*map(len, names.obs)], [*map(len, names.actions)]
        assert each == ([*task.spec.obs_sizes], [*task.spec.action_sizes])
    return sizes == (spec.n_agents, spec.state_size, spec.n_agents, spec.n_agents)


@pytest.mark.parametrize("robot", ["HalfCheetah-2x3", "Ant-4x2", "Humanoid-9x8", "Reacher-2x1"])
def test_names_of_robots_are_those_of_their_joints(robot: str) -> None:
    import mujoco

    task = make_task(f"mamujoco/{robot}")
    names = layout(f"mamujoco/{robot}", task)
    assert fits(task, names)
    env: Any = task.make(None)
    state, _ = env.reset(seed=0)
    for _ in range(3):
        state, *_ = env.step(env.action_space.sample())
    model, data = env.unwrapped.model, env.unwrapped.data

    def joint(name: str) -> int:
        return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)

    looked_at = 0
    for entry, name in enumerate(names.state):
        what, _, kind = name.rpartition(" ")
        if kind == "position":
            assert state[entry] == data.qpos[model.jnt_qposadr[joint(what)]]
        elif kind == "velocity":
            assert state[entry] == data.qvel[model.jnt_dofadr[joint(what)]]
        else:
            continue
        looked_at += 1
    assert looked_at >= {"Reacher-2x1": 0}.get(robot, 16)
    # An agent moves the joints that it sees.
    for obs, actions in zip(names.obs, names.actions, strict=True):
        assert robot == "Reacher-2x1" or {n.rpartition(" ")[0] for n in obs} == set(actions)
    env.close()


MAPS = [name for name in task_ids() if name.startswith("micro/")]
FEW = ("micro/3m", "micro/MMM2")


@pytest.mark.parametrize(
    "name", [pytest.param(m, marks=[] if m in FEW else pytest.mark.slow) for m in MAPS]
)
def test_names_of_battles_have_their_sizes(name: str) -> None:
    task = make_task(name)
    names = layout(name, task)
    assert fits(task, names)
    spec: Any = task.spec
    assert {len(obs) for obs in names.obs} == {spec.obs_size}
    assert {len(choices) for choices in names.actions} == {spec.n_actions}


def test_names_of_a_battle_say_what_is_there() -> None:
    task = make_task("micro/2s3z")
    names = layout("micro/2s3z", task)
    env = task.make(None)
    seen, _ = env.reset(seed=0)
    for agent, who in enumerate(names.agents):
        told = dict(zip(names.obs[agent], seen["obs"][agent].tolist(), strict=True))
        assert told["own health"] == told["own shield"] == 1
        assert [n for n in told if n.startswith("own is") and told[n]] == [f"own is {who[3:]}"]
        for other, unit in enumerate(n for n in names.agents if n != who):
            if told[f"other agent {other}: in sight"]:
                assert told[f"other agent {other}: is {unit[3:]}"] == 1
        for number, way in enumerate(("north", "south", "east", "west")):
            assert told[f"can go {way}"] == seen["avail_actions"][agent][2 + number]
    state = dict(zip(names.state, seen["state"].tolist(), strict=True))
    assert state["agent 0 (Stalker): health"] == state["enemy 4 (Zealot): shield"] == 1
    assert state["agent 0 (Stalker): x"] < 0 < state["enemy 0 (Stalker): x"]
    env.close()


def test_names_of_pettingzoo_s_agents() -> None:
    names = layout("x", parallel_task(games.Masked))
    assert names.agents == ("big", "small")
    assert names.obs == (("[0]", "[1]", "[2]"), ("observation[0]", "observation[1]"))
    assert names.state[:4] == ("big: [0]", "big: [1]", "big: [2]", "small: observation[0]")
    assert names.actions[0][:2] == ("(0, 5)", "(0, 6)")
    assert names.actions[1] == ("1", "2", "3", "4")
    task = parallel_task(games.WithState, None, EnvConfig(agents="small"))
    assert fits(task, layout("x", task))
    assert layout("x", task).state == ("state[0,0]", "state[0,1]", "small: [0]", "small: [1]")


class Rooms(gymnasium.Env[Any, Any]):
    observation_space = gymnasium.spaces.Dict(
        {"speed": gymnasium.spaces.Box(-1, 1, (2,)), "room": gymnasium.spaces.Discrete(3)}
    )
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))


def flattened(render_mode: str | None) -> Any:
    return gymnasium.wrappers.FlattenObservation(Rooms())


def test_names_of_flattened_observations() -> None:
    made = functools.partial(
        factorised, obs_index=[(0, 3), (4,)], action_index=[(1,), (0,)], task="x", episode_limit=3
    )
    task = made(flattened)
    names = layout("x", task)
    assert names.state == ("room[is 0]", "room[is 1]", "room[is 2]", "speed[0]", "speed[1]")
    assert names.obs == (("room[is 0]", "speed[0]"), ("speed[1]",))
    seen = flattened(None).observation({"speed": np.array([0.5, 0.0]), "room": 2})
    assert [n for n, v in zip(names.state, seen, strict=True) if v] == ["room[is 2]", "speed[0]"]


@pytest.mark.parametrize("name", ["probe/target", "probe/matching"])
def test_tasks_without_names(name: str) -> None:
    task = make_task(name)
    assert fits(task, layout(name, task))
    assert not any(layout(name, task).state)

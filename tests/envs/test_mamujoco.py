import contextlib
import io
import sys
import warnings

import mujoco
import numpy as np
import pytest

from race.config.settings import EnvConfig
from race.envs import make_task
from race.envs.mamujoco import KNOWN_PARTITIONS, quiet
from race.errors import ConfigError, TaskError

LIBRARY = EnvConfig(library_observation=True)

# id: observation entries, action entries, state entries, action limit.
PAPER_TASKS = {
    "HalfCheetah-2x3": ((6, 6), (3, 3), 17, 1.0),
    "HalfCheetah-6x1": ((2,) * 6, (1,) * 6, 17, 1.0),
    "Ant-2x4": ((8, 8), (4, 4), 105, 1.0),
    "Ant-2x4d": ((8, 8), (4, 4), 105, 1.0),
    "Ant-4x2": ((4,) * 4, (2,) * 4, 105, 1.0),
    "Hopper-3x1": ((2,) * 3, (1,) * 3, 11, 1.0),
    "Humanoid-9x8": ((18, 16), (9, 8), 348, 0.4),
    "HumanoidStandup-9x8": ((18, 16), (9, 8), 348, 0.4),
}


def reference(name: str, config: EnvConfig):
    """The library's own multi-agent environment, through its public interface."""
    with contextlib.redirect_stderr(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from gymnasium_robotics import mamujoco_v1

        # Or mujoco writes what it thinks of HalfCheetah's model into the current directory.
        mujoco.set_mju_user_warning(lambda message: None)
        scenario, partition = name.split("-")
        options = {"agent_obsk": 0, "local_categories": [["qpos", "qvel"]], "global_categories": ()}
        env = mamujoco_v1.parallel_env(
            scenario,
            partition.replace("9x8", "9|8"),
            **({} if config.library_observation else options),
        )
        mujoco.set_mju_user_warning(None)
        return env


@pytest.mark.parametrize("name", PAPER_TASKS)
def test_spec_of_paper_tasks(name):
    spec = make_task(f"mamujoco/{name}").spec
    obs_sizes, action_sizes, state_size, limit = PAPER_TASKS[name]
    assert spec.task == f"mamujoco/{name}"
    assert (spec.obs_sizes, spec.action_sizes) == (obs_sizes, action_sizes)
    assert spec.state_size == state_size
    assert spec.episode_limit == 1000
    np.testing.assert_array_equal(np.float32(spec.action_high), np.float32(limit))
    np.testing.assert_array_equal(np.float32(spec.action_low), -np.float32(limit))


@pytest.mark.parametrize(
    ("name", "config"),
    [
        *((name, EnvConfig()) for name in PAPER_TASKS),
        ("HalfCheetah-2x3", LIBRARY),
        ("Ant-4x2", LIBRARY),
        ("Reacher-2x1", LIBRARY),  # its observation is no part of the state
        ("Walker2d-2x3", EnvConfig()),  # the state clips the velocities, the observation does not
    ],
)
def test_equals_the_reference_to_the_bit(name, config):
    task = make_task(f"mamujoco/{name}", config)
    spec, env, other = task.spec, task.make(None), reference(name, config)
    rng = np.random.default_rng(3)
    state, _ = env.reset(seed=7)
    observations, _ = other.reset(seed=7)
    for _ in range(40):
        for agent, index in zip(other.possible_agents, spec.obs_index, strict=True):
            np.testing.assert_array_equal(state[list(index)], observations[agent])
        # Each agent's action, padded to the largest agent as the policies give them.
        padded = rng.uniform(-1, 1, (spec.n_agents, spec.action_size)).astype(np.float32)
        padded *= np.float32(spec.action_high[0])
        joint = padded.reshape(-1)[spec.joint_gather]
        # float64, as the reference passes actions on: control costs are computed in their type.
        state, reward, terminated, truncated, _ = env.step(joint.astype(np.float64))
        observations, rewards, terminations, truncations, _ = other.step(
            {
                agent: padded[i, : spec.action_sizes[i]]
                for i, agent in enumerate(other.possible_agents)
            }
        )
        assert {reward} == set(rewards.values())
        assert {terminated} == set(terminations.values())
        assert {truncated} == set(truncations.values())
        if terminated:
            state, _ = env.reset(seed=8)
            observations, _ = other.reset(seed=8)
    env.close()
    other.close()


def test_library_observation_sees_neighbours_and_torso():
    assert make_task("mamujoco/HalfCheetah-2x3", LIBRARY).spec.obs_sizes == (12, 12)


def test_last_category_repeats_for_farther_joints():
    def sizes(*categories: tuple[str, ...]) -> tuple[int, ...]:
        config = EnvConfig(agent_obsk=2, local_categories=categories)
        return make_task("mamujoco/HalfCheetah-6x1", config).spec.obs_sizes

    # Agent 2 is the back foot, at the end of the row of joints: it sees foot, shin and thigh.
    both, position = ("qpos", "qvel"), ("qpos",)
    assert sizes(both)[2] == 6
    assert sizes(both, position)[2] == 4
    assert sizes(both, position) == sizes(both, position, position)


def test_augmented_state_begins_with_the_original_one():
    task = make_task("mamujoco/Reacher-2x1")
    state, _ = task.make(None).reset(seed=1)
    assert task.spec.state_size == 10 + sum(task.spec.obs_sizes) == len(state)
    assert min(min(index) for index in task.spec.obs_index) == 10
    # The library's Reacher shows sine and cosine of the agent's angle; so does the state.
    sine, cosine, _velocity = state[list(task.spec.obs_index[0])]
    assert {sine, cosine} == {state[2], state[0]}


@pytest.mark.parametrize(
    "name", [f"{s}-{p}" for s, partitions in KNOWN_PARTITIONS.items() for p in partitions]
)
def test_every_listed_task_steps(name):
    task = make_task(f"mamujoco/{name}")
    env = task.make(None)
    state, _ = env.reset(seed=0)
    assert state.shape == (task.spec.state_size,)
    middle = np.add(task.spec.action_low, task.spec.action_high).astype(np.float32) / 2
    assert np.isfinite(env.step(middle)[0]).all()
    assert env.spec.max_episode_steps == task.spec.episode_limit


def test_order_of_joints_of_the_same_name_is_fixed():
    # Two joints of Pusher share a name, and the library orders them by their address in memory.
    task = make_task("mamujoco/Pusher-3p")
    for _ in range(20):
        state, _ = task.make(None).reset(seed=0)
        velocities = state[list(task.spec.obs_index[0])][1::2]
        np.testing.assert_array_equal(velocities, state[[7 + 2, 7 + 0, 7 + 1]])


def test_time_limit_is_kept():
    env = make_task("mamujoco/Reacher-2x1").make(None)
    env.reset(seed=0)
    ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(50)]
    assert ends == [(False, False)] * 49 + [(False, True)]


def test_both_spellings_of_the_humanoid_partition():
    assert make_task("mamujoco/Humanoid-9|8").spec == make_task("mamujoco/Humanoid-9x8").spec


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("mamujoco/HalfCheeta-2x3", "mamujoco/HalfCheetah-2x3"),
        ("mamujoco/Ant-2x5", "mamujoco/Ant-2x4"),
        ("mamujoco/Hopper", "mamujoco/Hopper-3x1"),
        ("mamujoco/ManySegmentAnt-0x2", "mamujoco/ManySegmentAnt-3x2"),
    ],
)
def test_unknown_task_names_the_nearest(name, nearest):
    with pytest.raises(TaskError, match=nearest):
        make_task(name)


def test_unknown_category_is_named():
    with pytest.raises(ConfigError, match="qpoz"):
        make_task("mamujoco/Ant-2x4", EnvConfig(local_categories=(("qpoz",),)))


def test_nothing_is_printed(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_task("mamujoco/HalfCheetah-2x3").make(None).reset(seed=0)
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []  # mujoco writes its log into the current directory


def observed(task, env):
    """What each agent sees of the robot as it stands."""
    augmented = getattr(env, "observation", lambda state: state)
    state = augmented(env.unwrapped._get_obs())
    return [state[list(index)] for index in task.spec.obs_index]


def seeing(task):
    """By moving it, which agents see each actuator's joint; and each joint of the root."""
    env = task.make(None)
    env.reset(seed=0)
    robot, model = env.unwrapped, env.unwrapped.model
    position, velocity = robot.data.qpos.copy(), np.linspace(-0.5, 0.5, model.nv)
    robot.set_state(position, velocity)
    before = observed(task, env)

    def seen_at(address, speed):
        found = []
        for moved_position, moved_velocity in ((address, None), (None, speed)):
            there, fast = position.copy(), velocity.copy()
            if moved_position is not None:
                there[moved_position] += 0.05
            else:
                fast[moved_velocity] += 0.05
            robot.set_state(there, fast)
            pairs = enumerate(zip(before, observed(task, env), strict=True))
            found.append({agent for agent, (a, b) in pairs if not np.array_equal(a, b)})
        return found

    joints = model.actuator_trnid[:, 0]
    by_actuator = [seen_at(model.jnt_qposadr[j], model.jnt_dofadr[j]) for j in joints]
    others = sorted(set(range(model.njnt)) - set(joints.tolist()))
    by_root = [seen_at(model.jnt_qposadr[j], model.jnt_dofadr[j]) for j in others]
    env.close()
    return by_actuator, by_root


@pytest.mark.parametrize(
    "name",
    [
        *(f"{s}-{p}" for s, partitions in KNOWN_PARTITIONS.items() for p in partitions),
        *("ManySegmentAnt-2x1", "ManySegmentAnt-5x1", "ManySegmentSwimmer-3x3"),
    ],
)
def test_who_moves_a_joint_and_nobody_else_sees_it(name):
    task = make_task(f"mamujoco/{name}")
    by_actuator, by_root = seeing(task)
    for agent, actuators in enumerate(task.spec.action_index):
        for actuator in actuators:
            assert by_actuator[actuator] == [{agent}, {agent}], (agent, actuator)
    # The library shows each agent of the short Swimmer one of the root's velocities on purpose.
    shown = {(0, 1): {0}, (1, 1): {1}} if name == "Swimmer-2x1" else {}
    for joint, found in enumerate(by_root):
        for kind, agents in enumerate(found):
            assert agents == shown.get((joint, kind), set())


def test_segments_of_the_long_ant_see_their_neighbours_hips():
    config = EnvConfig(agent_obsk=1)
    by_actuator, _ = seeing(make_task("mamujoco/ManySegmentAnt-4x1", config))
    # Of each segment hip, ankle, hip, ankle; hips hang on those of the segments before and behind.
    for actuator, (position, velocity) in enumerate(by_actuator):
        segment, is_hip = actuator // 4, actuator % 2 == 0
        near = {segment - 1, segment, segment + 1} & set(range(4)) if is_hip else {segment}
        assert position == velocity == near, actuator


def test_a_mujoco_that_is_not_imported_is_told_with_what_was_asked_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(TaskError, match=r"runs on \(MUJOCO_GL is 'osmesa'"), quiet():
        pass
    monkeypatch.delenv("MUJOCO_GL")
    with pytest.raises(TaskError, match="runs on: "), quiet():
        pass

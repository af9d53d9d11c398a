import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from race.envs import make_task
from race.envs.probe import (
    COORDINATION_BEST,
    COORDINATION_LOCAL,
    LAST,
    LIMIT,
    PROBES,
    ChainEnv,
    CoordinationEnv,
    TargetEnv,
)
from race.errors import RenderError, TaskError

UNIT = st.floats(-1, 1, width=32)


def episode(task_id: str, seed: int, act):
    """States, rewards and the way the episode ended."""
    env = make_task(task_id).make(None)
    state, _ = env.reset(seed=seed)
    states, rewards = [state], []
    terminated = truncated = False
    while not (terminated or truncated):
        state, reward, terminated, truncated, _ = env.step(act(state))
        states.append(state)
        rewards.append(reward)
    return np.array(states), rewards, terminated


@pytest.mark.parametrize("task_id", PROBES)
def test_spaces_fit_the_spec_and_seeds_repeat(task_id):
    task = make_task(task_id)
    env = task.make(None)
    assert env.observation_space.shape == (task.spec.state_size,)
    assert env.action_space.shape == (task.spec.joint_action_size,)

    def act(state):
        return np.full(task.spec.joint_action_size, 0.3, np.float32)

    states, rewards, _ = episode(task_id, 5, act)
    again, rewards_again, _ = episode(task_id, 5, act)
    np.testing.assert_array_equal(states, again)
    assert rewards == rewards_again
    assert len(rewards) == task.spec.episode_limit
    assert all(env.observation_space.contains(state) for state in states)


def test_target_is_met_by_the_optimal_action_only():
    states, rewards, terminated = episode("probe/target", 1, TargetEnv.optimal_action)
    assert terminated
    assert rewards == [0.0] == [PROBES["probe/target"].optimal_return]
    off = np.array([0.1, 0.0, -0.2], np.float32)
    _, rewards, _ = episode("probe/target", 1, lambda x: TargetEnv.optimal_action(x) + off)
    assert rewards == [pytest.approx(-0.05, rel=1e-5)]
    assert not np.array_equal(states, episode("probe/target", 2, TargetEnv.optimal_action)[0])


@given(st.lists(UNIT, min_size=4, max_size=4), st.lists(UNIT, min_size=2, max_size=2))
def test_target_of_an_agent_depends_on_its_own_observation(state, other):
    x = np.array(state, np.float32)
    best = TargetEnv.optimal_action(x)
    assert np.abs(best).max() < 0.9
    first, second = x.copy(), x.copy()
    first[2:], second[:2] = other, other
    np.testing.assert_array_equal(TargetEnv.optimal_action(first)[:2], best[:2])
    np.testing.assert_array_equal(TargetEnv.optimal_action(second)[2:], best[2:])


def test_chain_pays_at_the_end_what_its_q_says():
    first, second = np.array([0.5, 0.1], np.float32), np.array([0.4, -0.2], np.float32)
    states, rewards, terminated = episode(
        "probe/chain", 0, lambda state: second if state[0] else first
    )
    assert terminated
    np.testing.assert_allclose(states[:2], [[0, 0], [1, 0.3]], rtol=1e-6)
    assert rewards == [0.0, pytest.approx(1 + 0.3 - 0.1, rel=1e-6)]
    assert ChainEnv.optimal_q(states[1], second, 0.9) == pytest.approx(rewards[1])
    # From the start: the best second action is 0, which is worth 1.3 a step later.
    assert ChainEnv.optimal_q(states[0], first, 0.9) == pytest.approx(0.9 * 1.3)
    _, rewards, _ = episode("probe/chain", 0, lambda state: np.full(2, 1 - state[0], np.float32))
    assert sum(rewards) == PROBES["probe/chain"].optimal_return


def test_time_limit_truncates_and_hides_the_time():
    states, rewards, terminated = episode("probe/time-limit", 0, lambda _: np.zeros(2, np.float32))
    assert (rewards, terminated) == ([1.0] * LIMIT, False)
    assert (states == 1).all()


def test_terminates_shows_what_is_left():
    states, rewards, terminated = episode("probe/terminates", 0, lambda _: np.zeros(2, np.float32))
    assert (rewards, terminated) == ([1.0] * LAST, True)
    np.testing.assert_allclose(states[:, 0], np.arange(LAST, -1, -1) / LAST)


def test_coordination_has_no_way_out_alone():
    moves = np.linspace(-1, 1, 401)
    local, best = COORDINATION_LOCAL, COORDINATION_BEST
    for agent in (0, 1):
        actions = np.full((len(moves), 2), local[0])
        actions[:, agent] = moves
        rewards = CoordinationEnv.reward(actions)
        assert rewards.max() == pytest.approx(local[1])
        assert moves[rewards.argmax()] == pytest.approx(local[0])
    grid = np.stack(np.meshgrid(moves, moves), axis=-1).reshape(-1, 2)
    rewards = CoordinationEnv.reward(grid)
    assert rewards.max() == pytest.approx(best[1])
    assert best[1] > local[1]
    np.testing.assert_allclose(grid[rewards.argmax()], best[0])


def test_probes_cannot_be_rendered():
    with pytest.raises(RenderError, match="no picture"):
        make_task("probe/chain").make("rgb_array")


def test_unknown_probe():
    with pytest.raises(TaskError, match="probe/coordination"):
        make_task("probe/cordination")

import functools
import multiprocessing
import os
import signal
import subprocess
import sys
import time

import gymnasium
import numpy as np
import pytest

from race.envs import factorised, make_task
from race.envs.contract import in_units
from race.errors import DivergenceError, EnvFailedError, HandedOverError
from race.rollouts.beginnings import beginnings
from race.rollouts.host import collect
from race.rollouts.pool import EnvPool


class Countdown(gymnasium.Env):
    """Ends after 2 + seed steps: terminated for even seeds, truncated for odd ones.

    State: seed, steps made. Reward: 10 * seed + the step's number. Remembers the actions.
    """

    def __init__(self, fail_at: int = -1):
        self.observation_space = gymnasium.spaces.Box(-100, 100, (2,), np.float64)
        self.action_space = gymnasium.spaces.Box(
            np.array([-0.4, 1.0], np.float32), np.array([0.4, 4.0], np.float32)
        )
        self.fail_at = fail_at
        self.actions = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        # AsyncVectorEnv resets without a seed once an episode has ended.
        self.seed, self.count = 0 if seed is None else seed, 0
        return np.array([self.seed, 0.0]), {}

    def step(self, action):
        self.count += 1
        self.actions.append(action)
        if self.count == self.fail_at:
            raise OSError("the motor is on fire")
        over, even = self.count == 2 + self.seed, self.seed % 2 == 0
        reward = 10.0 * self.seed + self.count
        return np.array([self.seed, self.count]), reward, over and even, over and not even, {}


def countdown(fail_at, render_mode):
    return Countdown(fail_at)


def countdown_task(make=None):
    return factorised(
        make or functools.partial(countdown, -1),
        obs_index=[(0,), (1,)],
        action_index=[(0,), (1,)],
        task="countdown",
        episode_limit=9,
    )


def zeros(states, tick):
    return np.zeros((len(states), 2))


SEEDS = np.array([0, 2, 1])


def check_countdown(rollout):
    """Two, four and three steps, by tick and then team; worked out by hand."""
    state, _, reward, terminated, next_state = rollout.transitions
    seeds = [0, 2, 1, 0, 2, 1, 2, 1, 2]
    steps = [0, 0, 0, 1, 1, 1, 2, 2, 3]
    np.testing.assert_array_equal(state, np.transpose([seeds, steps]))
    np.testing.assert_array_equal(next_state, np.transpose([seeds, np.array(steps) + 1]))
    np.testing.assert_array_equal(reward, [1, 21, 11, 2, 22, 12, 23, 13, 24])
    np.testing.assert_array_equal(terminated, [0, 0, 0, 1, 0, 0, 0, 0, 1])
    np.testing.assert_array_equal(rollout.episode_return, [3, 90, 36])
    np.testing.assert_array_equal(rollout.episode_length, [2, 4, 3])
    assert {array.dtype for array in rollout.transitions} == {np.dtype(np.float32)}
    assert rollout.episode_return.dtype == np.float64


def test_unequal_lengths_order_and_ends():
    with EnvPool(countdown_task(), 3, processes=False) as pool:
        check_countdown(collect(pool, zeros, SEEDS))


def test_act_sees_every_teams_state_and_the_tick():
    seen = []

    def act(states, tick):
        seen.append((tick, states))
        return zeros(states, tick)

    with EnvPool(countdown_task(), 3, processes=False) as pool:
        collect(pool, act, SEEDS)
    assert [tick for tick, _ in seen] == [0, 1, 2, 3]
    # Kept arrays are not overwritten, and the states of ended teams stay at the end.
    np.testing.assert_array_equal(
        [s[:, 1] for _, s in seen], [[0] * 3, [1] * 3, [2] * 3, [2, 3, 3]]
    )
    assert all(states.dtype == np.float32 for _, states in seen)


def test_max_ticks_cuts_without_terminating():
    with EnvPool(countdown_task(), 3, processes=False) as pool:
        rollout = collect(pool, zeros, SEEDS, max_ticks=1)
        assert rollout.transitions.reward.tolist() == [1, 21, 11]
        assert rollout.transitions.terminated.tolist() == [0, 0, 0]
        assert rollout.episode_length.tolist() == [1, 1, 1]
        assert len(collect(pool, zeros, SEEDS, max_ticks=0).transitions.reward) == 0
        check_countdown(collect(pool, zeros, SEEDS, max_ticks=100))  # no trace of the cut episodes


def test_each_team_may_be_cut_by_itself():
    with EnvPool(countdown_task(), 3, processes=False) as pool:
        rollout = collect(pool, zeros, SEEDS, max_ticks=np.array([9, 1, 0]))
        assert rollout.transitions.reward.tolist() == [1, 21, 2]
        assert rollout.transitions.terminated.tolist() == [0, 0, 1]
        assert rollout.team.tolist() == [0, 1, 0]
        assert rollout.episode_length.tolist() == [2, 1, 0]


def test_beginnings_of_episodes():
    """Of two steps: team 0 ends with its second, the others go on; worked out by hand."""
    with EnvPool(countdown_task(), 3, processes=False) as pool:
        rollout = collect(pool, zeros, SEEDS)
    found = beginnings(rollout, 3, 2, 0.5)
    assert found.rewards.tolist() == [1 + 0.5 * 2, 21 + 0.5 * 22, 11 + 0.5 * 12]
    assert found.weight.tolist() == [0, 0.25, 0.25]
    assert found.state.tolist() == [[0, 2], [2, 2], [1, 2]]
    # Of more than there are: what there is.
    found = beginnings(rollout, 3, 4, 0.5)
    assert found.rewards[0] == 2
    assert found.rewards[2] == 11 + 6 + 13 / 4
    assert found.weight.tolist() == [0, 0, 0.125]


def test_arrays_grow(monkeypatch):
    monkeypatch.setattr("race.rollouts.host._FIRST_ROWS", 1)
    with EnvPool(countdown_task(), 3, processes=False) as pool:
        check_countdown(collect(pool, zeros, SEEDS))


def test_fewer_seeds_than_environments():
    with EnvPool(countdown_task(), 3, processes=False) as pool:
        rollout = collect(pool, zeros, SEEDS[:1])
        assert rollout.episode_return.tolist() == [3]
        with pytest.raises(ValueError, match="3 environments, but 4 were"):
            collect(pool, zeros, np.arange(4))


def test_actions_are_clipped_stored_and_mapped_to_units():
    envs = []

    def make(render_mode):
        envs.append(Countdown())
        return envs[-1]

    actions = np.array([[1.0, -1.0], [-7.0, 0.0]], np.float32)
    with EnvPool(countdown_task(make), 2, processes=False) as pool:
        rollout = collect(pool, lambda states, tick: actions, SEEDS[:2], max_ticks=1)
    np.testing.assert_array_equal(rollout.transitions.action, [[1, -1], [-1, 0]])
    first, second = (env.actions for env in envs if env.actions)
    np.testing.assert_array_equal(first, np.array([[0.4, 1.0]], np.float32))
    np.testing.assert_array_equal(second, np.array([[-0.4, 2.5]], np.float32))


def test_units_are_exact_products_around_zero_and_stay_inside_elsewhere():
    rng = np.random.default_rng(0)
    actions = np.concatenate([rng.uniform(-1, 1, (1000, 2)), [[1, 1], [-1, -1]]]).astype(np.float32)
    low, high = np.float32([-0.4, 0.1]), np.float32([0.4, 0.7])
    units = in_units(actions, low, high)
    assert units.dtype == np.float32
    np.testing.assert_array_equal(units[:, 0], actions[:, 0] * np.float32(0.4))
    assert (units >= low).all()
    assert (units <= high).all()
    np.testing.assert_array_equal(units[-2:], [high, low])
    np.testing.assert_allclose(units[:, 1], 0.4 + 0.3 * actions[:, 1], rtol=1e-5)


def test_action_that_is_not_finite():
    def act(states, tick):
        actions = np.zeros((3, 2))
        actions[0] = np.nan if tick == 2 else 0.0  # team 0 has ended by then
        actions[1] = np.inf if tick == 3 else 0.0
        return actions

    with (
        EnvPool(countdown_task(), 3, processes=False) as pool,
        pytest.raises(DivergenceError, match="at step 3"),
    ):
        collect(pool, act, SEEDS)


def test_what_is_not_finite_is_refused_where_it_enters():
    class Odd(Countdown):
        def step(self, action):
            state, reward, *rest = super().step(action)
            state = state * (np.array([1.0, np.nan]) if self.count == 2 and self.seed == 2 else 1.0)
            return state, reward, *rest

    told = (
        "countdown broke the contract at step 2 of the episode of seed 2 .environment 1.: entry 1"
    )
    with (
        EnvPool(countdown_task(lambda render_mode: Odd()), 3, processes=False) as pool,
        pytest.raises(HandedOverError, match=told),
    ):
        collect(pool, zeros, SEEDS)


def test_actions_of_a_wrong_shape():
    with (
        EnvPool(countdown_task(), 1, processes=False) as pool,
        pytest.raises(ValueError, match=r"\(1, 3\) instead of \(1, 2\)"),
    ):
        collect(pool, lambda states, tick: np.zeros((1, 3)), SEEDS[:1])


def test_failing_environment_names_the_task():
    task = countdown_task(functools.partial(countdown, 3))
    with (
        EnvPool(task, 3, processes=False) as pool,
        pytest.raises(EnvFailedError, match=r"countdown.*step 3.*environment 1.*OSError.*on fire"),
    ):
        collect(pool, zeros, SEEDS)


@pytest.mark.parametrize("task_id", ["probe/target", "mamujoco/Hopper-3x1"])
def test_seeds_decide_everything(task_id):
    task = make_task(task_id)
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1, 1, (50, 3, task.spec.joint_action_size))

    def run(seeds):
        with EnvPool(task, 3, processes=False) as pool:
            collect(pool, lambda states, tick: actions[-1], seeds + 9, max_ticks=4)
            return collect(pool, lambda states, tick: actions[tick], seeds, max_ticks=50)

    first, again, other = run(SEEDS), run(SEEDS), run(SEEDS + 1)
    for a, b in zip(first.transitions, again.transitions, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(first.episode_return, again.episode_return)
    assert not np.array_equal(first.transitions.state[:3], other.transitions.state[:3])
    # Each team's return is the sum of its own rewards.
    team = [t for tick in range(50) for t in range(3) if tick < first.episode_length[t]]
    sums = np.bincount(team, first.transitions.reward)
    np.testing.assert_allclose(first.episode_return, sums, rtol=1e-5)


def test_processes_only_where_they_can_pay():
    with EnvPool(make_task("probe/target"), 2) as pool:
        assert not pool.processes


@pytest.mark.slow
@pytest.mark.parametrize("task_id", ["probe/terminates", "mamujoco/Hopper-3x1"])
def test_processes_change_nothing(task_id):
    task = make_task(task_id)
    actions = np.random.default_rng(2).uniform(-1, 1, (1000, 3, task.spec.joint_action_size))
    rollouts = []
    for processes in (False, True):
        with EnvPool(task, 3, processes) as pool:
            for seeds in (SEEDS, SEEDS[:2] + 7):
                n = len(seeds)

                def act(states, tick, n=n):
                    return actions[tick, :n]

                rollouts.append(collect(pool, act, seeds))
    for here, there in zip(rollouts[:2], rollouts[2:], strict=True):
        for a, b in zip(here.transitions, there.transitions, strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(here.episode_return, there.episode_return)
        np.testing.assert_array_equal(here.episode_length, there.episode_length)
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_processes_with_ends_of_all_kinds_and_an_own_module():
    with EnvPool(countdown_task(), 3, processes=True) as pool:
        check_countdown(collect(pool, zeros, SEEDS))
        collect(pool, zeros, SEEDS, max_ticks=1)
        check_countdown(collect(pool, zeros, SEEDS))
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_failure_in_a_process_names_the_task():
    with (
        EnvPool(countdown_task(functools.partial(countdown, 3)), 2, processes=True) as pool,
        pytest.raises(
            EnvFailedError, match=r"countdown.*OSError.*on fire, in .*test_host.py, line"
        ),
    ):
        collect(pool, zeros, SEEDS[:2])
    assert not multiprocessing.active_children()


INTERRUPTED = """
import numpy as np
from race.envs import make_task
from race.rollouts.host import collect
from race.rollouts.pool import EnvPool

if __name__ == "__main__":
    with EnvPool(make_task("mamujoco/HumanoidStandup-9x8"), 2, processes=True) as pool:
        pool.reset({0: 0, 1: 1})
        print(*(worker.process_id for worker in pool._workers.values()), flush=True)
        while True:
            collect(pool, lambda states, tick: np.zeros((2, 17)), np.array([0, 1]))
"""


@pytest.mark.slow
def test_ctrl_c_leaves_no_process(tmp_path):
    script = tmp_path / "interrupted.py"
    script.write_text(INTERRUPTED)
    with subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        workers = [int(pid) for pid in process.stdout.readline().split()]
        assert len(workers) == 2
        time.sleep(0.5)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to every process of the group
        _, errors = process.communicate(timeout=20)
    assert process.returncode != 0
    assert errors.rstrip().endswith("KeyboardInterrupt")
    assert errors.count("Traceback") == 1
    for pid in workers:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)

"""The probes with discrete actions: both versions of the rules, and the answers."""

import itertools
import pickle
import subprocess
import sys
from functools import cache, partial
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.envs.discrete_probe import PROBES, make_task
from race.envs.discrete_probe.host import ProbeHost
from race.envs.discrete_probe.rules import CLIMB_PAYOFFS
from race.errors import RenderError, TaskError

MATCHING, MEMORY, CLIMB, LIVES = PROBES


@cache
def functions(task_id: str) -> tuple[Any, Any]:
    """Reset and step on the device, compiled."""
    device = make_task(task_id).device
    assert device is not None
    env = device()
    return jax.jit(partial(env.reset, env.arrays)), jax.jit(partial(env.step, env.arrays))


class Moment(NamedTuple):
    """What was to be seen, what was done, what it brought. The last moment has no deed."""

    seen: dict[str, Any]
    actions: Any = None
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    won: bool = False


class Device:
    """Steps the functions with the keys that the protocol says."""

    def __init__(self, task_id: str, seed: int) -> None:
        self.do_reset, self.do_step = functions(task_id)
        self.key = jax.random.key(seed)

    def now(self) -> Any:
        self.key, now = jax.random.split(self.key)
        return now

    def reset(self) -> dict[str, Any]:
        self.env_state, observation = self.do_reset(self.now())
        return {name: np.asarray(part) for name, part in observation._asdict().items()}

    def step(self, actions: Any) -> tuple[dict[str, Any], Any]:
        self.env_state, observation, outcome = self.do_step(self.env_state, actions, self.now())
        return {name: np.asarray(part) for name, part in observation._asdict().items()}, outcome


def play(task_id: str, seed: int, act: Any) -> list[Moment]:
    """An episode on the device; ``act(seen, moment) -> actions [N]``."""
    env, moments = Device(task_id, seed), []
    seen, over = env.reset(), False
    while not over:
        actions = np.asarray(act(seen, len(moments)), np.int32)
        after, outcome = env.step(actions)
        over = bool(outcome.terminated | outcome.truncated)
        moments.append(Moment(seen, actions, *(part.item() for part in outcome)))
        seen = after
    return [*moments, Moment(seen)]


def episode_return(moments: list[Moment]) -> float:
    return sum(moment.reward for moment in moments)


def random_choice(rng: np.random.Generator, seen: dict[str, Any]) -> Any:
    return np.array([rng.choice(np.flatnonzero(row)) for row in seen["avail_actions"]])


def follow(seen: dict[str, Any], moment: int) -> Any:
    """Agents of ``probe/lives`` that do what they see."""
    return np.where(seen["obs"][:, 0] > 0, 1 + seen["obs"][:, 2], 0)


@pytest.mark.parametrize("legal", [True, False])
@pytest.mark.parametrize("task_id", PROBES)
def test_host_and_device_are_the_same_task(task_id: str, legal: bool) -> None:
    task = make_task(task_id)
    env = task.make(None)
    n, rng = task.spec.n_agents, np.random.default_rng(0)
    for seed in range(12):
        device = Device(task_id, seed)
        for repeat in range(2):  # without a seed, the stream of keys goes on
            observed, _ = env.reset(seed=seed if repeat == 0 else None)
            seen = device.reset()
            over, steps = False, 0
            while not over:
                assert env.observation_space.contains(observed)
                assert [part.dtype for part in seen.values()] == [np.float32, np.float32, bool]
                for name, part in seen.items():
                    np.testing.assert_allclose(observed[name], part, rtol=1e-6, err_msg=name)
                wild = rng.integers(-1, task.spec.n_actions + 1, n)
                actions = random_choice(rng, seen) if legal else wild
                observed, reward, terminated, truncated, info = env.step(actions)
                seen, outcome = device.step(actions.astype(np.int32))
                assert reward == pytest.approx(float(outcome.reward), rel=1e-6)
                assert (terminated, truncated) == (outcome.terminated, outcome.truncated)
                assert info.get("battle_won", False) == outcome.won
                assert ("battle_won" in info) == task.spec.has_wins
                assert not (legal and info["refused"].any())
                over, steps = terminated or truncated, steps + 1
            for name, part in seen.items():
                np.testing.assert_allclose(observed[name], part, rtol=1e-6, err_msg=name)
            assert steps <= task.spec.episode_limit


@pytest.mark.parametrize("task_id", PROBES)
def test_seeds_repeat_and_differ(task_id: str) -> None:
    def seen(seed: int) -> Any:
        env = make_task(task_id).make(None)
        return np.concatenate([env.reset(seed=seed)[0]["state"] for _ in range(2)]).tolist()

    assert seen(3) == seen(3) == seen(3 + 2**32)
    assert len({tuple(seen(seed)) for seed in range(8)}) > 1 or task_id == CLIMB


@pytest.mark.parametrize("task_id", PROBES)
def test_environments_without_a_seed_draw_one(task_id: str) -> None:
    envs = [ProbeHost(task_id), ProbeHost(task_id)]
    keys = []
    for env in envs:
        env.reset()
        keys.append(jax.random.key_data(env._key).tolist())
    assert keys[0] != keys[1]


@pytest.mark.parametrize("task_id", PROBES)
def test_functions_can_be_mapped_and_go_on_after_the_end(task_id: str) -> None:
    task = make_task(task_id)
    assert task.device is not None
    spec, env = task.spec, task.device()
    keys = jax.random.split(jax.random.key(1), 3)

    @jax.jit
    def run(arrays: Any, keys: Any) -> Any:
        def one_step(env_state: Any, key: Any) -> Any:
            actions = jnp.ones((3, spec.n_agents), jnp.int32)
            step = jax.vmap(env.step, in_axes=(None, 0, 0, 0))
            env_state, *seen = step(arrays, env_state, actions, jax.random.split(key, 3))
            return env_state, seen

        env_state, _ = jax.vmap(env.reset, in_axes=(None, 0))(arrays, keys)
        return jax.lax.scan(one_step, env_state, jax.random.split(jax.random.key(2), 7))

    env_state, (observation, outcome) = run(env.arrays, keys)
    assert observation.obs.shape == (7, 3, spec.n_agents, spec.obs_size)
    assert observation.state.shape == (7, 3, spec.state_size)
    assert observation.avail_actions.shape == (7, 3, spec.n_agents, spec.n_actions)
    assert outcome.reward.shape == outcome.terminated.shape == outcome.won.shape == (7, 3)
    assert outcome.reward.dtype == jnp.float32
    leaves = jax.tree.leaves((env_state, observation, outcome))
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert observation.avail_actions.any(axis=-1).all()
    assert outcome.terminated[spec.episode_limit - 1 :].all()
    # A row of the batch is what a run alone gives.
    alone_reset, alone_step = functions(task_id)
    alone, _ = alone_reset(keys[2])
    for moment, key in enumerate(jax.random.split(jax.random.key(2), 7)):
        actions = np.ones(spec.n_agents, np.int32)
        alone, *seen = alone_step(alone, actions, jax.random.split(key, 3)[2])
        row = jax.tree.map(lambda x, t=moment: x[t, 2], [observation, outcome])
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), seen, row)


def best_of_all(task_id: str, seed: int) -> tuple[float, set[tuple[int, ...]]]:
    """The highest return of any sequence of available joint actions, and the last ones of these."""
    spec = make_task(task_id).spec
    joint = list(itertools.product(range(spec.n_actions), repeat=spec.n_agents))
    if task_id == LIVES:  # what is done changes nothing of what follows: each step by itself
        total, sequences = 0.0, [[actions] * spec.episode_limit for actions in joint]
        plays = [play(task_id, seed, lambda _, t, s=s: s[t]) for s in sequences]
        for moments in zip(*plays, strict=True):
            total += max(moment.reward for moment in moments)
        return total, set()
    returns: dict[Any, float] = {}
    for sequence in itertools.product(joint, repeat=spec.episode_limit):
        moments = play(task_id, seed, lambda _, t, s=sequence: s[t])
        legal = [
            m.seen["avail_actions"][np.arange(spec.n_agents), m.actions].all() for m in moments[:-1]
        ]
        if all(legal):
            returns[sequence] = episode_return(moments)
    best = max(returns.values())
    return best, {s[-1] for s, value in returns.items() if value == best}


@pytest.mark.parametrize("task_id", PROBES)
def test_no_actions_are_worth_more_than_the_optimal_return(task_id: str) -> None:
    for seed in range(3):
        best, last = best_of_all(task_id, seed)
        assert best == pytest.approx(PROBES[task_id].optimal_return)
        assert len(last) == (0 if task_id == LIVES else 1)


def test_matching_is_solved_by_what_an_agent_sees() -> None:
    for seed in range(10):
        moments = play(MATCHING, seed, lambda seen, _: seen["obs"].argmax(axis=1))
        assert [m.reward for m in moments[:-1]] == [PROBES[MATCHING].optimal_return]
        right = moments[0].actions
        np.testing.assert_array_equal(moments[0].seen["state"].reshape(2, 4), np.eye(4)[right])
        wrong = moments[0].seen["avail_actions"][1] & (np.arange(4) != right[1])
        for action in np.flatnonzero(wrong):
            half = play(MATCHING, seed, lambda *_, a=(right[0], action): a)
            assert half[0].reward == 0.5


def test_matching_blocks_half_of_the_wrong_actions_and_no_right_one() -> None:
    reset, _ = functions(MATCHING)
    _, seen = jax.vmap(reset)(jax.random.split(jax.random.key(0), 2000))
    obs, available = np.asarray(seen.obs), np.asarray(seen.avail_actions)
    assert (obs.sum(axis=-1) == 1).all()
    np.testing.assert_allclose(obs.mean(axis=0), 0.25, atol=0.05)
    # The agents' cues are independent: so are all pairs of them.
    pairs = np.einsum("bi,bj->ij", obs[:, 0], obs[:, 1]) / len(obs)
    np.testing.assert_allclose(pairs, 1 / 16, atol=0.03)
    assert available[obs > 0].all()
    np.testing.assert_allclose(available[obs == 0].mean(), 0.5, atol=0.03)


def one_seed_per_pair_of_cues() -> dict[tuple[int, ...], int]:
    seeds: dict[tuple[int, ...], int] = {}
    for seed in range(40):
        state = Device(MEMORY, seed).reset()["state"]
        seeds.setdefault(tuple(state[:4].reshape(2, 2).argmax(axis=1).tolist()), seed)
    assert len(seeds) == 4
    return seeds


def test_memory_is_solved_by_remembering_one_s_own_cue() -> None:
    for cues, seed in one_seed_per_pair_of_cues().items():
        remembered: list[Any] = []

        def act(seen: dict[str, Any], moment: int, remembered: Any = remembered) -> Any:
            remembered.append(seen["obs"][:, :2].argmax(axis=1))
            return remembered[0] * (moment == 2)

        moments = play(MEMORY, seed, act)
        assert tuple(remembered[0].tolist()) == cues
        assert [m.reward for m in moments] == [0, 0, PROBES[MEMORY].optimal_return, 0]
        assert [m.won for m in moments] == [False, False, True, False]
        assert [m.terminated for m in moments[:-1]] == [False, False, True]


def test_memory_shows_no_cue_after_the_start() -> None:
    seeds = one_seed_per_pair_of_cues()
    for act in (lambda *_: [0, 0], lambda _, t: [t != 1, t != 1]):
        episodes = {cues: play(MEMORY, seed, act) for cues, seed in seeds.items()}
        for cues, moments in episodes.items():
            np.testing.assert_array_equal(moments[0].seen["obs"][:, :2], np.eye(2)[list(cues)])
            for time in range(4):
                seen = moments[time].seen
                np.testing.assert_allclose(seen["obs"][:, 2], time / 3, rtol=1e-6)
                assert time == 0 or (seen["obs"][:, :2] == 0).all()
                # Nor do the masks; only at the middle step is there no choice, so that the
                # action just done tells nothing at the last one.
                expected = [[True, time != 1]] * 2
                np.testing.assert_array_equal(seen["avail_actions"], expected)


def test_memory_without_memory_is_chance() -> None:
    seeds = one_seed_per_pair_of_cues()
    # At the last moment all see the same, so what forgets is one joint action or a mixture.
    for joint in itertools.product((0, 1), repeat=2):
        rewards = [
            episode_return(play(MEMORY, seed, lambda _, t, j=joint: j if t != 1 else (0, 0)))
            for seed in seeds.values()
        ]
        assert sorted(rewards) == [0.0, 0.5, 0.5, 1.0]


def test_memory_is_won_by_both_or_not_at_all() -> None:
    for cues, seed in one_seed_per_pair_of_cues().items():
        moments = play(MEMORY, seed, lambda _, t, c=cues: [c[0], 1 - c[1]] if t != 1 else [0, 0])
        assert (moments[2].reward, moments[2].won) == (0.5, False)


def test_climb_pays_by_rows_of_the_first_agent() -> None:
    payoffs = np.array(
        [[play(CLIMB, 0, lambda *_, a=(i, j): a)[0].reward for j in range(3)] for i in range(3)]
    )
    assert payoffs[0, 2] == -0.25
    assert payoffs[2, 0] == 0.0
    np.testing.assert_array_equal(payoffs, CLIMB_PAYOFFS)


def test_climb_is_safe_at_2_and_best_at_0() -> None:
    payoffs = np.array(CLIMB_PAYOFFS)
    assert np.argwhere(payoffs == payoffs.max()).tolist() == [[0, 0]]
    assert payoffs[0, 0] == PROBES[CLIMB].optimal_return
    # From the safe joint action no agent gains alone, and moving on to 0 costs both.
    assert payoffs[2, 2] > max(payoffs[2, :2].max(), payoffs[:2, 2].max())
    for partner in (0, 1):
        assert payoffs.mean(axis=partner).argmax() == 2


def test_lives_is_worth_the_share_of_steps_left() -> None:
    lengths = set()
    for seed in range(12):
        moments = play(LIVES, seed, follow)
        length = len(moments) - 1
        lengths.add(length)
        assert [m.terminated for m in moments[:-1]] == [False] * (length - 1) + [True]
        np.testing.assert_allclose([m.reward for m in moments[:-1]], 1 / length, rtol=1e-6)
        assert episode_return(moments) == pytest.approx(PROBES[LIVES].optimal_return)
        for time, moment in enumerate(moments):
            np.testing.assert_allclose(moment.seen["state"][-2:], [time / 5, length / 5], rtol=1e-6)
    assert lengths == {3, 4, 5}


def test_lives_ends_for_one_agent_after_the_other() -> None:
    for seed in range(6):
        for time, moment in enumerate(play(LIVES, seed, follow)):
            for agent in range(3):
                obs, available = moment.seen["obs"][agent], moment.seen["avail_actions"][agent]
                if time <= agent:
                    assert obs[0] == 1
                    assert obs[1] + obs[2] == 1
                    assert obs[3] == np.float32(time / 5)
                    assert available.tolist() == [False, True, True]
                else:
                    assert (obs == 0).all()
                    assert available.tolist() == [True, False, False]
                np.testing.assert_array_equal(
                    moment.seen["state"][3 * agent : 3 * agent + 3], obs[:3]
                )


@pytest.mark.parametrize(
    ("wrong", "pays"), [(0, [2 / 3, 1, 1]), (1, [2 / 3, 1 / 2, 1]), (2, [2 / 3, 1 / 2, 0])]
)
def test_lives_pays_the_share_of_the_living(wrong: int, pays: list[float]) -> None:
    def act(seen: dict[str, Any], moment: int) -> Any:
        right = follow(seen, moment)
        right[wrong] = 3 - right[wrong] if right[wrong] > 0 else 0
        return right

    for seed in range(6):
        rewards = [m.reward for m in play(LIVES, seed, act)[:-1]]
        expected = [*pays, 1, 1][: len(rewards)]
        np.testing.assert_allclose(np.multiply(rewards, len(rewards)), expected, rtol=1e-6)


def test_lives_draws_cues_of_its_own_at_each_moment() -> None:
    cues = np.array(
        [
            [moment.seen["obs"][2, 2] for moment in play(LIVES, seed, follow)[:3]]
            for seed in range(60)
        ]
    )
    assert {tuple(row) for row in cues.tolist()} == set(itertools.product((0.0, 1.0), repeat=3))


def test_tasks_travel_to_other_processes() -> None:
    for task_id in PROBES:
        task = pickle.loads(pickle.dumps(make_task(task_id)))
        assert task.spec == make_task(task_id).spec
        assert task.make(None).reset(seed=1)[0]["obs"].shape == (
            task.spec.n_agents,
            task.spec.obs_size,
        )


def test_listing_the_probes_does_not_import_jax() -> None:
    code = "import sys, race.envs.discrete_probe as d; d.make_task('probe/lives'); "
    subprocess.run([sys.executable, "-c", code + "assert 'jax' not in sys.modules"], check=True)


def test_mistakes_are_told() -> None:
    with pytest.raises(TaskError, match="probe/climb"):
        make_task("probe/clim")
    with pytest.raises(RenderError, match="no picture"):
        make_task(CLIMB).make("rgb_array")
    host = ProbeHost(LIVES)
    with pytest.raises(gymnasium.error.ResetNeeded):
        host.step([1, 1, 1])
    host.seed(0)
    host.reset()
    with pytest.raises(TaskError, match=r"Agent 1 .* action 0"):
        host.step([1, 0, 2])

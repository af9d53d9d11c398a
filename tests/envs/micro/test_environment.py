"""Battles behind gymnasium's interface."""

import functools
import re
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from chosen import MAPS
from gymnasium.utils.env_checker import check_env

from race.envs import make_continuous_task, make_discrete_task, make_task
from race.envs.micro import Battle, load_map, make
from race.envs.micro.battle import FIRST_TARGET, NORTH, STOP, WEST
from race.envs.micro.environment import MicroEnv
from race.errors import RenderError, TaskError

LIMIT = 4
DUEL = f"""
description = "two Marines on each side, in reach of each other"
episode_limit = {LIMIT}
enemy_order = {{ kind = "hold" }}
allies = [{{ unit = "Marine", count = 2, at = [14.0, 16.0] }}]
enemies = [{{ unit = "Marine", count = 2, at = [18.0, 16.0] }}]
"""


@functools.cache
def duel(directory: Path) -> Battle:
    (directory / "duel.toml").write_text(DUEL)
    return make(str(directory / "duel.toml"))


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Battle:
    return duel(tmp_path_factory.mktemp("maps"))


SHOOT = np.array([FIRST_TARGET, FIRST_TARGET + 1])


def same(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def battle_of(env: Any, seed: int | None, actions: np.ndarray = SHOOT) -> list[Any]:
    steps = [env.reset(seed=seed)]
    while len(steps) == 1 or not steps[-1][2]:
        steps.append(env.step(actions))
    return steps


# Boxes without bounds are meant; the last is about environments that gymnasium has registered.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.* value is")
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_gymnasiums_checks_pass(played: Battle, render_mode: str | None) -> None:
    check_env(MicroEnv(played, render_mode))


def test_battles_are_those_of_the_functions(played: Battle) -> None:
    env = MicroEnv(played)
    key = jax.random.key(7)
    for seed in (7, None):  # without a seed the stream of keys goes on
        steps = battle_of(env, seed)
        key, now = jax.random.split(key)
        env_state, observation = played.reset(now)
        expected = observation._asdict()
        same(steps[0], (expected, {}))
        for observed, reward, terminated, truncated, info in steps[1:]:
            key, now = jax.random.split(key)
            env_state, timestep = played.step(env_state, SHOOT.astype(np.int32), now)
            same(observed, timestep.observation._asdict())
            assert (reward, terminated) == (float(timestep.reward), bool(timestep.terminated))
            assert not truncated
            same(info, timestep.info._asdict())
        assert env_state.steps == len(steps) - 1


def test_seeds_decide_battles_and_pictures_do_not(played: Battle) -> None:
    env, drawn = MicroEnv(played), MicroEnv(played, "rgb_array")
    first = battle_of(env, 1)
    second = battle_of(env, None)
    same(first, battle_of(env, 1))
    same(second, battle_of(env, None))
    same(first, battle_of(env, 1 + 2**32))
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, atol=1e-5), first, battle_of(drawn, 1)
    )
    other = battle_of(env, 2)
    assert any(
        not np.array_equal(one[0]["state"], two[0]["state"])
        for one, two in zip(first, other, strict=True)
    )
    # Two environments that were given no seed draw one each.
    keys = []
    for _ in range(2):
        fresh = MicroEnv(played)
        fresh.reset()
        keys.append(jax.random.key_data(fresh._key).tolist())
    assert keys[0] != keys[1]


def test_the_time_limit_terminates(played: Battle) -> None:
    steps = battle_of(MicroEnv(played), 0, np.full(2, STOP))
    assert len(steps) == LIMIT + 1
    _, _, terminated, truncated, info = steps[-1]
    assert (terminated, truncated, info["timed_out"], info["battle_won"]) == (
        True,
        False,
        True,
        False,
    )


def test_observations_and_facts_fit_their_spaces(played: Battle) -> None:
    env = MicroEnv(played)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert observation["avail_actions"][:, NORTH:].all()
    assert not observation["avail_actions"][:, 0].any()  # only the dead do nothing
    observation, _, _, _, info = env.step(np.array([0, WEST]))
    assert env.observation_space.contains(observation)
    assert info["refused"].tolist() == [True, False]
    for wild in ([-1, 99], [2**40, WEST]):
        assert env.step(np.array(wild))[4]["refused"][0]


def test_after_the_end_nothing_changes(played: Battle) -> None:
    env = MicroEnv(played, "rgb_array")
    battle_of(env, 0)
    picture = env.render()
    observation, reward, terminated, _, _ = env.step(SHOOT)
    assert (reward, terminated) == (0.0, True)
    np.testing.assert_array_equal(env.render(), picture)
    assert env.observation_space.contains(observation)


def test_pictures_follow_the_battle(played: Battle) -> None:
    env = MicroEnv(played, "rgb_array")
    env.reset(seed=0)
    start = env.render()
    assert start is not None
    assert start.dtype == np.uint8
    assert start.shape[2] == 3
    np.testing.assert_array_equal(start, env.render())
    env.step(SHOOT)
    after = env.render()
    assert not np.array_equal(start, after)
    env.reset(seed=0)
    np.testing.assert_array_equal(start, env.render())  # nothing is left of the battle before
    assert MicroEnv(played).render() is None


def test_misuse_is_refused(played: Battle) -> None:
    env = MicroEnv(played, "rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(SHOOT)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    env.reset(seed=0)
    for wrong in (np.array([1]), np.array([[1, 1]]), np.array([1.0, 1.0])):
        with pytest.raises(TaskError, match="2 in all"):
            env.step(wrong)
    with pytest.raises(RenderError, match="rgb_array"):
        MicroEnv(played, "human")


@pytest.mark.parametrize("name", MAPS)
def test_sizes_are_known_before_a_map_is_built(name: str) -> None:
    spec = make_discrete_task(f"micro/{name}").spec
    shape = make(name).shape
    assert spec.task == f"micro/{name}"
    assert (spec.n_agents, spec.n_actions) == (shape.n_allies, shape.n_actions)
    assert (spec.obs_size, spec.state_size) == (shape.obs_size, shape.state_size)
    assert spec.episode_limit == load_map(name).episode_limit


def test_a_map_of_ones_own_is_a_task(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(DUEL)
    task = make_discrete_task(f"micro/{tmp_path / 'mine.toml'}")
    env: Any = task.make(None)
    observation, _ = env.reset(seed=0)
    spec = task.spec
    assert observation["obs"].shape == (spec.n_agents, spec.obs_size)
    assert observation["state"].shape == (spec.state_size,)
    assert observation["avail_actions"].shape == (spec.n_agents, spec.n_actions)
    assert env.action_space.nvec.tolist() == [spec.n_actions] * spec.n_agents


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("micro/2s3y", "2s3z"),
        ("micro/nowhere.toml", "cannot be read"),
        ("2s3z", "micro/2s3z"),
        ("mamujoco/Hopper-3x1", "race.envs.make_task"),
    ],
)
def test_other_tasks_are_refused(task: str, message: str) -> None:
    with pytest.raises(TaskError, match=re.escape(message)):
        make_discrete_task(task)


def test_a_battle_is_a_task_like_others() -> None:
    assert make_task("micro/2s3z").spec == make_discrete_task("micro/2s3z").spec
    with pytest.raises(TaskError, match="discrete actions"):
        make_continuous_task("micro/2s3z")
    with pytest.raises(TaskError, match="3s5z"):
        make_task("micro/3s5x")
    with pytest.raises(TaskError, match="micro/2s3z"):
        make_task("2s3z")

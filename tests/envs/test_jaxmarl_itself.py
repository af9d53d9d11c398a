"""JaxMARL's own environments, where it is installed."""

import dataclasses
import importlib.metadata
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.algorithms.base import Teams
from race.cli import main
from race.config.presets import resolve
from race.config.settings import Config, EnvConfig, FacmacConfig
from race.config.shape import shape_of
from race.envs import make_task
from race.envs.jaxmarl import source
from race.envs.layout import layout
from race.errors import TaskError
from race.learners.facmac import new_encoder
from race.rollouts import device
from race.rollouts.episodes import Part

pytestmark = [
    pytest.mark.slow,
    # It says that there is a second version of it.
    pytest.mark.filterwarnings("ignore:OvercookedV2 is now:DeprecationWarning"),
]
pytest.importorskip("jaxmarl", reason="pip install 'race-marl[jaxmarl]'")


@pytest.fixture(autouse=True)
def as_jax_comes() -> Iterator[None]:
    """JaxMARL promotes ranks and types as JAX does unless told otherwise."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


NAMES = [
    *("SMAX/2s3z", "SMAX/3m", "SMAX/smacv2_5_units", "SMAX"),
    *("MPE/simple_spread_v3", "MPE/simple_tag_v3", "MPE/simple_speaker_listener_v4"),
    *("MPE/simple_reference_v3", "overcooked/cramped_room", "overcooked_v2"),
    *("switch_riddle", "coin_game", "hanabi"),
]


@pytest.mark.parametrize("name", NAMES)
def test_episodes_are_those_that_jaxmarl_plays(name: str) -> None:
    config = EnvConfig(episode_limit=20 if name == "hanabi" else None)
    task: Any = make_task(f"jaxmarl:{name}", config)
    env, theirs = task.make(None), source.made(name, "{}")
    rng = np.random.default_rng(0)
    seen = env.reset(seed=5)[0]
    key, now = jax.random.split(jax.random.key(5))
    shown, state = theirs.reset(jax.random.key_data(now))
    over, steps, total = False, 0, 0.0
    while not over:
        for i, agent in enumerate(theirs.agents):
            own = np.ravel(np.asarray(shown[agent], np.float32))
            np.testing.assert_allclose(seen["obs"][i, : own.size], own, rtol=1e-4, atol=1e-5)
            assert not seen["obs"][i, own.size :].any()
        masks = seen["avail_actions"]
        assert masks.any(axis=1).all()
        action = np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])
        chosen = {agent: jnp.int32(action[i]) for i, agent in enumerate(theirs.agents)}
        key, now = jax.random.split(key)
        shown, state, gain, dones, _ = theirs.step(jax.random.key_data(now), state, chosen)
        seen, reward, terminated, truncated, info = env.step(action)
        paid = np.mean([float(np.ravel(gain[agent])[0]) for agent in theirs.agents])
        assert reward == pytest.approx(paid, rel=1e-4, abs=1e-5)
        over, steps, total = terminated or truncated, steps + 1, total + reward
        assert terminated or bool(dones["__all__"]) <= truncated
        if name.startswith("SMAX/"):  # as JaxMARL's own wrapper tells wins
            assert info["battle_won"] == (reward >= 1)
    assert steps <= task.spec.episode_limit
    assert (steps == task.spec.episode_limit) or terminated


def test_names_are_those_of_what_is_shown() -> None:
    task: Any = make_task("jaxmarl:SMAX/2s3z")
    names, env = layout("jaxmarl:SMAX/2s3z", task), task.make(None)
    assert names.agents == tuple(f"ally_{i}" for i in range(5))
    assert len(names.state) == task.spec.state_size
    assert {len(obs) for obs in names.obs} == {task.spec.obs_size}
    assert {len(actions) for actions in names.actions} == {task.spec.n_actions}
    seen = env.reset(seed=1)[0]
    own, state = dict(zip(names.obs[3], seen["obs"][3], strict=True)), names.state
    assert own["own health"] == own["ally_0: health"] == 1
    assert own["own unit_type_bit_3"] == own["ally_4: unit_type_bits_3"] == 1  # zealots
    assert own["ally_0: unit_type_bits_2"] == 1  # a stalker
    whole = dict(zip(state, seen["state"], strict=True))
    assert (whole["enemy_4: team"], whole["enemy_4: type"], whole["ally_0: team"]) == (1, 3, 0)
    # Moves go where they are called.
    for name, axis, sign in (("north", 1, 1), ("east", 0, 1), ("south", 1, -1), ("west", 0, -1)):
        env.reset(seed=1)
        actions = np.full(5, names.actions[0].index("stop"))
        actions[0] = names.actions[0].index(name)
        after = dict(zip(state, env.step(actions)[0]["state"], strict=True))
        place = f"ally_0: position_{'xy'[axis]}"
        assert np.sign(after[place] - whole[place]) == sign
    # An enemy can be attacked once it is near: the nearest first.
    env.reset(seed=1)
    for _ in range(8):
        seen = env.step(np.full(5, names.actions[0].index("east")))[0]
        shown = dict(zip(state, seen["state"], strict=True))
        near = seen["avail_actions"][0]
        at = np.array([shown[f"ally_0: position_{c}"] for c in "xy"])
        for k, name in enumerate(names.actions[0]):
            if name.startswith("attack") and shown["ally_0: health"] > 0:
                enemy = name.removeprefix("attack ")
                there = np.array([shown[f"{enemy}: position_{c}"] for c in "xy"])
                reach = shown[f"{enemy}: health"] > 0 and np.linalg.norm(there - at) < 6
                assert bool(near[k]) == reach


@pytest.mark.parametrize("name", ["SMAX/3m", "MPE/simple_spread_v3"])
def test_device_and_host_play_alike(name: str) -> None:
    task: Any = make_task(f"jaxmarl:{name}")
    spec = task.spec
    config = resolve(Config(spec.task, facmac=FacmacConfig(hidden_size=3)), discrete=True)
    encoder = new_encoder(jax.random.key(0), spec, shape_of(config))
    heads = 3.0 * jax.random.normal(jax.random.key(1), (4, spec.n_agents, 4, spec.n_actions))
    seeds = np.arange(4, dtype=np.uint32)
    parts = [Part(Teams(encoder, heads), seeds, None)]
    (found,) = device.play(task.device(), parts, spec, "float32")
    env = task.make(None)
    for team, seed in enumerate(seeds.tolist()):
        env.reset(seed=seed)
        total, terminated = 0.0, False
        length = int(found.episodes.length[team])
        for action in np.asarray(found.episodes.action[team, :length]):
            _, reward, terminated, _, info = env.step(action)
            total += reward
        assert float(found.episode_return[team]) == pytest.approx(total, rel=1e-3, abs=1e-3)
        assert bool(found.episodes.terminated[team, length - 1]) == terminated
        assert bool(found.won[team]) == (info["battle_won"] and spec.has_wins)


def test_a_run_on_the_device_from_the_shell(tmp_path: Path) -> None:
    path = tmp_path / "run"
    small = ["--facmac.hidden-size", "8", "--facmac.batch-size", "4"]
    words = ["train", "jaxmarl:SMAX/3m", "--env-steps", "900", "--run-dir", str(path), *small]
    main([*words, "--evaluation.every", "400", "--evaluation.episodes", "4", "--env.normalise"])
    rows = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    assert any("eval/marl/win_rate" in row for row in rows)
    told = json.loads((path / "metadata.json").read_text())
    assert importlib.metadata.version("jaxmarl") in json.dumps(told)
    main(["evaluate", str(path), "--episodes", "4"])
    main(["export", str(path), "--out", str(tmp_path / "team.safetensors")])
    main(["describe", "jaxmarl:SMAX/3m"])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("storm", "nothing by the name of agent 0"),
        ("MPE/simple_facmac_v1", "Discrete"),
        ("hanabi", r"--env\.episode-limit"),
        ("SMAX/2s4z", "jaxmarl:SMAX/2s3z"),
    ],
)
def test_what_cannot_be_learned_is_told(name: str, words: str) -> None:
    with pytest.raises(TaskError, match=words):
        make_task(f"jaxmarl:{name}")


def test_a_picked_team_and_arguments() -> None:
    config = dataclasses.replace(EnvConfig(), agents="adversary_*", kwargs='{"max_steps": 7}')
    task: Any = make_task("jaxmarl:MPE/simple_tag_v3", config)
    assert (task.spec.n_agents, task.spec.episode_limit) == (3, 7)
    env = task.make(None)
    env.reset(seed=0)
    ends = [env.step(np.zeros(3, int))[2:4] for _ in range(7)]
    assert ends == [(False, False)] * 6 + [(False, True)]

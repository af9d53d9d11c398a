"""One step: compiled, vectorised or plain; refused actions, after the end; compiled programs."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray
from reels import STEPS, at, busiest, likeliest, reel

from race.envs import micro
from race.envs.micro import EnvState, Timestep, battle, make, map_names, smac
from race.envs.micro.scenario import Scenario


def assert_close(one: Any, other: Any) -> None:
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4), one, other)


def some(*chosen: str) -> list[Any]:
    """All maps; all but the chosen ones are slow."""
    return [
        pytest.param(name, marks=() if name in chosen else pytest.mark.slow) for name in map_names()
    ]


@pytest.mark.parametrize("name", some("2s3z"))
def test_vectorised_steps_agree(name: str) -> None:
    env, key = make(name), jax.random.key(3)
    busy, actions = busiest(name)
    early = at(reel(name, 0, "advance").before, 1)
    several = jax.tree.map(lambda *leaves: jnp.stack(leaves), early, busy)
    given = jnp.stack([jnp.ones_like(actions), jnp.asarray(actions)])
    keys = jax.random.wrap_key_data(jnp.stack([jax.random.key_data(key)] * 2))
    vectorised = jax.jit(jax.vmap(smac.step, (None, 0, 0, 0)))(env.scenario, several, given, keys)
    compiled = env.step(busy, actions, key)
    assert float(compiled[1].reward) > 0
    assert_close(at(vectorised, 1), compiled)
    assert_close(at(vectorised, 0), env.step(early, given[0], key))


@pytest.mark.parametrize("name", some("3s_vs_3z"))
def test_plain_steps_agree(name: str) -> None:
    env, key = make(name), jax.random.key(3)
    env_state, actions = busiest(name)
    with jax.disable_jit():
        plain = smac.step(env.scenario, env_state, jnp.asarray(actions), key)
    assert_close(plain, env.step(env_state, actions, key))


@pytest.mark.parametrize("name", some("MMM", "2s3z"))
def test_films_end_as_steps_do(name: str) -> None:
    """The battles above went on from the last shot of each step's film."""
    played = reel(name, 0, "advance")
    keys = jax.random.split(jax.random.key(0), STEPS)
    for t in range(0, len(played.timestep.reward), 5):
        _, chance = jax.random.split(keys[t])
        actions = played.after.last_actions[t]
        stepped = make(name).step(at(played.before, t), actions, chance)
        assert_close(stepped, (at(played.after, t), at(played.timestep, t)))


@pytest.mark.parametrize("name", some("MMM", "2s3z"))
def test_refused_actions_are_stops(name: str) -> None:
    env, played, rng = make(name), reel(name, 1, "advance"), np.random.default_rng(0)
    wasted = 0
    for t in range(1, len(played.timestep.reward), 3):
        env_state = at(played.before, t)
        available = played.timestep.observation.avail_actions[t - 1]
        instead = np.where(available[:, 0], battle.NO_OP, battle.STOP).astype(np.int32)
        kept, expected = env.step(env_state, instead, jax.random.key(t))
        assert not expected.info.refused.any()
        wrong = (~available * rng.random(available.shape)).argmax(1).astype(np.int32)
        wrong = np.where(rng.random(len(wrong)) < 0.3, rng.choice([-1, 999, -999]), wrong)
        wasted += len(set(wrong.tolist()))
        after, timestep = env.step(env_state, wrong.astype(np.int32), jax.random.key(t))
        assert timestep.info.refused.all()
        info = timestep.info._replace(refused=expected.info.refused)
        outcome = (after, timestep._replace(info=info))
        jax.tree.map(np.testing.assert_array_equal, outcome, (kept, expected))
        # One refusal does not touch the others.
        mixed = np.where(
            np.arange(len(wrong)) == 0, wrong, likeliest(at(played.timestep, t - 1)[0])
        )
        _, timestep = env.step(env_state, mixed.astype(np.int32), jax.random.key(t))
        assert timestep.info.refused.tolist() == [k == 0 for k in range(len(wrong))]
    assert wasted > 10


def ended(name: str) -> tuple[Any, EnvState, Timestep]:
    """A battle that runs out of time while it is fought."""
    env = make(name)
    env_state, actions = busiest(name)
    limit = env_state.steps + 1
    env = dataclasses.replace(env, scenario=dataclasses.replace(env.scenario, episode_limit=limit))
    after, timestep = env.step(env_state, actions, jax.random.key(0))
    assert bool(timestep.terminated)
    assert bool(timestep.info.timed_out)
    return env, after, timestep


@pytest.mark.parametrize("name", some("MMM", "2s3z"))
def test_nothing_changes_after_the_end(name: str) -> None:
    env, env_state, last = ended(name)
    for k in range(8):
        after, timestep = env.step(env_state, likeliest(last.observation), jax.random.key(k))
        jax.tree.map(np.testing.assert_array_equal, after, env_state)
        jax.tree.map(np.testing.assert_array_equal, timestep.observation, last.observation)
        assert float(timestep.reward) == 0.0
        assert bool(timestep.terminated)


def test_facts_stay_after_the_end() -> None:
    """Also where the next hits would kill, if there were any."""
    env, env_state, last = ended("2s3z")
    frail = env_state.units._replace(
        health=jnp.minimum(env_state.units.health, 0.5), shield=0 * env_state.units.shield
    )
    env_state = env_state._replace(units=frail)
    _, timestep = env.step(env_state, likeliest(last.observation), jax.random.key(0))
    assert timestep.info.dead_allies == (frail.health[:5] == 0).sum()
    assert timestep.info.dead_enemies == (frail.health[5:] == 0).sum()
    assert not timestep.info.battle_won


@pytest.mark.parametrize("name", ["2s3z", "MMM"])
def test_the_dead_do_not_matter(name: str) -> None:
    """Where the dead lie and what they were at makes no difference to anybody."""
    env = make(name)
    env_state, actions = busiest(name)
    n, rng = env.shape.n_allies, np.random.default_rng(0)
    dead = np.zeros(env.shape.n_units, bool)
    dead[[0, n - 2, n + 1, n + 3]] = True
    dead |= np.asarray(env_state.units.health == 0)
    actions = np.where(dead[:n], battle.NO_OP, np.where(actions == 0, battle.STOP, actions))
    actions = np.where(actions >= battle.FIRST_TARGET, battle.EAST, actions).astype(np.int32)
    names = ("x", "y", "shield", "energy", "cooldown", "since_hit", "aiming", "target")

    def step(scramble: Callable[[NDArray[Any]], NDArray[Any]]) -> tuple[Any, Any]:
        fields = {field: np.array(getattr(env_state.units, field)) for field in names}
        for field in fields.values():
            field[dead] = scramble(field[dead])
        fields["health"] = np.where(dead, 0, env_state.units.health).astype(np.float32)
        # Nothing of theirs is under way, and nobody has been hit by them.
        fields["pending"] = np.where(dead, 0, env_state.units.pending).astype(np.float32)
        fields["struck_by"] = np.full_like(env_state.units.struck_by, -1)
        units = env_state.units._replace(**{k: jnp.asarray(v) for k, v in fields.items()})
        after, timestep = env.step(env_state._replace(units=units), actions, jax.random.key(1))
        rest = {field: np.asarray(getattr(after.units, field))[~dead] for field in names}
        rest["health"] = np.asarray(after.units.health)[~dead]
        return rest, timestep

    still, timestep = step(lambda values: values)
    assert not timestep.info.refused.any()
    for _ in range(3):
        other = step(lambda values: rng.integers(0, 9, values.shape).astype(values.dtype))
        jax.tree.map(np.testing.assert_array_equal, other, (still, timestep))


def test_shields_come_back_after_ten_seconds() -> None:
    env = make("2s_vs_1sc")
    env_state, _ = env.reset(jax.random.key(0))
    units = env_state.units
    units = units._replace(shield=jnp.where(units.shield > 0, 10.0, 0.0))
    env_state, shields = env_state._replace(units=units), []
    for k in range(24):
        env_state, _ = env.step(env_state, np.ones(2, np.int32), jax.random.key(k))
        shields.append(float(env_state.units.shield[0]))
    assert shields[18] == 10
    assert shields[19] <= 10.25  # the battle may be two game loops old when it begins
    np.testing.assert_allclose(np.diff(shields[20:]), 1.0, atol=1e-4)


def test_a_move_beyond_the_rim_leads_to_the_rim(tmp_path: Path) -> None:
    """On ground with obstacles too, where units look up their ways."""
    rows = [14 * "."] * 4 + ["....######...."] * 4 + [14 * "."] * 4
    text = micro_text("3s_vs_3z").replace("[9.0, 16.0]", "[2.0, 6.0]")
    path = tmp_path / "pillar.toml"
    text = text[: text.index("[terrain]")].replace("[23.0, 16.0]", "[12.0, 6.0]")
    path.write_text(text.replace("count = 3", "count = 1") + cells(rows))
    env = make(str(path))
    assert not env.shape.plain
    for x, action in ((1.5, battle.WEST), (12.5, battle.EAST)):
        env_state, _ = env.reset(jax.random.key(0))
        units = env_state.units._replace(x=jnp.array([x, 7.0]), y=jnp.array([6.0, 1.0]))
        after, timestep = env.step(
            env_state._replace(units=units), np.array([action], np.int32), jax.random.key(0)
        )
        assert not timestep.info.refused.any()
        way = float(after.units.x[0]) - x
        assert way * (1 if action == battle.EAST else -1) > 0.2


def micro_text(name: str) -> str:
    return (Path(micro.__file__).parent / "maps" / f"{name}.toml").read_text()


def cells(rows: list[str]) -> str:
    return '[terrain]\ncells = """\n' + "\n".join(rows) + '\n"""\n'


# Programs.


@pytest.mark.parametrize("name", ["2s3z"])
def test_types_of_results(name: str) -> None:
    scenario, key = make(name).scenario, jax.random.key(0)
    env_state, shown = jax.eval_shape(smac.reset, scenario, key)
    actions = jnp.ones(scenario.shape.n_allies, jnp.int32)
    after, timestep = jax.eval_shape(smac.step, scenario, env_state, actions, key)
    assert jax.tree.map(lambda a: (a.shape, a.dtype), env_state) == jax.tree.map(
        lambda a: (a.shape, a.dtype), after
    )
    for observation in (shown, timestep.observation):
        assert observation.obs.dtype == observation.state.dtype == jnp.float32
        assert observation.avail_actions.dtype == bool
    assert timestep.reward.dtype == jnp.float32
    info = timestep.info
    for flag in (timestep.terminated, info.battle_won, info.timed_out, info.refused, after.over):
        assert flag.dtype == bool
    for number in (info.dead_allies, info.dead_enemies, after.steps, after.last_actions):
        assert number.dtype == jnp.int32
    kinds = {jnp.dtype(leaf.dtype).name for leaf in jax.tree.leaves((after, timestep))}
    assert kinds == {"float32", "bool", "int32"}


def counted() -> tuple[Any, list[int]]:
    """`smac.step`, compiled, and a list that grows with each compilation."""
    compilations: list[int] = []

    def step(*arguments: Any) -> Any:
        compilations.append(1)
        return smac.step(*arguments)

    return jax.jit(step), compilations


def moved(name: str, tmp_path: Path, old: str, new: str) -> Scenario:
    """A map with a change in its text."""
    text = micro_text(name)
    assert old in text
    path = tmp_path / f"moved_{name}.toml"
    path.write_text(text.replace(old, new, 1))
    return make(str(path)).scenario


def test_steps_compile_once_for_all_maps_of_a_shape(tmp_path: Path) -> None:
    step, compilations = counted()
    scenario = make("2s3z").scenario
    other = moved("2s3z", tmp_path, "at = [9.0, 16.0]", "at = [12.5, 14.0]")
    assert other.shape == scenario.shape
    assert not np.array_equal(other.x, scenario.x)
    for chosen in (scenario, other):
        env_state, shown = smac.reset(chosen, jax.random.key(0))
        for k in range(20):
            actions = jnp.asarray(likeliest(shown))
            env_state, timestep = step(chosen, env_state, actions, jax.random.key(k))
            shown = timestep.observation
        assert int(env_state.steps) == 20
    assert len(compilations) == 1
    # The count does grow with another shape.
    scenario = make("3s_vs_3z").scenario
    env_state, _ = smac.reset(scenario, jax.random.key(0))
    jax.eval_shape(step, scenario, env_state, jnp.ones(3, jnp.int32), jax.random.key(0))
    assert len(compilations) == 2


def test_battles_share_their_programs(tmp_path: Path) -> None:
    path = tmp_path / "again.toml"
    path.write_text(micro_text("2s3z").replace("[23.0, 16.0]", "[22.0, 17.0]"))
    sizes = []
    for env in (make("2s3z"), make(str(path))):
        env_state, _ = env.reset(jax.random.key(0))
        for k in range(3):
            env_state, _ = env.step(env_state, jnp.ones(5, jnp.int32), jax.random.key(k))
        programs: Any = micro._step, micro._reset
        sizes.append([program._cache_size() for program in programs])
    assert sizes[0] == sizes[1]


def test_maps_with_walls_share_a_program_too(tmp_path: Path) -> None:
    step, compilations = counted()
    text = (
        micro_text("3s_vs_3z")
        .replace("[9.0, 16.0]", "[2.0, 6.0]")
        .replace("count = 3", "count = 1")
    )
    text = text[: text.index("[terrain]")].replace("[23.0, 16.0]", "[12.0, 6.0]")
    for rows in (["....######...."], [".....#####...."]):
        path = tmp_path / "walls.toml"
        path.write_text(text + cells(5 * [14 * "."] + rows + 5 * [14 * "."]))
        env = make(str(path))
        env_state, _ = env.reset(jax.random.key(0))
        actions = jnp.ones(1, jnp.int32)
        jax.eval_shape(step, env.scenario, env_state, actions, jax.random.key(0))
        assert env.shape.width == 14
        assert not env.shape.plain
    assert len(compilations) == 1


def test_a_battle_is_up_to_two_loops_old_when_it_is_first_seen() -> None:
    env = make("3m")
    keys = jax.random.split(jax.random.key(0), 600)
    units = jax.vmap(lambda key: env.reset(key)[0].units)(keys)
    ages = np.asarray(units.clock)
    assert set(ages.tolist()) == {0, 1, 2}
    # A third each; three standard deviations of 600 draws.
    assert (np.abs(np.bincount(ages) / 600 - 1 / 3) < 0.058).all()
    marched = (np.asarray(env.scenario.x)[3:] - np.asarray(units.x)[:, 3:]).max(1)
    np.testing.assert_allclose(marched, ages * 2.25 / 16, atol=0.03)
    np.testing.assert_array_equal(units.x[:, :3], np.tile(env.scenario.x[:3], (600, 1)))

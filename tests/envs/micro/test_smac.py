"""SMAC's interface against a second version in plain Python, and where it is peculiar."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import MAPS
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from second_smac import TABLE, TYPES, Columns, Smac, blurred, later, situation

from race.envs.micro import make, smac

_observe = jax.jit(jax.vmap(smac.observe, in_axes=(None, 0, 0)))
_judge = jax.jit(jax.vmap(smac.judge, in_axes=(None, 0, 0, 0)))
BATCH = 48


def views(batch: list[Columns]) -> smac.View:
    return smac.View(*(jnp.stack([c[field] for c in batch]) for field in smac.View._fields))


def assert_agree(
    theirs: dict[str, Any], ours: Callable[[str], Any], situation: Columns, what: str = ""
) -> None:
    for quantity, value in theirs.items():
        difference = np.abs(np.asarray(ours(quantity), np.float64) - value).max()
        assert difference <= 1e-5, (quantity, what, situation)


def compare(name: str, seed: int) -> set[str]:
    """Compares a batch; what kinds of situation were in it."""
    rng, table, theirs = np.random.default_rng(seed), TABLE[name], Smac(name)
    old = [situation(table, rng) for _ in range(BATCH)]
    new = [later(table, units, rng) for units in old]
    last = rng.integers(-1, 6 + theirs.m, (BATCH, theirs.n)).astype(np.int32)
    steps = rng.choice([1, table.limit - 1, table.limit, table.limit + 1], BATCH)
    scenario = make(name).scenario
    shown = _observe(scenario, views(new), jnp.asarray(last))
    judged = _judge(scenario, views(old), views(new), jnp.asarray(steps, jnp.int32))
    reward, terminated, info = (jax.tree.map(np.asarray, part) for part in judged)
    shown = jax.tree.map(np.asarray, shown)
    kinds = set()
    for k in range(BATCH):
        result = theirs.judge(old[k], new[k], int(steps[k]))
        ours = {"reward": reward[k], "terminated": terminated[k]}
        ours |= {fact: getattr(info, fact)[k] for fact in info._fields}
        assert_agree(result, ours.__getitem__, new[k], f"steps {steps[k]}")
        kinds |= {fact for fact in ("battle_won", "timed_out") if result[fact]}
        kinds |= {"lost or drawn"} if result["terminated"] > result["battle_won"] else set()
        kinds |= {"end at the limit"} if result["battle_won"] and steps[k] >= table.limit else set()
        if not blurred(theirs.n, new[k]):
            seen = theirs.see(new[k], last[k])
            assert_agree(seen, lambda name, k=k: getattr(shown, name)[k], new[k])  # type: ignore[misc]
            kinds |= {"seen"} if seen["obs"].any() else set()
    return kinds


@pytest.mark.parametrize("name", MAPS)
def test_agrees_with_a_second_version(name: str) -> None:
    kinds: set[str] = set()

    @settings(max_examples=5, derandomize=True, deadline=None, phases=[Phase.generate])
    @given(st.integers(0, 2**32 - 1))
    def run(seed: int) -> None:
        kinds.update(compare(name, seed))

    run()
    assert kinds == {"battle_won", "timed_out", "lost or drawn", "end at the limit", "seen"}


@pytest.mark.slow
@pytest.mark.parametrize("name", MAPS)
@settings(max_examples=50, derandomize=True, deadline=None, phases=[Phase.generate])
@given(st.integers(0, 2**32 - 1))
def test_agrees_with_a_second_version_at_length(name: str, seed: int) -> None:
    compare(name, seed)


# Chosen situations.


def plain(name: str, **columns: Any) -> Columns:
    """Whole units far apart, but for the given columns; a dict sets single units."""
    types = TABLE[name].allies + TABLE[name].enemies
    whole, shields, _ = np.array([TYPES[kind] for kind in types]).T
    k = np.arange(len(types))
    units = {"x": 1.5 + k % 16 * 2, "y": 9.5 + k // 16 * 3.0, "health": whole, "shield": shields}
    units |= {"energy": 0 * whole, "cooldown": 0 * whole}
    units = {field: np.array(column, np.float32) for field, column in units.items()}
    for field, values in columns.items():
        for unit, value in values.items():
            units[field][unit] = value
    return units


def see(name: str, units: Columns) -> smac.Observation:
    last = jnp.full((1, len(TABLE[name].allies)), -1, jnp.int32)
    shown: smac.Observation = _observe(make(name).scenario, views([units]), last)
    theirs = Smac(name).see(units, np.asarray(last[0]))
    assert_agree(theirs, lambda quantity: getattr(shown, quantity)[0], units)
    return jax.tree.map(lambda leaf: np.asarray(leaf[0]), shown)


def judge(name: str, old: Columns, new: Columns, steps: int = 1) -> dict[str, Any]:
    judged = _judge(make(name).scenario, views([old]), views([new]), jnp.array([steps]))
    reward, terminated, info = jax.tree.map(lambda leaf: np.asarray(leaf[0]), judged)
    ours = {"reward": reward, "terminated": terminated} | info._asdict()
    assert_agree(Smac(name).judge(old, new, steps), ours.__getitem__, new)
    return ours


def test_worked_example() -> None:
    """An agent at (10, 16), a Zealot at (14, 19) with 80 health and 20 shield."""
    x, y = {0: 10, 1: 30, 2: 30, 3: 14, 4: 1, 5: 1}, {0: 16, 1: 1, 2: 2, 3: 19, 4: 1, 5: 2}
    units = plain("3s_vs_3z", x=x, y=y, health={3: 80}, shield={3: 20})
    shown = see("3s_vs_3z", units)
    assert shown.avail_actions[0, 6]
    row = [1, 0.555556, 0.444444, 0.333333, 0.8, 0.4]
    np.testing.assert_allclose(shown.obs[0, 4:10], row, atol=1e-6)
    np.testing.assert_allclose(shown.state[15:19], [0.8, -0.0625, 0.09375, 0.4], atol=1e-6)
    grown = units | {"shield": units["shield"] + np.eye(6, dtype=np.float32)[3]}
    assert judge("3s_vs_3z", units, grown)["reward"] == pytest.approx(0.029412, abs=1e-6)
    dead = units | {"health": units["health"] * (np.arange(6) != 3)}
    assert judge("3s_vs_3z", units, dead)["reward"] == pytest.approx(3.235294, abs=1e-6)
    alone = units | {"health": units["health"] * (np.arange(6) < 4)}
    won = judge("3s_vs_3z", alone, alone | {"health": alone["health"] * (np.arange(6) < 3)})
    assert won["reward"] == pytest.approx(3.235294 + 5.882353, abs=2e-6)
    assert won["battle_won"]


@pytest.mark.parametrize(
    ("dx", "shoots", "sees"),
    [(5.999, 1, 1), (6.0, 1, 1), (6.001, 0, 1), (8.999, 0, 1), (9.0, 0, 0), (9.001, 0, 0)],
)
@pytest.mark.parametrize("across", [False, True])
def test_thresholds(dx: float, shoots: int, sees: int, across: bool) -> None:
    places: Any = ({0: 10, 3: 10 + dx}, {0: 16, 3: 16})
    x, y = places[::-1] if across else places
    shown = see("3s_vs_3z", plain("3s_vs_3z", x=x, y=y))
    assert (shown.avail_actions[0, 6], shown.obs[0, 4:10].any()) == (bool(shoots), bool(sees))


@pytest.mark.parametrize("place", [0.0, 0.25, 0.999, 1.0, 1.5, 30.999, 31.0, 31.5, 32.0])
def test_moves_on_the_rim(place: float) -> None:
    """A probe is cut towards zero: from x < 1 the way west is offered, from 0 it is not."""
    shown = see("3s_vs_3z", plain("3s_vs_3z", x={0: place, 1: 16}, y={0: 16, 1: place}))
    on, on_outwards, inwards = place < 32, place < 31, place > 0
    assert shown.avail_actions[0, 2:6].tolist() == [on, on, on_outwards, inwards]
    assert shown.avail_actions[1, 2:6].tolist() == [on_outwards, inwards, on, on]


def test_moves_from_the_very_rim() -> None:
    """SMAC subtracts in double precision: -1 + 1e-9 is cut to 0, where there is ground."""
    see("3s_vs_3z", plain("3s_vs_3z", x={0: 1e-9}, y={0: 16}))


def test_medivac_rules() -> None:
    """Agent 9 and enemy 9 of MMM are Medivacs; the own rule comes first."""
    whole = plain("MMM")
    side = np.arange(20) < 10
    medivac = np.arange(20) % 10 == 9

    def end(lives: NDArray[np.bool_]) -> tuple[bool, bool]:
        ended = judge("MMM", whole, whole | {"health": whole["health"] * lives})
        return bool(ended["terminated"]), bool(ended["battle_won"])

    assert end(side | medivac) == (True, True)
    assert end(side) == (True, True)
    assert end(~side | medivac) == (True, False)
    assert end(side & medivac) == (True, False)
    assert end(medivac) == (True, False)
    assert end(~side) == (True, False)
    assert end(0 * side > 0) == (True, False)
    assert end(side | (np.arange(20) == 10)) == (False, False)
    assert end(np.isin(np.arange(20), [0, 10, 11])) == (False, False)


def test_a_healer_names_agents() -> None:
    units = plain("MMM", x=dict.fromkeys(range(20), 16.0), y=dict.fromkeys(range(20), 16.0))
    units["health"][[1, 12]] = 0
    mask = see("MMM", units).avail_actions
    assert mask[9, 6:].tolist() == [True, False, *(7 * [True]), False]
    assert mask[0, 6:].tolist() == [True, True, False, *(7 * [True])]
    assert mask[1].tolist() == [True] + 15 * [False]
    assert not see("MMM", units).obs[1].any()


def test_an_end_in_the_last_step_is_no_time_out() -> None:
    whole = plain("2s3z")
    late = TABLE["2s3z"].limit
    won = whole | {"health": whole["health"] * (np.arange(10) < 5)}
    ended = judge("2s3z", whole, won, late)
    assert ended["battle_won"]
    assert not ended["timed_out"]
    assert ended["reward"] == pytest.approx(20, rel=1e-6)
    nobody = judge("2s3z", whole, whole | {"health": 0 * whole["health"]}, late)
    assert not nobody["battle_won"]
    assert not nobody["timed_out"]
    assert nobody["terminated"]
    assert judge("2s3z", whole, whole, late)["timed_out"]
    assert not judge("2s3z", whole, whole, late - 1)["terminated"]


# Shapes and steps.


@pytest.mark.parametrize("name", MAPS)
def test_shapes(name: str) -> None:
    battle, table = make(name), TABLE[name]
    shape = battle.shape
    assert (shape.n_allies, shape.n_enemies) == (len(table.allies), len(table.enemies))
    assert (shape.n_actions, shape.obs_size, shape.state_size) == table.sizes
    assert battle.spec.episode_limit == table.limit
    _, shown = battle.reset(jax.random.key(0))
    assert shown.obs.shape == (shape.n_allies, shape.obs_size)
    assert shown.state.shape == (shape.state_size,)
    assert shown.avail_actions.shape == (shape.n_allies, shape.n_actions)


def columns(env_state: Any) -> Columns:
    return {field: np.array(getattr(env_state.units, field)) for field in smac.View._fields}


@pytest.mark.parametrize("name", ["MMM"])
def test_steps_show_what_the_second_version_makes_of_the_units(name: str) -> None:
    battle, theirs = make(name), Smac(name)
    rng = np.random.default_rng(0)
    env_state, shown = battle.reset(jax.random.key(0))
    start = theirs.see(columns(env_state), np.full(theirs.n, -1, np.int32))
    assert_agree(start, functools.partial(getattr, shown), columns(env_state))
    assert not shown.state[-theirs.n * (6 + theirs.m) :].any()
    hurt = 0.0
    for number in range(1, 31):
        # Towards the enemy, who comes as well; then whom they can reach.
        chances = np.asarray(shown.avail_actions) * np.array([1, 1, 1, 1, 4, 1] + theirs.m * [9])
        actions = (chances * rng.random(chances.shape)).argmax(1).astype(np.int32)
        old = columns(env_state)
        env_state, timestep = battle.step(env_state, actions, jax.random.key(number))
        shown, new = timestep.observation, columns(env_state)
        assert_agree(theirs.see(new, actions), functools.partial(getattr, shown), new)
        facts = {"reward": timestep.reward, "terminated": timestep.terminated}
        facts |= timestep.info._asdict()
        assert_agree(theirs.judge(old, new, number), facts.__getitem__, new)
        assert not timestep.info.refused.any()
        hurt += float(timestep.reward)
        if timestep.terminated:
            break
    assert hurt > 0

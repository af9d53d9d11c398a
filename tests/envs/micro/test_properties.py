"""What holds in every battle, whatever the agents do: bodies, damage, the dead, chance."""

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
from reels import (
    EPSILON,
    HEALTH,
    MANNERS,
    PATIENTS,
    RADIUS,
    SHIELD,
    SPEED,
    ZERG,
    Reel,
    at,
    likeliest,
    play,
    reel,
)

from race.envs.micro import make

# What holds in every battle.


def nothing_is_nan(r: Reel) -> None:
    leaves = jax.tree.leaves((r.after, r.shots, r.timestep))
    assert all(np.isfinite(leaf).all() for leaf in leaves)


def health_rises_by_regeneration_and_healing_only(r: Reel) -> None:
    health = r.shots.health.astype(float)
    most = r.per_type(HEALTH)
    assert ((health >= 0) & (health <= most)).all()
    allowed = np.tile(r.per_type(dict.fromkeys(ZERG, 0.2734 / 16)), (len(health) - 1, 1))
    for healer in np.flatnonzero(np.array(r.types) == "Medivac"):
        given = spent(r, healer) / 0.33
        patient = r.shots.target[1:, healer]
        allowed[np.arange(len(given)), np.maximum(patient, 0)] += np.where(patient >= 0, given, 0)
    assert (np.diff(health, axis=0) <= allowed + EPSILON).all()


def spent(r: Reel, healer: Any) -> NDArray[np.float64]:
    """Energy that a healer gives away in each loop of its life."""
    energy = r.shots.energy[:, healer].astype(float)
    lives = r.shots.health[1:, healer] > 0
    charged = np.minimum(energy[:-1] + 0.5625 / 16, 200)
    return np.where(lives, np.maximum(charged - energy[1:], 0), 0.0)


def energy_falls_by_healing_only(r: Reel) -> None:
    types, units = np.array(r.types), r.shots
    assert not units.energy[:, types != "Medivac"].any()
    side = np.arange(len(types)) < r.n
    for healer in np.flatnonzero(types == "Medivac"):
        given = spent(r, healer)
        assert (given <= 9 * 0.33 / 16 + EPSILON).all()
        loops = np.flatnonzero(given > 1e-5)
        patient = units.target[1 + loops, healer]
        assert (patient >= 0).all()
        assert (side[patient] == side[healer]).all()
        assert np.isin(types[patient], PATIENTS).all()
        old = [(field[loops, patient], field[loops, healer]) for field in (units.x, units.y)]
        gap = np.hypot(*(one - other for one, other in old)) - 0.75 - r.per_type(RADIUS)[patient]
        assert (gap <= 4 + EPSILON).all()
        around = np.minimum(units.health[loops, patient], units.health[1 + loops, patient])
        assert (around < r.per_type(HEALTH)[patient]).all()
        assert (units.health[loops, healer] > 0).all()
        assert (np.diff(units.energy[:, healer]) <= 0.5625 / 16 + EPSILON).all()


def shields_rise_ten_seconds_after_damage(r: Reel) -> None:
    shield, health = r.shots.shield.astype(float), r.shots.health.astype(float)
    most = r.per_type(SHIELD)
    assert ((shield >= 0) & (shield <= most)).all()
    rise, alive = np.diff(shield, axis=0), health[1:] > 0
    assert (rise <= 0.125 + EPSILON).all()
    hit = (rise < -EPSILON) | ((np.diff(health, axis=0) < -EPSILON) & (most > 0))
    loop = np.arange(len(hit))[:, None]
    calm = loop - np.maximum.accumulate(np.where(hit, loop, -1000), axis=0)
    assert not ((rise > EPSILON) & (calm < 160)).any()
    must = alive & (calm > 161) & (shield[:-1] < most)
    expected = np.minimum(0.125, most - shield[:-1])
    np.testing.assert_allclose(rise[must], expected[must], atol=EPSILON)


def units_stay_on_their_ground(r: Reel) -> None:
    x, y = r.shots.x, r.shots.y
    assert ((x >= 0) & (x < 32) & (y >= 0) & (y < 32)).all()
    cell = r.cells[np.floor(x).astype(int), np.floor(y).astype(int)]
    kinds = [{"Colossus": ".C", "Medivac": ".#C"}.get(kind, ".") for kind in r.types]
    for k, kind in enumerate(kinds):
        assert np.isin(cell[:, k], list(kind)).all(), r.types[k]
    if "SpineCrawler" in r.types:  # the room, without the rim outside
        assert ((x > 8) & (x < 20) & (y > 8) & (y < 24)).all()


def nobody_is_faster_than_its_legs(r: Reel) -> None:
    way = np.hypot(np.diff(r.shots.x, axis=0), np.diff(r.shots.y, axis=0))
    assert (way <= r.per_type(SPEED) / 16 + EPSILON).all()
    assert not way[:, np.array(r.types) == "SpineCrawler"].any()


def the_dead_do_nothing(r: Reel) -> None:
    dead = r.shots.health[:-1] == 0
    assert not r.shots.health[1:][dead].any()
    for field in ("x", "y"):
        old, new = (getattr(r.shots, field)[part] for part in (slice(-1), slice(1, None)))
        np.testing.assert_array_equal(old[dead], new[dead])
    for field in ("cooldown", "shield", "energy", "aiming"):  # a shot would set the cooldown
        old, new = (getattr(r.shots, field)[part] for part in (slice(-1), slice(1, None)))
        assert (new[dead] <= old[dead]).all(), field


def the_dead_see_nothing(r: Reel) -> None:
    dead = r.after.units.health[:, : r.n] == 0
    shown = r.timestep.observation
    assert not shown.obs[dead].any()
    assert not shown.avail_actions[dead][:, 1:].any()
    assert shown.avail_actions[dead][:, 0].all()
    assert not shown.avail_actions[~dead][:, 0].any()
    assert shown.avail_actions[~dead][:, 1].all()
    np.testing.assert_array_equal(r.timestep.info.dead_allies, dead.sum(1))
    foes = r.after.units.health[:, r.n :] == 0
    np.testing.assert_array_equal(r.timestep.info.dead_enemies, foes.sum(1))


def no_more_is_earned_than_was_done(r: Reel) -> None:
    """A return above 20 comes from what enemies regained, which pays where nobody is hurt."""
    old, new = (
        np.where(units.health > 0, units.health + units.shield, 0.0)[:, r.n :].astype(float)
        for units in (r.before.units, r.after.units)
    )
    dealt, regained = np.maximum(old - new, 0).sum(1), np.maximum(new - old, 0).sum(1)
    deaths, win = ((old > 0) & (new == 0)).sum(1), r.timestep.info.battle_won
    reward = r.timestep.reward.astype(float) * r.scale
    assert (reward >= 0).all()
    np.testing.assert_allclose(
        reward, abs(dealt - regained + 10 * deaths) + 200 * win, rtol=1e-4, atol=2e-2
    )
    assert reward.sum() <= (dealt + regained + 10 * deaths + 200 * win).sum() + 0.1
    assert reward.sum() <= 20 * r.scale + 2 * regained.sum() + 0.1


def no_action_of_the_mask_is_refused(r: Reel) -> None:
    assert not r.timestep.info.refused.any()


CHECKS = [
    nothing_is_nan,
    health_rises_by_regeneration_and_healing_only,
    energy_falls_by_healing_only,
    shields_rise_ten_seconds_after_damage,
    units_stay_on_their_ground,
    nobody_is_faster_than_its_legs,
    the_dead_do_nothing,
    the_dead_see_nothing,
    no_more_is_earned_than_was_done,
    no_action_of_the_mask_is_refused,
]


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", MAPS)
@settings(max_examples=4, derandomize=True, deadline=None, phases=[Phase.generate])
@given(st.integers(0, 1), st.sampled_from(sorted(MANNERS)))
def test_holds(name: str, check: Callable[[Reel], None], seed: int, manner: str) -> None:
    check(reel(name, seed, manner))


@pytest.mark.slow
@pytest.mark.parametrize("name", MAPS)
@settings(max_examples=20, derandomize=True, deadline=None, phases=[Phase.generate])
@given(st.integers(2, 2**31), st.sampled_from(sorted(MANNERS)))
def test_holds_at_length(name: str, seed: int, manner: str) -> None:
    played = reel.__wrapped__(name, seed, manner)
    for check in CHECKS:
        check(played)


@pytest.mark.parametrize("name", MAPS)
def test_battles_are_fought(name: str) -> None:
    """The battles above are no walks: units are hurt, healed and die."""
    reels = [reel(name, seed, "advance") for seed in (0, 1)]
    assert all((np.diff(r.shots.health, axis=0) < 0).any() for r in reels)
    assert any((r.after.units.health == 0).any() for r in reels)
    assert any(r.timestep.reward.sum() > 1 for r in reels)
    if name.startswith("MMM"):
        healers = np.flatnonzero(np.array(reels[0].types) == "Medivac")
        assert all(any(spent(r, healer).sum() > 1 for r in reels) for healer in healers)


# Chance.


@pytest.mark.parametrize("name", MAPS)
def test_the_key_decides(name: str) -> None:
    first, again, other = (play(name, seed, "advance") for seed in (0, 0, 1))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert not np.array_equal(first[1].units.x, other[1].units.x)


def test_chance_lies_in_the_cooldowns_alone() -> None:
    """With the same actions another key changes only when attacks are ready again."""
    env, played = make("2s3z"), reel("2s3z", 0, "advance")
    fired = 0
    for t in range(1, len(played.timestep.reward), 4):
        env_state = at(played.before, t)
        actions = likeliest(at(played.timestep.observation, t - 1))
        one, other = (env.step(env_state, actions, jax.random.key(k))[0] for k in (1, 2))
        differ = np.asarray(one.units.cooldown != other.units.cooldown)
        rise = np.asarray(one.units.cooldown > jnp.maximum(env_state.units.cooldown - 8, 0.0))
        np.testing.assert_array_equal(differ, rise)
        fired += rise.sum()
        same = [unit._replace(cooldown=0 * unit.cooldown) for unit in (one.units, other.units)]
        jax.tree.map(np.testing.assert_array_equal, *same)
    assert fired > 0

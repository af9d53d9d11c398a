"""Fights against their closed forms: who dies after how many hits, and when."""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from numpy.typing import NDArray

from race.envs.micro import combat, smac
from race.envs.micro.battle import (
    EAST,
    FIRST_TARGET,
    NO_OP,
    NORTH,
    SOUTH,
    STOP,
    WEST,
    Orders,
    game_loop,
)
from race.envs.micro.maps import load_map, parse_map
from race.envs.micro.scenario import APART, Scenario, build
from race.envs.micro.state import NOBODY, EnvState, Units, start
from race.envs.micro.units import LOOPS_PER_SECOND, UNIT_TYPES

Points = list[tuple[float, float]]

# Hits that kill from full health and shield; for pairs, attacks in the second place.
HITS: dict[str, dict[str, int]] = {
    "Stalker": {
        "Stalker": 12, "Zealot": 17, "Colossus": 27, "Marine": 5, "Marauder": 10, "Medivac": 12,
        "Zergling": 4, "Baneling": 3, "SpineCrawler": 25,
    },
    "Zealot": {
        "Stalker": 22, "Zealot": 21, "Colossus": 48, "Marine": 6, "Marauder": 18, "Zergling": 5,
        "Baneling": 4, "SpineCrawler": 50,
    },
    "Colossus": {
        "Stalker": 9, "Zealot": 8, "Colossus": 19, "Marine": 3, "Marauder": 7, "Zergling": 2,
        "Baneling": 2, "SpineCrawler": 17,
    },
    "Marine": {
        "Stalker": 30, "Zealot": 29, "Colossus": 65, "Marine": 8, "Marauder": 25, "Medivac": 30,
        "Zergling": 6, "Baneling": 5, "SpineCrawler": 75,
    },
    "Marauder": {
        "Stalker": 9, "Zealot": 17, "Colossus": 19, "Marine": 5, "Marauder": 7, "Zergling": 4,
        "Baneling": 3, "SpineCrawler": 17,
    },
    "Zergling": {
        "Stalker": 36, "Zealot": 35, "Colossus": 80, "Marine": 9, "Marauder": 32, "Zergling": 7,
        "Baneling": 6, "SpineCrawler": 100,
    },
    "SpineCrawler": {
        "Stalker": 6, "Zealot": 7, "Colossus": 12, "Marine": 2, "Marauder": 5, "Zergling": 2,
        "Baneling": 2, "SpineCrawler": 11,
    },
    "Hydralisk": {
        "Stalker": 14, "Zealot": 14, "Colossus": 31, "Marine": 4, "Marauder": 12, "Medivac": 14,
        "Zergling": 3, "Baneling": 3, "SpineCrawler": 30, "Hydralisk": 7,
    },
}  # fmt: skip
BURSTS = {
    "Stalker": 9, "Zealot": 5, "Colossus": 19, "Marine": 2, "Marauder": 7, "Zergling": 1,
    "Baneling": 2, "SpineCrawler": 4, "Hydralisk": 3,
}  # fmt: skip
# Seconds from the first hit to the last.
TIMES: dict[str, dict[str, float]] = {
    "Stalker": {
        "Stalker": 15.84, "Zealot": 23.04, "Colossus": 37.44, "Marine": 5.76, "Marauder": 12.96,
        "Medivac": 15.84, "Zergling": 4.32, "Baneling": 2.88, "SpineCrawler": 34.56,
    },
    "Zealot": {
        "Stalker": 12.28, "Zealot": 12.00, "Colossus": 27.88, "Marine": 2.68, "Marauder": 9.88,
        "Zergling": 2.40, "Baneling": 1.48, "SpineCrawler": 29.08,
    },
    "Colossus": {
        "Stalker": 8.80, "Zealot": 6.60, "Colossus": 19.80, "Marine": 2.20, "Marauder": 6.60,
        "Zergling": 0.00, "Baneling": 0.00, "SpineCrawler": 17.60,
    },
    "Marine": {
        "Stalker": 24.96, "Zealot": 24.10, "Colossus": 55.09, "Marine": 6.03, "Marauder": 20.66,
        "Medivac": 24.96, "Zergling": 4.30, "Baneling": 3.44, "SpineCrawler": 63.70,
    },
    "Marauder": {
        "Stalker": 12.00, "Zealot": 24.00, "Colossus": 27.00, "Marine": 6.00, "Marauder": 9.00,
        "Zergling": 4.50, "Baneling": 3.00, "SpineCrawler": 24.00,
    },
    "Zergling": {
        "Stalker": 24.36, "Zealot": 23.66, "Colossus": 54.98, "Marine": 5.57, "Marauder": 21.58,
        "Zergling": 4.18, "Baneling": 3.48, "SpineCrawler": 68.90,
    },
    "SpineCrawler": {
        "Stalker": 8.00, "Zealot": 9.60, "Colossus": 17.60, "Marine": 1.60, "Marauder": 6.40,
        "Zergling": 1.60, "Baneling": 1.60, "SpineCrawler": 16.00,
    },
    "Hydralisk": {
        "Stalker": 10.79, "Zealot": 10.79, "Colossus": 24.90, "Marine": 2.49, "Marauder": 9.13,
        "Medivac": 10.79, "Zergling": 1.66, "Baneling": 1.66, "SpineCrawler": 24.07,
        "Hydralisk": 4.98,
    },
}  # fmt: skip
# Hits on a Hydralisk, and seconds from the first to the last.
ON_HYDRALISKS = {
    "Stalker": (8, 10.08), "Zealot": (10, 5.08), "Colossus": (4, 2.20), "Marine": (14, 11.19),
    "Marauder": (8, 10.50), "Zergling": (16, 10.44), "SpineCrawler": (4, 4.80),
}  # fmt: skip
for _attacker, (_hits, _seconds) in ON_HYDRALISKS.items():
    HITS[_attacker]["Hydralisk"], TIMES[_attacker]["Hydralisk"] = _hits, _seconds
DUELS = [(attacker, target) for attacker, row in HITS.items() for target in row]


def battle_of(allies: list[tuple[str, int]], enemies: list[tuple[str, int]], **changes: Any) -> Any:
    """A map on a plain with these groups; the enemies hold."""
    groups = [("allies", *group) for group in allies] + [("enemies", *group) for group in enemies]
    text = 'description = "test"\nepisode_limit = 1000\n[enemy_order]\nkind = "hold"\n'
    for k, (side, unit, count) in enumerate(groups):
        text += f'[[{side}]]\nunit = "{unit}"\ncount = {count}\nat = [16.0, {4.0 + 8 * k}]\n'
    scenario = build(parse_map("test", text))
    changes = {name: jnp.asarray(value, jnp.float32) for name, value in changes.items()}
    # Rules are tested with enemies that look for targets all the time.
    return dataclasses.replace(scenario, scan_period=jnp.array(1), **changes)


def placed(scenario: Scenario, places: Points, **changes: Any) -> Units:
    """The units at the start, but at these places."""
    x, y = np.array(places, np.float32).T
    units = start(scenario).units._replace(x=jnp.asarray(x), y=jnp.asarray(y))
    for name, value in changes.items():
        units = units._replace(**{name: jnp.asarray(value, getattr(units, name).dtype)})
    return units


CHUNK = 20


@jax.jit
def _chunk(scenario: Scenario, units: Units, given: Orders) -> tuple[Units, Units]:
    delays = jnp.zeros(scenario.shape.n_units)

    def step(units: Units, _: None) -> tuple[Units, Units]:
        units = game_loop(scenario, units, given, delays)
        return units, units

    return jax.lax.scan(step, units, None, length=CHUNK)


def play(
    scenario: Scenario, units: Units, targets: Float[Array, "n"], loops: int
) -> tuple[Units, Units]:
    """Game loops without random delays under one order: attack these units, or stand (-1).

    Returns the units at the end, and those after every loop.
    """
    n = scenario.shape.n_allies
    target = targets.astype(units.target.dtype)
    given = Orders(target, jnp.zeros(n, bool), units.x[:n], units.y[:n])
    films = []
    for _ in range(math.ceil(loops / CHUNK)):
        units, film = _chunk(scenario, units, given)
        films.append(jax.tree.map(np.asarray, film))
    whole: Units = jax.tree.map(lambda *parts: jnp.asarray(np.concatenate(parts)[:loops]), *films)
    return jax.tree.map(lambda leaf: leaf[-1], whole), whole


def standing(n: int) -> Any:
    return jnp.full(n, float(NOBODY))


class Hits(NamedTuple):
    loops: NDArray[np.int64]  # in which something was lost
    left: NDArray[np.float32]  # health and shield after it, [hits, 2]


def hits_on(unit: int, before: Units, film: Units) -> Hits:
    left = np.stack([np.asarray(film.health[:, unit]), np.asarray(film.shield[:, unit])], 1)
    first = np.array([[before.health[unit], before.shield[unit]]])
    lost = -np.diff(np.concatenate([first, left]).sum(1))
    loops = np.nonzero(lost > 1e-4)[0]
    return Hits(loops, left[loops])


@functools.cache
def duel(attacker: str, target: str) -> Hits:
    """An enemy attacks an ally that stands; no regeneration."""
    scenario = battle_of([(target, 1)], [(attacker, 1)], regeneration=[0.0, 0.0])
    weapon = UNIT_TYPES[attacker].weapon
    assert weapon is not None
    apart = UNIT_TYPES[attacker].radius + UNIT_TYPES[target].radius + 0.05
    loops = math.ceil(TIMES[attacker][target] * LOOPS_PER_SECOND * 1.2) + 60
    units = placed(scenario, [(10.0, 10.0), (10.0 + apart, 10.0)])
    _, film = play(scenario, units, standing(1), loops)
    return hits_on(0, units, film)


@pytest.mark.parametrize(("attacker", "target"), DUELS)
def test_hits_and_time_to_kill(attacker: str, target: str) -> None:
    hits = duel(attacker, target)
    weapon = UNIT_TYPES[attacker].weapon
    assert weapon is not None
    assert hits.left[-1].tolist()[0] == 0
    together = weapon.hits if weapon.second_hit == 0 else 1
    assert len(hits.loops) == math.ceil(HITS[attacker][target] / together)
    attacks = math.ceil(HITS[attacker][target] / weapon.hits)
    # A weapon fires in the first game loop in which it is ready: up to a loop late each time.
    late = (hits.loops[-1] - hits.loops[0]) - TIMES[attacker][target] * LOOPS_PER_SECOND
    period = weapon.period * LOOPS_PER_SECOND
    assert abs(late - (math.ceil(period) - period) * (attacks - 1)) <= 1


@pytest.mark.parametrize(
    ("attacker", "target", "expected"),
    [
        ("Stalker", "Zealot", [(100, 40), (100, 30), (100, 20), (100, 10), (100, 0), (91, 0)]),
        ("Stalker", "Stalker", [(80, 66), (80, 52), (80, 38), (80, 24), (80, 10), (77, 0)]),
        ("Zealot", "Zealot", [(100, 42 - 8 * k) for k in range(6)] + [(95, 0), (88, 0)]),
        ("SpineCrawler", "Stalker", [(80, 50), (80, 20), (71, 0), (42, 0), (13, 0), (0, 0)]),
        ("Stalker", "SpineCrawler", [(288, 0), (276, 0), (264, 0)]),
        ("Marauder", "Marauder", [(106, 0), (87, 0), (68, 0)]),
        ("Marine", "Medivac", [(145, 0), (140, 0)]),
        ("Hydralisk", "Zealot", [(100, 38), (100, 26), (100, 14), (100, 2), (91, 0), (80, 0)]),
        ("Zealot", "Hydralisk", [(72, 0), (64, 0), (56, 0), (48, 0)]),
        ("Marine", "Zealot", [(100, 50 - 6 * k) for k in range(1, 9)] + [(97, 0), (92, 0)]),
    ],
)
def test_health_and_shield_after_each_hit(
    attacker: str, target: str, expected: list[tuple[float, float]]
) -> None:
    hits = duel(attacker, target)
    np.testing.assert_allclose(hits.left[: len(expected)], expected, atol=1e-3)


def test_absorb_pays_armour_once_per_hit_and_only_behind_the_shield() -> None:
    hits = jnp.array([[8.0, 8.0, 0.6], [8.0, 0.0, 8.0]])
    armour = jnp.array([[1.0, 1.0, 1.0]])
    shield = jnp.array([10.0, 3.0, 0.0])
    # 8 + 2 into the shield, 6 - 1; 3 into the shield, 5 - 1; at least 0.5, then 8 - 1.
    np.testing.assert_allclose(combat.absorb(hits, armour, shield), [5.0, 4.0, 7.5])


@pytest.mark.parametrize("target", sorted(BURSTS))
def test_banelings_needed(target: str) -> None:
    most = max(BURSTS.values())
    scenario = battle_of([(target, 1)], [("Baneling", most)])
    ring = [
        (16 + 1.1 * math.cos(a), 16 + 1.1 * math.sin(a))
        for a in np.linspace(0, 2 * math.pi, most, endpoint=False)
    ]
    units = placed(scenario, [(16.0, 16.0), *ring])
    for banelings, survives in ((BURSTS[target], False), (BURSTS[target] - 1, True)):
        there = jnp.arange(most + 1) <= banelings
        after, _ = play(
            scenario,
            units._replace(health=jnp.where(there, units.health, 0.0), burst=~there),
            standing(1),
            40,
        )
        assert not np.asarray(after.health[1:] > 0).any() or banelings == 0
        assert bool(after.health[0] > 0) == survives


def test_five_bursts_kill_any_number_of_zealots_in_reach() -> None:
    scenario = battle_of([("Zealot", 7)], [("Baneling", 5)])
    disc = [(16.0, 16.0)] + [
        (16 + 0.75 * math.cos(k * math.pi / 3), 16 + 0.75 * math.sin(k * math.pi / 3))
        for k in range(6)
    ]
    attackers = [(17.9 + 0.8 * k, 16.0) for k in range(5)]
    units = placed(scenario, disc + attackers)
    units, _ = play(scenario, units, standing(7), 60)
    assert not np.asarray(units.health > 0).any()


def test_a_baneling_that_is_killed_bursts_in_the_same_loop() -> None:
    scenario = battle_of([("Zealot", 1)], [("Baneling", 1)])
    units = placed(scenario, [(16.0, 16.0), (16.85, 16.0)], cooldown=[0.0, 99.0], health=[100, 8])
    _, film = play(scenario, units, jnp.array([1.0]), 8)
    died = int(np.argmax(np.asarray(film.health[:, 1]) <= 0))
    assert died > 0 or film.health[0, 1] <= 0
    # The zealot's first hit kills it; the burst of 35 takes its shield of 50 down to 15.
    assert film.shield[died, 0] == pytest.approx(15.0)
    assert film.shield[-1, 0] == pytest.approx(15.0)


def test_a_colossus_strikes_everyone_on_its_line_and_nobody_else() -> None:
    scenario = battle_of([("Colossus", 1)], [("Zergling", 8)])
    # Line of fire along x: the line lies along y through the target at (21, 16).
    along = [0.0, 0.75, 1.5, 1.77, 1.79, -1.5, -1.9]
    lings = [(21.0, 16.0 + offset) for offset in along] + [(21.6, 16.0)]
    scenario = dataclasses.replace(
        scenario, speed=jnp.zeros(9), contact=jnp.full_like(scenario.contact, APART)
    )
    units = placed(scenario, [(16.0, 16.0), *lings])
    units, film = play(scenario, units, jnp.array([1.0]), 20)
    dead = [not bool(h > 0) for h in units.health[1:]]
    assert dead == [True, True, True, True, False, True, False, False]
    bystander, main = (int(np.argmax(np.asarray(film.health[:, k]) <= 0)) for k in (2, 1))
    assert bystander < main


def test_dead_colossi_stop_their_beams_and_missiles_of_the_dead_hit() -> None:
    for shooter, lands in (("Colossus", False), ("Stalker", True)):
        scenario = battle_of([(shooter, 1)], [("SpineCrawler", 1)])
        units = placed(scenario, [(10.0, 16.0), (17.0, 16.0)], cooldown=[0.0, 99.0])
        _, film = play(scenario, units, jnp.array([1.0]), 8)
        fired = int(np.argmax(np.asarray(film.cooldown[:, 0]) > 0))
        shot = jax.tree.map(lambda leaf, fired=fired: leaf[fired], film)
        assert shot.health[1] == 300
        shot = shot._replace(health=shot.health.at[0].set(0.0))
        after, _ = play(scenario, shot, standing(1), 16)
        assert bool(after.health[1] < 299) == lands


def test_missiles_are_lost_on_the_dead() -> None:
    scenario = battle_of([("Stalker", 2)], [("Zergling", 1)])
    units = placed(
        scenario, [(10.0, 16.0), (10.0, 18.0), (16.5, 17.0)], health=[80, 80, 10],
        cooldown=[0, 0, 99],
    )  # fmt: skip
    _, film = play(scenario, units, jnp.array([2.0, 2.0]), 30)
    dead = int(np.argmax(np.asarray(film.health[:, 2]) <= 0))
    assert (np.asarray(film.cooldown[dead, :2]) > 0).all()  # both had fired
    assert film.health[-1, 2] == 0


def test_shields_come_back_after_ten_seconds() -> None:
    scenario = battle_of([("Zealot", 1)], [("Medivac", 1)])
    units = placed(scenario, [(16.0, 16.0), (2.0, 2.0)], shield=[10.0, 0.0])
    _, film = play(scenario, units, standing(1), 200)
    shield = np.asarray(film.shield[:, 0])
    assert (shield[:159] == 10).all()
    np.testing.assert_allclose(np.diff(shield[160:190]), 0.125, atol=1e-5)


def test_zerg_health_comes_back_always_and_protoss_and_terran_never() -> None:
    scenario = battle_of([("Zergling", 1), ("Zealot", 1), ("Marine", 1)], [("Medivac", 1)])
    order = list(np.asarray(scenario.max_health))
    units = placed(
        scenario, [(10.0, 10.0), (14.0, 10.0), (18.0, 10.0), (2.0, 30.0)], health=[9, 9, 9, 150]
    )
    units, _ = play(scenario, units, standing(3), 160)
    gained = {h: float(g) - 9 for h, g in zip(order[:3], units.health[:3], strict=True)}
    assert gained[35] == pytest.approx(2.734, abs=1e-3)
    assert gained[100] == 0
    assert gained[45] == 0


def test_a_medivac_heals_at_its_rate_until_its_energy_is_gone() -> None:
    scenario = battle_of([("Marauder", 1), ("Medivac", 1)], [("Zergling", 2)])
    scenario = dataclasses.replace(
        scenario, max_health=scenario.max_health.at[0].set(1000.0), speed=jnp.zeros(4)
    )
    units = placed(scenario, [(10.0, 10.0), (12.0, 10.0), (30.0, 30.0), (30.0, 28.0)])
    units = units._replace(health=units.health.at[0].set(1.0))
    # The healer's order names the agent to heal.
    _, film = play(scenario, units, jnp.array([-1.0, 0.0]), 400)
    health = np.asarray(film.health[:, 0])
    np.testing.assert_allclose(np.diff(health[:320]), 9 / 16, atol=1e-4)
    empty = 20.77 * LOOPS_PER_SECOND
    assert health[round(empty)] - 1 == pytest.approx(186.9, abs=1)
    # From then on only what the energy's regeneration buys.
    assert np.diff(health[350:]).max() <= 0.5625 / 16 / 0.33 + 1e-3


def test_a_medivac_heals_neither_machines_nor_the_whole_nor_the_far() -> None:
    scenario = battle_of([("Marine", 1), ("Medivac", 2)], [("Zergling", 3)])
    scenario = dataclasses.replace(scenario, speed=jnp.zeros(6))
    far = [(30.0, 30.0), (30.0, 28.0), (28.0, 30.0)]
    units = placed(scenario, [(10.0, 10.0), (12.0, 10.0), (14.0, 10.0), *far])
    units = units._replace(health=units.health.at[1].set(50.0))
    after, _ = play(scenario, units, jnp.array([-1.0, 0.0, 1.0]), 32)
    assert after.health[1] == 50
    assert after.energy[1] > 50
    moved = units._replace(x=units.x.at[0].set(3.0), health=units.health.at[0].set(1.0))
    after, _ = play(scenario, moved, jnp.array([-1.0, 0.0, 1.0]), 32)
    assert after.health[0] == 1


def test_enemy_medivacs_heal_the_worst_hurt_in_reach_by_themselves() -> None:
    scenario = battle_of([("Zergling", 1)], [("Marine", 3), ("Medivac", 1)])
    places = [(30.0, 30.0), (10.0, 10.0), (12.0, 10.0), (14.0, 10.0), (12.0, 12.0)]
    units = placed(scenario, places, health=[35, 40, 10, 20, 150])
    after, _ = play(scenario, units, standing(1), 16)
    np.testing.assert_allclose(after.health[1:4], [40, 19, 20], atol=1e-3)


def test_ground_weapons_cannot_hit_flyers() -> None:
    scenario = battle_of([("Marauder", 1)], [("Medivac", 1)])
    units = placed(scenario, [(10.0, 10.0), (12.0, 10.0)])
    units, _ = play(scenario, units, jnp.array([1.0]), 80)
    assert units.health[1] == 150
    assert (float(units.x[0]), float(units.y[0])) == (10.0, 10.0)


def test_the_crawler_reaches_its_range_and_stays_where_it_is() -> None:
    scenario = build(load_map("2s_vs_1sc"))
    for distance, reached in ((8.45, True), (8.55, False)):
        units = placed(scenario, [(14.0, 20.0 - distance), (9.0, 8.5), (14.0, 20.0)])
        units, _ = play(scenario, units, standing(2), 40)
        assert bool(units.shield[0] < 80) == reached
        assert (float(units.x[2]), float(units.y[2])) == (14.0, 20.0)


def test_two_stalkers_that_stand_before_the_crawler_lose() -> None:
    scenario = build(load_map("2s_vs_1sc"))
    units = placed(scenario, [(13.0, 12.0), (15.0, 12.0), (14.0, 20.0)])
    units, film = play(scenario, units, jnp.array([2.0, 2.0]), 400)
    assert not np.asarray(units.health[:2] > 0).any()
    lost = np.maximum(-np.diff(np.asarray(film.health[:, 2])), 0)
    assert 16 <= round(lost.sum() / 12) <= 19


def gaps_to_enemies(env_state: EnvState, x: float, y: float, n: int) -> NDArray[np.float64]:
    """Centre distances from a point to the enemies; the dead are far."""
    u = env_state.units
    distance = np.hypot(np.asarray(u.x[n:], float) - x, np.asarray(u.y[n:], float) - y)
    return np.where(np.asarray(u.health[n:]) > 0, distance, 99.0)


def kite(env_state: EnvState, n: int) -> list[int]:
    """Shoot when ready and not about to be caught; else away along a wide circle."""
    actions, u = [], env_state.units
    for agent in range(n):
        x, y = float(u.x[agent]), float(u.y[agent])
        gaps = gaps_to_enemies(env_state, x, y, n)
        near, ready = int(np.argmin(gaps)), float(u.cooldown[agent]) <= 3
        if float(u.health[agent]) <= 0:
            actions.append(NO_OP)
        elif ready and 3.0 < gaps[near] <= 6.0:
            actions.append(FIRST_TARGET + near)
        elif ready and gaps[near] > 6.0:
            actions.append(STOP)
        else:
            values = {}
            for action, (mx, my) in MOVES.items():
                to_x, to_y = x + 1.48 * mx, y + 1.48 * my
                rim = max(abs(to_x - 16), abs(to_y - 16)) - 11
                gap = gaps_to_enemies(env_state, to_x, to_y, n).min()
                values[action] = gap - 4 * max(rim, 0.0)
            actions.append(max(values, key=lambda action: values[action]))
    return actions


def fought_out(scenario: Scenario, seed: int, *, kites: bool) -> tuple[EnvState, smac.Info]:
    """The end of a battle of agents that kite, or that stand and shoot the first enemy."""
    n, key = scenario.shape.n_allies, jax.random.key(seed)
    env_state, observation = smac.reset(scenario, key)
    for t in range(400):
        shoots = np.asarray(observation.avail_actions[:, FIRST_TARGET])
        stands = [FIRST_TARGET if near else STOP for near in shoots]
        actions = kite(env_state, n) if kites else stands
        env_state, timestep = STEP(
            scenario, env_state, jnp.array(actions), jax.random.fold_in(key, t)
        )
        assert not timestep.info.refused.any()
        observation = timestep.observation
        if timestep.terminated:
            break
    return env_state, timestep.info


STEP = jax.jit(smac.step)
MOVES = {EAST: (1, 0), WEST: (-1, 0), NORTH: (0, 1), SOUTH: (0, -1)}


def test_a_stalker_that_kites_a_zealot_wins_unhurt_and_one_that_stands_dies() -> None:
    text = 'description = "t"\nepisode_limit = 400\n[enemy_order]\nkind = "attack_move"\n'
    text += 'to = [10.0, 16.0]\n[[allies]]\nunit = "Stalker"\ncount = 1\nat = [10.0, 16.0]\n'
    text += '[[enemies]]\nunit = "Zealot"\ncount = 1\nat = [20.0, 16.0]\n'
    scenario = build(parse_map("duel", text))
    end, info = fought_out(scenario, 1, kites=True)
    assert info.battle_won
    assert (end.units.health[0], end.units.shield[0]) == (80, 80)
    assert not fought_out(scenario, 1, kites=False)[1].battle_won


def test_stalkers_that_kite_win_3s_vs_3z_without_a_loss() -> None:
    for seed in range(2):
        _, info = fought_out(build(load_map("3s_vs_3z")), seed, kites=True)
        assert info.battle_won
        assert info.dead_allies == 0


def test_colossi_cross_the_cliff_that_zerglings_must_go_round() -> None:
    scenario = build(load_map("2c_vs_64zg"))
    step = jax.jit(smac.step)
    env_state, observation = smac.reset(scenario, jax.random.key(0))
    assert not observation.avail_actions[0, SOUTH]  # SMAC's mask knows no cliff walkers
    units = env_state.units
    # A move order south crosses it all the same.
    n = scenario.shape.n_allies
    given = Orders(
        jnp.full(n, NOBODY), jnp.array([True, False]), jnp.array([3.0, 16.0]),
        jnp.array([9.0, 16.0]),
    )  # fmt: skip
    units = units._replace(
        x=units.x.at[0].set(10.0), y=units.y.at[0].set(15.0), health=units.health.at[n:].set(0.0)
    )
    given = given._replace(x=jnp.array([10.0, 16.0]))
    delays = jnp.zeros(scenario.shape.n_units)
    loop = jax.jit(game_loop)
    for _ in range(60):
        units = loop(scenario, units, given, delays)
    assert float(units.y[0]) == pytest.approx(9.0, abs=0.05)
    assert float(units.x[0]) == pytest.approx(10.0, abs=0.05)

    # Until the zerglings have come round, the colossi shoot and are not hit.
    deaths = 0
    for t in range(8):
        target = int(np.argmax(np.asarray(observation.avail_actions[0, FIRST_TARGET:])))
        action = FIRST_TARGET + target if observation.avail_actions[0, FIRST_TARGET:].any() else 1
        env_state, timestep = step(scenario, env_state, jnp.array([action, 1]), jax.random.key(t))
        observation, deaths = timestep.observation, int(timestep.info.dead_enemies)
        assert (np.asarray(env_state.units.shield[:2]) == 150).all()
    assert deaths >= 2

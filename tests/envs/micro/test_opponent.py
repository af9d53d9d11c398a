"""What the enemies do: whom they attack, whom they answer, where they go, whom they heal."""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from race.envs.micro import battle
from race.envs.micro.battle import Orders
from race.envs.micro.maps import parse_map
from race.envs.micro.scenario import Scenario, build
from race.envs.micro.state import NOBODY, Units, start
from race.envs.micro.units import UNIT_TYPES

Points = dict[int, tuple[float, float]]
Sides = tuple[tuple[str, ...], tuple[str, ...]]

# Four against four, so that all battles of a race share one program. Agents are sorted by type.
PROTOSS: Sides = (
    ("Stalker", "Stalker", "Zealot", "Zealot"),
    ("Zealot", "Zealot", "Stalker", "Stalker"),
)
ZEALOTS: Sides = (PROTOSS[0], ("Zealot",) * 4)
TERRAN: Sides = (
    ("Marauder", "Marine", "Marine", "Medivac"),
    ("Marine", "Marine", "Marauder", "Medivac"),
)

_film = jax.jit(battle.film)


@functools.cache
def arena(sides: Sides, order: str = 'kind = "hold"', terrain: str = "") -> Scenario:
    """A map on which these units start far from each other, the enemies in a row."""
    text = f'description = "test"\nepisode_limit = 1000\n[enemy_order]\n{order}\n{terrain}'
    for side, units, y in (("allies", sides[0], 10.0), ("enemies", sides[1], 20.0)):
        for k, unit in enumerate(units):
            text += f'[[{side}]]\nunit = "{unit}"\ncount = 1\nat = [{20.0 + 2 * k}, {y}]\n'
    # Rules are tested with enemies that look all the time.
    return dataclasses.replace(build(parse_map("test", text)), scan_period=jnp.array(1))


def harmless(scenario: Scenario) -> Scenario:
    """The same with weapons that do no damage, so that fights go on."""
    return dataclasses.replace(scenario, damage=jnp.zeros_like(scenario.damage))


def present(scenario: Scenario, places: Points, **changes: dict[int, float]) -> Units:
    """These units at these places, and with these entries; all others are dead."""
    units = start(scenario).units
    values = {name: np.array(getattr(units, name)) for name in {"x", "y", "health", *changes}}
    values["health"][[k for k in range(scenario.shape.n_units) if k not in places]] = 0
    for k, (x, y) in places.items():
        values["x"][k], values["y"][k] = x, y
    for name, entries in changes.items():
        for k, value in entries.items():
            values[name][k] = value
    return units._replace(**{name: jnp.asarray(value) for name, value in values.items()})


def stand(scenario: Scenario, units: Units, target: dict[int, int] | None = None) -> Orders:
    """Orders to attack (to heal) these units; the other agents stop."""
    n = scenario.shape.n_allies
    targets = [(target or {}).get(k, NOBODY) for k in range(n)]
    return Orders(jnp.array(targets, jnp.int32), jnp.zeros(n, bool), units.x[:n], units.y[:n])


def watch(scenario: Scenario, units: Units, steps: int, given: Orders | None = None) -> Any:
    """The units in numpy: first as given, then after each of the eight game loops of each step."""
    given = stand(scenario, units) if given is None else given
    films = [jax.tree.map(lambda leaf: np.asarray(leaf)[None], units)]
    for k in range(steps):
        film = _film(scenario, units, given, jax.random.key(k))
        units = jax.tree.map(lambda shots: shots[-1], film)
        films.append(jax.tree.map(np.asarray, film))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *films)


def apart(film: Any, one: int, other: int) -> NDArray[np.float64]:
    """Centre distance in each frame."""
    gap: NDArray[np.float64] = np.hypot(
        film.x[:, one] - film.x[:, other], film.y[:, one] - film.y[:, other]
    )
    return gap


def moved(film: Any, unit: int) -> bool:
    return bool((np.ptp(film.x[:, unit]) > 0) | (np.ptp(film.y[:, unit]) > 0))


# Whom they attack.


@pytest.mark.parametrize(
    ("enemy", "ally", "distance"),
    [
        pytest.param(4, 0, 6.125, id="Zealot on Stalker"),
        pytest.param(4, 2, 6.0, id="Zealot on Zealot"),
        pytest.param(6, 0, 7.25, id="Stalker on Stalker"),
        pytest.param(6, 2, 7.125, id="Stalker on Zealot"),
    ],
)
def test_enemies_attack_what_comes_within_five_or_their_range_from_edge_to_edge(
    enemy: int, ally: int, distance: float
) -> None:
    scenario = arena(PROTOSS)
    scenario = dataclasses.replace(scenario, goal_x=jnp.full(4, 8.0), goal_y=jnp.full(4, 16.0))
    for direction in (0.0, 2.0, 4.0):
        for nearer, found in ((0.01, True), (-0.01, False)):
            way = distance - nearer
            place = (8 + way * math.cos(direction), 16 + way * math.sin(direction))
            film = watch(scenario, present(scenario, {ally: place, enemy: (8.0, 16.0)}), 2)
            assert (film.target[1:, enemy] == (ally if found else NOBODY)).all()
            # Whoever cannot shoot yet comes; nobody comes that has seen nobody.
            assert moved(film, enemy) == (found and enemy == 4)


@pytest.mark.parametrize("nearest", [0, 1, 2, 3])
def test_enemies_attack_the_nearest_and_not_the_weakest(nearest: int) -> None:
    scenario = arena(PROTOSS)
    for enemy in (4, 6):
        places = {k: (16 + 4.5 * math.cos(k), 16 + 4.5 * math.sin(k)) for k in range(4)}
        places[nearest] = (16 + 4.2 * math.cos(nearest), 16 + 4.2 * math.sin(nearest))
        weak = {k: 1.0 for k in range(4) if k != nearest}
        units = present(
            scenario, {**places, enemy: (16.0, 16.0)}, health=weak, shield=dict.fromkeys(weak, 0.0)
        )
        assert watch(scenario, units, 1).target[1, enemy] == nearest


@pytest.mark.parametrize(
    ("enemy", "reach"), [pytest.param(4, 1.225, id="Zealot"), pytest.param(6, 7.25, id="Stalker")]
)
def test_a_target_in_weapon_range_is_kept_and_one_beyond_it_chosen_anew(
    enemy: int, reach: float
) -> None:
    scenario = arena(PROTOSS)
    for distance, kept in ((reach - 0.01, True), (reach + 0.01, False)):
        near = (16.0, 16.0 + 0.8 * reach)
        places = {0: (16 + distance, 16.0), 1: near, enemy: (16.0, 16.0)}
        film = watch(scenario, present(scenario, places, target={enemy: 0}), 1)
        assert film.target[1, enemy] == (0 if kept else 1)


def test_a_target_is_kept_while_another_comes_nearer() -> None:
    scenario = harmless(arena(PROTOSS))
    units = present(scenario, {0: (10.0, 16.0), 1: (16.0, 26.0), 6: (16.0, 16.0)})
    n = scenario.shape.n_allies
    given = Orders(
        jnp.full(n, NOBODY),
        jnp.arange(n) == 1,
        units.x[:n],
        jnp.where(jnp.arange(n) == 1, 18.0, units.y[:n]),
    )
    film = watch(scenario, units, 8, given)
    assert apart(film, 1, 6)[-1] < 3 < apart(film, 0, 6)[-1]
    assert (film.target[1:, 6] == 0).all()
    # It is not that the other cannot be a target.
    units = jax.tree.map(lambda leaf: jnp.asarray(leaf[-1]), film)
    alone = units._replace(health=units.health.at[0].set(0.0))
    assert watch(scenario, alone, 1).target[1, 6] == 1


def test_the_nearest_is_chosen_when_the_target_dies() -> None:
    scenario = arena(PROTOSS)
    places = {0: (13.0, 16.0), 1: (16.0, 21.0), 2: (16.0, 12.0), 6: (16.0, 16.0)}
    units = present(scenario, places, health={0: 1.0}, shield={0: 0.0})
    film = watch(scenario, units, 3)
    died = int(np.argmax(film.health[:, 0] == 0))
    assert died > 0
    assert (film.target[1 : died + 1, 6] == 0).all()
    assert (film.target[died + 1 :, 6] == 2).all()


ANTI_AIR = ("Marine", "Stalker", "Hydralisk")


def test_reluctance_tells_threats_from_the_harmless_and_the_unreachable() -> None:
    """Of SMAC's types a Marauder and a melee unit cannot hit flyers; healers count as threats."""
    by_rank = tuple(sorted(UNIT_TYPES, key=lambda unit: UNIT_TYPES[unit].rank))
    sides = (by_rank, tuple(sorted(UNIT_TYPES)))
    scenario = arena(sides)
    ally_of = {unit: k for k, unit in enumerate(sides[0])}
    for row, enemy in zip(np.asarray(scenario.reluctance), sides[1], strict=True):
        never = {sides[0][k] for k in np.flatnonzero(np.isinf(row))}
        if enemy == "Medivac":
            assert never == set(sides[0])
        else:
            assert never == (set() if enemy in ANTI_AIR else {"Medivac"}), enemy
        assert (row[[k for unit, k in ally_of.items() if unit not in never]] == 0).all()


def test_who_cannot_strike_back_is_attacked_last() -> None:
    scenario = arena(PROTOSS)
    harmless_zealots = jnp.asarray(
        np.where(np.array(sides_types(PROTOSS)[:4]) == "Zealot", 1e6, 0.0)[None].repeat(4, 0),
        jnp.float32,
    )
    scenario = dataclasses.replace(scenario, reluctance=harmless_zealots)
    places = {2: (14.0, 16.0), 0: (20.0, 16.0), 6: (16.0, 16.0)}
    assert watch(scenario, present(scenario, places), 1).target[1, 6] == 0
    assert watch(scenario, present(scenario, places, target={6: 2}), 1).target[1, 6] == 0
    del places[0]
    assert watch(scenario, present(scenario, places), 1).target[1, 6] == 2


def sides_types(sides: Sides) -> tuple[str, ...]:
    return (*sides[0], *sides[1])


def test_what_a_weapon_cannot_reach_is_never_a_target() -> None:
    """A Marauder beside a flyer waits for somebody on the ground; a Marine shoots at it."""
    scenario = arena(TERRAN)
    flyer, marauder, marine = 3, 6, 4
    places = {flyer: (16.0, 18.0), 1: (22.0, 16.0), marauder: (16.0, 16.0)}
    assert watch(scenario, present(scenario, places), 1).target[1, marauder] == 1
    struck = {marauder - 4: float(flyer)}
    del places[1]
    for changes in ({}, {"target": {marauder: flyer}}, {"struck_by": struck}):
        film = watch(scenario, present(scenario, places, **changes), 1)
        if "target" not in changes:
            assert (film.target[1:, marauder] == NOBODY).all()
        assert (film.health[:, flyer] == 150).all()
    places[marine] = places.pop(marauder)
    assert watch(scenario, present(scenario, places), 1).target[1, marine] == flyer


# Whom they answer.


def test_who_is_hit_from_afar_chases_and_idle_friends_within_four_join() -> None:
    scenario = arena(PROTOSS)
    attacker, victim, busy, near, far = 0, 4, 5, 6, 7
    places = {
        attacker: (23.05, 16.0),
        victim: (16.0, 16.0),
        near: (16.2, 19.7),
        far: (16.5, 11.85),
        # It chases somebody of its own, beyond its scan range.
        busy: (17.0, 13.6),
        2: (4.0, 13.6),
    }
    scenario = dataclasses.replace(
        scenario,
        goal_x=jnp.array([places[k][0] for k in range(4, 8)]),
        goal_y=jnp.array([places[k][1] for k in range(4, 8)]),
    )
    units = present(scenario, places, target={busy: 2})
    given = stand(scenario, units, {attacker: victim})
    film = watch(scenario, units, 5, given)
    whole = film.health[:, victim] + film.shield[:, victim] == 150
    hit = int(np.argmin(whole))
    assert hit > 0
    assert apart(film, attacker, victim)[hit] > 6.2
    assert (film.target[1 : hit + 1, victim] == NOBODY).all()
    assert (film.target[hit + 1 :, victim] == attacker).all()
    assert apart(film, attacker, victim)[-1] < apart(film, attacker, victim)[hit] - 1
    heard = 8 * math.ceil(hit / 8)  # calls are answered once per environment step
    assert (film.target[1 : heard + 1, near] == NOBODY).all()
    assert (film.target[heard + 1 :, near] == attacker).all()
    assert apart(film, attacker, near)[-1] < 7.25 < apart(film, attacker, near)[heard]
    assert (film.target[1:, far] == NOBODY).all()
    assert not moved(film, far)
    assert apart(film, busy, victim)[heard] < 4
    assert apart(film, busy, 2).min() > 6.2
    assert (film.target[1:, busy] == 2).all()


def test_who_fights_is_not_turned_by_hits_of_others() -> None:
    scenario = harmless(arena(PROTOSS))
    scenario = dataclasses.replace(scenario, damage=scenario.damage.at[0, 4].set(1.0))
    units = present(scenario, {0: (23.05, 16.0), 2: (15.2, 16.0), 4: (16.0, 16.0)})
    film = watch(scenario, units, 4, stand(scenario, units, {0: 4}))
    assert film.shield[-1, 4] < 50
    assert (film.target[1:, 4] == 2).all()


@pytest.mark.parametrize(("distance", "chased"), [(6.2, True), (20.9, True), (21.1, False)])
def test_an_ally_is_chased_as_far_as_the_leash(distance: float, chased: bool) -> None:
    scenario = arena(PROTOSS)
    units = present(scenario, {0: (5 + distance, 16.0), 4: (5.0, 16.0)}, target={4: 0})
    film = watch(scenario, units, 2)
    assert (film.target[1:, 4] == (0 if chased else NOBODY)).all()
    if chased:
        assert apart(film, 0, 4)[-1] == pytest.approx(distance - 2.25, abs=0.01)


def test_a_chase_ends_where_the_chased_is_faster_than_the_leash_allows() -> None:
    """A Stalker that a Zealot follows runs away and is let go at 21."""
    scenario = arena(PROTOSS)
    units = present(scenario, {0: (24.0, 16.0), 4: (3.5, 16.0)}, target={4: 0})
    given = stand(scenario, units)._replace(walks=jnp.arange(4) == 0, x=jnp.full(4, 31.0))
    film = watch(scenario, units, 3, given)
    gap = apart(film, 0, 4)
    given_up = int(np.argmax(gap > 21))
    assert given_up > 2
    assert (film.target[1 : given_up + 1, 4] == 0).all()
    assert film.target[given_up + 1, 4] == NOBODY


def test_whoever_comes_within_the_scan_range_is_preferred_to_the_chased() -> None:
    scenario = arena(PROTOSS)
    units = present(scenario, {0: (20.0, 16.0), 1: (8.0, 20.0), 4: (8.0, 16.0)}, target={4: 0})
    assert watch(scenario, units, 1).target[1, 4] == 1


# Where they go.


@pytest.mark.parametrize("ally", [None, (12.0, 18.0)], ids=["nobody", "somebody"])
def test_marching_enemies_keep_their_lattice_until_contact(
    ally: tuple[float, float] | None,
) -> None:
    scenario = harmless(arena(ZEALOTS, 'kind = "attack_move"\nto = [8.0, 20.0]'))
    lattice = np.array([[24.0, 12.0], [25.0, 12.0], [24.0, 13.0], [26.0, 14.0]], np.float32)
    start_x, start_y = np.asarray(scenario.x[4:]), np.asarray(scenario.y[4:])
    # The goal is the point plus the offset from the middle at the start of the map.
    np.testing.assert_allclose(scenario.goal_x, 8 + start_x - start_x.mean())
    np.testing.assert_allclose(scenario.goal_y, 20 + start_y - start_y.mean())
    goal = np.array([8.0, 20.0], np.float32) + lattice - lattice.mean(0)
    scenario = dataclasses.replace(
        scenario, goal_x=jnp.asarray(goal[:, 0]), goal_y=jnp.asarray(goal[:, 1])
    )
    places = {4 + k: (float(x), float(y)) for k, (x, y) in enumerate(lattice)}
    film = watch(scenario, present(scenario, places | ({0: ally} if ally else {})), 20)
    at = np.stack([film.x[:, 4:], film.y[:, 4:]], -1)
    offsets = at - at.mean(1, keepdims=True)
    strain = np.abs(offsets - offsets[:1]).max((1, 2))
    meets = (film.target[:, 4:] >= 0).any(1)
    contact = int(np.argmax(meets)) if ally else len(meets)
    # Those behind others start a little later.
    assert (strain[:contact] < 0.01).all()
    if ally:
        assert contact > 20
        assert strain[-1] > 0.3
        assert (film.cooldown[-1, 4:] > 0).sum() >= 3
    else:
        assert not meets.any()
        steps = np.linalg.norm(np.diff(at, axis=0), axis=-1)
        way = float(np.hypot(*(goal - lattice)[0]))
        arrival = way / 2.25 * 16
        np.testing.assert_allclose(steps[1 : int(arrival) - 1], 2.25 / 16, atol=1e-4)
        np.testing.assert_allclose(at[-1], goal, atol=1e-3)
        assert steps[math.ceil(arrival) + 1 :].max() < 1e-4


def test_enemies_march_on_when_the_fight_is_over() -> None:
    scenario = arena(ZEALOTS, 'kind = "attack_move"\nto = [8.0, 20.0]')
    units = present(scenario, {0: (16.0, 18.0), 4: (17.5, 18.0)}, health={0: 1.0}, shield={0: 0.0})
    film = watch(scenario, units, 12)
    assert film.health[-1, 0] == 0
    goal = float(scenario.goal_x[0]), float(scenario.goal_y[0])
    np.testing.assert_allclose((film.x[-1, 4], film.y[-1, 4]), goal, atol=1e-3)


def test_a_goal_on_no_ground_becomes_the_point_itself() -> None:
    terrain = (
        '[terrain]\ncells = """\n' + "\n".join((["#" * 32] * 8) + (["." * 32] * 24)) + '\n"""\n'
    )
    scenario = arena(ZEALOTS, 'kind = "attack_move"\nto = [1.0, 16.0]', terrain)
    # Offsets are -3, -1, 1 and 3 in x: the first two would end beyond the map.
    np.testing.assert_allclose(scenario.goal_x, [1.0, 0.0, 2.0, 4.0])


def test_holding_enemies_stay_without_a_target() -> None:
    scenario = arena(PROTOSS)
    # The enemies where they start; an ally just beyond the reach of all of them.
    places = {k: (float(scenario.x[k]), float(scenario.y[k])) for k in range(4, 8)}
    places[2] = (20.0, 13.9)
    film = watch(scenario, present(scenario, places), 6)
    assert (film.target[1:, 4:] == NOBODY).all()
    assert not any(moved(film, k) for k in range(8))
    assert (film.health == film.health[0]).all()


def test_holding_enemies_chase_and_go_nowhere_but_home() -> None:
    scenario = arena(PROTOSS)
    home = (float(scenario.x[4]), float(scenario.y[4]))
    units = present(
        scenario, {2: (home[0], home[1] - 5.5), 4: home}, health={2: 1.0}, shield={2: 0.0}
    )
    film = watch(scenario, units, 14)
    died = int(np.argmax(film.health[:, 2] == 0))
    assert film.y[died, 4] < home[1] - 4
    away = np.hypot(film.x[died:, 4] - home[0], film.y[died:, 4] - home[1])
    assert (np.diff(away) <= 1e-5).all()


def test_enemies_under_attack_nearest_find_allies_anywhere_one_after_the_other() -> None:
    scenario = arena(PROTOSS, 'kind = "attack_nearest"')
    places = {0: (3.0, 30.0), 2: (22.0, 4.0), 4: (30.0, 3.0), 6: (29.0, 29.0)}
    units = present(scenario, places, health={2: 1.0, 0: 1.0}, shield={2: 0.0, 0: 0.0})
    assert apart(jax.tree.map(lambda leaf: leaf[None], units), 0, 6)[0] > 21
    film = watch(scenario, units, 30)
    first = int(np.argmax(film.health[:, 2] == 0))
    last = int(np.argmax(film.health[:, 0] == 0))
    assert 0 < first < last
    assert (film.target[1 : first + 1, 4] == 2).all()
    assert (film.target[first + 1 : last + 1, 4] == 0).all()
    assert (film.target[first + 1 : last + 1, 6] == 0).all()
    assert (film.target[last + 1 :, 4:] == NOBODY).all()
    gap = apart(film, 6, 0)
    assert (np.diff(gap[first + 1 : last])[gap[first + 1 : last - 1] > 7.5] < 0).all()


# Healers.


def gap_for(patient: str, edge: float) -> float:
    return edge + UNIT_TYPES["Medivac"].radius + UNIT_TYPES[patient].radius


def clinic() -> Scenario:
    """Terran enemies that hold; nobody walks."""
    scenario = arena(TERRAN)
    return dataclasses.replace(scenario, speed=jnp.zeros_like(scenario.speed))


def test_an_enemy_healer_prefers_the_lowest_share_then_the_nearest_in_reach() -> None:
    scenario = clinic()
    marine, other, marauder, healer = 4, 5, 6, 7

    def chosen(health: dict[int, float], distances: dict[int, float]) -> int:
        places = {k: (10 + d * math.cos(k), 16 + d * math.sin(k)) for k, d in distances.items()}
        units = present(scenario, {**places, healer: (10.0, 16.0)}, health=health)
        return int(watch(scenario, units, 1).target[1, healer])

    near = {marine: 3.0, other: 3.0, marauder: 4.0}
    # 60 of 125 is a smaller share than 30 of 45.
    assert chosen({marine: 30.0, marauder: 60.0}, near) == marauder
    assert chosen({marine: 20.0, marauder: 60.0}, near) == marine
    assert chosen({marine: 20.0, other: 20.0}, near | {marine: 3.5}) == other
    assert chosen({marine: 20.0, other: 20.0}, near | {other: 3.5}) == marine
    assert chosen({}, near) == NOBODY
    for patient, kind in ((other, "Marine"), (marauder, "Marauder")):
        health = {marine: 40.0, patient: 1.0}
        assert chosen(health, near | {patient: gap_for(kind, 5.99)}) == patient
        assert chosen(health, near | {patient: gap_for(kind, 6.01)}) == marine
    # The wounded of the other side are not its business.
    assert chosen({1: 1.0, marine: 44.0}, near | {1: 2.0}) == marine


def test_an_enemy_healer_begins_at_five_energy_and_ends_without_any() -> None:
    scenario = clinic()
    healer, patient = 7, 6
    places = {patient: (12.0, 16.0), healer: (10.0, 16.0)}
    units = present(scenario, places, health={patient: 1.0}, energy={healer: 4.5})
    film = watch(scenario, units, 8)
    begins = int(np.argmax(film.target[:, healer] == patient))
    assert film.energy[begins - 1, healer] == pytest.approx(5.0, abs=0.04)
    assert (film.health[:begins, patient] == 1).all()
    assert (film.target[1:begins, healer] == NOBODY).all()
    # It does not stop below 5, but when nothing is left.
    ends = begins + int(np.argmax(film.target[begins:, healer] == NOBODY))
    assert ends > begins + 30
    assert film.energy[ends - 1, healer] < 0.2
    np.testing.assert_allclose(
        np.diff(film.health[begins - 1 : ends - 1, patient]), 9 / 16, atol=1e-4
    )
    assert (film.target[ends:, healer] == NOBODY).all()
    assert (film.health[ends:, patient] == film.health[ends, patient]).all()
    # A healer that looked away must wait until it has five again.
    later = watch(
        scenario, present(scenario, places, health={patient: 1.0}, energy={healer: 2.0}), 4
    )
    assert (later.target[1:, healer] == NOBODY).all()
    assert (later.health[:, patient] == 1).all()


def test_an_enemy_healer_keeps_its_patient_until_it_is_whole() -> None:
    scenario = clinic()
    marine, other, healer = 4, 5, 7
    places = {marine: (12.0, 16.0), other: (10.0, 18.0), healer: (10.0, 16.0)}
    units = present(scenario, places, health={marine: 40.0, other: 10.0}, target={healer: marine})
    film = watch(scenario, units, 3)
    whole = int(np.argmax(film.health[:, marine] == 45))
    assert whole == 9
    assert (film.target[1 : whole + 1, healer] == marine).all()
    assert (film.target[whole + 1 :, healer] == other).all()
    assert film.health[-1, other] > 15
    # Kept also beyond the range of healing, by one at most.
    for edge, kept in ((4.99, True), (5.01, False)):
        far = places | {marine: (10 + gap_for("Marine", edge), 16.0)}
        units = present(scenario, far, health={marine: 40.0, other: 10.0}, target={healer: marine})
        assert watch(scenario, units, 1).target[1, healer] == (marine if kept else other)


def test_an_enemy_healer_goes_to_its_patient_and_with_its_army() -> None:
    scenario = harmless(arena(TERRAN, 'kind = "attack_move"\nto = [8.0, 16.0]'))
    marine, healer = 4, 7
    # A patient 5.9 away: it comes as near as healing asks for.
    away = gap_for("Marine", 5.9)
    hold = dataclasses.replace(scenario, goal_x=jnp.full(4, 16.0), goal_y=jnp.full(4, 16.0))
    places = {marine: (16.0, 16.0), healer: (16.0, 16.0 + away)}
    film = watch(hold, present(hold, places, health={marine: 1.0}), 6)
    assert apart(film, marine, healer).min() > gap_for("Marine", 3.5)
    assert film.health[-1, marine] > 5
    # Nobody is hurt and nobody there to fight: it ends at its place of the formation.
    start_places = {k: (float(scenario.x[k]), float(scenario.y[k])) for k in range(4, 8)}
    film = watch(scenario, present(scenario, start_places), 20)
    goals = np.stack([scenario.goal_x, scenario.goal_y], 1)
    np.testing.assert_allclose(np.stack([film.x[-1, 4:], film.y[-1, 4:]], 1), goals, atol=0.05)
    assert (film.target[1:, 4:] == NOBODY).all()


def test_an_enemy_healer_stays_over_its_army_while_that_fights() -> None:
    scenario = harmless(arena(TERRAN, 'kind = "attack_move"\nto = [4.0, 16.0]'))
    army, healer = (4, 5, 6), 7
    places = {4: (18.0, 15.0), 5: (18.0, 17.0), 6: (19.0, 20.0), healer: (28.0, 20.0)}
    places[0] = (14.0, 16.0)
    units = present(scenario, places)
    film = watch(scenario, units, 14)
    assert (film.target[2:, 4] == 0).all()
    middle = [film.x[-1, army].mean(), film.y[-1, army].mean()]
    np.testing.assert_allclose([film.x[-1, healer], film.y[-1, healer]], middle, atol=0.1)
    assert (film.target[1:, healer] == NOBODY).all()
    # The army's dead do not count, and without a fight it goes on to its goal.
    units = jax.tree.map(lambda leaf: jnp.asarray(leaf[-1]), film)
    fewer = units._replace(health=units.health.at[6].set(0.0))
    film = watch(scenario, fewer, 6)
    middle = [film.x[-1, army[:2]].mean(), film.y[-1, army[:2]].mean()]
    np.testing.assert_allclose([film.x[-1, healer], film.y[-1, healer]], middle, atol=0.1)
    film = watch(scenario, fewer._replace(health=fewer.health.at[0].set(0.0)), 6)
    assert film.x[-1, healer] < film.x[0, healer] - 3


# Always.


@pytest.mark.parametrize(
    "order", ['kind = "attack_nearest"', 'kind = "attack_move"\nto = [9.0, 9.0]']
)
@pytest.mark.parametrize("sides", [PROTOSS, TERRAN], ids=["Protoss", "Terran"])
def test_targets_are_always_living_units_of_the_right_side(sides: Sides, order: str) -> None:
    scenario = arena(sides, order)
    scenario = dataclasses.replace(scenario, damage=3 * scenario.damage)
    places = {k: (12.0 + 2 * (k % 4), 10.0 + 4 * (k // 4)) for k in range(8)}
    units = present(scenario, places)
    film = watch(scenario, units, 24, stand(scenario, units, {0: 4, 1: 5, 2: 6, 3: 1}))
    n, types = scenario.shape.n_allies, sides_types(sides)
    deaths = (film.health[-1] == 0).sum()
    assert deaths >= 4
    for enemy in range(n, 8):
        alive = film.health[:-1, enemy] > 0
        target = film.target[1:, enemy][alive]
        health = film.health[:-1][alive]
        named = np.flatnonzero(target != NOBODY)
        assert len(named) > 0
        friends = types[enemy] == "Medivac"
        low, high = (n, 8) if friends else (0, n)
        assert ((target[named] >= low) & (target[named] < high)).all()
        assert (health[named, target[named]] > 0).all()
        if not friends and "nearest" in order and sides is PROTOSS:
            # Nobody idles while somebody is left to fight.
            assert ((target != NOBODY) == (health[:, :n] > 0).any(1)).all()


# When they look.


def test_enemies_look_once_in_a_period_each_at_a_moment_of_its_own() -> None:
    scenario = dataclasses.replace(arena(ZEALOTS), scan_period=jnp.array(8))
    units = present(
        scenario, {0: (16.0, 16.0), **{4 + k: (18.5, 14.5 + k) for k in range(4)}}
    )._replace(scan_phase=jnp.array([0.0, 0.25, 0.5, 0.99]))
    film = watch(scenario, units, 1)
    first = np.argmax(film.target[:, 4:] == 0, axis=0)
    # In loop k the clock shows k; who looks has phase (8 - k) mod 8.
    np.testing.assert_array_equal(first, [8, 6, 4, 1])


def test_who_lost_its_target_stands_until_it_looks_again() -> None:
    scenario = dataclasses.replace(
        arena(ZEALOTS, 'kind = "attack_move"\nto = [8.0, 20.0]'), scan_period=jnp.array(8)
    )
    units = present(scenario, {0: (16.0, 16.0), 1: (12.0, 16.0), 4: (16.9, 16.0)})
    units = units._replace(
        target=units.target.at[4].set(0),
        health=units.health.at[0].set(0.0),
        scan_phase=jnp.full(4, 0.25),
        clock=jnp.array(0),
    )
    film = watch(scenario, units, 1)
    # Six loops pass before it looks.
    np.testing.assert_array_equal(film.target[1:6, 4], 0)
    np.testing.assert_allclose(film.x[:6, 4], 16.9)
    assert film.target[6, 4] == 1
    assert film.x[-1, 4] < 16.9

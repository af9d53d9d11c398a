"""How units walk: speeds, pushes, crowds, walls, and the ways round them."""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray
from test_opponent import PROTOSS, TERRAN, ZEALOTS, apart, arena, moved, present, stand, watch

from race.envs.micro import load_map, make
from race.envs.micro.battle import EAST, Orders, orders
from race.envs.micro.maps import parse_map
from race.envs.micro.scenario import Scenario, build
from race.envs.micro.state import NOBODY, Units, start
from race.envs.micro.units import UNIT_TYPES

PER_STEP = {
    "Baneling": 1.25,
    "Hydralisk": 1.125,
    "Colossus": 1.125,
    "Marauder": 1.125,
    "Marine": 1.125,
    "Medivac": 1.375,
    "SpineCrawler": 0.0,
    "Stalker": 1.47655,
    "Zealot": 1.125,
    "Zergling": 1.47655,
}
ZEALOT_RADIUS = 0.375  # with which it keeps others off
BAND = "\n".join(["#" * 32] * 8 + ["." * 32] * 16 + ["#" * 32] * 8)
# Rows 8 to 23 of a map are ground; its programs are those of a plain.
CORRIDOR = f'[terrain]\ncells = """\n{BAND}\n"""\n'


def walk(scenario: Scenario, units: Units, goals: dict[int, tuple[float, float]]) -> Orders:
    """Orders to walk to these places; the other agents stop."""
    given = stand(scenario, units)
    x, y, walks = np.array(given.x), np.array(given.y), np.array(given.walks)
    for k, (to_x, to_y) in goals.items():
        x[k], y[k], walks[k] = to_x, to_y, True
    return given._replace(x=jnp.asarray(x), y=jnp.asarray(y), walks=jnp.asarray(walks))


def peaceful(scenario: Scenario, **goals: float) -> Scenario:
    """Enemies that attack nobody, and all go to one place if there is one."""
    changes: dict[str, Any] = {name: jnp.full(4, goals[name]) for name in goals}
    reluctance = jnp.full_like(scenario.reluctance, jnp.inf)
    return dataclasses.replace(scenario, reluctance=reluctance, **changes)


def at_starts(scenario: Scenario) -> dict[int, tuple[float, float]]:
    return {k: (float(scenario.x[k]), float(scenario.y[k])) for k in range(scenario.shape.n_units)}


def paces(film: Any, unit: int) -> NDArray[np.float64]:
    """How far a unit went in each game loop."""
    steps: NDArray[np.float64] = np.hypot(np.diff(film.x[:, unit]), np.diff(film.y[:, unit]))
    return steps


def reversals(film: Any, part: slice) -> float:
    """Share of the moving loops in which a unit goes back where it came from."""
    dx, dy = np.diff(film.x[:, part], axis=0), np.diff(film.y[:, part], axis=0)
    way = np.hypot(dx, dy)
    moving = (way[1:] > 0.01) & (way[:-1] > 0.01)
    back = dx[1:] * dx[:-1] + dy[1:] * dy[:-1] < 0
    assert moving.sum() > 100
    return float((back & moving).sum() / moving.sum())


# Speeds.


def test_speeds_are_those_of_the_table() -> None:
    kinds = tuple(sorted(PER_STEP, key=lambda unit: UNIT_TYPES[unit].rank))
    assert set(kinds) == set(UNIT_TYPES)
    scenario = arena((kinds, kinds))
    expected = np.array([PER_STEP[unit] for unit in kinds * 2]) / 8
    np.testing.assert_allclose(scenario.speed, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("agent", "unit"),
    [pytest.param(0, "Stalker", id="Stalker"), pytest.param(2, "Zealot", id="Zealot")],
)
@pytest.mark.parametrize("direction", [0.0, 1.0, 4.0])
def test_units_walk_at_full_speed_from_the_first_loop_and_straight(
    agent: int, unit: str, direction: float
) -> None:
    scenario = arena(PROTOSS)
    units = present(scenario, {agent: (12.0, 12.0)})
    dx, dy = math.cos(direction), math.sin(direction)
    film = watch(scenario, units, 2, walk(scenario, units, {agent: (12 + 5 * dx, 12 + 5 * dy)}))
    np.testing.assert_allclose(paces(film, agent), PER_STEP[unit] / 8, atol=1e-5)
    for steps in (1, 2):
        gone = film.x[8 * steps, agent] - 12, film.y[8 * steps, agent] - 12
        way = steps * PER_STEP[unit]
        np.testing.assert_allclose(gone, (way * dx, way * dy), atol=1e-4)


def test_units_stop_at_their_goal_and_under_the_order_to_stop() -> None:
    scenario = arena(PROTOSS)
    units = present(scenario, {0: (12.0, 12.0), 2: (12.0, 20.0)})
    film = watch(scenario, units, 2, walk(scenario, units, {0: (12.9, 12.0)}))
    np.testing.assert_allclose(film.x[[5, 16], 0], 12.9, atol=1e-5)
    assert not moved(film, 2)


def medivac_flight() -> Any:
    scenario = arena(TERRAN)
    units = present(scenario, {3: (5.0, 10.0)})
    return watch(scenario, units, 12, walk(scenario, units, {3: (15.0, 10.0)}))


def test_a_medivac_takes_nineteen_loops_to_full_speed() -> None:
    pace = paces(medivac_flight(), 3)
    acceleration = 2.3125 / 16**2
    np.testing.assert_allclose(pace[:19], acceleration * np.arange(1, 20), atol=1e-4)
    assert pace[17] < 0.96 * 2.75 / 16 < 0.99 * 2.75 / 16 < pace[18]
    np.testing.assert_allclose(pace[19:30], 2.75 / 16, atol=1e-5)
    assert pace[19:27].sum() == pytest.approx(1.375, abs=1e-4)


def test_a_medivac_brakes_and_comes_to_rest_at_its_goal() -> None:
    film = medivac_flight()
    pace = paces(film, 3)
    assert film.x[:, 3].max() < 15.1
    assert film.x[-1, 3] == pytest.approx(15.0, abs=0.02)
    assert pace[-8:].max() < 0.005
    np.testing.assert_allclose(film.y[:, 3], 10, atol=1e-4)
    # It brakes no harder than it accelerates.
    assert np.abs(np.diff(pace)).max() <= 2.3125 / 16**2 + 1e-4


# Pushes.


def test_friends_that_walk_at_each_other_do_not_pass_through() -> None:
    scenario = arena(PROTOSS)
    for offset in (0.0, 0.1):
        units = present(scenario, {2: (10.0, 16.0), 3: (16.0, 16.0 + offset)})
        goals = {2: (16.0, 16.0), 3: (10.0, 16.0)}
        film = watch(scenario, units, 8, walk(scenario, units, goals))
        assert apart(film, 2, 3).min() > 2 * ZEALOT_RADIUS - 0.15
        # They go round each other.
        np.testing.assert_allclose(film.x[-1, 2:4], [16.0, 10.0], atol=0.05)


def test_enemies_that_walk_at_each_other_do_not_pass_through() -> None:
    scenario = peaceful(arena(ZEALOTS), goal_x=10.0, goal_y=16.0)
    units = present(scenario, {2: (10.0, 16.0), 4: (16.0, 16.0)})
    film = watch(scenario, units, 8, walk(scenario, units, {2: (16.0, 16.0)}))
    assert apart(film, 2, 4).min() > 2 * ZEALOT_RADIUS - 0.15
    np.testing.assert_allclose(film.x[-1, [2, 4]], [16.0, 10.0], atol=0.05)


def test_fighters_are_not_moved_by_those_who_push_them() -> None:
    scenario = arena(PROTOSS)
    scenario = dataclasses.replace(scenario, damage=jnp.zeros_like(scenario.damage))
    units = present(scenario, {2: (16.0, 16.0), 4: (16.9, 16.0), 0: (12.0, 16.1), 3: (16.0, 12.0)})
    given = walk(scenario, units, {0: (22.0, 16.1), 3: (16.0, 22.0)})
    given = given._replace(target=given.target.at[2].set(4))
    film = watch(scenario, units, 8, given)
    assert film.cooldown[1:, [2, 4]].max(0).min() > 0
    pushes = np.minimum(apart(film, 2, 0) - 1.0, apart(film, 2, 3) - 0.75)
    assert pushes.min() < 0.02  # they did come against it
    assert not moved(film, 2)
    assert not moved(film, 4)
    # And the pushers got past.
    assert film.x[-1, 0] > 18
    assert film.y[-1, 3] > 18


def test_the_idle_yield_to_friends_and_not_to_enemies() -> None:
    scenario = peaceful(arena(ZEALOTS), goal_x=22.0, goal_y=16.1)
    for walker, yields in ((3, True), (4, False)):
        units = present(scenario, {2: (16.0, 16.0), walker: (13.0, 16.1)})
        goals = {3: (22.0, 16.1)} if walker == 3 else {}
        film = watch(scenario, units, 8, walk(scenario, units, goals))
        assert apart(film, 2, walker).min() < 0.8
        shift = np.hypot(film.x[-1, 2] - 16, film.y[-1, 2] - 16)
        if yields:
            assert shift > 0.1
        else:
            assert not moved(film, 2)
        assert film.x[-1, walker] > 20  # nobody is in the way for good


def test_units_that_overlap_come_apart() -> None:
    ground = arena(PROTOSS)
    film = watch(ground, present(ground, {2: (16.0, 16.0), 3: (16.1, 16.0)}), 2)
    assert apart(film, 2, 3)[-1] > 2 * ZEALOT_RADIUS - 0.02
    assert apart(film, 2, 3)[-1] < 2 * ZEALOT_RADIUS + 0.2


@functools.cache
def flyers_at_one_place() -> Any:
    air = peaceful(arena(TERRAN), goal_x=16.2, goal_y=16.0)
    return watch(air, present(air, {3: (16.0, 16.0), 7: (16.2, 16.0)}), 6)


def test_flyers_that_overlap_come_apart() -> None:
    gap = apart(flyers_at_one_place(), 3, 7)
    assert gap[0] < 0.3
    assert gap.max() > 0.8


def test_flyers_drift_apart_slowly() -> None:
    """A twentieth of the overlap of 1.3 is undone in a loop: 0.44 in eight loops."""
    gap = apart(flyers_at_one_place(), 3, 7)
    assert gap[8] < 1.2
    assert (gap < 2 * 0.75 + 0.05).all()


def test_flyers_and_the_ground_pass_each_other() -> None:
    air = arena(TERRAN)
    film = watch(air, present(air, {1: (16.0, 16.0), 3: (16.0, 16.0)}), 1)
    assert not moved(film, 1)
    assert not moved(film, 3)


@pytest.mark.parametrize("idle", [True, False])
def test_structures_never_move_and_keep_others_off(idle: bool) -> None:
    scenario = build(load_map("2s_vs_1sc"))
    scenario = peaceful(scenario) if idle else scenario
    units = start(scenario).units._replace(
        x=jnp.array([13.9, 15.2, 14.0]), y=jnp.array([17.0, 18.0, 20.0])
    )
    given = walk(scenario, units, {0: (14.0, 20.2), 1: (14.0, 20.0)})
    film = watch(scenario, units, 5, given)
    assert (film.target[1:, 2] == NOBODY).all() == idle
    assert not moved(film, 2)
    near = np.minimum(apart(film, 0, 2), apart(film, 1, 2))
    assert 1.5 - 0.15 < near.min() < 1.5 + 0.05


def test_idle_structures_yield_to_nobody() -> None:
    """All of the push is the friend's who walks into one."""
    scenario = arena((("Zergling", "SpineCrawler"), ("Zergling",)))
    units = present(scenario, {0: (12.0, 16.0), 1: (16.0, 16.0)})
    film = watch(scenario, units, 3, walk(scenario, units, {0: (16.0, 16.0)}))
    assert not moved(film, 1)
    assert 0.875 + 0.375 - 0.1 < apart(film, 0, 1).min() < 0.875 + 0.375 + 0.05


def test_a_medivac_keeps_its_speed_from_order_to_order() -> None:
    scenario = arena(TERRAN)
    units, way = present(scenario, {3: (5.0, 10.0)}), []
    for _ in range(6):
        x = float(units.x[3])
        film = watch(scenario, units, 1, orders(scenario, units, jnp.full(4, EAST)))
        units = jax.tree.map(lambda leaf: jnp.asarray(leaf[-1]), film)
        way.append(float(units.x[3]) - x)
    np.testing.assert_allclose(way[3:], PER_STEP["Medivac"], atol=1e-3)


# Crowds.


@functools.cache
def siege() -> Any:
    """Twelve Zealots against a Colossus that stands; nobody is hurt."""
    text = 'description = "t"\nepisode_limit = 400\n[enemy_order]\nkind = "attack_nearest"\n'
    text += '[[allies]]\nunit = "Colossus"\ncount = 1\nat = [10.0, 16.0]\n'
    text += '[[enemies]]\nunit = "Zealot"\ncount = 12\nat = [18.0, 16.0]\n'
    scenario = build(parse_map("siege", text))
    scenario = dataclasses.replace(scenario, damage=jnp.zeros_like(scenario.damage))
    return watch(scenario, start(scenario).units, 30)


def test_a_crowd_surrounds_its_target() -> None:
    film = siege()
    six = 6 * 16
    fought = film.cooldown[: six + 1, 1:].max(0) > 0
    assert fought.sum() >= 6
    # All come to fight in the end, from all sides.
    assert (film.cooldown[:, 1:].max(0) > 0).all()
    around = np.sort(np.arctan2(film.y[-1, 1:] - 16, film.x[-1, 1:] - 10))
    assert np.diff([*around, around[0] + 2 * math.pi]).max() < math.pi / 2
    one, other = np.triu_indices(12, 1)
    gaps = np.hypot(
        film.x[-1, 1 + one] - film.x[-1, 1 + other], film.y[-1, 1 + one] - film.y[-1, 1 + other]
    )
    assert gaps.min() > 0.94 * 2 * ZEALOT_RADIUS


def test_nobody_in_a_crowd_trembles() -> None:
    assert reversals(siege(), slice(1, None)) < 0.05


# Walls.


@pytest.mark.parametrize("agent", [0, 2])
@pytest.mark.parametrize("north", [True, False])
def test_units_slide_along_straight_walls(agent: int, north: bool) -> None:
    scenario = arena(PROTOSS, terrain=CORRIDOR)
    assert scenario.shape.plain
    inner = [0.5, 0.5, 0.375, 0.375][agent]
    y, edge = (23.0, 24 - inner) if north else (9.0, 8 + inner)
    units = present(scenario, {agent: (16.0, y)})
    goal = (20.0, y + (4 if north else -4))
    film = watch(scenario, units, 4, walk(scenario, units, {agent: goal}))
    assert film.y[-1, agent] == pytest.approx(edge, abs=1e-4)
    assert film.y[:, agent].max() <= 24 - inner + 1e-4
    assert film.y[:, agent].min() >= 8 + inner - 1e-4
    assert film.x[-1, agent] > 18


def wander(scenario: Scenario, units: Units, agents: tuple[int, ...], seed: int) -> Any:
    """Agents that walk in a random direction for two steps at a time."""
    rng = np.random.default_rng(seed)
    films = []
    for _ in range(12):
        angle = rng.uniform(0, 2 * math.pi, len(agents))
        goals = {
            k: (float(units.x[k]) + 6 * math.cos(a), float(units.y[k]) + 6 * math.sin(a))
            for k, a in zip(agents, angle, strict=True)
        }
        film = watch(scenario, units, 2, walk(scenario, units, goals))
        units = units._replace(x=jnp.asarray(film.x[-1]), y=jnp.asarray(film.y[-1]))
        films.append(film)
    return np.concatenate([f.x for f in films]), np.concatenate([f.y for f in films])


@pytest.mark.parametrize("seed", [0, 1])
def test_units_never_enter_walls(seed: int) -> None:
    spec = load_map("2s_vs_1sc")
    scenario = build(spec)
    assert not scenario.shape.plain
    units = start(scenario).units
    units = units._replace(health=units.health.at[2].set(0.0))
    x, y = wander(scenario, units, (0, 1), seed)
    open_ground = spec.cells == "."
    touched = 0
    for k in (0, 1):
        for i, j in zip(x[:, k], y[:, k], strict=True):
            column, row = math.floor(i), math.floor(j)
            assert open_ground[column, row]
            for wall, gap in (
                (not open_ground[column + 1, row], column + 1 - i),
                (not open_ground[column - 1, row], i - column),
                (not open_ground[column, row + 1], row + 1 - j),
                (not open_ground[column, row - 1], j - row),
            ):
                assert not wall or gap >= 0.5 - 1e-4
                touched += wall and gap < 0.5 + 1e-4
    assert touched > 20


def test_units_slide_along_walls_with_corners() -> None:
    scenario = build(load_map("2s_vs_1sc"))
    units = start(scenario).units
    units = units._replace(
        x=jnp.array([10.5, 17.2, 14.0]), y=jnp.array([17.0, 12.0, 20.0]),
        health=units.health.at[2].set(0.0),
    )  # fmt: skip
    # West and north-west lie walls: what is left of the way is north, or south.
    film = watch(scenario, units, 6, walk(scenario, units, {0: (4.0, 21.5), 1: (23.0, 9.0)}))
    assert film.x[-1, 0] == pytest.approx(8.5, abs=0.02)
    assert film.y[-1, 0] == pytest.approx(19.5, abs=0.6)
    assert film.x[-1, 1] == pytest.approx(19.5, abs=0.02)
    assert film.y[-1, 1] < 10


def too_near_in_the_room(x: float) -> tuple[Scenario, Units]:
    scenario = build(load_map("2s_vs_1sc"))
    units = start(scenario).units
    return scenario, units._replace(
        x=jnp.array([x, 14.0, 14.0]), y=jnp.array([12.5, 9.0, 20.0]),
        health=units.health.at[2].set(0.0),
    )  # fmt: skip


def too_near_on_a_plain(x: float) -> tuple[Scenario, Units]:
    scenario = arena(PROTOSS)
    return scenario, present(scenario, {0: (x, 12.5)})


NEAR_WALLS = [
    pytest.param(lambda: too_near_in_the_room(8.1), 1, id="west of the room"),
    pytest.param(lambda: too_near_in_the_room(19.9), -1, id="east of the room"),
    pytest.param(lambda: too_near_on_a_plain(0.1), 1, id="west of a plain"),
    pytest.param(lambda: too_near_on_a_plain(31.9), -1, id="east of a plain"),
]


@pytest.mark.parametrize(("there", "inwards"), NEAR_WALLS)
def test_who_was_created_too_near_to_a_wall_can_walk_away(there: Any, inwards: int) -> None:
    scenario, units = there()
    x, y = float(units.x[0]), float(units.y[0])
    way = 2 * PER_STEP["Stalker"]
    film = watch(scenario, units, 2, walk(scenario, units, {0: (x + 4 * inwards, y)}))
    assert abs(film.x[16, 0] - x) == pytest.approx(way, abs=0.01)
    film = watch(scenario, units, 2, walk(scenario, units, {0: (x, y + 4)}))
    assert film.y[16, 0] - y == pytest.approx(way, abs=0.01)
    film = watch(scenario, units, 2, walk(scenario, units, {0: (x - 4 * inwards, y)}))
    assert ((film.x[:, 0] - x) * inwards >= -1e-5).all()


@pytest.mark.parametrize(("there", "inwards"), NEAR_WALLS)
def test_who_was_created_too_near_to_a_wall_stays_if_it_stands(there: Any, inwards: int) -> None:
    del inwards
    scenario, units = there()
    assert not moved(watch(scenario, units, 1), 0)


def test_a_medivac_flies_over_walls_that_stop_the_ground() -> None:
    scenario = arena(TERRAN, terrain=CORRIDOR)
    units = present(scenario, {1: (16.0, 20.0), 3: (12.0, 20.0)})
    film = watch(scenario, units, 14, walk(scenario, units, {1: (16.0, 40.0), 3: (12.0, 40.0)}))
    assert film.y[-1, 1] == pytest.approx(24 - 0.375, abs=1e-4)
    # Its body stays on the map.
    assert film.y[-1, 3] == pytest.approx(32 - 0.75, abs=1e-4)


# Ways.


def test_zerglings_go_round_the_cliff_on_both_sides_and_arrive() -> None:
    battle = make("2c_vs_64zg")
    film = watch(battle.scenario, start(battle.scenario).units, 28)
    left = (film.health + film.shield)[:, :2].sum(1)
    first = int(np.argmax(left < left[0])) / 16
    assert 8 <= first <= 14
    lings = slice(2, None)
    assert ((film.x[:, lings] < 4).any(0)).sum() >= 16
    assert ((film.x[:, lings] > 28).any(0)).sum() >= 16
    columns, rows = np.floor(film.x[:, lings]).astype(int), np.floor(film.y[:, lings]).astype(int)
    assert (battle.spec.cells[columns, rows] == ".").all()
    # Half of them stand before the Colossi by then.
    x, y = film.x[-1], film.y[-1]
    nearest = np.min([np.hypot(x[lings] - x[k], y[lings] - y[k]) for k in (0, 1)], axis=0)
    assert (nearest < 5).sum() >= 32
    assert reversals(film, lings) < 0.05


def test_banelings_come_down_the_corridor() -> None:
    battle = make("so_many_baneling")
    film = watch(battle.scenario, start(battle.scenario).units, 20)
    columns, rows = np.floor(film.x).astype(int), np.floor(film.y).astype(int)
    assert (battle.spec.cells[columns, rows] == ".").all()
    left = (film.health + film.shield)[:, :7].sum(1)
    first = int(np.argmax(left < left[0]))
    # The way of about 20 cells at 2.5 a second.
    assert 6 <= first / 16 <= 11
    lead = np.hypot(film.x[:, 7:] - film.x[0, 3], film.y[:, 7:] - film.y[0, 3]).min(1)
    assert (np.diff(lead[:first]) < 0).all()
    # All go at their own speed, but where they jostle.
    marching = np.array([paces(film, k)[8:48].mean() for k in range(7, 39)])
    assert (marching > 0.9 * 2.5 / 16).all()
    assert marching.mean() > 0.98 * 2.5 / 16
    assert reversals(film, slice(7, None)) < 0.05

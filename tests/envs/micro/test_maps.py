"""Maps: where units start, maps of one's own, and what is said about broken ones."""

import json
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from race.envs.micro import lattice, load_map, make, map_names, maps, opponent
from race.envs.micro.maps import parse_map
from race.errors import TaskError

# Where units start, agents in their order and enemies in the order of creation.
MARINES = [(8.25, 16), (9, 15.25), (9, 16), (9, 16.75), (9.75, 15.25), (9.75, 16), (9.75, 16.75)]
TERRANS: dict[str, list[Any]] = {
    "Marauder": [(7.875, 14.875), (7.875, 17.125)],
    "Marine": MARINES,
    "Medivac": [(9, 16)],
}
FOES = [(23, 16), (23, 15.25), (23.75, 16), (23, 16.75), (22.25, 16), (23.75, 15.25)]
STARTS: dict[str, tuple[dict[str, list[Any]], dict[str, list[Any]]]] = {
    "2s3z": (
        {"Stalker": [(9, 14.75), (9, 16)], "Zealot": [(8, 17), (10, 17), (11, 16)]},
        {"Stalker": [(23, 16), (23, 14.75)], "Zealot": [(24, 17), (22, 17), (25, 16)]},
    ),
    "3s5z": (
        {
            "Stalker": [(9, 14.75), (9, 16), (10.25, 16)],
            "Zealot": [(7, 16), (8, 17), (9, 18), (10, 14), (11, 15)],
        },
        {
            "Stalker": [(23, 16), (23, 14.75), (24.25, 16)],
            "Zealot": [(22, 17), (23, 18), (21, 16), (24, 14), (25, 15)],
        },
    ),
    "3s_vs_3z": (
        {"Stalker": [(9, 14.75), (9, 16), (10.25, 16)]},
        {"Zealot": [(23, 16), (23, 15), (24, 16)]},
    ),
    "MMM": (
        TERRANS,
        {
            "Marine": [*FOES, (23.75, 16.75)],
            "Marauder": [(21.875, 17.125), (21.875, 14.875)],
            "Medivac": [(23, 16)],
        },
    ),
    "MMM2": (
        TERRANS,
        {
            "Marine": [*FOES, (23.75, 16.75), (22.25, 16.75)],
            "Marauder": [(21.875, 14.875), (23, 13.75), (25.25, 16)],
            "Medivac": [(23, 16)],
        },
    ),
    "2s_vs_1sc": (
        {"Stalker": [(11.1208, 10.338), (16.976, 10.3662)]},
        {"SpineCrawler": [(14, 20)]},
    ),
    "2c_vs_64zg": ({"Colossus": [(16, 14), (16, 16)]}, {}),
    "so_many_baneling": (
        {
            "Zealot": [
                (10.469, 12.0234),
                (11.469, 11.0234),
                (11.469, 12.0234),
                (11.469, 13.0234),
                (12.469, 11.0234),
                (12.469, 12.0234),
                (12.469, 13.0234),
            ]
        },
        {},
    ),
}
# Swarms: the unit, the point, and the columns of each row of the lattice.
SWARMS = {
    "2c_vs_64zg": (
        *("Zergling", (16, 9), (13, 0.75)),
        {
            **dict.fromkeys((11.25, 6.75), range(1, 8)),
            **dict.fromkeys((10.5, 9.75, 9, 8.25, 7.5), range(9)),
            6: range(2, 7),
        },
    ),
    "so_many_baneling": (
        *("Baneling", (27.91, 28.24), (25.66, 0.75)),
        {
            **dict.fromkeys((29.74, 26.74), range(1, 6)),
            **dict.fromkeys((28.99, 28.24, 27.49), range(6)),
            25.99: range(2, 6),
        },
    ),
}
# Cells that are walkable.
OPEN = {
    **{"2c_vs_64zg": 336, "2s_vs_1sc": 896, "3s_vs_3z": 1024, "so_many_baneling": 300},
    **{"3s_vs_4z": 1024, "3s_vs_5z": 1024, "2m_vs_1z": 360, "bane_vs_bane": 360},
    **{"6h_vs_8z": 908, "corridor": 343},
}
MORE_STARTS = json.loads((Path(__file__).parent / "starts.json").read_text())

THREE_MARINES = """
description = "three Marines on each side"
episode_limit = 60

[[allies]]
unit = "Marine"
count = 3
at = [9.0, 16.0]

[[enemies]]
unit = "Marine"
count = 3
at = [23.0, 16.0]

[enemy_order]
kind = "attack_move"
to = [9.0, 16.0]
"""


def flat(side: dict[str, list[Any]]) -> list[tuple[str, float, float]]:
    return [(unit, x, y) for unit, places in side.items() for x, y in places]


def assert_same_starts(ours: Any, expected: list[tuple[str, float, float]]) -> None:
    assert [start.unit for start in ours] == [unit for unit, _, _ in expected]
    places = [(start.x, start.y) for start in ours]
    np.testing.assert_allclose(places, [(x, y) for _, x, y in expected], atol=1e-9)


def from_south(point: tuple[float, float], middle: tuple[float, float]) -> tuple[float, float]:
    """Distance, then angle counter-clockwise from due south: the order of creation."""
    dx, dy = point[0] - middle[0], point[1] - middle[1]
    return round(math.hypot(dx, dy), 6), round(math.atan2(dx, -dy) % (2 * math.pi), 6)


@pytest.mark.parametrize("name", sorted(STARTS))
def test_units_start_where_the_maps_create_them(name: str) -> None:
    allies, enemies = STARTS[name]
    spec = load_map(name)
    assert_same_starts(spec.allies, flat(allies))
    expected = flat(enemies)
    if name in SWARMS:
        unit, middle, (left, step), rows = SWARMS[name]
        places = [(left + step * k, float(y)) for y, columns in rows.items() for k in columns]
        places.sort(key=lambda place: from_south(place, middle))
        expected = [(unit, x, y) for x, y in places]
        assert len(expected) == {"2c_vs_64zg": 64, "so_many_baneling": 32}[name]
    assert_same_starts(spec.enemies, expected)
    scenario = make(name).scenario
    starts = [*spec.allies, *spec.enemies]
    np.testing.assert_allclose(scenario.x, [start.x for start in starts], rtol=1e-6)
    np.testing.assert_allclose(scenario.y, [start.y for start in starts], rtol=1e-6)


@pytest.mark.parametrize("name", sorted(MORE_STARTS))
def test_units_of_the_other_maps_start_where_they_are_known_to(name: str) -> None:
    """As decoded from the maps' archives and seen in recorded battles."""
    spec, expected = load_map(name), MORE_STARTS[name]
    assert_same_starts(spec.allies, [tuple(start) for start in expected["allies"]])
    assert_same_starts(spec.enemies, [tuple(start) for start in expected["enemies"]])


def test_a_colossus_that_took_room_would_move_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = load_map("1c3s5z").allies
    monkeypatch.setattr(lattice, "COLOSSUS_TAKES_ROOM", True)
    assert load_map("1c3s5z").allies != usual
    assert load_map("3s5z").allies == make("3s5z").spec.allies


def test_half_tiles_are_ground_or_wall_by_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = csgraph_parts(load_map("corridor").cells)
    assert parts == [343]
    monkeypatch.setattr(maps, "HALF_TILES_ARE", "#")
    walls = load_map("corridor")
    assert (walls.cells == ".").sum() == 332
    assert csgraph_parts(walls.cells) == [4, 100, 228]  # nobody would come through


def test_levels_agree_with_the_cells() -> None:
    told = [name for name in map_names() if load_map(name).levels]
    assert told == ["2c_vs_64zg"]
    spec = load_map("2c_vs_64zg")
    levels = np.array([list(row) for row in spec.levels])[::-1].T
    assert levels.shape == spec.cells.shape
    assert not (levels[spec.cells != "#"] == "0").any()
    # A cliff has the lower floor on one side and the higher one on the other.
    cliff = np.argwhere(spec.cells == "C")
    assert set(levels[cliff[:, 0], cliff[:, 1].min() - 1]) == {"1"}
    assert set(levels[8:24, cliff[:, 1].max() + 1]) == {"2"}


def csgraph_parts(cells: Any) -> list[int]:
    """Sizes of the parts of the ground that hang together."""
    labels, count = ndimage.label(cells == ".")
    return sorted(int((labels == label).sum()) for label in range(1, count + 1))


def test_the_enemies_of_2m_vs_1z_march_to_a_point_drawn_for_each_battle() -> None:
    battle = make("2m_vs_1z")
    shifts = np.array([battle.reset(jax.random.key(k))[0].units.goal_shift[0] for k in range(60)])
    assert (np.abs(shifts[:, 0]) <= 3.0).all()
    assert (shifts[:, 1] == 0).all()
    assert shifts[:, 0].min() < -2 < 2 < shifts[:, 0].max()
    assert make("3m").reset(jax.random.key(0))[0].units.goal_shift.shape == (0, 2)
    env_state = battle.reset(jax.random.key(3))[0]
    for shift in (-3.0, 3.0):
        units = env_state.units._replace(goal_shift=jax.numpy.array([[shift, 0.0]]))
        goal = opponent.march(battle.scenario, units, jax.numpy.array([-1]))
        np.testing.assert_allclose([goal.x[0], goal.y[0]], [16.0 + shift, 12.0])


@pytest.mark.parametrize("name", map_names())
def test_maps_of_the_package(name: str) -> None:
    spec = load_map(name)
    assert set(map_names()) == set(STARTS) | set(MORE_STARTS)
    assert spec.cells.shape == (32, 32)
    assert (spec.cells == ".").sum() == OPEN.get(name, 512)
    assert (spec.cells == "C").sum() == (48 if name == "2c_vs_64zg" else 0)
    assert load_map(name) == spec
    assert hash(load_map(name)) == hash(spec)


def test_cells_are_indexed_from_the_south_west() -> None:
    cells = load_map("2c_vs_64zg").cells
    assert "".join(cells[:, 12]) == "...." + 24 * "C" + "...."
    assert "".join(cells[:, 7]) == "####" + 24 * "." + "####"
    cells = load_map("so_many_baneling").cells
    assert "".join(cells[:, 2]) == "##......" + 24 * "#"


def test_a_text_file_is_a_map(tmp_path: Path) -> None:
    path = tmp_path / "3m.toml"
    path.write_text(THREE_MARINES)
    battle = make(str(path))
    shape = battle.shape
    assert battle.spec.name == "3m"
    assert (shape.n_allies, shape.n_enemies, shape.n_actions) == (3, 3, 9)
    assert (shape.obs_size, shape.state_size) == (4 + 3 * 5 + 2 * 5 + 1, 3 * 4 + 3 * 3 + 3 * 9)
    assert_same_starts(battle.spec.allies, flat({"Marine": [(9, 15.25), (9, 16), (9.75, 16)]}))
    assert_same_starts(battle.spec.enemies, flat({"Marine": [(23, 16), (23, 15.25), (23.75, 16)]}))
    env_state, observation = battle.reset(jax.random.key(0))
    earned, steps = 0.0, 0
    for key in jax.random.split(jax.random.key(0), 60):
        available = np.asarray(observation.avail_actions)
        # The first enemy that is offered; without one wait for them to come.
        actions = np.where(available[:, 0], 0, 1)
        offered = available[:, 6:]
        actions = np.where(offered.any(1), 6 + offered.argmax(1), actions)
        env_state, timestep = battle.step(env_state, actions, key)
        observation, steps = timestep.observation, steps + 1
        earned += float(timestep.reward)
        assert observation.obs.shape == (3, shape.obs_size)
        assert observation.state.shape == (shape.state_size,)
        assert not timestep.info.refused.any()
        if timestep.terminated:
            break
    assert bool(timestep.terminated)
    assert steps < 60
    dead = int(timestep.info.dead_allies), int(timestep.info.dead_enemies)
    assert 3 in dead
    assert bool(timestep.info.battle_won) == (dead[1] == 3 > dead[0])
    assert earned == pytest.approx(20.0, rel=1e-5) if timestep.info.battle_won else earned < 20


def test_one_against_one_can_be_played(tmp_path: Path) -> None:
    path = tmp_path / "duel.toml"
    path.write_text(THREE_MARINES.replace("count = 3", "count = 1"))
    battle = make(str(path))
    env_state, observation = battle.reset(jax.random.key(0))
    assert observation.obs.shape == (1, 4 + 5 + 1)
    _, timestep = battle.step(env_state, np.array([4]), jax.random.key(0))
    assert float(timestep.observation.state[2]) > float(observation.state[2])


def test_unknown_maps_and_files(tmp_path: Path) -> None:
    with pytest.raises(TaskError, match="2s3z"):
        load_map("2s3")
    with pytest.raises(TaskError, match="no map ''"):
        load_map("")
    with pytest.raises(TaskError, match="nowhere"):
        load_map(str(tmp_path / "nowhere.toml"))
    with pytest.raises(TaskError, match="cannot be read"):
        load_map(str(tmp_path / "folder.toml" / ".toml"))
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(TaskError, match="cannot be read"):
        load_map(str(tmp_path / "folder.toml"))
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(TaskError, match=r"bytes\.toml cannot be read"):
        load_map(str(tmp_path / "bytes.toml"))


def changed(old: str, new: str) -> str:
    assert old in THREE_MARINES
    return THREE_MARINES.replace(old, new, 1)


def with_cells(*rows: str) -> str:
    return THREE_MARINES + '\n[terrain]\ncells = """\n' + "\n".join(rows) + '\n"""\n'


ALLIES = '[[allies]]\nunit = "Marine"\ncount = 3\nat = [9.0, 16.0]\n'
MANY_HEALERS = '[[allies]]\nunit = "Medivac"\ncount = 1\nat = [9.0, 16.0]\n' + ALLIES
BROKEN = {
    "no TOML": ("episode_limit = = 3", "not valid TOML"),
    "two of an entry": (THREE_MARINES + "[enemy_order]\n", "not valid TOML"),
    "empty": ("", "'description'"),
    "unknown entry": ("speed = 3\n" + THREE_MARINES, "unknown entry 'speed'"),
    "unknown table": (THREE_MARINES + "[terain]\ncells = '.'\n", "unknown entry 'terain'"),
    "no description": (changed("description", "# description"), "'description'"),
    "description is no text": (changed('"three Marines on each side"', "3"), "'description'"),
    "no limit": (changed("episode_limit", "# episode_limit"), "'episode_limit'"),
    "limit is text": (changed("= 60", '= "60"'), "'episode_limit'"),
    "limit is a fraction": (changed("= 60", "= 60.5"), "'episode_limit'"),
    "limit is a truth value": (changed("= 60", "= true"), "'episode_limit'"),
    "limit is 0": (changed("= 60", "= 0"), "episode_limit"),
    "no allies": (changed(ALLIES, ""), "'allies'"),
    "empty allies": ("allies = []\n" + changed(ALLIES, ""), "no allies"),
    "allies are text": ("allies = 'Marine'\n" + changed(ALLIES, ""), "'allies'"),
    "allies are a table": (changed("[[allies]]", "[allies]"), "'allies'"),
    "allies are a list of texts": ("allies = ['Marine']\n" + changed(ALLIES, ""), "allies"),
    "allies are a list of numbers": ("allies = [1, 2]\n" + changed(ALLIES, ""), "allies"),
    "allies are a list of lists": ("allies = [[]]\n" + changed(ALLIES, ""), "allies"),
    "no enemies": (changed("[[enemies]]", "[[allies]]"), "'enemies'"),
    "no unit": (changed('unit = "Marine"', ""), "'unit'"),
    "unit is a number": (changed('"Marine"', "48"), "'unit'"),
    "unknown unit": (changed('Marine"\ncount', 'Firebat"\ncount'), "'Firebat'"),
    "no count": (changed("count = 3", ""), "'count'"),
    "count is text": (changed("count = 3", "count = '3'"), "'count'"),
    "count is a truth value": (changed("count = 3", "count = true"), "'count'"),
    "count is 0": (changed("count = 3", "count = 0"), "count of Marine"),
    "count is negative": (changed("count = 3", "count = -3"), "count of Marine"),
    "too many": (changed("count = 3", "count = 5000"), "room for only"),
    "no point": (changed("at = [9.0, 16.0]", ""), "'at'"),
    "point is a number": (changed("at = [9.0, 16.0]", "at = 9.0"), "'at'"),
    "point of one number": (changed("at = [9.0, 16.0]", "at = [9.0]"), "'at'"),
    "point of texts": (changed("at = [9.0, 16.0]", "at = ['9', '16']"), "'at'"),
    "point of truth values": (changed("at = [9.0, 16.0]", "at = [true, true]"), "'at'"),
    "point is nan": (changed("at = [9.0", "at = [nan"), "'at'"),
    "point is infinite": (changed("at = [9.0", "at = [inf"), "'at'"),
    "point is huge": (changed("at = [9.0", "at = [1e300"), "'at'"),
    "point is a huge integer": (changed("at = [9.0", f"at = [1{400 * '0'}"), "'at'"),
    "point outside": (changed("at = [9.0", "at = [-90.0"), "room for only 0 of 3 Marine"),
    "no order": (changed("[enemy_order]", ""), "unknown entry 'kind'"),
    "order is text": (
        "enemy_order = 'hold'\n" + THREE_MARINES[: THREE_MARINES.index("[enemy_order]")],
        "'enemy_order'",
    ),
    "no kind": (changed('kind = "attack_move"', ""), "kind of enemy_order"),
    "unknown kind": (changed('"attack_move"', '"flee"'), "'flee'"),
    "kind is a list": (changed('"attack_move"', "['hold']"), "kind of enemy_order"),
    "no goal": (changed("to = [9.0, 16.0]", ""), "'to'"),
    "goal is text": (changed("to = [9.0, 16.0]", "to = 'west'"), "'to'"),
    "columns are text": ("ally_type_columns = 'Marine'\n" + THREE_MARINES, "'ally_type_columns'"),
    "columns of lists": ("ally_type_columns = [[]]\n" + THREE_MARINES, "'ally_type_columns'"),
    "columns of tables": ("enemy_type_columns = [{}]\n" + THREE_MARINES, "'enemy_type_columns'"),
    "columns of numbers": ("ally_type_columns = [1]\n" + THREE_MARINES, "'ally_type_columns'"),
    "unknown columns": ("ally_type_columns = ['Ghost']\n" + THREE_MARINES, "'Ghost'"),
    "columns of one side": ("ally_type_columns = ['Marine']\n" + THREE_MARINES, "same length"),
    "columns without a unit": (
        "ally_type_columns = ['Zealot']\nenemy_type_columns = ['Marine']\n" + THREE_MARINES,
        "Marine has no one-hot column",
    ),
    "terrain is text": ("terrain = '...'\n" + THREE_MARINES, "'terrain'"),
    "no cells": (THREE_MARINES + "[terrain]\n", "'cells'"),
    "cells are a list": (THREE_MARINES + "[terrain]\ncells = ['..', '..']\n", "'cells'"),
    "empty cells": (with_cells(""), "lines of equal length"),
    "ragged cells": (with_cells("....", "..."), "lines of equal length"),
    "unknown cells": (with_cells("..~.", "...."), "lines of equal length"),
    "all walls": (with_cells(*32 * [32 * "#"]), "room for only 0 of 3 Marine"),
    "all cliffs": (with_cells(*32 * [32 * "C"]), "room for only 0 of 3 Marine"),
    "small": (with_cells("....", "...."), "room for only"),
    "more allies than a healer has actions": (
        changed(ALLIES, MANY_HEALERS),
        "each of the 4 allies",
    ),
    "unknown entry of a group": (changed("count = 3", "count = 3\nlevel = 2"), "'level'"),
    "unknown entry of the order": (THREE_MARINES + "speed = 2\n", "'speed'"),
    "unknown entry of the terrain": (
        with_cells(*32 * [32 * "."]) + "height = 2\n",
        "'height'",
    ),
    "levels are a number": (with_cells(*32 * [32 * "."]) + "levels = 2\n", "'levels'"),
    "levels of another size": (with_cells(*32 * [32 * "."]) + "levels = '11'\n", "levels"),
    "unknown levels": (
        with_cells(*32 * [32 * "."]) + 'levels = """' + 32 * (32 * "3" + "\n") + '"""\n',
        "'0', '1', '2'",
    ),
    "goal outside": (changed("to = [9.0", "to = [-9.0"), "'to'"),
}


@pytest.mark.parametrize("case", sorted(BROKEN))
def test_broken_maps_are_told(case: str) -> None:
    text, problem = BROKEN[case]
    with pytest.raises(TaskError) as raised:
        parse_map("broken-map", text)
    assert "broken-map" in str(raised.value)
    assert problem in str(raised.value)


@settings(max_examples=150, derandomize=True, deadline=None)
@given(st.data())
def test_a_damaged_map_raises_a_task_error_or_loads(data: st.DataObject) -> None:
    """One value of a good map is replaced by any other of TOML's."""
    lines = with_cells(*32 * [32 * "."]).splitlines()
    lines.insert(1, 'ally_type_columns = ["Marine"]\nenemy_type_columns = ["Marine"]')
    values = [k for k, line in enumerate(lines) if "=" in line and '"""' not in line]
    number = data.draw(st.sampled_from(values))
    value = data.draw(
        st.sampled_from(
            [
                "1",
                "-1",
                "0",
                "1.5",
                "nan",
                "-inf",
                "true",
                "''",
                "'Zealot'",
                "'SpineCrawler'",
                "[]",
                "[1]",
                "[1, 2]",
                "[-0.0, 31.99]",
                "['Marine']",
                "{}",
                "{a = 1}",
                "1979-05-27",
                "07:32:00",
                "0xff",
                "[1, 2, 3]",
                "[nan, 1]",
                "[16, 1e9]",
            ]
        )
    )
    lines[number] = "\n".join(
        part.split("=")[0] + "= " + value for part in lines[number].splitlines()
    )
    problem = ""
    try:
        spec = parse_map("damaged", "\n".join(lines))
    except TaskError as error:
        problem = str(error)
    assert "damaged" in problem if problem else spec.allies and spec.enemies


def test_an_endless_episode_is_told(tmp_path: Path) -> None:
    path = tmp_path / "endless.toml"
    path.write_text(changed("= 60", "= 3_000_000_000"))
    with pytest.raises(TaskError, match=r"endless.*episode_limit"):
        make(str(path))


def test_flyers_need_no_ground(tmp_path: Path) -> None:
    path = tmp_path / "air.toml"
    path.write_text(with_cells(*32 * [32 * "#"]).replace("Marine", "Medivac"))
    assert make(str(path)).shape.n_units == 6

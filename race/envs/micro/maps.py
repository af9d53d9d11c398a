"""Maps as text: who fights whom, where they start, what the ground is like.

A map is a TOML file. All 23 of SMAC lie in the folder ``maps`` beside this module; a file
of your own needs nothing else::

    description = "three Marines on each side"
    episode_limit = 60

    [[allies]]            # one block per group, in the order of creation
    unit = "Marine"
    count = 3
    at = [9.0, 16.0]

    [[enemies]]
    unit = "Marine"
    count = 3
    at = [23.0, 16.0]

    [enemy_order]
    kind = "attack_move"  # or "attack_nearest", or "hold"
    to = [9.0, 16.0]      # or to_between = [[9.0, 12.0], [9.0, 20.0]]: drawn for each battle

    [terrain]             # optional; without it a 32 x 32 plain
    cells = \"\"\"
    ....
    \"\"\"
    levels = ...          # optional, for pictures: heights (`MapSpec`)

``ally_type_columns`` and ``enemy_type_columns``, lists of unit types, add one-hot columns of the
type to observations and state; SMAC has them where a side has several types.
"""

import difflib
import re
import tomllib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from race.envs.micro.lattice import Group, Start, place
from race.envs.micro.units import GROUND, HALF_TILE, HALF_TILES_ARE, UNIT_TYPES
from race.errors import TaskError

OrderKind = Literal["attack_move", "attack_nearest", "hold"]

PLAIN: Final = (GROUND * 32,) * 32

_MOST: Final = 256
"""Cells of a map's longer side."""
_FAR: Final = 1e6
_MOST_STEPS: Final = 1_000_000
_FOLDER: Final = Path(__file__).parent / "maps"
_KEYS: Final = {
    "description",
    "episode_limit",
    "ally_type_columns",
    "enemy_type_columns",
    "allies",
    "enemies",
    "enemy_order",
    "terrain",
}


class EnemyOrder(NamedTuple):
    """What the enemies are told at the start.

    ``attack_move``: go to (x, y) and fight what comes near on the way. ``attack_nearest``: each
    attacks the ally that is nearest to it, wherever that is. ``hold``: nothing; they fight what
    comes near.
    """

    kind: OrderKind
    x: float = 0.0
    y: float = 0.0
    spread_x: float = 0.0
    """The point of each battle is drawn from the segment of which (x, y) is the middle and
    (x + spread_x, y + spread_y) one end."""
    spread_y: float = 0.0


@dataclass(frozen=True)
class MapSpec:
    """A map. Hashable.

    Attributes:
        name: without ``micro/``.
        description: one line.
        episode_limit: environment steps.
        ally_groups: in the order of creation.
        enemy_groups: likewise.
        ally_type_columns: unit types of the allies' one-hot columns; empty without any.
        enemy_type_columns: likewise, and as many.
        enemy_order: what the enemies do.
        rows: cells of the map, the north first: "." ground, "#" wall or pit, "C" cliff, "/" half
            a tile of ground (`race.envs.micro.units.HALF_TILES_ARE`).
        levels: heights of the cells, for pictures alone, the north first: "0" a pit, "1" and "2"
            two floors, "a", "b" and "c" ramps 1/8, 3/8 and 5/8 of the way up from 1 to 2. Empty
            if they are not known.
    """

    name: str
    description: str
    episode_limit: int
    ally_groups: tuple[Group, ...]
    enemy_groups: tuple[Group, ...]
    ally_type_columns: tuple[str, ...]
    enemy_type_columns: tuple[str, ...]
    enemy_order: EnemyOrder
    rows: tuple[str, ...] = PLAIN
    levels: tuple[str, ...] = ()

    @cached_property
    def cells(self) -> NDArray[Any]:
        """Kind of each cell, indexed [x, y], y upwards."""
        rows = [list(row.replace(HALF_TILE, HALF_TILES_ARE)) for row in self.rows]
        return np.array(rows)[::-1].T

    @cached_property
    def allies(self) -> tuple[Start, ...]:
        """The agents at the start, in SMAC's order: by type, then x, then y."""
        starts = place(self.cells, self.name, self.ally_groups)
        return tuple(sorted(starts, key=lambda s: (UNIT_TYPES[s.unit].rank, s.x, s.y)))

    @cached_property
    def enemies(self) -> tuple[Start, ...]:
        """The enemies at the start, in the order of creation."""
        return place(self.cells, self.name, self.enemy_groups)


def map_names() -> tuple[str, ...]:
    """Names of the maps that come with the package."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.toml")))


def load_map(name: str) -> MapSpec:
    """The map of a name, or of a path that ends with ``.toml``.

    Raises:
        TaskError: if there is no such map, or its file is wrong; the message says what and where.
    """
    if name.endswith(".toml"):
        path = Path(name)
    elif name in map_names():
        path = _FOLDER / f"{name}.toml"
    else:
        near = difflib.get_close_matches(name, map_names(), n=3, cutoff=0.0)
        raise TaskError(
            f"There is no map {name!r}. The nearest names are {', '.join(near)}; a map of your own "
            "is a file whose name ends with .toml."
        )
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TaskError(f"The map {path} cannot be read: {error}.") from error
    return parse_map(path.stem, text)


def parse_map(name: str, text: str) -> MapSpec:
    """The map that a text describes.

    Raises:
        TaskError: if the text is no TOML, or an entry is missing, unknown or impossible.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TaskError(f"Map {name} is not valid TOML: {error}.") from error
    _table(name, "the map", table, _KEYS)
    spec = MapSpec(
        name=name,
        description=_entry(name, table, "description", str),
        episode_limit=_entry(name, table, "episode_limit", int),
        ally_groups=_groups(name, table, "allies"),
        enemy_groups=_groups(name, table, "enemies"),
        ally_type_columns=_columns(name, table, "ally_type_columns"),
        enemy_type_columns=_columns(name, table, "enemy_type_columns"),
        enemy_order=_order(name, table),
        rows=_rows(name, table),
        levels=_levels(name, table),
    )
    _check(spec)
    return spec


def _table(name: str, what: str, value: Any, keys: set[str]) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TaskError(f"Map {name}: {what} must be a table, and is {value!r}.")
    for key in value:
        if key not in keys:
            raise TaskError(
                f"Map {name}: {what} has the unknown entry {key!r}; there may be "
                f"{', '.join(sorted(keys))}."
            )
    return value


def _entry(name: str, table: dict[str, Any], key: str, kind: type) -> Any:
    value = table.get(key)
    if not isinstance(value, kind) or isinstance(value, bool):
        raise TaskError(
            f"Map {name} needs the entry {key!r} of type {kind.__name__}; it has {value!r}."
        )
    return value


def _point(name: str, table: dict[str, Any], key: str) -> tuple[float, float]:
    value = table.get(key)
    if (
        not isinstance(value, list)
        or len(value) != 2
        or not all(type(v) in (int, float) and abs(v) <= _FAR for v in value)
    ):
        raise TaskError(f"Map {name}: {key!r} must be a point [x, y], and is {value!r}.")
    return float(value[0]), float(value[1])


def _groups(name: str, table: dict[str, Any], key: str) -> tuple[Group, ...]:
    groups = []
    for value in _entry(name, table, key, list):
        group = _table(name, f"each group of {key}", value, {"unit", "count", "at"})
        unit = _entry(name, group, "unit", str)
        if unit not in UNIT_TYPES:
            raise TaskError(
                f"Map {name}: there is no unit type {unit!r}. There are {', '.join(UNIT_TYPES)}."
            )
        count = _entry(name, group, "count", int)
        if count < 1:
            raise TaskError(f"Map {name}: count of {unit} must be at least 1, and is {count}.")
        groups.append(Group(unit, count, *_point(name, group, "at")))
    if not groups:
        raise TaskError(f"Map {name} has no {key}.")
    return tuple(groups)


def _columns(name: str, table: dict[str, Any], key: str) -> tuple[str, ...]:
    value = table.get(key, [])
    if not isinstance(value, list) or not all(v in list(UNIT_TYPES) for v in value):
        raise TaskError(f"Map {name}: {key!r} must be a list of unit types, and is {value!r}.")
    return tuple(value)


def _order(name: str, table: dict[str, Any]) -> EnemyOrder:
    order = table.get("enemy_order")
    kind: Any = order.get("kind") if isinstance(order, dict) else None
    points = {"to_between"} if isinstance(order, dict) and "to_between" in order else {"to"}
    known = {"kind"} | (set() if kind in ("attack_nearest", "hold") else points)
    order = _table(name, "'enemy_order'", order, known)
    if kind not in get_args(OrderKind):
        raise TaskError(
            f"Map {name}: kind of enemy_order must be one of {', '.join(get_args(OrderKind))}, and "
            f"is {kind!r}."
        )
    if kind != "attack_move":
        return EnemyOrder(kind)
    if "to" in order:
        return EnemyOrder(kind, *_point(name, order, "to"))
    ends = order.get("to_between")
    if not isinstance(ends, list) or len(ends) != 2:
        raise TaskError(
            f"Map {name}: 'to_between' of 'enemy_order' must be two points, and is {ends!r}; or "
            "name one point by 'to'."
        )
    (x, y), (last_x, last_y) = (_point(name, {"to_between": end}, "to_between") for end in ends)
    return EnemyOrder(kind, (x + last_x) / 2, (y + last_y) / 2, (last_x - x) / 2, (last_y - y) / 2)


def _rows(name: str, table: dict[str, Any]) -> tuple[str, ...]:
    if "terrain" not in table:
        return PLAIN
    terrain = _table(name, "'terrain'", table["terrain"], {"cells", "levels"})
    rows = tuple(_entry(name, terrain, "cells", str).split())
    if len({len(row) for row in rows}) != 1 or not re.fullmatch(r"[.#C/]+", "".join(rows)):
        raise TaskError(
            f"Map {name}: cells of the terrain must be lines of equal length out of '.', '#', 'C' "
            "and '/'."
        )
    if max(len(rows), len(rows[0])) > _MOST:
        raise TaskError(f"Map {name}: the terrain must not be longer than {_MOST} cells.")
    return rows


def _levels(name: str, table: dict[str, Any]) -> tuple[str, ...]:
    terrain = table.get("terrain", {})
    if "levels" not in terrain:
        return ()
    levels = tuple(_entry(name, terrain, "levels", str).split())
    lengths = [len(row) for row in _rows(name, table)]
    if [len(row) for row in levels] != lengths or not re.fullmatch(r"[012abc]+", "".join(levels)):
        raise TaskError(
            f"Map {name}: levels of the terrain must be as many lines as its cells, as long as "
            "they, out of '0', '1', '2' and, for ramps, 'a', 'b' and 'c'."
        )
    return levels


def _check(spec: MapSpec) -> None:
    name = spec.name
    if not 1 <= spec.episode_limit <= _MOST_STEPS:
        raise TaskError(
            f"Map {name}: episode_limit must be from 1 to {_MOST_STEPS}, and is "
            f"{spec.episode_limit}."
        )
    if len(spec.ally_type_columns) != len(spec.enemy_type_columns):
        raise TaskError(
            f"Map {name}: ally_type_columns and enemy_type_columns must have the same length."
        )
    for columns, groups in (
        (spec.ally_type_columns, spec.ally_groups),
        (spec.enemy_type_columns, spec.enemy_groups),
    ):
        for group in groups:
            if columns and group.unit not in columns:
                raise TaskError(f"Map {name}: {group.unit} has no one-hot column.")
    n_allies, n_enemies = len(spec.allies), len(spec.enemies)
    if any(UNIT_TYPES[s.unit].heals for s in spec.allies) and n_allies > n_enemies:
        raise TaskError(
            f"Map {name}: an allied healer needs an action for each of the {n_allies} allies, and "
            f"SMAC's actions offer one per enemy, {n_enemies}."
        )
    width, height = spec.cells.shape
    order = spec.enemy_order
    for side in (-1, 0, 1):
        x, y = order.x + side * order.spread_x, order.y + side * order.spread_y
        if not (0 <= x < width and 0 <= y < height):
            raise TaskError(
                f"Map {name}: 'to' of 'enemy_order' is ({x:g}, {y:g}), beyond the map of {width} x "
                f"{height} cells."
            )

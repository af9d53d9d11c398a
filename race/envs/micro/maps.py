"""Maps as text: who fights whom, where they start, what the ground is like.

A map is a TOML file. The eight of the paper lie in the folder ``maps`` beside this module; a file
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
    to = [9.0, 16.0]

    [terrain]             # optional; without it a 32 x 32 plain
    cells = \"\"\"
    ....
    \"\"\"

``ally_type_columns`` and ``enemy_type_columns``, lists of unit types, add one-hot columns of the
type to observations and state; SMAC has them where a side has several types.
"""

import difflib
import math
import re
import tomllib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from race.envs.micro.units import UNIT_TYPES, Mover, UnitType
from race.errors import TaskError

OrderKind = Literal["attack_move", "attack_nearest", "hold"]

GROUND: Final = "."
WALL: Final = "#"
CLIFF: Final = "C"
PLAIN: Final = (GROUND * 32,) * 32

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


class Start(NamedTuple):
    """A unit at the start: its type and the place of its centre."""

    unit: str
    x: float
    y: float


class Group(NamedTuple):
    """Units created together round a point."""

    unit: str
    size: int
    x: float
    y: float


class EnemyOrder(NamedTuple):
    """What the enemies are told at the start.

    ``attack_move``: go to (x, y) and fight what comes near on the way. ``attack_nearest``: each
    attacks the ally that is nearest to it, wherever that is. ``hold``: nothing; they fight what
    comes near.
    """

    kind: OrderKind
    x: float = 0.0
    y: float = 0.0


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
        rows: cells of the map, the north first: "." ground, "#" wall or pit, "C" cliff.
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

    @cached_property
    def cells(self) -> NDArray[Any]:
        """Kind of each cell, indexed [x, y], y upwards."""
        return np.array([list(row) for row in self.rows])[::-1].T

    @cached_property
    def allies(self) -> tuple[Start, ...]:
        """The agents at the start, in SMAC's order: by type, then x, then y."""
        starts = _place(self, self.ally_groups)
        return tuple(sorted(starts, key=lambda s: (UNIT_TYPES[s.unit].rank, s.x, s.y)))

    @cached_property
    def enemies(self) -> tuple[Start, ...]:
        """The enemies at the start, in the order of creation."""
        return _place(self, self.enemy_groups)


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
    unknown = sorted(set(table) - _KEYS)
    if unknown:
        raise TaskError(
            f"Map {name} has the unknown entry {unknown[0]!r}; there may be "
            f"{', '.join(sorted(_KEYS))}."
        )
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
    )
    _check(spec)
    return spec


def _entry(name: str, table: dict[str, Any], key: str, kind: type) -> Any:
    value = table.get(key)
    if key not in table or not isinstance(value, kind) or isinstance(value, bool):
        raise TaskError(
            f"Map {name} needs the entry {key!r} of type {kind.__name__}; it has {value!r}."
        )
    return value


def _point(name: str, table: dict[str, Any], key: str) -> tuple[float, float]:
    value = table.get(key)
    if (
        not isinstance(value, list)
        or len(value) != 2
        or not all(type(v) in (int, float) and math.isfinite(v) for v in value)
    ):
        raise TaskError(f"Map {name}: {key!r} must be a point [x, y], and is {value!r}.")
    return float(value[0]), float(value[1])


def _groups(name: str, table: dict[str, Any], key: str) -> tuple[Group, ...]:
    groups = []
    for group in _entry(name, table, key, list):
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
    if not isinstance(value, list) or not all(v in UNIT_TYPES for v in value):
        raise TaskError(f"Map {name}: {key!r} must be a list of unit types, and is {value!r}.")
    return tuple(value)


def _order(name: str, table: dict[str, Any]) -> EnemyOrder:
    order = _entry(name, table, "enemy_order", dict)
    kind = order.get("kind")
    if kind not in get_args(OrderKind):
        raise TaskError(
            f"Map {name}: kind of enemy_order must be one of {', '.join(get_args(OrderKind))}, and "
            f"is {kind!r}."
        )
    return EnemyOrder(kind, *(_point(name, order, "to") if kind == "attack_move" else (0.0, 0.0)))


def _rows(name: str, table: dict[str, Any]) -> tuple[str, ...]:
    if "terrain" not in table:
        return PLAIN
    rows = tuple(_entry(name, _entry(name, table, "terrain", dict), "cells", str).split())
    if len({len(row) for row in rows}) != 1 or not re.fullmatch(r"[.#C]+", "".join(rows)):
        raise TaskError(
            f"Map {name}: cells of the terrain must be lines of equal length out of '.', '#', 'C'."
        )
    return rows


def _check(spec: MapSpec) -> None:
    name = spec.name
    if spec.episode_limit < 1:
        raise TaskError(f"Map {name}: episode_limit must be at least 1.")
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


# SMAC's maps create a group on a square lattice through its point.


def _place(spec: MapSpec, groups: tuple[Group, ...]) -> tuple[Start, ...]:
    placed: list[Start] = []
    for group in groups:
        unit = UNIT_TYPES[group.unit]
        x, y = group.x, group.y
        if "structure" in unit.attributes:  # its 2 x 2 footprint snaps to the grid
            x, y = float(round(x)), float(round(y))
        step = 2 * unit.radius
        found = 0
        for i, j in _lattice(int(max(spec.cells.shape) / step) + 1):
            start = Start(group.unit, x + i * step, y + j * step)
            if _fits(spec, unit, start, placed):
                placed.append(start)
                found += 1
            if found == group.size:
                break
        else:
            raise TaskError(
                f"Map {spec.name}: there is room for only {found} of {group.size} {group.unit} "
                f"round ({group.x:g}, {group.y:g})."
            )
    return tuple(placed)


def _lattice(reach: int) -> list[tuple[int, int]]:
    """Points of the lattice by distance, at equal distance counter-clockwise from the south."""
    points = [(i, j) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1)]

    def order(point: tuple[int, int]) -> tuple[int, float]:
        i, j = point
        return i * i + j * j, math.atan2(i, -j) % (2 * math.pi)

    return sorted(points, key=order)


def _fits(spec: MapSpec, unit: UnitType, start: Start, placed: list[Start]) -> bool:
    x, y = math.floor(start.x), math.floor(start.y)
    width, height = spec.cells.shape
    if not (0 <= x < width and 0 <= y < height):
        return False
    flies = unit.mover is Mover.AIR
    if not flies and spec.cells[x, y] != GROUND:
        return False
    return all(
        math.hypot(start.x - other.x, start.y - other.y)
        >= unit.radius + UNIT_TYPES[other.unit].radius - 1e-6
        for other in placed
        if (UNIT_TYPES[other.unit].mover is Mover.AIR) == flies
    )

"""Where units start that a map creates together: on a square lattice through one point."""

import math
from typing import Any, NamedTuple

from numpy.typing import NDArray

from race.envs.micro.units import GROUND, UNIT_TYPES, Mover, UnitType
from race.errors import TaskError

COLOSSUS_TAKES_ROOM = False
"""Whether a Colossus keeps others of its group from starting below it. It does not collide with
ground units, and recorded battles show a Stalker at its place (1c3s5z); they leave some doubt."""


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


def place(cells: NDArray[Any], name: str, groups: tuple[Group, ...]) -> tuple[Start, ...]:
    """Places groups one after the other.

    The lattice's step is a unit's diameter. Its points are tried by their distance; a point is
    passed over where there is no ground, or where the unit would overlap one that is there.

    Args:
        cells: kinds of the cells, [X, Y].
        name: of the map, for errors.
        groups: in the order of creation.

    Raises:
        TaskError: if there is not enough room.
    """
    placed: list[Start] = []
    for group in groups:
        unit = UNIT_TYPES[group.unit]
        x, y = group.x, group.y
        if "structure" in unit.attributes:  # its 2 x 2 footprint snaps to the grid
            x, y = float(round(x)), float(round(y))
        step = 2 * unit.radius
        found = 0
        for i, j in _lattice(int(max(cells.shape) / step) + 1):
            start = Start(group.unit, x + i * step, y + j * step)
            if _fits(cells, unit, start, placed):
                placed.append(start)
                found += 1
            if found == group.size:
                break
        else:
            raise TaskError(
                f"Map {name}: there is room for only {found} of {group.size} {group.unit} "
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


def _fits(cells: NDArray[Any], unit: UnitType, start: Start, placed: list[Start]) -> bool:
    x, y = math.floor(start.x), math.floor(start.y)
    width, height = cells.shape
    if not (0 <= x < width and 0 <= y < height):
        return False
    if unit.mover is not Mover.AIR and cells[x, y] != GROUND:
        return False
    return all(
        math.hypot(start.x - other.x, start.y - other.y)
        >= unit.radius + UNIT_TYPES[other.unit].radius - 1e-6
        for other in placed
        if _plane(UNIT_TYPES[other.unit]) == _plane(unit)
    )


def _plane(unit: UnitType) -> Mover:
    """Units of one plane take each other's room."""
    return Mover.GROUND if COLOSSUS_TAKES_ROOM and unit.mover is Mover.CLIFF else unit.mover

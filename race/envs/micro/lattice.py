"""Where units start that a map creates together: on a square lattice through one point."""

import math
from typing import Any, NamedTuple

import numpy as np
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
    # Place and radius of those of each plane, for all of them at once.
    taken: dict[Mover, NDArray[np.float64]] = {}
    for group in groups:
        unit = UNIT_TYPES[group.unit]
        x, y = group.x, group.y
        if "structure" in unit.attributes:  # its 2 x 2 footprint snaps to the grid
            x, y = float(round(x)), float(round(y))
        step, plane = 2 * unit.radius, _plane(unit)
        others = taken.get(plane, np.zeros((0, 3)))
        room = np.concatenate([others, np.zeros((group.size, 3))])
        count = begun = len(others)
        for i, j in _lattice(int(max(cells.shape) / step) + 1):
            start = Start(group.unit, x + i * step, y + j * step)
            if _fits(cells, unit, start, room[:count]):
                placed.append(start)
                room[count] = start.x, start.y, unit.radius
                count += 1
            if count - begun == group.size:
                break
        else:
            raise TaskError(
                f"Map {name}: there is room for only {count - begun} of {group.size} {group.unit} "
                f"round ({group.x:g}, {group.y:g})."
            )
        taken[plane] = room
    return tuple(placed)


def _lattice(reach: int) -> list[tuple[int, int]]:
    """Points of the lattice by distance, at equal distance counter-clockwise from the south."""
    points = [(i, j) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1)]

    def order(point: tuple[int, int]) -> tuple[int, float]:
        i, j = point
        return i * i + j * j, math.atan2(i, -j) % (2 * math.pi)

    return sorted(points, key=order)


def _fits(cells: NDArray[Any], unit: UnitType, start: Start, others: NDArray[np.float64]) -> bool:
    x, y = math.floor(start.x), math.floor(start.y)
    width, height = cells.shape
    if not (0 <= x < width and 0 <= y < height):
        return False
    if unit.mover is not Mover.AIR and cells[x, y] != GROUND:
        return False
    apart = np.hypot(start.x - others[:, 0], start.y - others[:, 1])
    return bool(np.all(apart >= unit.radius + others[:, 2] - 1e-6))


def _plane(unit: UnitType) -> Mover:
    """Units of one plane take each other's room."""
    return Mover.GROUND if COLOSSUS_TAKES_ROOM and unit.mover is Mover.CLIFF else unit.mover

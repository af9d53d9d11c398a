"""The ground: where units of a kind can be, and the ways round obstacles.

All of it is worked out once per map, in numpy. Units then look up two tables: the walls beside
their cell, and the next cell to head for on the way to another.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csgraph

from race.envs.micro.units import CLIFF, GROUND, Mover
from race.errors import TaskError

EAST, WEST, NORTH, SOUTH = 1, 2, 4, 8
"""Bits of `Terrain.walls`."""

CLEARANCE: Final = 0.45
"""How far ways keep from walls: less than half a cell, so that the middle of any cell will do."""
_SAMPLES_PER_CELL: Final = 4
MOST_CELLS: Final = 1024
"""Cells of ground with obstacles that a map may have; the ways on more take minutes."""
_ROUND: Final = 128
"""Tables are as long as a multiple of this, so that maps of similar size share their programs."""


class Terrain(NamedTuple):
    """Tables of a map, one per kind of mover (`Mover`, index K); cells are indexed [x, y].

    Attributes:
        walls: bits that tell which of a cell's four neighbours cannot be entered, [K, X, Y].
        node: number of a cell in `ways`, [K, X, Y]. A cell that cannot be entered has the number
            of the nearest one that can.
        ways: number of the cell to head for in order to come from one cell to another,
            [K, nodes, nodes]. It is the goal itself where nothing is in between.
        centre: middle of each numbered cell, [K, nodes, 2].
        plain: whether every mover's ground is one rectangle without obstacles; then
            `node`, `ways` and `centre` are empty, because straight ahead is always right.
        bounds: lowest x, highest x, lowest y, highest y of each mover's ground, [K, 4].
        walkable: cells open to ground units, [X, Y].
    """

    walls: NDArray[np.uint8]
    node: NDArray[np.int32]
    ways: NDArray[np.int32]
    centre: NDArray[np.float32]
    plain: bool
    bounds: NDArray[np.float32]
    walkable: NDArray[np.bool_]


def survey(cells: NDArray[Any], movers: tuple[Mover, ...], starts: NDArray[np.float64]) -> Terrain:
    """The tables of a map.

    Args:
        cells: kinds of the cells, [X, Y].
        movers: the kinds of movers on the map.
        starts: where units start, [units, 2]; ground that cannot be reached from there is left
            out of the ways.

    Raises:
        TaskError: if there are more than `MOST_CELLS` cells of ground with obstacles.
    """
    grounds = [_enterable(cells, mover) for mover in Mover]
    areas = [
        _reachable(ground, starts) if mover in movers and mover is not Mover.AIR else ground
        for mover, ground in zip(Mover, grounds, strict=True)
    ]
    walled = [m for m in movers if m is not Mover.AIR and not _is_rectangle(areas[m])]
    most = max((int(areas[m].sum()) for m in walled), default=0)
    if most > MOST_CELLS:
        raise TaskError(
            f"The map has {most:,} cells of ground with obstacles, and ways are only worked out "
            f"for {MOST_CELLS:,}. Make it smaller, or one rectangle of ground without obstacles."
        )
    size = math.ceil(most / _ROUND) * _ROUND
    node = np.zeros((len(Mover), *cells.shape) if walled else (len(Mover), 0, 0), np.int32)
    ways = np.zeros((len(Mover), size, size), np.int32)
    centre = np.zeros((len(Mover), size, 2), np.float32)
    for mover in walled:
        node[mover], way, middle = _ways(areas[mover])
        ways[mover, : len(way), : len(way)] = way
        centre[mover, : len(middle)] = middle
    return Terrain(
        walls=np.stack([_walls(ground) for ground in grounds]),
        node=node,
        ways=ways,
        centre=centre,
        plain=not walled,
        bounds=np.stack([_bounds(area) for area in areas]),
        walkable=grounds[Mover.GROUND],
    )


def _enterable(cells: NDArray[Any], mover: Mover) -> NDArray[np.bool_]:
    match mover:
        case Mover.GROUND:
            return cells == GROUND
        case Mover.CLIFF:
            return (cells == GROUND) | (cells == CLIFF)
        case Mover.AIR:
            return np.ones(cells.shape, np.bool_)


def _walls(enterable: NDArray[np.bool_]) -> NDArray[np.uint8]:
    blocked = ~np.pad(enterable, 1)
    return (
        EAST * blocked[2:, 1:-1]
        + WEST * blocked[:-2, 1:-1]
        + NORTH * blocked[1:-1, 2:]
        + SOUTH * blocked[1:-1, :-2]
    ).astype(np.uint8)


def _bounds(area: NDArray[np.bool_]) -> NDArray[np.float32]:
    x, y = np.nonzero(area if area.any() else np.ones_like(area))
    return np.array([x.min(), x.max() + 1, y.min(), y.max() + 1], np.float32)


def _is_rectangle(area: NDArray[np.bool_]) -> bool:
    x, y = np.nonzero(area)
    return bool(area[x.min() : x.max() + 1, y.min() : y.max() + 1].all())


def _reachable(enterable: NDArray[np.bool_], starts: NDArray[np.float64]) -> NDArray[np.bool_]:
    reached = np.zeros_like(enterable)
    x, y = np.floor(starts).astype(int).T
    reached[x, y] = True
    reached &= enterable
    while True:
        wide = np.pad(reached, 1)
        grown = enterable & (
            wide[2:, 1:-1] | wide[:-2, 1:-1] | wide[1:-1, 2:] | wide[1:-1, :-2] | reached
        )
        if (grown == reached).all():
            return reached
        reached = grown


def _ways(
    area: NDArray[np.bool_],
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Numbers of the cells, next cell from each to each, and middles.

    Shortest paths over the middles of cells that see each other: any angle, few corners.
    """
    corners = np.argwhere(area)
    middle = corners.astype(np.float64) + 0.5
    every = np.argwhere(np.ones_like(area))
    nearest = np.square(every[:, None] - corners[None]).sum(-1).argmin(-1)
    node = nearest.reshape(area.shape).astype(np.int32)
    distance = np.sqrt(np.square(middle[:, None] - middle[None]).sum(-1))
    graph = np.where(_see_each_other(area, middle), distance, 0.0)
    _, before = csgraph.shortest_path(graph, directed=False, return_predecessors=True)
    # `before[goal, cell]` is the cell before `cell` on the way from `goal`: where to go from it.
    way = np.where(before >= 0, before, np.arange(len(middle))[:, None]).T
    return node, way.astype(np.int32), middle.astype(np.float32)


def _see_each_other(area: NDArray[np.bool_], middle: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether a unit of radius `CLEARANCE` can go straight between two middles, [nodes, nodes]."""
    wide = np.pad(area, 1)
    sees = np.ones((len(middle), len(middle)), np.bool_)
    longest = np.abs(middle[:, None] - middle[None]).max()
    for share in np.linspace(0, 1, int(longest * _SAMPLES_PER_CELL) + 1):
        points = (1 - share) * middle[:, None] + share * middle[None]
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            x = np.floor(points[..., 0] + dx * CLEARANCE).astype(int) + 1
            y = np.floor(points[..., 1] + dy * CLEARANCE).astype(int) + 1
            sees &= wide[x, y]
    return sees

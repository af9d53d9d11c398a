"""The ground: ways lead everywhere, straight where possible and never through walls."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csgraph

from race.envs.micro import load_map, make
from race.envs.micro.terrain import survey
from race.envs.micro.units import UNIT_TYPES, Mover


def plain_paths(area: NDArray[np.bool_], cells: NDArray[np.int_]) -> NDArray[np.float64]:
    """Lengths of the shortest paths from cell to neighbour, no diagonal past a corner."""
    number = np.full(area.shape, -1)
    number[tuple(cells.T)] = np.arange(len(cells))
    rows, columns, lengths = [], [], []
    for k, (x, y) in enumerate(cells):
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            u, v = x + dx, y + dy
            if u < area.shape[0] and 0 <= v < area.shape[1]:
                free = area[u, v] and area[u, y] and area[x, v]
                if free:
                    rows.append(k)
                    columns.append(number[u, v])
                    lengths.append(math.hypot(dx, dy))
    graph = coo_matrix((lengths, (rows, columns)), shape=(len(cells), len(cells)))
    paths: NDArray[np.float64] = csgraph.dijkstra(graph.tocsr(), directed=False)
    return paths


def assert_good_ways(area: NDArray[np.bool_], ground: Any, mover: Mover) -> None:
    """Ways over all of an area, which is connected, and nowhere else."""
    cells = np.argwhere(area)
    node = ground.node[mover]
    np.testing.assert_array_equal(np.sort(node[area]), np.arange(len(cells)))
    middle = np.zeros((len(cells), 2))
    middle[node[area]] = cells + 0.5
    np.testing.assert_allclose(ground.centre[mover][: len(cells)], middle)
    goal = np.arange(len(cells))[None].repeat(len(cells), 0)
    here, length = goal.T.copy(), np.zeros(goal.shape)
    legs = set()
    for _ in range(len(cells)):
        if (here == goal).all():
            break
        following = ground.ways[mover, here, goal]
        length += np.linalg.norm(middle[following] - middle[here], axis=-1)
        legs |= set(zip(here.ravel().tolist(), following.ravel().tolist(), strict=True))
        here = following
    assert (here == goal).all()
    starts, ends = middle[np.array(sorted(legs))].swapaxes(0, 1)
    for share in np.linspace(0, 1, 250):
        x, y = np.floor((1 - share) * starts + share * ends).astype(int).T
        assert area[x, y].all()
    paths = plain_paths(area, node_order(cells, node))
    assert (length <= paths + 1e-4).all()
    assert (length >= np.linalg.norm(middle[:, None] - middle[None], axis=-1) - 1e-4).all()


def node_order(cells: NDArray[np.int_], node: NDArray[np.int32]) -> NDArray[np.int_]:
    """Cells in the order of their numbers."""
    ordered = np.zeros_like(cells)
    ordered[node[tuple(cells.T)]] = cells
    return ordered


@pytest.mark.parametrize(
    ("name", "mover", "size"),
    [
        ("so_many_baneling", Mover.GROUND, 300),
        ("2s_vs_1sc", Mover.GROUND, 168),
        ("2c_vs_64zg", Mover.GROUND, 336),
        ("2c_vs_64zg", Mover.CLIFF, 384),
    ],
)
def test_ways_lead_from_everywhere_to_everywhere(name: str, mover: Mover, size: int) -> None:
    spec = load_map(name)
    starts = np.array([[s.x, s.y] for s in (*spec.allies, *spec.enemies)])
    movers = tuple(sorted({UNIT_TYPES[s.unit].mover for s in (*spec.allies, *spec.enemies)}))
    assert mover in movers
    ground = survey(spec.cells, movers, starts)
    assert not ground.plain
    area = np.isin(spec.cells, [".", "C"] if mover is Mover.CLIFF else ["."])
    if name == "2s_vs_1sc":  # the room, without the rim that nobody can reach
        area[:8], area[20:], area[:, :8], area[:, 24:] = False, False, False, False
    assert area.sum() == size
    assert_good_ways(area, ground, mover)


@settings(max_examples=40, derandomize=True, deadline=None)
@given(hnp.arrays(bool, (7, 6), elements=st.integers(0, 3).map(bool)), st.integers(0, 41))
def test_ways_over_any_ground(free: NDArray[np.bool_], first: int) -> None:
    x, y = divmod(first, 6)
    free[x, y] = True
    cells = np.where(free, ".", "#")
    ground = survey(cells, (Mover.GROUND,), np.array([[x + 0.5, y + 0.5]]))
    # What can be reached by steps east, west, north and south.
    area = np.zeros_like(free)
    edge = [(x, y)]
    while edge:
        x, y = edge.pop()
        if 0 <= x < 7 and 0 <= y < 6 and free[x, y] and not area[x, y]:
            area[x, y] = True
            edge += [(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)]
    columns, rows = np.nonzero(area)
    box = area[columns.min() : columns.max() + 1, rows.min() : rows.max() + 1]
    assert ground.plain == box.all()
    if ground.plain:
        low_x, high_x, low_y, high_y = ground.bounds[Mover.GROUND]
        assert (low_x, high_x) == (columns.min(), columns.max() + 1)
        assert (low_y, high_y) == (rows.min(), rows.max() + 1)
    else:
        assert_good_ways(area, ground, Mover.GROUND)


@pytest.mark.parametrize("name", ["2s3z", "3s5z", "3s_vs_3z", "MMM", "MMM2"])
def test_plain_maps_have_no_ways(name: str) -> None:
    scenario = make(name).scenario
    assert scenario.shape.plain
    assert scenario.node.size == scenario.ways.size == scenario.centre.size == 0

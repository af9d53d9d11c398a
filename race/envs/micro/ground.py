"""A map's ground as a picture: floors by their height, ramps, cliffs, walls and pits.

Of most maps no more is known than where ground units may go: their floor is drawn on one level,
and what surrounds it as a pit. Where the file tells levels, higher floor is lighter and ramps grow
lighter on the way up. Ground that cannot be reached is dim.
"""

from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter
from scipy import ndimage

from race.envs.micro.canvas import Frame, View
from race.envs.micro.maps import MapSpec
from race.envs.micro.sprites import DARK, Color, mixed
from race.envs.micro.units import CLIFF, HALF_TILE, WALL

Number = float | int
_PIT: Final[Color] = (16, 18, 22)
_SLOPE: Final[Color] = (40, 42, 46)
_LOW: Final[Color] = (58, 64, 66)
_HIGH: Final[Color] = (94, 98, 92)
_CLIFF: Final[Color] = (96, 80, 60)
_EDGE: Final[Color] = (124, 130, 130)
_FINE: Final = 2
_LEVELS: Final = {"0": 0.0, "1": 1.0, "a": 1.125, "b": 1.375, "c": 1.625, "2": 2.0}
_SIDES: Final = ((1, 0), (-1, 0), (0, 1), (0, -1))


def paint(spec: MapSpec, view: View) -> Frame:
    """The ground in the box of a view."""
    width, height = view.box.right - view.box.left, view.box.bottom - view.box.top
    floor = Image.new("RGB", (width * _FINE, height * _FINE))
    mask = Image.new("L", floor.size)
    scale, window = view.scale * _FINE, view.window
    colors = _colors(spec)
    draw, stencil = ImageDraw.Draw(floor), ImageDraw.Draw(mask)

    def pixel(x: Number, y: Number) -> tuple[float, float]:
        return (x - window.left) * scale, (window.top - y) * scale

    def stroke(x: Number, y: Number, to_x: Number, to_y: Number, color: Color, width: int) -> None:
        draw.line((*pixel(x, y), *pixel(to_x, to_y)), color, width)

    for (x, y), color in colors.items():
        box = (*pixel(x, y + 1), *pixel(x + 1, y))
        draw.rectangle(box, fill=color)
        stencil.rectangle(box, fill=255)
    for (x, y), color in colors.items():
        stroke(x, y, x, y + 1, mixed(color, DARK, 0.15), _FINE)
        stroke(x, y + 1, x + 1, y + 1, mixed(color, DARK, 0.15), _FINE)
    for x, y in _cells(spec.cells == CLIFF):
        for share in (0.125, 0.375, 0.625, 0.875):
            dark = mixed(_CLIFF, DARK, 0.4)
            stroke(x + share, y + 0.15, x + share, y + 0.85, dark, 2 * _FINE)
    for x, y in _cells(_half_tiles(spec)):
        for slope in (0, 1):
            dark = mixed(_LOW, DARK, 0.3)
            stroke(x, y + slope, x + 1, y + 1 - slope, dark, 2 * _FINE)
    picture = _shaded(floor.reduce(_FINE), mask.reduce(_FINE), 0.3 * view.scale)
    rim = ImageDraw.Draw(picture)
    for one, other in _edges(spec):
        places = [part / _FINE for end in (one, other) for part in pixel(*end)]
        rim.line(places, _EDGE, max(round(view.scale / 24), 1))
    return np.array(picture)


def _shaded(floor: Image.Image, mask: Image.Image, reach: float) -> Image.Image:
    """The floor a little darker towards its rim, and round it a slope down into the dark."""
    near = np.asarray(mask.filter(ImageFilter.GaussianBlur(reach)), np.float32)[..., None] / 255
    inside = np.asarray(mask, np.float32)[..., None] / 255
    pit, slope = np.array(_PIT, np.float32), np.array(_SLOPE, np.float32)
    around = pit + (slope - pit) * np.minimum(2 * near, 1.0)
    ground = np.asarray(floor, np.float32) * (0.7 + 0.3 * near)
    return Image.fromarray((around + (ground - around) * inside).astype(np.uint8))


def reachable(spec: MapSpec) -> Bool[NDArray[Any], "X Y"]:
    """The ground, cliffs included, that is connected with where units start."""
    areas, _ = ndimage.label(spec.cells != WALL)
    begun = {areas[int(s.x), int(s.y)] for s in (*spec.allies, *spec.enemies)}
    return np.isin(areas, list(begun - {0}))


def _colors(spec: MapSpec) -> dict[tuple[int, int], Color]:
    reached, levels = reachable(spec), _levels(spec)

    def color(x: int, y: int) -> Color:
        height = mixed(_LOW, _HIGH, min(max(float(levels[x, y]) - 1, 0.0), 1.0))
        known = _CLIFF if spec.cells[x, y] == CLIFF else height
        return known if reached[x, y] else mixed(known, _PIT, 0.6)

    return {(x, y): color(x, y) for x, y in _cells(spec.cells != WALL)}


def _levels(spec: MapSpec) -> Float[NDArray[Any], "X Y"]:
    """1 for the lower floor, 2 for the higher one."""
    if not spec.levels:
        return np.ones(spec.cells.shape)
    return np.array([[_LEVELS[level] for level in row] for row in spec.levels])[::-1].T


def _half_tiles(spec: MapSpec) -> Bool[NDArray[Any], "X Y"]:
    tiles = np.array([[cell == HALF_TILE for cell in row] for row in spec.rows])[::-1].T
    return tiles & (spec.cells != WALL)


def _cells(chosen: Bool[NDArray[Any], "X Y"]) -> list[tuple[int, int]]:
    return [(x, y) for x, y in np.argwhere(chosen).tolist()]


def _edges(spec: MapSpec) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Where ground, cliffs and what is neither meet: both ends of each cell's side."""
    kinds = np.pad(spec.cells, 1, constant_values=WALL)
    edges = []
    for x, y in _cells(spec.cells != WALL):
        for dx, dy in _SIDES:
            if kinds[x + 1 + dx, y + 1 + dy] != kinds[x + 1, y + 1]:
                begin = (x + (dx > 0), y + (dy > 0))
                edges.append((begin, (begin[0] + abs(dy), begin[1] + abs(dx))))
    return edges

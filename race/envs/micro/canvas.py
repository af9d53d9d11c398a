"""Where a map's cells lie in a frame, and a pen that draws there."""

import math
from typing import Final, NamedTuple, final

import numpy as np
from jaxtyping import Shaped, UInt8

from race.envs.micro.sprites import Color, Sprite

Point = tuple[float, float]
Frame = UInt8[np.ndarray, "h w 3"]

LARGE: Final = (1920, 1080)
"""Width and height of a frame in pixels."""
SMALL: Final = (960, 540)
"""The same where a file or somebody else's window should not grow too large."""
_LEAST_CELLS: Final = 17.0
"""A frame is at least as many cells wide, so that a duel does not fill the screen."""
_BAR: Final = 0.09
"""Height of a legend above the battle as a share of the frame's."""
_PANEL: Final = 0.17
"""Width of a legend beside it, likewise."""


class Window(NamedTuple):
    """A part of a map, in cells."""

    left: float
    bottom: float
    right: float
    top: float


class Box(NamedTuple):
    """A part of a frame, in pixels from its upper left corner."""

    left: int
    top: int
    right: int
    bottom: int


class View(NamedTuple):
    """A window of a map in a frame."""

    size: tuple[int, int]
    """Of the frame."""
    box: Box
    """Where the battle is; the rest of the frame is for the legend."""
    window: Window
    scale: float
    """Pixels per cell."""

    @property
    def legend(self) -> Box:
        """The strip for the legend: above the battle, or left of it."""
        width, height = self.size
        if self.box.top:
            return Box(0, 0, width, self.box.top)
        return Box(0, 0, self.box.left, height)


def fit(
    shown: Window, limits: tuple[int, int], size: tuple[int, int], *, short_legend: bool = True
) -> View:
    """The largest view of a window; what is left of the frame shows more of the map.

    Args:
        shown: what must be in the picture.
        limits: width and height of the map, in cells.
        size: width and height of the frame in pixels.
        short_legend: whether the legend has room above the battle, not beside it alone.
    """
    width, height = size
    bar, panel = round(_BAR * height), round(_PANEL * width)
    boxes = [Box(panel, 0, width, height)]
    if short_legend:
        boxes.append(Box(0, bar, width, height))

    def scale(box: Box) -> float:
        return min(
            (box.right - box.left) / max(shown.right - shown.left, _LEAST_CELLS),
            (box.bottom - box.top) / (shown.top - shown.bottom),
        )

    box = max(boxes, key=scale)
    best = scale(box)
    across, up = (box.right - box.left) / best, (box.bottom - box.top) / best
    left, right = _widened(shown.left, shown.right, across, float(limits[0]))
    bottom, top = _widened(shown.bottom, shown.top, up, float(limits[1]))
    return View(size, box, Window(left, bottom, right, top), best)


def _widened(low: float, high: float, length: float, limit: float) -> tuple[float, float]:
    """A longer stretch round one; within the map, if that is long enough, else round it."""
    begin = (low + high - length) / 2
    if length <= limit:
        begin = min(max(begin, 0.0), limit - length)
    else:
        begin = min(max((limit - length) / 2, high - length), low)
    return begin, begin + length


@final
class Pen:
    """Draws on a frame. Places and lengths are in cells; opacity is from 0 to 1."""

    def __init__(self, frame: Frame, view: View) -> None:
        left, top, right, bottom = view.box
        self._frame, self._view = frame, view
        self._battle = frame[top:bottom, left:right]

    def stamp(self, place: Point, sprite: Sprite) -> None:
        """A sprite with its middle at a place of the battle."""
        column, row = self._pixel(place)
        height, width = sprite.veil.shape[:2]
        stamp(self._battle, math.floor(column) - width // 2, math.floor(row) - height // 2, sprite)

    def line(
        self, one: Point, other: Point, color: Color, opacity: float = 1.0, width: float = 0.06
    ) -> None:
        """A straight line."""
        thick = max(width * self._view.scale, 1.5)
        line(self._battle, self._pixel(one), self._pixel(other), color, opacity, thick)

    def _pixel(self, place: Point) -> Point:
        window, scale = self._view.window, self._view.scale
        return (place[0] - window.left) * scale, (window.top - place[1]) * scale


def stamp(frame: Frame, left: int, top: int, sprite: Sprite) -> None:
    """Lays a sprite over a frame; what lies beyond the frame's rim is cut off."""
    height, width = sprite.veil.shape[:2]
    first_row, first_column = max(-top, 0), max(-left, 0)
    part = frame[top + first_row : max(top + height, 0), left + first_column : max(left + width, 0)]
    rows = slice(first_row, first_row + part.shape[0])
    columns = slice(first_column, first_column + part.shape[1])
    mixed = part * sprite.veil[rows, columns]
    mixed >>= 8
    mixed += sprite.ink[rows, columns]
    part[:] = mixed


def line(
    frame: Frame, one: Point, other: Point, color: Color, opacity: float, width: float
) -> None:
    """Lays a straight line over a frame.

    For each pixel along its longer side, so many across as it is wide; at its edges and ends a
    pixel gets about as much colour as the line covers of it.
    """
    (x, y), (to_x, to_y) = one, other
    if abs(to_y - y) > abs(to_x - x):
        frame, x, y, to_x, to_y = frame.swapaxes(0, 1), y, x, to_y, to_x
    if to_x < x:
        x, y, to_x, to_y = to_x, to_y, x, y
    length, half = math.hypot(to_x - x, to_y - y), width / 2
    if length < 1e-3:
        return
    ahead, aside = (to_x - x) / length, (to_y - y) / length
    begin, end = math.floor(x - half), math.ceil(to_x + half)
    columns = np.arange(max(begin, 0), min(end, frame.shape[1]))
    away = columns + 0.5 - x
    middle, thick = y + away * aside / ahead, half / ahead
    across = np.arange(math.ceil(2 * thick) + 2)
    rows = np.floor(middle - thick - 0.5).astype(int)[:, None] + across
    beside = half + 0.5 - np.abs(rows + 0.5 - middle[:, None]) * ahead
    along = (away * ahead)[:, None] + (rows + 0.5 - y) * aside
    inward = np.minimum(along, length - along) + 0.5
    share = opacity * np.clip(beside, 0.0, 1.0) * np.clip(inward, 0.0, 1.0)
    ink, inside = np.broadcast_to(columns[:, None], rows.shape), (rows >= 0) & (rows < len(frame))
    if not inside.all():
        rows, ink, share = rows[inside], ink[inside], share[inside]
    _blend(frame, rows, ink, color, share)


def _blend(
    frame: Shaped[np.ndarray, "_ _ 3"],
    rows: Shaped[np.ndarray, "..."],
    columns: Shaped[np.ndarray, "..."],
    color: Color,
    share: Shaped[np.ndarray, "..."],
) -> None:
    weight = (256 * share).astype(np.int32)[..., None]
    below = frame[rows, columns].astype(np.int32)
    below += (np.array(color, np.int32) - below) * weight >> 8
    frame[rows, columns] = below

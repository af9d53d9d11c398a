"""A map's ground as a picture, and a pen that draws on it in the map's cells."""

import functools
import math
from typing import Final, NamedTuple, final

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from race.envs.micro.maps import MapSpec
from race.envs.micro.units import CLIFF, WALL

Color = tuple[int, int, int]
Point = tuple[float, float]

WHITE: Final[Color] = (255, 255, 255)
_GROUND: Final[Color] = (66, 74, 70)
_GRID: Final[Color] = (61, 69, 65)
_WALL: Final[Color] = (31, 34, 38)
_EDGE: Final[Color] = (96, 104, 98)
_CLIFF: Final[Color] = (112, 94, 72)
_CLIFF_LINE: Final[Color] = (88, 73, 56)
_CAPTION: Final[Color] = (20, 22, 26)

_OVERSAMPLING: Final = 2
_WIDEST: Final = 760
_HIGHEST: Final = 600
"""Size of the ground in a frame, at most, in pixels."""
_CAPTION_HEIGHT: Final = 26


class Window(NamedTuple):
    """The part of a map that is drawn, in cells."""

    left: float
    bottom: float
    right: float
    top: float


@final
class Canvas:
    """The ground of a window of a map, under a line for a caption.

    Attributes:
        size: width and height of a picture in pixels; both are even, as videos want it.
    """

    def __init__(self, spec: MapSpec, window: Window) -> None:
        width, height = window.right - window.left, window.top - window.bottom
        cell = max(math.floor(min(_WIDEST / width, _HIGHEST / height)), 4)
        self._window, self._scale = window, cell * _OVERSAMPLING
        self.size = (_even(width * cell), _even(height * cell + _CAPTION_HEIGHT))
        self._ground = self._paint_ground(spec)

    def begin(self) -> "Pen":
        """A new picture of the bare ground."""
        return Pen(self._ground.copy(), self._window, self._scale)

    def _paint_ground(self, spec: MapSpec) -> Image.Image:
        width, height = (pixels * _OVERSAMPLING for pixels in self.size)
        image = Image.new("RGB", (width, height), _WALL)
        draw = ImageDraw.Draw(image)
        window, scale, top = self._window, self._scale, _CAPTION_HEIGHT * _OVERSAMPLING
        open_cells = [(int(x), int(y)) for x, y in np.argwhere(spec.cells != WALL)]
        edges = []
        for x, y in open_cells:
            left, upper = (x - window.left) * scale, (window.top - y - 1) * scale + top
            right, lower = left + scale, upper + scale
            is_cliff = spec.cells[x, y] == CLIFF
            draw.rectangle((left, upper, right, lower), fill=_CLIFF if is_cliff else _GROUND)
            if is_cliff:
                for row in (upper + scale / 4, lower - scale / 4):
                    draw.line((left, row, right, row), fill=_CLIFF_LINE, width=2)
            else:
                draw.line((left, lower, left, upper, right, upper), fill=_GRID, width=2)
            for neighbour, edge in (
                ((x + 1, y), (right, upper, right, lower)),
                ((x - 1, y), (left, upper, left, lower)),
                ((x, y + 1), (left, upper, right, upper)),
                ((x, y - 1), (left, lower, right, lower)),
            ):
                if not _is_open(spec, neighbour):
                    edges.append(edge)
        for edge in edges:
            draw.line(edge, fill=_EDGE, width=4)
        draw.rectangle((0, 0, width, top - 1), fill=_CAPTION)
        return image


@final
class Pen:
    """Draws one picture. Places and lengths are in cells; opacity is from 0 to 1."""

    def __init__(self, image: Image.Image, window: Window, scale: int) -> None:
        self._image, self._window, self._scale = image, window, scale
        self._draw = ImageDraw.Draw(image, "RGBA")

    def disc(
        self,
        centre: Point,
        radius: float,
        fill: Color | None,
        opacity: float = 1.0,
        rim: Color | None = None,
        rim_width: float = 0.07,
    ) -> None:
        """A filled circle with or without a rim."""
        column, row = self._pixel(centre)
        reach = radius * self._scale
        self._draw.ellipse(
            (column - reach, row - reach, column + reach, row + reach),
            fill=None if fill is None else _with(fill, opacity),
            outline=rim,
            width=self._width(rim_width) if rim else 0,
        )

    def line(
        self, one: Point, other: Point, color: Color, opacity: float = 1.0, width: float = 0.1
    ) -> None:
        """A straight line."""
        ends = (*self._pixel(one), *self._pixel(other))
        self._draw.line(ends, fill=_with(color, opacity), width=self._width(width))

    def label(self, centre: Point, size: float, text: str, number: str = "") -> None:
        """A text, and a smaller number behind it, centred together."""
        column, row = self._pixel(centre)
        pixels = size * self._scale
        large, small = _font(max(int(0.62 * pixels), 8)), _font(max(int(0.42 * pixels), 8))
        width = large.getlength(text)
        left = column - (width + small.getlength(number)) / 2
        self._draw.text((left, row), text, fill=WHITE, font=large, anchor="lm")
        if number:
            below = (left + width, row + 0.12 * pixels)
            self._draw.text(below, number, fill=(235, 240, 150), font=small, anchor="lm")

    def bars(self, bottom: Point, width: float, bars: list[tuple[float, Color]]) -> None:
        """Bars that are filled to a share, the first one lowest."""
        column, row = self._pixel(bottom)
        half, thick = width / 2 * self._scale, self._width(0.15)
        for share, color in bars:
            left, right = column - half, column + half
            self._draw.rectangle((left, row - thick, right, row), fill=(0, 0, 0, 200))
            if share > 0:
                filled = left + 1 + max((right - left - 2) * share, 1)
                self._draw.rectangle((left + 1, row - thick + 1, filled, row - 1), fill=color)
            row -= thick + 1

    def finish(
        self, left: list[tuple[str, Color]], right: list[tuple[str, Color]]
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The picture, with texts at both ends of the caption."""
        image = self._image.reduce(_OVERSAMPLING)
        draw, font = ImageDraw.Draw(image), _font(15)
        column = 8.0
        for text, color in left:
            draw.text((column, _CAPTION_HEIGHT / 2), text, fill=color, font=font, anchor="lm")
            column += font.getlength(text) + 16
        column = image.width - 8.0
        for text, color in reversed(right):
            draw.text((column, _CAPTION_HEIGHT / 2), text, fill=color, font=font, anchor="rm")
            column -= font.getlength(text)
        return np.array(image)

    def _pixel(self, place: Point) -> Point:
        return (
            (place[0] - self._window.left) * self._scale,
            (self._window.top - place[1]) * self._scale + _CAPTION_HEIGHT * _OVERSAMPLING,
        )

    def _width(self, cells: float) -> int:
        return max(round(cells * self._scale), 2)


def mixed(one: Color, other: Color, share: float) -> Color:
    """A colour between two: ``one`` at 0, ``other`` at 1."""
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(one, other, strict=True))
    return red, green, blue


def _with(color: Color, opacity: float) -> tuple[int, int, int, int]:
    return (*color, round(255 * min(max(opacity, 0.0), 1.0)))


def _is_open(spec: MapSpec, cell: tuple[int, int]) -> bool:
    x, y = cell
    width, height = spec.cells.shape
    return 0 <= x < width and 0 <= y < height and bool(spec.cells[x, y] != WALL)


@functools.cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font


def _even(pixels: float) -> int:
    return 2 * round(pixels / 2)

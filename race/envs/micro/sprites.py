"""Small pictures that are drawn once and stamped many times: bodies, rings, words.

A picture is drawn large and shrunk, for smooth edges, and kept; a frame is then little more than
copies of them. Lengths are in pixels of the frame.
"""

import functools
import math
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import UInt8, UInt16
from PIL import Image, ImageDraw, ImageFont

Color = tuple[int, int, int]

WHITE: Final[Color] = (255, 255, 255)
DARK: Final[Color] = (12, 14, 18)

_FINE: Final = 4
"""How much larger a picture is drawn."""
_SMALLEST: Final = 9.0
"""Height of letters that can still be read."""


class Sprite(NamedTuple):
    """A picture with see-through parts, ready to be laid over another one."""

    ink: UInt8[np.ndarray, "h w 3"]
    """What it adds: its colours times their opacity."""
    veil: UInt16[np.ndarray, "h w 1"]
    """What it lets through, 256 for everything."""


def mixed(one: Color, other: Color, share: float) -> Color:
    """A colour between two: ``one`` at 0, ``other`` at 1."""
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(one, other, strict=True))
    return red, green, blue


def faded(sprite: Sprite, opacity: float) -> Sprite:
    """The same picture, more transparent."""
    ink = (sprite.ink * opacity).astype(np.uint8)
    return Sprite(ink, (256 - (256 - sprite.veil) * opacity).astype(np.uint16))


def over(upper: Sprite, lower: Sprite) -> Sprite:
    """Two pictures of equal size as one."""
    ink = upper.ink + (lower.ink * upper.veil >> 8).astype(np.uint8)
    return Sprite(ink, (upper.veil.astype(np.uint32) * lower.veil >> 8).astype(np.uint16))


@functools.lru_cache(maxsize=4096)
def body(
    radius: float, rim: float, color: Color, label: str, flash: float = 0.0, opacity: float = 1.0
) -> Sprite:
    """A disc in a dark rim that is wide enough for rings, with a label.

    Args:
        radius: of all of it.
        rim: width of the rim.
        color: of the disc.
        label: a letter, or a letter and a number. Where there is no room for both, the number.
        flash: share of white in the disc.
        opacity: of all of it.
    """
    image, draw, middle = _blank(radius)
    _disc(draw, middle, radius, DARK)
    _disc(draw, middle, radius - rim, mixed(color, WHITE, flash))
    bright = 0.3 * color[0] + 0.6 * color[1] + 0.1 * color[2] > 150
    _label(draw, middle, radius - rim, label, DARK if bright else WHITE)
    return faded(_sprite(image), opacity)


@functools.lru_cache(maxsize=4096)
def ring(radius: float, outer: float, width: float, share: float, color: Color) -> Sprite:
    """Part of a ring, clockwise from the top, in a picture as large as a body of a radius.

    Args:
        radius: of the body.
        outer: of the ring.
        width: of the ring.
        share: from 0 to 1.
        color: of the ring.
    """
    image, draw, middle = _blank(radius)
    reach, thick = outer * _FINE, max(round(width * _FINE), 1)
    box = (middle - reach, middle - reach, middle + reach, middle + reach)
    if share > 0:
        draw.arc(box, -90, -90 + 360 * min(share, 1.0), fill=(*color, 255), width=thick)
    return _sprite(image)


@functools.lru_cache(maxsize=512)
def disc(radius: float, color: Color, opacity: float, rim: float = 0.0) -> Sprite:
    """A see-through disc, in a rim of a width that is less so."""
    image, draw, middle = _blank(radius)
    _disc(draw, middle, radius, color, min(2 * opacity, 1.0) if rim else opacity)
    if rim:
        _disc(draw, middle, radius - rim, color, opacity)
    return _sprite(image)


@functools.lru_cache(maxsize=512)
def cross(radius: float, color: Color, opacity: float) -> Sprite:
    """Two crossed strokes."""
    image, draw, middle = _blank(radius)
    reach, width = radius * _FINE * math.sqrt(0.5), max(round(radius * _FINE / 4), 2)
    for turn in (1, -1):
        ends = (middle - reach, middle - turn * reach, middle + reach, middle + turn * reach)
        draw.line(ends, fill=(*color, round(255 * opacity)), width=width)
    return _sprite(image)


@functools.lru_cache(maxsize=256)
def words(text: str, height: int, color: Color) -> Sprite:
    """A line of text; it is as high for every text of a height."""
    font = _font(height)
    ascent, descent = font.getmetrics()
    mask = Image.new("L", (math.ceil(font.getlength(text)) + 1, ascent + descent))
    ImageDraw.Draw(mask).text((0, 0), text, fill=255, font=font)
    image = Image.new("RGBA", mask.size, color)
    image.putalpha(mask)
    return _sprite(image, fine=1)


def _blank(radius: float) -> tuple[Image.Image, ImageDraw.ImageDraw, float]:
    size = (2 * math.ceil(radius) + 1) * _FINE
    image = Image.new("RGBA", (size, size))
    return image, ImageDraw.Draw(image), (size - 1) / 2


def _disc(
    draw: ImageDraw.ImageDraw, middle: float, radius: float, color: Color, opacity: float = 1.0
) -> None:
    reach = radius * _FINE
    box = (middle - reach, middle - reach, middle + reach, middle + reach)
    draw.ellipse(box, fill=(*color, round(255 * opacity)))


def _label(
    draw: ImageDraw.ImageDraw, middle: float, radius: float, label: str, color: Color
) -> None:
    letter, number = label[:1], label[1:]
    if number and 0.85 * radius < _SMALLEST:
        letter, number = number, ""  # the colour tells the type, nothing else the agent
    height = (1.0 if number or len(letter) > 1 else 1.3) * radius
    if height < _SMALLEST * 0.8:
        return
    large, small = _font(round(height * _FINE)), _font(round(0.75 * height * _FINE))
    left = middle - (large.getlength(letter) + small.getlength(number)) / 2
    _, top, _, bottom = large.getbbox(letter, anchor="ls")
    for text, font in ((letter, large), (number, small)):
        place = left, middle - (top + bottom) / 2
        draw.text(place, text, color, font, anchor="ls", stroke_width=height * _FINE / 40)
        left += font.getlength(text)


def _sprite(image: Image.Image, fine: int = _FINE) -> Sprite:
    pixels = np.asarray((image.reduce(fine) if fine > 1 else image).convert("RGBa"))
    opaque = pixels[..., 3:].astype(np.uint16)
    return Sprite(np.ascontiguousarray(pixels[..., :3]), 256 - opaque - (opaque >> 7))


@functools.cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font

"""A picture of a team at work in a frame that says which task, whose team, and how it goes."""

import functools
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

from race.viewing.progress import rounded

Color = tuple[int, int, int]
Frame = UInt8[ndarray, "h w 3"]
Size = tuple[int, int]

LARGE: Final = (1280, 720)
"""Width and height of a frame in pixels."""
SMALL: Final = (640, 360)
"""The same in a .gif, which would grow too large."""

_BACK: Final[Color] = (27, 29, 34)
_WHITE: Final[Color] = (255, 255, 255)
_GREY: Final[Color] = (182, 188, 194)
_BAR: Final = 15
"""Bars in the height of a frame."""


class Headline(NamedTuple):
    """What a frame says of what it shows."""

    task: str
    team: str
    agents: tuple[Color, ...] = ()
    """The colours of the agents, where the picture has them."""


def picture_size(size: Size) -> Size:
    """Width and height that are left for the picture in a frame."""
    return size[0], size[1] - _bar(size)


def framed(
    picture: Frame, size: Size, headline: Headline, steps: int, paid: float
) -> UInt8[ndarray, "H W 3"]:
    """The picture, as large as it fits, under a line of text.

    Args:
        picture: what is shown, of any size.
        size: width and height of the frame in pixels.
        headline: what is said of all of the episode.
        steps: of the episode so far.
        paid: its return so far.
    """
    width, height = picture_size(size)
    frame = Image.new("RGB", size, _BACK)
    shown = Image.fromarray(picture)
    scale = min(width / shown.width, height / shown.height)
    if scale != 1:
        fitted = (max(round(scale * shown.width), 1), max(round(scale * shown.height), 1))
        # Pixels of a small picture stay sharp; a large one is smoothed.
        way = Image.Resampling.NEAREST if scale >= 2 else Image.Resampling.LANCZOS
        shown = shown.resize(fitted, way)
    frame.paste(shown, ((width - shown.width) // 2, _bar(size) + (height - shown.height) // 2))
    _write(frame, size, headline, steps, paid)
    return np.asarray(frame)


def _bar(size: Size) -> int:
    return 2 * round(size[1] / _BAR / 2)


def _write(frame: Image.Image, size: Size, headline: Headline, steps: int, paid: float) -> None:
    bar = _bar(size)
    pen, font = ImageDraw.Draw(frame), _font(round(0.5 * bar))
    gap = 0.6 * bar
    right = _legend(pen, size, headline.agents)
    words = [
        (headline.team, _GREY),
        (f"step {steps}", _GREY),
        (f"return {rounded(paid)}", _GREY),
    ]
    room = right - sum(font.getlength(text) + gap for text, _ in words) - 2 * gap
    left = 0.4 * bar
    for text, color in [(_cut(headline.task, room, round(0.5 * bar)), _WHITE), *words]:
        pen.text((left, bar / 2), text, fill=color, font=font, anchor="lm")
        left += font.getlength(text) + gap


def _legend(pen: ImageDraw.ImageDraw, size: Size, agents: tuple[Color, ...]) -> float:
    """Discs in the agents' colours with their numbers, at the right; returns where they begin."""
    bar, right = _bar(size), size[0] - 0.2 * _bar(size)
    if not agents:
        return right
    pitch = min(0.85 * bar, 0.35 * size[0] / len(agents))
    radius, font = 0.45 * pitch, _font(max(round(0.5 * pitch), 7))
    left = right - pitch * len(agents)
    for agent, color in enumerate(agents):
        x, y = left + pitch * (agent + 0.5), bar / 2
        pen.ellipse((x - radius, y - radius, x + radius, y + radius), fill=color)
        pen.text((x, y), str(agent), fill=_WHITE, font=font, anchor="mm")
    word = _font(round(0.42 * bar))
    left -= word.getlength("agents ") + 0.1 * bar
    pen.text((left, bar / 2), "agents", fill=_GREY, font=word, anchor="lm")
    return left


@functools.cache
def _font(height: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(height)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font


@functools.lru_cache(maxsize=256)
def _cut(text: str, room: float, height: int) -> str:
    """As much of a text as there is room for."""
    font = _font(height)
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(f"{text}…") > room:
        text = text[:-1]
    return f"{text}…"

"""Colours of sides, of unit types and of what happens to them."""

import colorsys
from typing import Final

from race.envs.micro.sprites import Color, mixed

ALLY: Final[Color] = (80, 150, 255)
ENEMY: Final[Color] = (255, 96, 84)
ALLY_SHOT: Final[Color] = (150, 205, 255)
ENEMY_SHOT: Final[Color] = (255, 176, 120)
FULL: Final[Color] = (84, 222, 92)
HALF: Final[Color] = (240, 205, 60)
LOW: Final[Color] = (245, 66, 56)
SHIELD: Final[Color] = (150, 226, 255)
ENERGY: Final[Color] = (206, 140, 250)
HEAL: Final[Color] = (110, 240, 120)
BEAM: Final[Color] = (255, 200, 80)
BURST: Final[Color] = (170, 235, 60)
GREY: Final[Color] = (182, 188, 194)
VERDICTS: Final[dict[str, Color]] = {"won": HEAL, "lost": (255, 120, 110)}

_ALLY_HUE: Final = 215.0
_ENEMY_HUE: Final = 6.0
_SPREAD: Final = 44.0
"""Degrees that a type's hue may be off its side's."""
_TINTS: Final[dict[str, tuple[float, float]]] = {
    "Marine": (0.0, 0.92),
    "Marauder": (0.8, 0.74),
    "Medivac": (-0.8, 0.85),
    "Stalker": (0.8, 0.86),
    "Zealot": (-0.4, 0.95),
    "Colossus": (-1.0, 0.78),
    "Zergling": (0.0, 0.88),
    "Baneling": (-0.95, 0.92),
    "Hydralisk": (0.5, 0.86),
    "SpineCrawler": (0.2, 0.72),
}
"""Of each type: shift of the hue as a share of the spread, and brightness."""


def of_type(unit: str, ally: bool) -> Color:
    """The colour of a unit: agents blue, from green-blue to violet, enemies from yellow to pink."""
    shift, value = _TINTS.get(unit, (0.0, 0.9))
    hue = _ALLY_HUE + _SPREAD * shift if ally else _ENEMY_HUE - _SPREAD * shift
    red, green, blue = colorsys.hsv_to_rgb(hue % 360 / 360, 0.74 if ally else 0.76, value)
    return round(255 * red), round(255 * green), round(255 * blue)


def of_health(share: float) -> Color:
    """From green over yellow to red."""
    return mixed(HALF, FULL, 2 * share - 1) if share > 0.5 else mixed(LOW, HALF, 2 * share)

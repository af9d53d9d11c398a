"""What a frame says beside the battle: how it stands, who is who, and what the rings mean."""

from collections.abc import Iterator
from typing import Final, NamedTuple, final

import numpy as np
from jaxtyping import Bool

from race.envs.micro import colors
from race.envs.micro.battle import LOOPS_PER_STEP
from race.envs.micro.canvas import Frame, View, stamp
from race.envs.micro.maps import MapSpec
from race.envs.micro.sprites import WHITE, Color, Sprite, body, over, ring, words
from race.envs.micro.units import LOOPS_PER_SECOND, UNIT_TYPES

_BACK: Final[Color] = (27, 29, 34)
_LINES: Final = 30
"""Lines of a panel, at least; a bar has two."""
_MOST_TYPES: Final = 3
"""Types of a side for which a bar has room."""
_TITLES: Final = (("agents", colors.ALLY), ("enemies", colors.ENEMY))


class Standing(NamedTuple):
    """How a battle stands."""

    loops: int
    """Game loops so far."""
    episode_return: float
    verdict: str
    """How it ended; empty before that."""
    alive: Bool[np.ndarray, "U"]


class _Count(NamedTuple):
    left: float
    top: float
    units: range | list[int]


@final
class Legend:
    """A bar above a battle or a panel left of it, as the view has room."""

    def __init__(self, spec: MapSpec, view: View, team: str = "") -> None:
        _, top, right, bottom = view.legend
        self._spec, self._box, self._team = spec, view.legend, team
        self._panel = bottom - top > right
        needed = 13 + sum(len(_types(spec, side)) for side in _sides(spec))
        self._line = (bottom - top) / (max(_LINES, needed) if self._panel else 2)
        self._text = max(round(0.54 * self._line), 8)
        self._pad = 0.4 * self._line
        self._counts: list[_Count] = []
        self._title = self._name()

    def paint(self, frame: Frame) -> None:
        """What stays the same for all of a battle."""
        box, spec = self._box, self._spec
        frame[box.top : box.bottom, box.left : box.right] = _BACK
        self._counts = []
        left, top = self._pad, self._pad + 7 * self._line if self._panel else self._line
        for (title, color), side in zip(_TITLES, _sides(spec), strict=True):
            if side.start and not self._panel:
                left = box.right / 2
            left, top = self._entry(frame, left, top, None, title, color, side)
            for name, members in _types(spec, side).items():
                fill, letter = colors.of_type(name, side.start == 0), UNIT_TYPES[name].letter
                chip = body(0.38 * self._line, 1.0, fill, letter)
                left, top = self._entry(frame, left, top, chip, name, colors.GREY, members)
            top += self._line if self._panel else 0.0
        self._explain(frame)

    def write(self, frame: Frame, standing: Standing) -> None:
        """What changes: time, return, end, and how many are alive."""
        limit = self._spec.episode_limit
        steps = -(-standing.loops // LOOPS_PER_STEP)
        lines = [
            self._title,
            *([words(self._team, self._text, colors.GREY)] if self._team else []),
            words(f"{standing.loops / LOOPS_PER_SECOND:.1f} s", self._text, colors.GREY),
            words(f"step {steps}/{limit}", self._text, colors.GREY),
            words(f"return {standing.episode_return:.2f}", self._text, colors.GREY),
        ]
        if standing.verdict:
            color = colors.VERDICTS.get(standing.verdict, colors.HALF)
            lines.append(words(standing.verdict, self._text, color))
        left, top = self._pad, self._pad if self._panel else 0.0
        for line in lines:
            self._put(frame, left, top, line)
            if self._panel:
                top += self._line
            else:
                left += line.veil.shape[1] + self._line
        for count in self._counts:
            alive = int(standing.alive[count.units].sum())
            color = WHITE if alive else (110, 114, 120)
            text = words(f"{alive}/{len(count.units)}", self._text, color)
            self._put(frame, count.left, count.top, text)

    def _entry(
        self,
        frame: Frame,
        left: float,
        top: float,
        chip: Sprite | None,
        name: str,
        color: Color,
        units: range | list[int],
    ) -> tuple[float, float]:
        """A line that counts units; returns where the next one goes."""
        right = left
        for sprite in ([chip] if chip else []) + [words(name, self._text, color)]:
            right = self._put(frame, right, top, sprite) + self._pad
        self._counts.append(_Count(right, top, units))
        if self._panel:
            return left, top + self._line
        widest = words(f"{len(units)}/{len(units)}", self._text, WHITE).veil.shape[1]
        return right + widest + 0.6 * self._line, top

    def _name(self) -> Sprite:
        """The map's name, or as much of it as there is room for."""
        room = self._box.right - 2 * self._pad if self._panel else 0.3 * self._box.right
        name, shown = self._spec.name, words(self._spec.name, self._text, WHITE)
        while shown.veil.shape[1] > room:
            name = name[:-1]
            shown = words(f"{name}…", self._text, WHITE)
        return shown

    def _explain(self, frame: Frame) -> None:
        """What the rings of this map's units mean: in a bar at its end, in a panel at its foot."""
        entries = [
            (ring_sample(0.38 * self._line, color), words(name, self._text, colors.GREY))
            for name, color in self._rings()
        ]
        if self._panel:
            top = self._box.bottom - self._pad - len(entries) * self._line
            for sample, name in entries:
                self._put(frame, self._put(frame, self._pad, top, sample) + self._pad, top, name)
                top += self._line
        else:
            widths = [s.veil.shape[1] + n.veil.shape[1] + 3 * self._pad for s, n in entries]
            left = self._box.right - sum(widths)
            for (sample, name), width in zip(entries, widths, strict=True):
                self._put(frame, self._put(frame, left, 0.0, sample) + self._pad, 0.0, name)
                left += width

    def _rings(self) -> Iterator[tuple[str, Color]]:
        types = [UNIT_TYPES[s.unit] for s in (*self._spec.allies, *self._spec.enemies)]
        yield "health", colors.FULL
        if any(t.shield for t in types):
            yield "shield", colors.SHIELD
        if any(t.heals for t in types):
            yield "energy", colors.ENERGY

    def _put(self, frame: Frame, left: float, top: float, sprite: Sprite) -> float:
        """Stamps a sprite in the middle of a line's height; returns where it ends."""
        height, width = sprite.veil.shape[:2]
        stamp(frame, round(left), round(top + (self._line - height) / 2), sprite)
        return left + width


def is_short(spec: MapSpec) -> bool:
    """Whether a bar has room for a map's legend."""
    return all(len(_types(spec, side)) <= _MOST_TYPES for side in _sides(spec))


def _sides(spec: MapSpec) -> tuple[range, range]:
    n = len(spec.allies)
    return range(n), range(n, n + len(spec.enemies))


def _types(spec: MapSpec, side: range) -> dict[str, list[int]]:
    """The units of each type of a side."""
    units = [*spec.allies, *spec.enemies]
    types: dict[str, list[int]] = {}
    for k in side:
        types.setdefault(units[k].unit, []).append(k)
    return types


def ring_sample(radius: float, color: Color) -> Sprite:
    """A ring without a unit in it."""
    width = radius / 3
    return over(ring(radius, radius - 1, width, 0.75, color), body(radius, width + 2, _BACK, ""))

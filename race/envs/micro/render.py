"""Pictures of battles, one per game loop."""

import math
from collections.abc import Iterator
from typing import Any, Final, NamedTuple, final

import jax
import numpy as np

from race.envs.micro import Battle, colors, ground
from race.envs.micro.attacks import Attacks, at
from race.envs.micro.battle import LOOPS_PER_STEP
from race.envs.micro.canvas import LARGE, Frame, Pen, Window, fit
from race.envs.micro.legend import Legend, Standing, is_short
from race.envs.micro.maps import MapSpec
from race.envs.micro.recording import Recording
from race.envs.micro.sprites import DARK, Color, body, disc, ring
from race.envs.micro.state import Units
from race.envs.micro.units import LOOPS_PER_SECOND, MAX_ENERGY, UNIT_TYPES, Mover, UnitType
from race.envs.micro.watching import Watch

FPS: Final = float(LOOPS_PER_SECOND)
"""Frames per second for playback at the game's "normal" speed: one frame is one game loop."""

_FLASH: Final = 4
"""Loops that a hit stays visible."""
_HOLD: Final = 20
"""Frames that the end of a battle stays visible."""
_MARGIN: Final = 1.5
"""Cells round what is shown."""
_OPACITY: Final = {Mover.GROUND: 1.0, Mover.CLIFF: 0.85, Mover.AIR: 0.6}
"""Of bodies: who is above others does not hide them."""
_SHARES: Final = 40
"""Lengths of a ring that are told apart."""


def frames(
    played: Battle, recording: Recording, size: tuple[int, int] = LARGE, team: str = ""
) -> Iterator[Frame]:
    """A frame for each moment of a recording, of the part of the map that it uses.

    The last frame of a battle that has ended is repeated for a while (`n_frames` counts all).

    Args:
        played: the map.
        recording: of a battle on it.
        size: width and height of a frame in pixels.
        team: who plays, for the legend.
    """
    painter = Painter(played, used(played.spec, recording.units), size, team)
    moments = len(recording.units.x)
    for moment in range(moments):
        painter.see(Units(*(leaf[moment] for leaf in recording.units)))
        # A step's reward is known at its end.
        paid = moment // LOOPS_PER_STEP
        episode_return = float(recording.returns[paid - 1]) if paid else 0.0
        last = moment == moments - 1
        frame = painter.draw(moment, episode_return, recording.verdict if last else "")
        yield frame
    if recording.verdict:
        yield from [frame] * _HOLD


def n_frames(recording: Recording) -> int:
    """How many frames `frames` makes."""
    return len(recording.units.x) + (_HOLD if recording.verdict else 0)


def whole(played: Battle) -> Window:
    """Every place that a unit may come to."""
    width, height = played.spec.cells.shape
    if played.scenario.shape.flyers:
        return Window(0.0, 0.0, float(width), float(height))
    x, y = np.nonzero(ground.reachable(played.spec))
    return Window(float(x.min()), float(y.min()), float(x.max()) + 1, float(y.max()) + 1)


def used(spec: MapSpec, units: Units) -> Window:
    """Every place that a living unit comes to, with a margin; ``units`` have a leading axis."""
    alive = units.health > 0
    width, height = spec.cells.shape
    left, right = _span(units.x[alive], width)
    bottom, top = _span(units.y[alive], height)
    return Window(left, bottom, right, top)


def _span(places: Any, size: int) -> tuple[float, float]:
    low, high = float(places.min()) - _MARGIN, float(places.max()) + _MARGIN
    return max(low, 0.0), min(high, float(size))


class _Figure(NamedTuple):
    """How a unit is drawn; lengths in pixels."""

    kind: UnitType
    color: Color
    label: str
    radius: float
    ring: float
    """Width of each of its rings."""
    rim: float
    """Width of all of them, with what is between."""


@final
class Painter:
    """Draws battles of a map: show it each game loop with `see`, and `draw` when you like.

    Attributes:
        view: where the map lies in a frame.
    """

    def __init__(
        self, played: Battle, window: Window, size: tuple[int, int] = LARGE, team: str = ""
    ) -> None:
        """A painter of a map.

        Args:
            played: the map.
            window: what must be in the picture; there may be more.
            size: width and height of a frame in pixels.
            team: who plays, for the legend.
        """
        spec, scenario = played.spec, jax.tree.map(np.asarray, played.scenario)
        self.view = view = fit(window, spec.cells.shape, size, short_legend=is_short(spec))
        self._watch, self._legend = Watch(scenario), Legend(spec, view, team)
        left, top, right, bottom = view.box
        self._back = np.zeros((size[1], size[0], 3), np.uint8)
        self._back[top:bottom, left:right] = ground.paint(spec, view)
        self._legend.paint(self._back)
        units = [start.unit for start in (*spec.allies, *spec.enemies)]
        n = played.shape.n_allies
        self._figures = [
            _figure(unit, k if k < n else None, view.scale) for k, unit in enumerate(units)
        ]
        types = [figure.kind for figure in self._figures]
        self._attacks = Attacks(types, n, scenario.beams.tolist(), view.scale)
        self._of_mover = {m: [k for k, t in enumerate(types) if t.mover is m] for m in Mover}

    def forget(self) -> None:
        """Before another battle: what was seen of this one leaves no traces."""
        self._watch.forget()

    def see(self, units: Units) -> None:
        """The units after one more game loop, as numpy arrays."""
        self._watch.see(units)

    def draw(self, loops: int, episode_return: float, verdict: str = "") -> Frame:
        """The game loop that was seen last.

        Args:
            loops: game loops so far, for the legend.
            episode_return: sum of rewards so far, for the legend.
            verdict: how the battle ended, for the legend.
        """
        moment, frame = self._watch.moment, self._back.copy()
        alive, pen = moment.units.health > 0, Pen(frame, self.view)
        self._attacks.traces(pen, moment)
        # Those that climb are tall and walk over others.
        for mover in (Mover.GROUND, Mover.CLIFF):
            for k in self._of_mover[mover]:
                if alive[k]:
                    self._unit(pen, moment.units, k, int(moment.since_hit[k]))
        self._attacks.draw(pen, moment)
        flyers = [k for k in self._of_mover[Mover.AIR] if alive[k]]
        for k in flyers:
            x, y = at(moment.units, k)
            pen.stamp((x + 0.35, y - 0.45), disc(0.9 * self._figures[k].radius, DARK, 0.35))
        for k in flyers:
            self._unit(pen, moment.units, k, int(moment.since_hit[k]))
        self._legend.write(frame, Standing(loops, episode_return, verdict, alive))
        return frame

    def _unit(self, pen: Pen, units: Units, k: int, since_hit: int) -> None:
        kind, color, label, radius, width, rim = self._figures[k]
        flash = 0.45 * max(1 - since_hit / _FLASH, 0.0)
        opacity = _OPACITY[kind.mover]
        place = at(units, k)
        pen.stamp(place, body(radius, rim, color, label, flash, opacity))
        health = _share(float(units.health[k]), kind.health)
        pen.stamp(place, ring(radius, radius - 1, width, health, colors.of_health(health)))
        inner = radius - 2 - width
        if kind.shield:
            shield = _share(float(units.shield[k]), kind.shield)
            pen.stamp(place, ring(radius, inner, width, shield, colors.SHIELD))
        if kind.heals:
            energy = _share(float(units.energy[k]), MAX_ENERGY)
            pen.stamp(place, ring(radius, inner, width, energy, colors.ENERGY))


def _share(value: float, most: float) -> float:
    """A share in whole steps, rounded up: only nothing looks like nothing."""
    return math.ceil(_SHARES * value / most - 1e-6) / _SHARES


def _figure(unit: str, agent: int | None, scale: float) -> _Figure:
    kind = UNIT_TYPES[unit]
    radius = kind.radius * scale
    width = min(max(0.17 * radius, 2.5), 0.1 * scale)
    rings = 1 + bool(kind.shield) + kind.heals
    label = kind.letter + ("" if agent is None else str(agent))
    rim = 1 + rings * (width + 1)
    return _Figure(kind, colors.of_type(unit, agent is not None), label, radius, width, rim)

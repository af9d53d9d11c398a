"""Pictures of battles, one per game loop."""

import math
from collections.abc import Iterator
from typing import Any, Final, final

import jax
import numpy as np
from jaxtyping import UInt8

from race.envs.micro import Battle
from race.envs.micro.battle import LOOPS_PER_STEP
from race.envs.micro.canvas import WHITE, Canvas, Color, Pen, Point, Window, mixed
from race.envs.micro.combat import BEAM_HALF_LENGTH
from race.envs.micro.maps import MapSpec
from race.envs.micro.recording import Recording
from race.envs.micro.state import Units
from race.envs.micro.units import LOOPS_PER_SECOND, MAX_ENERGY, UNIT_TYPES, WALL, Mover

FPS: Final = float(LOOPS_PER_SECOND)
"""Frames per second for playback at the game's "normal" speed: one frame is one game loop."""

_ALLY: Final[Color] = (62, 124, 214)
_ENEMY: Final[Color] = (205, 66, 60)
_ALLY_SHOT: Final[Color] = (140, 200, 255)
_ENEMY_SHOT: Final[Color] = (255, 170, 120)
_FULL: Final[Color] = (90, 220, 90)
_HALF: Final[Color] = (235, 200, 60)
_LOW: Final[Color] = (235, 70, 60)
_SHIELD: Final[Color] = (110, 190, 255)
_ENERGY: Final[Color] = (196, 130, 240)
_HEAL: Final[Color] = (110, 235, 120)
_BEAM: Final[Color] = (255, 190, 70)
_BURST: Final[Color] = (160, 225, 70)
_DARK: Final[Color] = (10, 12, 16)
_GREY: Final[Color] = (190, 195, 200)
_VERDICTS: Final[dict[str, Color]] = {"won": (110, 235, 120), "lost": (255, 120, 110)}

_FLASH: Final = 4
"""Loops that a shot or a hit stays visible."""
_FADE: Final = 12
"""Loops that a death or a burst stays visible."""
_HOLD: Final = 20
"""Frames that the end of a battle stays visible."""
_SWARM: Final = 24
"""With more units than this, those without a scratch show no bars."""
_MARGIN: Final = 2.0
"""Cells round what is shown."""


def frames(played: Battle, recording: Recording) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """A frame for each moment of a recording, of the part of the map that it uses.

    The last frame of a battle that has ended is repeated for a while (`n_frames` counts all).
    """
    painter = Painter(played, used(played.spec, recording.units))
    moments = len(recording.units.x)
    for moment in range(moments):
        painter.see(Units(*(leaf[moment] for leaf in recording.units)))
        # A step's reward is known at its end.
        paid = moment // LOOPS_PER_STEP
        episode_return = float(recording.returns[paid - 1]) if paid else 0.0
        last = moment == moments - 1
        frame = painter.draw(
            math.ceil(moment / LOOPS_PER_STEP), episode_return, recording.verdict if last else ""
        )
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
    x, y = np.nonzero(played.spec.cells != WALL)
    return Window(
        max(float(x.min()) - 1, 0.0),
        max(float(y.min()) - 1, 0.0),
        min(float(x.max()) + 2, float(width)),
        min(float(y.max()) + 2, float(height)),
    )


def used(spec: MapSpec, units: Units) -> Window:
    """Every place that a living unit comes to, with a margin; ``units`` have a leading axis."""
    alive = units.health > 0
    width, height = spec.cells.shape
    left, right = _span(units.x[alive], 20.0, width)
    bottom, top = _span(units.y[alive], 12.0, height)
    return Window(left, bottom, right, top)


def _span(places: Any, least: float, size: int) -> tuple[float, float]:
    low, high = float(places.min()) - _MARGIN, float(places.max()) + _MARGIN
    missing = max(least - (high - low), 0.0) / 2
    return float(max(math.floor(low - missing), 0)), float(min(math.ceil(high + missing), size))


@final
class Painter:
    """Draws battles of a map: show it each game loop with `see`, and `draw` when you like."""

    def __init__(self, played: Battle, window: Window) -> None:
        spec = played.spec
        self._canvas = Canvas(spec, window)
        self._map, self._scenario = spec, jax.tree.map(np.asarray, played.scenario)
        self._n, self._units = played.shape.n_allies, played.shape.n_units
        self._types = [UNIT_TYPES[start.unit] for start in (*spec.allies, *spec.enemies)]
        self.forget()

    def forget(self) -> None:
        """Before another battle: what was seen of this one leaves no traces."""
        self._now: Units | None = None
        self._dead, self._struck, self._hit = (np.full(self._units, _FADE) for _ in range(3))
        self._heals = np.zeros(self._units, np.bool_)

    def see(self, units: Units) -> None:
        """The units after one more game loop, as numpy arrays."""
        before, self._now = self._now, units
        if before is None:
            return
        died = (before.health > 0) & (units.health <= 0)
        second = (self._scenario.second_hit > 0) & (before.pending > 0) & (units.pending <= 0)
        struck = (units.cooldown > before.cooldown) | second
        hit = units.health + units.shield < before.health + before.shield - 1e-3
        # Loops since each unit died, struck and was hit.
        self._dead = np.where(died, 0, self._dead + 1)
        self._struck = np.where(struck, 0, self._struck + 1)
        self._hit = np.where(hit, 0, self._hit + 1)
        self._heals = units.energy < before.energy

    def draw(
        self, step: int, episode_return: float, verdict: str = ""
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The game loop that was seen last.

        Args:
            step: environment steps so far, for the caption.
            episode_return: sum of rewards so far, for the caption.
            verdict: how the battle ended, for the caption.
        """
        assert self._now is not None, "see comes before draw"
        units, pen = self._now, self._canvas.begin()
        living = [k for k in range(self._units) if units.health[k] > 0]
        flyers = [k for k in living if self._scenario.flying[k]]
        # Those that climb are tall and walk over others.
        walkers = [k for k in living if self._types[k].mover is Mover.GROUND]
        walkers += [k for k in living if self._types[k].mover is Mover.CLIFF]
        self._traces(pen, units)
        for k in walkers:
            self._body(pen, units, k)
        for k in walkers:
            self._bars(pen, units, k)
        for k in walkers:
            self._label(pen, units, k)
        for k in range(self._units):
            self._attack(pen, units, k)
        for k in flyers:
            x, y = _at(units, k)
            pen.disc((x + 0.35, y - 0.45), 0.9 * self._types[k].radius, _DARK, 0.35)
        for k in flyers:
            self._body(pen, units, k)
            self._bars(pen, units, k)
            self._label(pen, units, k)
        return pen.finish(*self._caption(units, step, episode_return, verdict))

    def _traces(self, pen: Pen, units: Units) -> None:
        """What the dead leave behind for a while."""
        for k in np.flatnonzero(self._dead < _FADE).tolist():
            fade, (x, y) = 1 - float(self._dead[k]) / _FADE, _at(units, k)
            weapon = self._types[k].weapon
            if weapon and weapon.burst:
                pen.disc((x, y), weapon.burst, _BURST, 0.4 * fade**2)
            half = 0.5 * self._types[k].radius
            color = self._shot(k)
            pen.line((x - half, y - half), (x + half, y + half), color, fade)
            pen.line((x - half, y + half), (x + half, y - half), color, fade)

    def _body(self, pen: Pen, units: Units, k: int) -> None:
        radius, color = self._types[k].radius, _ALLY if k < self._n else _ENEMY
        hit = max(1 - float(self._hit[k]) / _FLASH, 0.0)
        pen.disc(
            _at(units, k),
            radius,
            color,
            opacity=1.0 if self._types[k].mover is Mover.GROUND else 0.8,
            rim=mixed(mixed(color, _DARK, 0.45), WHITE, hit),
            rim_width=0.07 + 0.05 * hit,
        )

    def _label(self, pen: Pen, units: Units, k: int) -> None:
        number = str(k) if k < self._n else ""
        pen.label(_at(units, k), 2 * self._types[k].radius, self._types[k].letter, number)

    def _bars(self, pen: Pen, units: Units, k: int) -> None:
        kind = self._types[k]
        health, shield = float(units.health[k]), float(units.shield[k])
        if self._units > _SWARM and (health, shield) == (kind.health, kind.shield):
            return
        share = health / kind.health
        color = mixed(_HALF, _FULL, 2 * share - 1) if share > 0.5 else mixed(_LOW, _HALF, 2 * share)
        bars = [(share, color)]
        if kind.shield:
            bars.append((shield / kind.shield, _SHIELD))
        if kind.heals:
            bars.append((float(units.energy[k]) / MAX_ENERGY, _ENERGY))
        x, y = _at(units, k)
        pen.bars((x, y + kind.radius + 0.04), max(2 * kind.radius, 0.72), bars)

    def _attack(self, pen: Pen, units: Units, k: int) -> None:
        """What a unit does to another, from its aim to the end of its shot."""
        weapon, color = self._types[k].weapon, self._shot(k)
        target, struck = int(units.target[k]), int(units.struck[k])
        alive, pending = bool(units.health[k] > 0), float(units.pending[k])
        flash = max(1 - float(self._struck[k]) / _FLASH, 0.0)
        if weapon is None:
            if alive and self._heals[k] and target >= 0:
                pen.line(*self._ends(units, k, target), _HEAL, 0.8, width=0.13)
            return
        melee = weapon.range < 1
        if alive and units.aiming[k] > 0 and units.health[target] > 0 and not melee:
            pen.line(*self._ends(units, k, target), color, 0.3, width=0.05)
        if struck < 0 or not (alive or weapon.missile_speed):
            return
        if weapon.missile_speed:
            if pending > 0:
                self._missile(pen, units, k, pending / LOOPS_PER_SECOND * weapon.missile_speed)
        elif weapon.delay and pending > 0:
            share = 1 - pending / (weapon.delay * LOOPS_PER_SECOND)
            if weapon.beam:
                self._beam(pen, units, k, share)
            else:
                (x, y), (to_x, to_y) = self._ends(units, k, struck)
                tip = x + (to_x - x) * share, y + (to_y - y) * share
                pen.line((x, y), tip, color, 0.9, width=0.2)
        elif melee and flash and not weapon.burst:
            (x, y), (to_x, to_y) = self._ends(units, k, struck)
            pen.disc(((x + to_x) / 2, (y + to_y) / 2), 0.17, mixed(color, WHITE, 0.4), flash)
        elif flash and not weapon.delay:
            pen.line(*self._ends(units, k, struck), color, 0.9 * flash)

    def _ends(self, units: Units, k: int, other: int) -> tuple[Point, Point]:
        """From the edge of a unit to within the edge of another."""
        (x, y), (to_x, to_y) = _at(units, k), _at(units, other)
        distance = max(math.hypot(to_x - x, to_y - y), 1e-6)
        dx, dy = (to_x - x) / distance, (to_y - y) / distance
        near = min(self._types[k].radius, distance)
        far = max(distance - 0.7 * self._types[other].radius, near)
        return (x + near * dx, y + near * dy), (x + far * dx, y + far * dy)

    def _missile(self, pen: Pen, units: Units, k: int, left: float) -> None:
        """As far from its target as it will fly in the time that is left."""
        (x, y), (to_x, to_y) = self._ends(units, k, int(units.struck[k]))
        way = max(math.hypot(to_x - x, to_y - y), 1e-6)
        head, tail = 1 - min(left / way, 1.0), 1 - min((left + 0.7) / way, 1.0)
        places = [(x + (to_x - x) * share, y + (to_y - y) * share) for share in (tail, head)]
        pen.line(places[0], places[1], self._shot(k), 0.5, width=0.14)
        pen.disc(places[1], 0.15, mixed(self._shot(k), WHITE, 0.5))

    def _beam(self, pen: Pen, units: Units, k: int, share: float) -> None:
        """Two rays sweep over the line from its ends while it begins to burn."""
        x, y, dx, dy = units.beam[self._scenario.beams.tolist().index(k)].tolist()

        def on_line(along: float) -> Point:
            return x - dy * along * BEAM_HALF_LENGTH, y + dx * along * BEAM_HALF_LENGTH

        pen.line(on_line(-1.0), on_line(1.0), _BEAM, 0.3 + 0.6 * min(2 - 2 * share, 1.0), width=0.3)
        if share < 0.5:
            for side in (-1.0, 1.0):
                pen.line(_at(units, k), on_line(side * (1 - 4 * share)), _BEAM, 0.8)

    def _shot(self, k: int) -> Color:
        return _ALLY_SHOT if k < self._n else _ENEMY_SHOT

    def _caption(
        self, units: Units, step: int, episode_return: float, verdict: str
    ) -> tuple[list[tuple[str, Color]], list[tuple[str, Color]]]:
        alive, n = units.health > 0, self._n
        left = [
            (self._map.name, WHITE),
            (f"step {step}/{self._map.episode_limit}", _GREY),
            (f"return {episode_return:.2f}", _GREY),
        ]
        if verdict:
            left.append((verdict, _VERDICTS.get(verdict, _HALF)))
        right = [
            (str(alive[:n].sum()), mixed(_ALLY, WHITE, 0.35)),
            (" : ", _GREY),
            (str(alive[n:].sum()), mixed(_ENEMY, WHITE, 0.35)),
        ]
        return left, right


def _at(units: Units, k: int) -> Point:
    return float(units.x[k]), float(units.y[k])

"""Aims, shots, missiles, beams, bursts, healing and deaths in a picture of a battle."""

import math
from typing import Final, final

from race.envs.micro import colors
from race.envs.micro.canvas import Pen, Point
from race.envs.micro.combat import BEAM_HALF_LENGTH
from race.envs.micro.sprites import WHITE, Color, cross, disc, mixed
from race.envs.micro.state import Units
from race.envs.micro.units import LOOPS_PER_SECOND, UnitType
from race.envs.micro.watching import Moment

_FLASH: Final = 4
"""Loops that a shot stays visible."""
_BURST_FADE: Final = 14
"""Loops that a burst stays visible."""
_DEATH_FADE: Final = 24
"""Loops that a death stays visible."""


@final
class Attacks:
    """Draws what units do to each other."""

    def __init__(
        self, types: list[UnitType], n_allies: int, beams: list[int], scale: float
    ) -> None:
        """For the units of a map.

        Args:
            types: of all units, allies first.
            n_allies: how many are allies.
            beams: numbers of the units with a beam, in the order of `Units.beam`.
            scale: pixels per cell.
        """
        self._types, self._n, self._beams, self._scale = types, n_allies, beams, scale

    def traces(self, pen: Pen, moment: Moment) -> None:
        """What the dead leave behind for a while."""
        for k in (moment.since_death < _DEATH_FADE).nonzero()[0].tolist():
            loops, place = int(moment.since_death[k]), at(moment.units, k)
            weapon = self._types[k].weapon
            if weapon and weapon.burst and loops < _BURST_FADE:
                fade = 1 - loops / _BURST_FADE
                reach, rim = weapon.burst * self._scale, 0.07 * self._scale
                pen.stamp(place, disc(reach, colors.BURST, round(0.4 * fade**2, 3), rim))
            fade = 1 - loops / _DEATH_FADE
            arm = max(0.6 * self._types[k].radius * self._scale, 4.0)
            pen.stamp(place, cross(arm, self._shot(k), round(0.8 * fade, 3)))

    def draw(self, pen: Pen, moment: Moment) -> None:
        """Attacks of all units, from the aim to the end of the shot, and healing."""
        for k in range(len(self._types)):
            if self._types[k].weapon is None:
                self._healing(pen, moment, k)
            else:
                self._attack(pen, moment, k)

    def _healing(self, pen: Pen, moment: Moment, k: int) -> None:
        units, patient = moment.units, int(moment.units.target[k])
        if moment.heals[k] and units.health[k] > 0 and patient >= 0:
            pen.line(*self._ends(units, k, patient), colors.HEAL, 0.85, width=0.12)

    def _attack(self, pen: Pen, moment: Moment, k: int) -> None:
        weapon, units, color = self._types[k].weapon, moment.units, self._shot(k)
        assert weapon is not None
        target, struck = int(units.target[k]), int(units.struck[k])
        alive, pending = bool(units.health[k] > 0), float(units.pending[k])
        flash = max(1 - int(moment.since_strike[k]) / _FLASH, 0.0)
        melee = weapon.range < 1
        if alive and units.aiming[k] > 0 and units.health[target] > 0 and not melee:
            pen.line(*self._ends(units, k, target), color, 0.3, width=0.03)
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
            spark = disc(0.13 * self._scale, mixed(color, WHITE, 0.5), round(flash, 3))
            pen.stamp(((x + to_x) / 2, (y + to_y) / 2), spark)
        elif flash and not weapon.delay:
            pen.line(*self._ends(units, k, struck), color, 0.9 * flash, width=0.07)

    def _ends(self, units: Units, k: int, other: int) -> tuple[Point, Point]:
        """From the edge of a unit to within the edge of another."""
        (x, y), (to_x, to_y) = at(units, k), at(units, other)
        distance = max(math.hypot(to_x - x, to_y - y), 1e-6)
        dx, dy = (to_x - x) / distance, (to_y - y) / distance
        near = min(self._types[k].radius, distance)
        far = max(distance - 0.7 * self._types[other].radius, near)
        return (x + near * dx, y + near * dy), (x + far * dx, y + far * dy)

    def _missile(self, pen: Pen, units: Units, k: int, left: float) -> None:
        """As far from its target as it will fly in the time that is left."""
        (x, y), (to_x, to_y) = self._ends(units, k, int(units.struck[k]))
        way = max(math.hypot(to_x - x, to_y - y), 1e-6)
        head, tail = 1 - min(left / way, 1.0), 1 - min((left + 0.9) / way, 1.0)
        places = [(x + (to_x - x) * share, y + (to_y - y) * share) for share in (tail, head)]
        pen.line(places[0], places[1], self._shot(k), 0.6, width=0.12)
        pen.stamp(places[1], disc(0.15 * self._scale, mixed(self._shot(k), WHITE, 0.5), 1.0))

    def _beam(self, pen: Pen, units: Units, k: int, share: float) -> None:
        """Two rays sweep over the line from its ends while it begins to burn."""
        x, y, dx, dy = units.beam[self._beams.index(k)].tolist()

        def on_line(along: float) -> Point:
            return x - dy * along * BEAM_HALF_LENGTH, y + dx * along * BEAM_HALF_LENGTH

        glow = 0.3 + 0.6 * min(2 - 2 * share, 1.0)
        pen.line(on_line(-1.0), on_line(1.0), colors.BEAM, glow, width=0.3)
        if share < 0.5:
            for side in (-1.0, 1.0):
                pen.line(at(units, k), on_line(side * (1 - 4 * share)), colors.BEAM, 0.8)

    def _shot(self, k: int) -> Color:
        return colors.ALLY_SHOT if k < self._n else colors.ENEMY_SHOT


def at(units: Units, k: int) -> Point:
    """Where a unit is."""
    return float(units.x[k]), float(units.y[k])

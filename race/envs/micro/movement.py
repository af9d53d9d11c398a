"""How units walk, keep apart and stay on their ground."""

import math
import operator
from typing import Any, Final, NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from race.envs.micro.pairs import Footing, Step, larger, meet, over_others, smaller
from race.envs.micro.scenario import Scenario
from race.envs.micro.state import Units
from race.envs.micro.terrain import EAST, NORTH, SOUTH, WEST

SWERVE: Final = 1.0
"""Share of what a blocked unit loses of its step that it takes aside instead."""
STILL: Final = 0.1
"""A unit that makes less than this share of its step in a game loop is stuck."""
CARRY: Final = 0.3
"""Share of the last loop's step that goes on in a crowd, where units else tremble."""
PATIENCE: Final = 4
"""Game loops for which a unit is stuck before it goes round the others."""
DETOUR: Final = 8.0
"""Game loops for which it does so, before it heads for its goal again."""
DETOUR_TURN: Final = math.radians(120.0)
"""How far aside: backwards too, out of the notch between two others (30 degrees)."""
TIGHT: Final = 0.97
"""Share of the contact distance within which nobody comes any nearer to anybody."""
AIR_DRIFT: Final = 0.025
"""Share of an overlap by which each of two flyers gives way in a game loop."""


class Course(NamedTuple):
    """Where each unit wants to go in a game loop."""

    x: Float[Any, "U"]
    y: Float[Any, "U"]
    distance: Float[Any, "U"]
    """How far it wants to go towards (x, y); 0 to stay."""


def move(scenario: Scenario, units: Units, course: Course, footing: Footing) -> Units:
    """One game loop of walking: own steps, round others, along walls, and never into anybody.

    What a step may close of a gap to another unit is half of it, all of it if the other fights,
    and more by as much as the other draws away. Whatever exceeds this is taken off the step, and
    turned aside instead; what is still too much shortens it.
    """
    alive = units.health > 0
    own = _own_step(scenario, units, course)
    own = Step(jnp.where(alive, own.x, 0.0), jnp.where(alive, own.y, 0.0))
    own = _detour(scenario, units, own)
    step = _round_others(scenario, units, own, footing)
    held = (step.x != own.x) | (step.y != own.y)
    step = _along_walls(scenario, units, step)
    share = jnp.where(alive, _free(scenario, units, step, footing), 0.0)
    held |= share < 1
    step = Step(step.x * share, step.y * share)
    gone = step
    if scenario.shape.flyers:  # which slow down too gently to take a push along
        gone = Step(
            jnp.where(scenario.flying, own.x, gone.x), jnp.where(scenario.flying, own.y, gone.y)
        )
    return units._replace(
        x=units.x + step.x,
        y=units.y + step.y,
        vx=gone.x,
        vy=gone.y,
        detour=_next_detour(scenario, units, own, step, held & ~footing.fights & ~footing.idle),
    )


def _own_step(scenario: Scenario, units: Units, course: Course) -> Step:
    x, y = _way(scenario, units, course)
    dx, dy = x - units.x, y - units.y
    length = jnp.sqrt(dx * dx + dy * dy)
    distance = jnp.maximum(course.distance, 0.0)
    step = jnp.minimum(scenario.speed, distance)
    if scenario.shape.flyers:
        # Units that take time to slow down begin to do so in time.
        step = jnp.minimum(step, jnp.sqrt(2 * scenario.acceleration * distance))
    share = step / jnp.maximum(length, 1e-6)
    vx, vy = dx * share, dy * share
    if scenario.shape.flyers:
        change_x, change_y = vx - units.vx, vy - units.vy
        change = jnp.sqrt(change_x * change_x + change_y * change_y)
        share = jnp.minimum(1.0, scenario.acceleration / jnp.maximum(change, 1e-6))
        vx, vy = units.vx + change_x * share, units.vy + change_y * share
    return Step(vx, vy)


def _way(
    scenario: Scenario, units: Units, course: Course
) -> tuple[Float[Any, "U"], Float[Any, "U"]]:
    """Where to head for: the goal, or the next corner on the way to it."""
    if scenario.shape.plain:
        return course.x, course.y
    mover = scenario.mover
    # A move order may lead beyond the rim.
    column = jnp.clip(_cell(course.x), 0, scenario.shape.width - 1)
    row = jnp.clip(_cell(course.y), 0, scenario.shape.height - 1)
    goal = scenario.node[mover, column, row]
    here = scenario.node[mover, _cell(units.x), _cell(units.y)]
    corner = scenario.ways[mover, here, goal]
    centre = scenario.centre[mover, corner]
    straight = corner == goal
    return (
        jnp.where(straight, course.x, centre[:, 0]),
        jnp.where(straight, course.y, centre[:, 1]),
    )


def _detour(scenario: Scenario, units: Units, own: Step) -> Step:
    """The steps of those who go round, turned to their side."""
    side = jnp.where(jnp.abs(units.detour) < 1, 0.0, jnp.sign(units.detour))
    ahead = jnp.where(side == 0, 1.0, math.cos(DETOUR_TURN))
    aside = math.sin(DETOUR_TURN) * side
    return Step(ahead * own.x - aside * own.y, ahead * own.y + aside * own.x)


def _next_detour(
    scenario: Scenario, units: Units, own: Step, step: Step, held: Bool[Any, "U"]
) -> Float[Any, "U"]:
    """Game loops that are left of each unit's detour, below 0 to the right.

    Who is stuck for a while begins one to the side that its number says, and on a detour turns to
    the other at once. Values between 0 and 1 are its patience.

    Args:
        scenario: the map.
        units: before the step.
        own: what they wanted to do.
        step: what they do.
        held: units on their way whose step others changed.
    """
    length = jnp.square(step.x) + jnp.square(step.y)
    stuck = length < jnp.square(STILL) * (jnp.square(own.x) + jnp.square(own.y))
    stuck &= held
    if scenario.shape.flyers:
        stuck &= ~scenario.flying
    goes_round = jnp.abs(units.detour) >= 1
    left = jnp.where(goes_round, units.detour - jnp.sign(units.detour), 0.0)
    side = jnp.where(jnp.arange(scenario.shape.n_units) % 2 == 0, DETOUR, -DETOUR)
    tired = units.detour + 1 / PATIENCE
    begins = jnp.where(tired >= 1, side, tired)
    other = jnp.where(goes_round, -jnp.sign(units.detour) * DETOUR, begins)
    return jnp.where(stuck, other, left)


def _round_others(scenario: Scenario, units: Units, own: Step, footing: Footing) -> Step:
    """Takes off a step what others leave no room for, and goes aside instead."""
    pairs = meet(scenario, units, own, footing)
    gap = pairs.square - scenario.contact * pairs.distance
    wants = pairs.meets + jnp.where(pairs.makes_way, 0.5 * larger(-pairs.gives, 0.0), 0.0)
    excess = larger(wants - (0.5 + pairs.firmer) * gap - pairs.leads, 0.0)
    if scenario.shape.flyers:
        excess += AIR_DRIFT * larger(scenario.air_contact * pairs.distance - pairs.square, 0.0)
    push = excess / pairs.square
    stays = footing.fights & ~scenario.flying
    back_x = jnp.where(stays, 0.0, -over_others(push * pairs.x, operator.add))
    back_y = jnp.where(stays, 0.0, -over_others(push * pairs.y, operator.add))
    turn = jnp.where(footing.fights | footing.idle | scenario.flying, 0.0, SWERVE)
    # On the side on which it already goes round.
    onwards = units.vy * back_x - units.vx * back_y
    turn = jnp.where(onwards >= 0, turn, -turn)
    x, y = own.x + back_x - turn * back_y, own.y + back_y + turn * back_x
    goes = jnp.square(units.vx) + jnp.square(units.vy) > jnp.square(STILL * scenario.speed)
    crowded = ((back_x != 0) | (back_y != 0)) & goes & ~scenario.flying
    x = jnp.where(crowded, (1 - CARRY) * x + CARRY * units.vx, x)
    y = jnp.where(crowded, (1 - CARRY) * y + CARRY * units.vy, y)
    length = jnp.sqrt(x * x + y * y)
    share = smaller(1.0, scenario.speed / larger(length, 1e-6))
    return Step(x * share, y * share)


def _along_walls(scenario: Scenario, units: Units, step: Step) -> Step:
    """Keeps centres at their inner radius from walls, first in x, then in y.

    A unit that is nearer already, because it was created there, comes no nearer.
    """
    x, y = units.x + step.x, units.y + step.y
    low_x, high_x, low_y, high_y = scenario.bounds
    if scenario.shape.plain:
        x = jnp.clip(x, jnp.minimum(low_x, units.x), jnp.maximum(high_x, units.x))
        y = jnp.clip(y, jnp.minimum(low_y, units.y), jnp.maximum(high_y, units.y))
        return Step(x - units.x, y - units.y)
    walls, mover, inner = scenario.walls, scenario.mover, scenario.inner_radius

    def between(
        old: Float[Any, "U"], new: Float[Any, "U"], lower: Bool[Any, "U"], upper: Bool[Any, "U"]
    ) -> Float[Any, "U"]:
        cell = jnp.floor(old)
        new = jnp.where(upper, jnp.minimum(new, jnp.maximum(cell + 1 - inner, old)), new)
        return jnp.where(lower, jnp.maximum(new, jnp.minimum(cell + inner, old)), new)

    beside = walls[mover, _cell(units.x), _cell(units.y)]
    x = between(units.x, x, (beside & WEST) > 0, (beside & EAST) > 0)
    beside = walls[mover, _cell(x), _cell(units.y)]
    y = between(units.y, y, (beside & SOUTH) > 0, (beside & NORTH) > 0)
    return Step(x - units.x, y - units.y)


def _free(scenario: Scenario, units: Units, step: Step, footing: Footing) -> Float[Any, "U"]:
    """The share of a step that leads too near to nobody."""
    pairs = meet(scenario, units, step, footing)
    gap = larger(pairs.square - TIGHT * scenario.contact * pairs.distance, 0.0)
    room = (0.5 + larger(pairs.firmer, 0.0)) * gap + pairs.leads
    needed = over_others(pairs.meets / larger(room, 1e-6), larger)
    return 1.0 / larger(needed, 1.0)


def _cell(place: Float[Any, "U"]) -> Int[Any, "U"]:
    return jnp.floor(place).astype(jnp.int32)

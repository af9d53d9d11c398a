"""How units walk, keep apart and stay on their ground."""

import math
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from race.envs.micro.scenario import Scenario
from race.envs.micro.state import Units
from race.envs.micro.terrain import EAST, NORTH, SOUTH, WEST

SWERVE: Final = 1.0
"""Share of what a blocked unit loses of its step that it takes aside instead."""
STILL: Final = 0.1
"""A unit that makes less than this share of its step in a game loop is stuck."""
CARRY: Final = 0.3
"""Share of the last loop's step that goes on in a crowd, where units else tremble."""
DETOUR: Final = 12.0
"""Game loops for which a unit that was stuck goes round, before it heads for its goal again."""
DETOUR_TURN: Final = math.radians(100.0)
"""How far aside: a little backwards, out of the notch between two others."""
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


class Footing(NamedTuple):
    """How firmly units stand against others that walk into them."""

    fights: Bool[Any, "U"]
    """Units in an attack hold their place."""
    idle: Bool[Any, "U"]
    """Idle units make way for friends and not for enemies."""


class Step(NamedTuple):
    """A game loop's step of each unit."""

    x: Float[Any, "U"]
    y: Float[Any, "U"]


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
    step = _along_walls(scenario, units, step)
    share = jnp.where(alive, _free(scenario, units, step, footing), 0.0)
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
        detour=_next_detour(scenario, units, own, step, footing),
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
    side = jnp.sign(units.detour)
    ahead = jnp.where(side == 0, 1.0, math.cos(DETOUR_TURN))
    aside = math.sin(DETOUR_TURN) * side
    return Step(ahead * own.x - aside * own.y, ahead * own.y + aside * own.x)


def _next_detour(
    scenario: Scenario, units: Units, own: Step, step: Step, footing: Footing
) -> Float[Any, "U"]:
    """Game loops that are left of each unit's detour, below 0 to the right.

    Who is stuck begins one to the side that its number says, and on a detour turns to the other.
    """
    length = jnp.square(step.x) + jnp.square(step.y)
    stuck = length < jnp.square(STILL) * (jnp.square(own.x) + jnp.square(own.y))
    stuck &= ~footing.fights & ~footing.idle
    if scenario.shape.flyers:
        stuck &= ~scenario.flying
    left = jnp.sign(units.detour) * jnp.maximum(jnp.abs(units.detour) - 1.0, 0.0)
    left = jnp.where(footing.fights | footing.idle, 0.0, left)
    first = jnp.where(jnp.arange(scenario.shape.n_units) % 2 == 0, DETOUR, -DETOUR)
    other = jnp.where(units.detour == 0, first, -jnp.sign(units.detour) * DETOUR)
    return jnp.where(stuck, other, left)


class _Pairs(NamedTuple):
    """Each unit i (rows) and whom it may meet (columns)."""

    x: Float[Any, "U U"]
    """Direction from i to j, of length 1."""
    y: Float[Any, "U U"]
    near: Float[Any, "U U"]
    """From contact to contact; below 0 in an overlap."""
    meets: Float[Any, "U U"]
    """By how much the steps of i bring it nearer to j."""
    gives: Float[Any, "U U"]
    """By how much the steps of j bring it away from i."""
    room: Float[Any, "U U"]
    """By how much i may come nearer."""


def _pairs(
    scenario: Scenario, units: Units, step: Step, footing: Footing, contact: float
) -> _Pairs:
    n, everyone = scenario.shape.n_allies, jnp.arange(scenario.shape.n_units)
    # The dead are put out of everyone's way.
    x = jnp.where(units.health > 0, units.x, 1000.0 + 10.0 * everyone.astype(jnp.float32))
    with_friends = jnp.where(footing.fights, 0.5, 0.0)
    with_enemies = jnp.where(footing.fights | footing.idle, 0.5, 0.0)
    # Without the barrier the compiler works these out again for every pair of units.
    x, with_friends, with_enemies, step = jax.lax.optimization_barrier(
        (x, with_friends, with_enemies, step)
    )
    dx, dy = x[None] - x[:, None], units.y[None] - units.y[:, None]
    square = jnp.maximum(dx * dx + dy * dy, 1e-4)
    inverse = jax.lax.rsqrt(square)
    dx, dy = dx * inverse, dy * inverse
    near = square * inverse - contact * scenario.contact
    gives = step.x[None] * dx + step.y[None] * dy
    # Who did not draw away in the last loop may not do so in this one either.
    last = units.vx[None] * dx + units.vy[None] * dy
    side = everyone < n
    firmer = jnp.where(
        side[:, None] == side[None],
        with_friends[None] - with_friends[:, None],
        with_enemies[None] - with_enemies[:, None],
    )
    share = 0.5 + jnp.where(near > 0, jnp.maximum(firmer, 0.0), firmer)
    return _Pairs(
        x=dx,
        y=dy,
        near=near,
        meets=step.x[:, None] * dx + step.y[:, None] * dy,
        gives=gives,
        room=share * near + jnp.maximum(jnp.minimum(gives, last), 0.0),
    )


def _round_others(scenario: Scenario, units: Units, own: Step, footing: Footing) -> Step:
    """Takes off a step what others leave no room for, and goes aside instead."""
    n, everyone = scenario.shape.n_allies, jnp.arange(scenario.shape.n_units)
    pairs = _pairs(scenario, units, own, footing, 1.0)
    side, idle = everyone < n, footing.idle
    makes_way = (side[:, None] == side[None]) & (idle & ~footing.fights)[:, None] & ~idle[None]
    wants = pairs.meets + jnp.where(makes_way, 0.5 * jnp.maximum(-pairs.gives, 0.0), 0.0)
    excess = jnp.maximum(wants - pairs.room, 0.0)
    if scenario.shape.flyers:
        distance = pairs.near + scenario.contact
        excess += AIR_DRIFT * jnp.maximum(scenario.air_contact - distance, 0.0)
    stays = footing.fights & ~scenario.flying
    back_x = jnp.where(stays, 0.0, -jnp.sum(excess * pairs.x, axis=1))
    back_y = jnp.where(stays, 0.0, -jnp.sum(excess * pairs.y, axis=1))
    turn = jnp.where(footing.fights | idle | scenario.flying, 0.0, SWERVE)
    # On the side on which it already goes round.
    onwards = units.vy * back_x - units.vx * back_y
    turn = jnp.where(onwards >= 0, turn, -turn)
    x, y = own.x + back_x - turn * back_y, own.y + back_y + turn * back_x
    goes = jnp.square(units.vx) + jnp.square(units.vy) > jnp.square(STILL * scenario.speed)
    crowded = ((back_x != 0) | (back_y != 0)) & goes & ~scenario.flying
    x = jnp.where(crowded, (1 - CARRY) * x + CARRY * units.vx, x)
    y = jnp.where(crowded, (1 - CARRY) * y + CARRY * units.vy, y)
    length = jnp.sqrt(x * x + y * y)
    share = jnp.minimum(1.0, scenario.speed / jnp.maximum(length, 1e-6))
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
    pairs = _pairs(scenario, units, step, footing, TIGHT)
    needed = pairs.meets / jnp.maximum(pairs.room, 1e-6)
    return 1.0 / jnp.maximum(jnp.max(needed, axis=1), 1.0)


def _cell(place: Float[Any, "U"]) -> Int[Any, "U"]:
    return jnp.floor(place).astype(jnp.int32)

"""How units walk, keep apart and stay on their ground."""

from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from race.envs.micro.scenario import Scenario
from race.envs.micro.state import Units
from race.envs.micro.terrain import EAST, NORTH, SOUTH, WEST

SWERVE: Final = 1.0
"""Share of a push that also turns the unit aside, so that it finds its way round others."""


class Course(NamedTuple):
    """Where each unit wants to go in a game loop."""

    x: Float[Any, "U"]
    y: Float[Any, "U"]
    distance: Float[Any, "U"]
    """How far it wants to go towards (x, y); 0 to stay."""


class Footing(NamedTuple):
    """How firmly units stand against others that walk into them."""

    fights: Bool[Any, "U"]
    """Units in an attack yield to nobody."""
    idle: Bool[Any, "U"]
    """Idle units yield to friends and not to enemies."""


def move(scenario: Scenario, units: Units, course: Course, footing: Footing) -> Units:
    """One game loop of walking: own steps, then others' pushes, then walls."""
    alive = units.health > 0
    vx, vy = _own_step(scenario, units, course)
    vx, vy = jnp.where(alive, vx, 0.0), jnp.where(alive, vy, 0.0)
    push_x, push_y = _pushes(scenario, units, vx, vy, footing)
    pushed = (push_x != 0) | (push_y != 0)
    dx, dy = vx + push_x, vy + push_y
    # Half of the last loop's step goes on in a crowd; without it units tremble between others.
    dx = jnp.where(pushed, 0.5 * (dx + units.vx), dx)
    dy = jnp.where(pushed, 0.5 * (dy + units.vy), dy)
    length = jnp.sqrt(dx * dx + dy * dy)
    share = jnp.where(alive, jnp.minimum(1.0, scenario.speed / jnp.maximum(length, 1e-6)), 0.0)
    x, y = _stop_at_walls(scenario, units, units.x + dx * share, units.y + dy * share)
    x, y = jnp.where(alive, x, units.x), jnp.where(alive, y, units.y)
    going_x, going_y = x - units.x, y - units.y
    if scenario.shape.flyers:  # which slow down too gently to take a push along
        going_x = jnp.where(scenario.flying, vx, going_x)
        going_y = jnp.where(scenario.flying, vy, going_y)
    return units._replace(x=x, y=y, vx=going_x, vy=going_y)


def _own_step(
    scenario: Scenario, units: Units, course: Course
) -> tuple[Float[Any, "U"], Float[Any, "U"]]:
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
    return vx, vy


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


def _pushes(
    scenario: Scenario,
    units: Units,
    vx: Float[Any, "U"],
    vy: Float[Any, "U"],
    footing: Footing,
) -> tuple[Float[Any, "U"], Float[Any, "U"]]:
    """What undoes overlaps, shared by how firmly the two units stand.

    Of two equally firm units each takes half; a firm one takes none and leaves all to the other.
    """
    n, everyone = scenario.shape.n_allies, jnp.arange(scenario.shape.n_units)
    # The dead are put out of everyone's way.
    x = jnp.where(units.health > 0, units.x + vx, 1000.0 + 10.0 * everyone.astype(jnp.float32))
    y = units.y + vy
    with_friends = jnp.where(footing.fights, 0.5, 0.0)
    with_enemies = jnp.where(footing.fights | footing.idle, 0.5, 0.0)
    # Without the barrier the compiler works these out again for every pair of units.
    x, y, with_friends, with_enemies = jax.lax.optimization_barrier(
        (x, y, with_friends, with_enemies)
    )
    dx, dy = x[:, None] - x[None], y[:, None] - y[None]
    # (c^2 - d^2) / 2d is the overlap c - d near contact, and more where it is deep.
    square = jnp.maximum(dx * dx + dy * dy, 1e-3)
    overlap = jnp.maximum(scenario.contact / square - 1.0, 0.0) * scenario.stiffness
    side = everyone < n
    same = side[:, None] == side[None]
    share = 0.5 + jnp.where(
        same,
        with_friends[None] - with_friends[:, None],
        with_enemies[None] - with_enemies[:, None],
    )
    weight = overlap * share
    push_x, push_y = jnp.sum(weight * dx, axis=1), jnp.sum(weight * dy, axis=1)
    turn = jnp.where(footing.fights | footing.idle, 0.0, SWERVE)
    # On to the side on which it already goes round, or else to the one that brings it on.
    onwards = units.vy * push_x - units.vx * push_y
    onwards = jnp.where(onwards == 0, vy * push_x - vx * push_y, onwards)
    turn = jnp.where(onwards >= 0, turn, -turn)
    return push_x - turn * push_y, push_y + turn * push_x


def _stop_at_walls(
    scenario: Scenario, units: Units, x: Float[Any, "U"], y: Float[Any, "U"]
) -> tuple[Float[Any, "U"], Float[Any, "U"]]:
    """Keeps centres at their inner radius from walls, first in x, then in y.

    A unit that is nearer already, because it was created there, comes no nearer.
    """
    low_x, high_x, low_y, high_y = scenario.bounds
    if scenario.shape.plain:
        x = jnp.clip(x, jnp.minimum(low_x, units.x), jnp.maximum(high_x, units.x))
        return x, jnp.clip(y, jnp.minimum(low_y, units.y), jnp.maximum(high_y, units.y))
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
    return x, y


def _cell(place: Float[Any, "U"]) -> Int[Any, "U"]:
    return jnp.floor(place).astype(jnp.int32)

"""Each unit and every other one that its step may lead to.

Most of a game loop's time goes into arrays of all pairs, so that how they are written matters:
`Footing` and `over_others` tell what the compiler makes of them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float

from race.envs.micro.scenario import Scenario
from race.envs.micro.state import Units


class Step(NamedTuple):
    """A game loop's step of each unit."""

    x: Float[Any, "U"]
    y: Float[Any, "U"]


class Footing(NamedTuple):
    """How firmly units stand against others that walk into them."""

    fights: Bool[Any, "U"]
    """Units in an attack hold their place."""
    idle: Bool[Any, "U"]
    """Idle units make way for friends and not for enemies."""

    def against_friends(self) -> Float[Any, "U"]:
        """One half for who holds its place against friends, 0 for others."""
        return _half(self.fights)

    def against_enemies(self) -> Float[Any, "U"]:
        """The same against enemies."""
        return _half(self.fights | self.idle)


def _half(holds: Bool[Any, "U"]) -> Float[Any, "U"]:
    """One half or 0, as a square root.

    The compiler works out anew for every pair what a value of one unit comes from, unless it
    thinks that dear, and of roots it does. All pairs of a game loop take a third less time so.
    """
    return jnp.sqrt(jnp.where(holds, 0.25, 0.0))


class Pairs(NamedTuple):
    """Each unit i (columns) and each j whom it may meet (rows).

    What is said of steps is multiplied by the distance of the two, which spares divisions.
    """

    x: Float[Any, "U U"]
    """From i to j, as long as their distance."""
    y: Float[Any, "U U"]
    square: Float[Any, "U U"]
    """Of the distance."""
    distance: Float[Any, "U U"]
    meets: Float[Any, "U U"]
    """By how much the step of i brings it nearer to j."""
    gives: Float[Any, "U U"]
    """By how much the step of j brings it away from i."""
    leads: Float[Any, "U U"]
    """By how much it does so for sure: who did not go in the last loop may not go in this one."""
    firmer: Float[Any, "U U"]
    """Share of a gap, beyond half of it, that is left to i because j stands more firmly."""
    makes_way: Bool[Any, "U U"]
    """Whether i stands idle where a friend j wants to go."""


def meet(scenario: Scenario, units: Units, step: Step, footing: Footing) -> Pairs:
    """All pairs of units that take their steps."""
    n, everyone = scenario.shape.n_allies, jnp.arange(scenario.shape.n_units)
    # The dead are put out of everyone's way.
    x = jnp.where(units.health > 0, units.x, 1000.0 + 10.0 * everyone.astype(jnp.float32))
    dx, dy = x[:, None] - x[None], units.y[:, None] - units.y[None]
    gives = step.x[:, None] * dx + step.y[:, None] * dy
    last = units.vx[:, None] * dx + units.vy[:, None] * dy
    square = larger(dx * dx + dy * dy, 1e-3)
    side = everyone < n
    friends = side[:, None] == side[None]
    to_friends, to_enemies = footing.against_friends(), footing.against_enemies()
    return Pairs(
        x=dx,
        y=dy,
        square=square,
        distance=jnp.sqrt(square),
        meets=step.x[None] * dx + step.y[None] * dy,
        gives=gives,
        leads=larger(smaller(gives, last), 0.0),
        firmer=jnp.where(
            friends, to_friends[:, None] - to_friends[None], to_enemies[:, None] - to_enemies[None]
        ),
        makes_way=friends & (to_enemies > to_friends)[None] & (to_enemies <= 0)[:, None],
    )


def over_others(pairs: Float[Any, "U U"], operation: Callable[[Any, Any], Any]) -> Float[Any, "U"]:
    """Each unit's sum or maximum over all others: rows, halves of them at a time.

    A reduction would run through a column at a time, one number after the other; whole rows fill
    the machine's vectors.
    """
    odd = None
    while len(pairs) > 1:
        half = len(pairs) // 2
        if len(pairs) % 2:
            odd = pairs[-1] if odd is None else operation(odd, pairs[-1])
        pairs = operation(pairs[:half], pairs[half : 2 * half])
    return pairs[0] if odd is None else operation(pairs[0], odd)


def larger(one: Any, other: Any) -> Any:
    """The maximum where nothing is nan; not to look for it halves the time of all pairs."""
    return jnp.where(one > other, one, other)


def smaller(one: Any, other: Any) -> Any:
    """The minimum where nothing is nan."""
    return jnp.where(one < other, one, other)

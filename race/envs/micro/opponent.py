"""What the enemies do: StarCraft II's behaviour of units under one order, and nothing cleverer.

The maps give all enemies one order at the start. From then on each unit acts by itself: it
attacks the nearest ally within its scan range, keeps that target while it is in weapon range,
chases it, answers whoever hits it, and otherwise walks on.
"""

from typing import Any, Final, NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from race.envs.micro.scenario import Scenario
from race.envs.micro.state import NOBODY, Units
from race.envs.micro.units import HEAL_COST, HEAL_RANGE, HEAL_RATE, LOOPS_PER_SECOND

LEASH: Final = 21.0
"""Centre distance at which an enemy gives up an ally that it chases."""
HELP_RANGE: Final = 4.0
"""Idle friends of a unit that was hit join it from this far, centre to centre."""
CAST_RANGE: Final = 6.0
"""How far, edge to edge, a healer looks for a patient."""
CAST_SLOP: Final = 1.0
"""How much further than the healing range a patient may get before the healer looks again."""
CAST_ENERGY: Final = 5.0
"""Energy without which a healer begins no healing."""


def answer_calls(scenario: Scenario, units: Units) -> Units:
    """Enemies without a target join friends nearby that were hit; then who was hit is forgotten.

    Once per environment step; the game lets a unit call at most every two seconds.
    """
    n = scenario.shape.n_allies
    x, y = units.x[n:], units.y[n:]
    distance = jnp.square(x[:, None] - x[None]) + jnp.square(y[:, None] - y[None])
    calls = (units.struck_by >= 0)[None] & (distance <= HELP_RANGE**2)
    caller = jnp.argmin(jnp.where(calls, distance, jnp.inf), axis=1)
    attacker = units.struck_by[caller]
    joins = (
        jnp.any(calls, axis=1)
        & (units.target[n:] < 0)
        & (units.health[attacker] > 0)
        & jnp.isfinite(scenario.reluctance[jnp.arange(len(attacker)), attacker])
    )
    target = jnp.where(joins, attacker, units.target[n:])
    return units._replace(
        target=jnp.concatenate([units.target[:n], target]),
        struck_by=jnp.full_like(units.struck_by, NOBODY),
    )


def choose_targets(scenario: Scenario, units: Units) -> Int[Any, "m"]:
    """The ally that each enemy attacks, or `NOBODY`. Healers attack nobody.

    Enemies choose once in ``scenario.scan_period`` game loops. In between they stay with their
    choice, and stand where their target has died.
    """
    n = scenario.shape.n_allies
    alive = units.health[:n] > 0
    current = units.target[n:]
    dx = units.x[n:, None] - units.x[None, :n]
    dy = units.y[n:, None] - units.y[None, :n]
    distance = dx * dx + dy * dy
    kept = (jnp.arange(n)[None] == current[:, None]) & (distance <= scenario.reach)
    preference = jnp.where(
        alive[None] & (distance <= scenario.scan),
        jnp.where(kept, -1.0, distance) + scenario.reluctance,
        jnp.inf,
    )
    nearest = jnp.argmin(preference, axis=1).astype(current.dtype)
    found = jnp.min(preference, axis=1) < jnp.inf

    def still(ally: Int[Any, "m"]) -> Bool[Any, "m"]:
        return (ally >= 0) & (ally < n) & (units.health[ally] > 0)

    rows = jnp.arange(len(current))
    chased = still(current) & (distance[rows, current] <= LEASH**2)
    attacker = units.struck_by
    answers = still(attacker) & jnp.isfinite(scenario.reluctance[rows, attacker])
    other = jnp.where(chased, current, jnp.where(answers, attacker, NOBODY))
    period = scenario.scan_period
    phase = jnp.floor(period.astype(jnp.float32) * units.scan_phase).astype(period.dtype)
    looks = (units.clock + phase) % period == 0
    return jnp.where(looks, jnp.where(found, nearest, other), current)


def choose_patients(scenario: Scenario, units: Units) -> Int[Any, "healers"]:
    """The friend that each healer would heal by itself, or `NOBODY`.

    Of the hurt biological friends in range the one with the lowest share of its health, then the
    nearest. A patient is kept until it is whole or the energy is gone.
    """
    healers, n = scenario.healers, scenario.shape.n_allies
    everyone = jnp.arange(scenario.shape.n_units)
    friends = (healers < n)[:, None] == (everyone < n)[None]
    friends &= everyone[None] != healers[:, None]
    hurt = (units.health > 0) & (units.health < scenario.max_health) & scenario.biological
    gap = gaps(scenario, units, healers)
    kept = (everyone[None] == units.target[healers][:, None]) & (gap <= HEAL_RANGE + CAST_SLOP)
    kept &= (units.energy[healers] >= HEAL_COST * HEAL_RATE / LOOPS_PER_SECOND)[:, None]
    may_begin = units.energy[healers] >= CAST_ENERGY
    offered = friends & hurt[None] & (kept | ((gap <= CAST_RANGE) & may_begin[:, None]))
    share = units.health / scenario.max_health
    preference = jnp.where(offered, jnp.where(kept, -1.0, 1000.0 * share[None] + gap), jnp.inf)
    patient = jnp.argmin(preference, axis=1).astype(units.target.dtype)
    return jnp.where(jnp.any(offered, axis=1), patient, NOBODY)


def gaps(scenario: Scenario, units: Units, healers: Int[Any, "healers"]) -> Float[Any, "healers U"]:
    """Distances from edge to edge between healers and everyone."""
    dx = units.x[healers][:, None] - units.x[None]
    dy = units.y[healers][:, None] - units.y[None]
    radii = scenario.radius[healers][:, None] + scenario.radius[None]
    return jnp.sqrt(dx * dx + dy * dy) - radii


class March(NamedTuple):
    """Where enemies go that have nothing to do."""

    x: Float[Any, "m"]
    y: Float[Any, "m"]


def march(scenario: Scenario, units: Units, target: Int[Any, "m"]) -> March:
    """Each enemy's place at its goal; flyers stay over their army while it fights."""
    shape = scenario.shape
    goal_x = scenario.goal_x + jnp.sum(units.goal_shift[:, 0])
    goal_y = scenario.goal_y + jnp.sum(units.goal_shift[:, 1])
    if not shape.flyers:
        return March(goal_x, goal_y)
    n = shape.n_allies
    flies = scenario.flying[n:]
    army = jnp.where(flies, 0.0, (units.health[n:] > 0).astype(jnp.float32))
    size = jnp.sum(army)
    fights = jnp.any((target >= 0) & (army > 0))
    hovers = flies & fights
    share = army / jnp.maximum(size, 1.0)
    return March(
        jnp.where(hovers, jnp.sum(share * units.x[n:]), goal_x),
        jnp.where(hovers, jnp.sum(share * units.y[n:]), goal_y),
    )

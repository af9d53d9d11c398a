"""Attacks, damage, healing and regeneration."""

from typing import Any, Final, NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from race.envs.micro.scenario import Scenario
from race.envs.micro.state import NOBODY, Units
from race.envs.micro.units import (
    ENERGY_REGENERATION,
    HEAL_COST,
    HEAL_RANGE,
    HEAL_RATE,
    LOOPS_PER_SECOND,
    MAX_ENERGY,
    SHIELD_DELAY,
    SHIELD_REGENERATION,
)

LEAST_DAMAGE: Final = 0.5
"""What a hit takes from health at least, whatever the armour."""
DELAY_LOW: Final = -0.0625 * LOOPS_PER_SECOND
DELAY_HIGH: Final = 0.125 * LOOPS_PER_SECOND
"""Each attack's cooldown is longer than the period by a random time between these, in loops."""
BEAM_HALF_LENGTH: Final = 1.25
BEAM_RADIUS: Final = 0.15
BEAM_LEAD: Final = (0.343 + 0.375 - 0.25 - 0.5 * 0.3125) * LOOPS_PER_SECOND
"""How long before the target of a beam the others on its line are hit, in loops.

Two sweeps pass over the line from both ends in 0.3125 s; whom they find takes damage 0.25 s later.
The two hits of one unit are thus 0.406 s after the shot on average, wherever on the line it
stands; both are dealt then.
"""


class Sight(NamedTuple):
    """How each unit stands to its target."""

    dx: Float[Any, "U"]
    dy: Float[Any, "U"]
    distance: Float[Any, "U"]
    gap: Float[Any, "U"]
    """From edge to edge."""
    valid: Bool[Any, "U"]
    """Whether both live and the unit can attack this target."""


class Attack(NamedTuple):
    """What the units' weapons do in a game loop."""

    aims: Bool[Any, "U"]
    aiming: Float[Any, "U"]
    fires: Bool[Any, "U"]


def look(scenario: Scenario, units: Units, target: Int[Any, "U"]) -> Sight:
    """Where the targets are."""
    dx, dy = units.x[target] - units.x, units.y[target] - units.y
    distance = jnp.sqrt(dx * dx + dy * dy)
    radius = scenario.radius
    valid = (target >= 0) & (units.health > 0) & (units.health[target] > 0) & scenario.armed
    if scenario.shape.flyers:
        valid &= scenario.weapon_air | ~scenario.flying[target]
    return Sight(dx, dy, distance, distance - radius - radius[target], valid)


def aim(scenario: Scenario, units: Units, target: Int[Any, "U"], sight: Sight) -> Attack:
    """Who aims and who fires.

    A unit in range aims for its weapon's damage point before it fires, in the last loops of its
    cooldown if it can, so that standing units attack once per period. It goes on aiming while the
    target is no further than the range and the weapon's slop.
    """
    aimed = jnp.where(target == units.target, units.aiming, 0.0)
    reach = scenario.range + jnp.where(aimed > 0, scenario.slop, 0.0)
    aims = sight.valid & (sight.gap <= reach) & (units.cooldown <= scenario.damage_point)
    aiming = jnp.where(aims, aimed + 1, 0.0)
    fires = aims & (aiming > scenario.damage_point) & (units.cooldown <= 0)
    return Attack(aims, aiming, fires)


def strike(
    scenario: Scenario,
    units: Units,
    target: Int[Any, "U"],
    sight: Sight,
    attack: Attack,
    walks: Bool[Any, "U"],
    delays: Float[Any, "U"],
) -> Units:
    """Launches attacks, lands hits and takes off the damage.

    Args:
        scenario: the map.
        units: before this game loop's hits.
        target: each unit's target.
        sight: towards it.
        attack: who fires.
        walks: units under an order to move; they lose the second hit of an attack.
        delays: random addition to the cooldown of an attack, in loops.
    """
    shape, alive = scenario.shape, units.health > 0
    fires, pending = attack.fires, jnp.maximum(units.pending - 1, 0.0)
    lands = (units.pending > 0) & (pending <= 0) & (alive | scenario.missile)
    channelled = (target == units.struck) & sight.valid & ~walks
    channelled &= sight.gap <= scenario.range + scenario.slop
    lands &= (scenario.second_hit <= 0) | channelled
    flight = scenario.delay + scenario.loops_per_cell * jnp.maximum(sight.gap, 0.0)
    at_once = fires & (flight <= 0)
    victim = jnp.where(at_once, target, jnp.where(lands, units.struck, NOBODY))
    others = _beam(scenario, units, pending, alive)
    units = units._replace(
        cooldown=jnp.where(fires, scenario.period + delays, units.cooldown),
        since_shot=jnp.where(fires, 0.0, units.since_shot),
        pending=jnp.where(fires, jnp.where(flight <= 0, scenario.second_hit, flight), pending),
        struck=jnp.where(fires, target, units.struck),
        aiming=attack.aiming,
        beam=_line(scenario, units, target, sight, fires),
        health=jnp.where(fires & scenario.bursting, 0.0, units.health),
    )
    n = shape.n_allies
    struck = victim[:, None] == jnp.arange(shape.n_units)[None]
    first = jnp.where(struck, scenario.damage, 0.0)
    second = first[scenario.beams] * (scenario.hits[scenario.beams] - 1)[:, None]
    armour = scenario.armour
    ally_hits = [first[:n, n:], second[:, n:], others[:, n:], others[:, n:]]
    enemy_hits = [first[n:, :n], second[:, :n], others[:, :n], others[:, :n]]
    used = 4 if shape.n_beams else 1
    ally_hits, enemy_hits = ally_hits[:used], enemy_hits[:used]
    units = units._replace(struck_by=_attackers(scenario, units.struck_by, alive, ally_hits))
    units = _take(
        units,
        shape.n_allies,
        jnp.concatenate(enemy_hits),
        jnp.concatenate(ally_hits),
        armour[None, :n],
        armour[None, n:],
        shields=(shape.ally_shields, shape.enemy_shields),
    )
    return _explode(scenario, units)


def absorb(
    hits: Float[Any, "hits targets"],
    armour: Float[Any, "#hits targets"],
    shield: Float[Any, "targets"],
) -> Float[Any, "targets"]:
    """What hits take from health behind shields, one hit after the other.

    A shield absorbs what it holds; the rest of the hit loses the armour once, and takes 0.5 from
    health at least.

    Args:
        hits: damage of each hit on each target; 0 for no hit.
        armour: of each target against each hit.
        shield: of each target before the hits.
    """
    loss = jnp.zeros_like(shield)
    armour = jnp.broadcast_to(armour, hits.shape)
    for k in range(hits.shape[0]):
        rest = jnp.maximum(hits[k] - shield, 0.0)
        shield = jnp.maximum(shield - hits[k], 0.0)
        loss += jnp.where(rest > 0, jnp.maximum(rest - armour[k], LEAST_DAMAGE), 0.0)
    return loss


def _take(
    units: Units,
    n: int,
    on_allies: Float[Any, "hits n"],
    on_enemies: Float[Any, "hits2 m"],
    ally_armour: Float[Any, "#hits n"],
    enemy_armour: Float[Any, "#hits2 m"],
    *,
    shields: tuple[bool, bool],
) -> Units:
    sides = []
    for part, hits, armour, shielded in (
        (slice(None, n), on_allies, ally_armour, shields[0]),
        (slice(n, None), on_enemies, enemy_armour, shields[1]),
    ):
        total = jnp.sum(hits, axis=0)
        if shielded:
            loss = absorb(hits, armour, units.shield[part])
        else:
            loss = jnp.sum(jnp.where(hits > 0, jnp.maximum(hits - armour, LEAST_DAMAGE), 0.0), 0)
        sides.append((total, loss))
    total, loss = (jnp.concatenate(pair) for pair in zip(*sides, strict=True))
    return units._replace(
        health=jnp.maximum(units.health - loss, 0.0),
        shield=jnp.maximum(units.shield - total, 0.0),
        since_hit=jnp.where(total > 0, 0.0, units.since_hit),
    )


def _attackers(
    scenario: Scenario,
    known: Int[Any, "m"],
    alive: Bool[Any, "U"],
    hits: list[Float[Any, "_ m"]],
) -> Int[Any, "m"]:
    n = scenario.shape.n_allies
    by_living = (hits[0] > 0) & alive[:n, None]  # a missile may outlive its shooter
    attacker = jnp.max(jnp.where(by_living, jnp.arange(n)[:, None], NOBODY), axis=0)
    if scenario.shape.n_beams:
        beams = scenario.beams[:, None]
        attacker = jnp.maximum(attacker, jnp.max(jnp.where(hits[2] > 0, beams, NOBODY), axis=0))
    return jnp.where(attacker >= 0, attacker, known).astype(known.dtype)


def _line(
    scenario: Scenario, units: Units, target: Int[Any, "U"], sight: Sight, fires: Bool[Any, "U"]
) -> Float[Any, "beams 4"]:
    beams = scenario.beams
    aimed = target[beams]
    length = jnp.maximum(sight.distance[beams], 1e-6)
    line = jnp.stack(
        [units.x[aimed], units.y[aimed], sight.dx[beams] / length, sight.dy[beams] / length], 1
    )
    return jnp.where(fires[beams][:, None], line, units.beam)


def _beam(
    scenario: Scenario, units: Units, pending: Float[Any, "U"], alive: Bool[Any, "U"]
) -> Float[Any, "beams U"]:
    """Damage of one sweep of each beam to whom it meets besides its target."""
    beams = scenario.beams
    now = (units.pending[beams] > BEAM_LEAD) & (pending[beams] <= BEAM_LEAD) & alive[beams]
    x, y, dx, dy = (units.beam[:, k, None] for k in range(4))
    away_x, away_y = units.x[None] - x, units.y[None] - y
    across = away_x * dx + away_y * dy
    along = jnp.maximum(jnp.abs(away_y * dx - away_x * dy) - BEAM_HALF_LENGTH, 0.0)
    touched = across**2 + along**2 <= (BEAM_RADIUS + scenario.radius[None]) ** 2
    main = jnp.arange(scenario.shape.n_units)[None] == units.struck[beams][:, None]
    return jnp.where(touched & ~main & now[:, None] & alive[None], scenario.damage[beams], 0.0)


def _explode(scenario: Scenario, units: Units) -> Units:
    """Bursts of the units that have just died, by their own attack or otherwise.

    What a burst kills bursts in the next game loop.
    """
    shape, n = scenario.shape, scenario.shape.n_allies
    if not (shape.ally_bursts or shape.enemy_bursts):
        return units
    bursts = scenario.bursting & (units.health <= 0) & ~units.burst
    distance = jnp.hypot(units.x[:, None] - units.x[None], units.y[:, None] - units.y[None])
    near = bursts[:, None] & (distance <= scenario.burst_reach) & (units.health > 0)[None]
    hits = jnp.where(near, scenario.burst_damage, 0.0)
    units = units._replace(burst=units.burst | bursts)
    return _take(
        units,
        n,
        hits[n:, :n],
        hits[:n, n:],
        scenario.burst_armour[n:, :n],
        scenario.burst_armour[:n, n:],
        shields=(shape.ally_shields, shape.enemy_shields),
    )


def regenerate(scenario: Scenario, units: Units) -> Units:
    """Zerg health, shields that were not hit for ten seconds, and healers' energy."""
    alive = units.health > 0
    since_hit = units.since_hit + 1
    health = jnp.minimum(units.health + scenario.regeneration, scenario.max_health)
    units = units._replace(health=jnp.where(alive, health, 0.0), since_hit=since_hit)
    if scenario.shape.ally_shields or scenario.shape.enemy_shields:
        grows = alive & (since_hit > SHIELD_DELAY * LOOPS_PER_SECOND)
        grown = units.shield + SHIELD_REGENERATION / LOOPS_PER_SECOND
        units = units._replace(
            shield=jnp.where(grows, jnp.minimum(grown, scenario.max_shield), units.shield)
        )
    if scenario.shape.n_healers:
        charged = units.energy[scenario.healers] + ENERGY_REGENERATION / LOOPS_PER_SECOND
        charged = jnp.where(alive[scenario.healers], jnp.minimum(charged, MAX_ENERGY), 0.0)
        units = units._replace(energy=units.energy.at[scenario.healers].set(charged))
    return units


def heal(scenario: Scenario, units: Units, target: Int[Any, "U"], gap: Float[Any, "U"]) -> Units:
    """Healers in range of a hurt patient turn energy into its health."""
    if not scenario.shape.n_healers:
        return units
    healers = scenario.healers
    patient = target[healers]
    alive = (units.health[healers] > 0) & (patient >= 0) & (units.health[patient] > 0)
    able = alive & scenario.biological[patient] & (gap[healers] <= HEAL_RANGE)
    # Only one healer mends a patient at a time.
    order = jnp.arange(len(healers))
    earlier = (order[:, None] > order[None]) & able[None]
    able &= ~jnp.any(earlier & (patient[:, None] == patient[None]), axis=1)
    energy = units.energy[healers]
    missing = scenario.max_health[patient] - units.health[patient]
    given = jnp.minimum(jnp.minimum(HEAL_RATE / LOOPS_PER_SECOND, missing), energy / HEAL_COST)
    given = jnp.where(able, given, 0.0)
    return units._replace(
        health=jnp.minimum(units.health.at[patient].add(given), scenario.max_health),
        energy=units.energy.at[healers].set(jnp.maximum(energy - given * HEAL_COST, 0.0)),
    )

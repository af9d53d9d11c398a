"""What changes in a battle."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from race.envs.micro.scenario import Scenario
from race.envs.micro.units import START_ENERGY

NOBODY = -1
NEVER = 1e6
"""Game loops since something that has not happened."""


class Units(NamedTuple):
    """All units of a battle; ``U`` units, allies first. A unit is dead when its health is 0.

    Times are in game loops, lengths in cells. Units are named by their number.
    """

    x: Float[Any, "U"]
    y: Float[Any, "U"]
    vx: Float[Any, "U"]
    """Velocity: the step of the last game loop."""
    vy: Float[Any, "U"]
    detour: Float[Any, "U"]
    """Game loops for which it still goes round others to its left (to its right if below 0).
    Between 0 and 1: for how long it has been stuck, as a share of its patience."""
    health: Float[Any, "U"]
    shield: Float[Any, "U"]
    energy: Float[Any, "U"]
    cooldown: Float[Any, "U"]
    """Until the weapon is ready."""
    since_shot: Float[Any, "U"]
    """Since the last attack left the unit."""
    since_hit: Float[Any, "U"]
    """Since the last damage taken."""
    target: Int[Any, "U"]
    """Whom the unit attacks or heals."""
    aiming: Float[Any, "U"]
    """Loops the unit has aimed at its target, this one included; 0 if it does not aim."""
    pending: Float[Any, "U"]
    """Until the next hit of the last attack lands; 0 if none is under way."""
    struck: Int[Any, "U"]
    """Whom the last attack was aimed at."""
    struck_by: Int[Any, "m"]
    """An ally that hit the enemy in this step."""
    burst: Bool[Any, "U"]
    """Whether the unit has burst."""
    beam: Float[Any, "beams 4"]
    """Middle (x, y) of each beam's line and the direction (x, y) of the shot across it."""
    scan_phase: Float[Any, "m"]
    """When in the course of a period an enemy looks for targets, from 0 to 1."""
    clock: Int[Any, ""]
    """Game loops since the battle began."""
    goal_shift: Float[Any, "goals 2"]
    """From the middle of where enemies may be sent to where they are sent in this battle; none on
    maps that always send them to the same point."""


class EnvState(NamedTuple):
    """The state of the environment between two steps."""

    units: Units
    steps: Int[Any, ""]
    last_actions: Int[Any, "n"]
    """-1 after a reset."""
    over: Bool[Any, ""]
    """Whether the battle has ended; further steps change nothing."""


def start(scenario: Scenario, key: Key[Array, ""] | None = None) -> EnvState:
    """The start of a battle.

    Args:
        scenario: the map.
        key: of what is left to chance: when each enemy looks for targets, and the enemies' point
            of attack on 2m_vs_1z. None: evenly spread, and the middle.
    """
    shape = scenario.shape
    along = jnp.zeros(())
    phase = jnp.arange(shape.n_enemies) / shape.n_enemies
    if key is not None:
        place, looks = jax.random.split(key)
        along = jax.random.uniform(place, minval=-1.0)
        phase = jax.random.uniform(looks, (shape.n_enemies,))
    zeros = jnp.zeros(shape.n_units)
    nobody = jnp.full(shape.n_units, NOBODY, jnp.int32)
    units = Units(
        x=scenario.x,
        y=scenario.y,
        vx=zeros,
        vy=zeros,
        detour=zeros,
        health=scenario.max_health,
        shield=scenario.max_shield,
        energy=zeros.at[scenario.healers].set(START_ENERGY),
        cooldown=zeros,
        since_shot=jnp.full(shape.n_units, NEVER),
        since_hit=zeros,
        target=nobody,
        aiming=zeros,
        pending=zeros,
        struck=nobody,
        struck_by=jnp.full(shape.n_enemies, NOBODY, jnp.int32),
        burst=zeros > 0,
        beam=jnp.zeros((shape.n_beams, 4)),
        scan_phase=phase.astype(jnp.float32),
        clock=jnp.zeros((), jnp.int32),
        goal_shift=along * scenario.goal_spread,
    )
    return EnvState(
        units,
        steps=jnp.zeros((), jnp.int32),
        last_actions=jnp.full(shape.n_allies, NOBODY, jnp.int32),
        over=jnp.zeros((), jnp.bool_),
    )

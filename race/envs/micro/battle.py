"""One environment step of fighting: eight game loops under the agents' orders."""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from race.envs.micro import combat, movement, opponent, pairs
from race.envs.micro.scenario import Scenario
from race.envs.micro.state import NOBODY, Units
from race.envs.micro.units import HEAL_RANGE

LOOPS_PER_STEP: Final = 8
LATEST_SIGHT: Final = 2
"""Game loops that a battle may be old when it is first seen."""
MOVE: Final = 2.0
"""How far a move order goes, in cells; no unit gets there within a step."""
NO_OP, STOP, NORTH, SOUTH, EAST, WEST, FIRST_TARGET = range(7)
"""SMAC's actions. Those from FIRST_TARGET on name an enemy, or for a healer an agent."""
_CLOSER: Final = 0.02
"""How much nearer than its range a unit walks, so that rounding does not keep it outside."""


class Orders(NamedTuple):
    """What the agents were told for a step."""

    target: Int[Any, "n"]
    """The unit to attack or heal, or `NOBODY`."""
    walks: Bool[Any, "n"]
    x: Float[Any, "n"]
    """Where to walk."""
    y: Float[Any, "n"]


def orders(scenario: Scenario, units: Units, actions: Int[Any, "n"]) -> Orders:
    """The orders that SMAC sends for available actions."""
    n = scenario.shape.n_allies
    named = actions - FIRST_TARGET
    target = jnp.where(scenario.healing_columns, named, named + n)
    # A flyer would brake for the end of a move that it never reaches.
    reach = jnp.where(scenario.flying[:n], 2 * MOVE, MOVE)
    step_x = jnp.where(actions == EAST, reach, 0.0) - jnp.where(actions == WEST, reach, 0.0)
    step_y = jnp.where(actions == NORTH, reach, 0.0) - jnp.where(actions == SOUTH, reach, 0.0)
    return Orders(
        target=jnp.where(named >= 0, target, NOBODY).astype(units.target.dtype),
        walks=(actions >= NORTH) & (actions <= WEST),
        x=units.x[:n] + step_x,
        y=units.y[:n] + step_y,
    )


def wait(scenario: Scenario, units: Units, key: Key[Array, ""]) -> Units:
    """What happens before a battle is first seen: 0, 1 or 2 game loops, each as likely.

    SMAC looks at the units of a new episode up to two loops after the game has made them. That
    the three are equally likely is a choice of ours.
    """
    loops = jax.random.randint(key, (), 0, LATEST_SIGHT + 1)
    stop = jnp.full(scenario.shape.n_allies, STOP)
    given, delays = orders(scenario, units, stop), jnp.zeros(scenario.shape.n_units)

    def loop(units: Units, number: Int[Any, ""]) -> tuple[Units, None]:
        later = game_loop(scenario, units, given, delays)
        begun = number < loops
        return jax.tree.map(lambda new, old: jnp.where(begun, new, old), later, units), None

    return jax.lax.scan(loop, units, jnp.arange(LATEST_SIGHT))[0]


def fight(scenario: Scenario, units: Units, given: Orders, key: Key[Array, ""]) -> Units:
    """Eight game loops; the units after them."""
    return _loops(scenario, units, given, key, lambda units: None)[0]


def film(scenario: Scenario, units: Units, given: Orders, key: Key[Array, ""]) -> Units:
    """The same, with the units after each game loop along a leading axis of eight."""
    shots: Units = _loops(scenario, units, given, key, lambda units: units)[1]
    return shots


def _loops(
    scenario: Scenario,
    units: Units,
    given: Orders,
    key: Key[Array, ""],
    show: Callable[[Units], Units | None],
) -> tuple[Units, Any]:
    units = opponent.answer_calls(scenario, units)
    # No weapon fires twice within a step, so one delay per unit is enough.
    delays = jax.random.uniform(
        key, (scenario.shape.n_units,), minval=combat.DELAY_LOW, maxval=combat.DELAY_HIGH
    )

    def loop(units: Units, _: None) -> tuple[Units, Units | None]:
        units = game_loop(scenario, units, given, delays)
        return units, show(units)

    return jax.lax.scan(loop, units, None, length=LOOPS_PER_STEP)


def game_loop(scenario: Scenario, units: Units, given: Orders, delays: Float[Any, "U"]) -> Units:
    """1/16 s: choose targets, attack, heal, regenerate, move."""
    shape, n = scenario.shape, scenario.shape.n_allies
    units = units._replace(
        cooldown=jnp.maximum(units.cooldown - 1, 0.0),
        since_shot=units.since_shot + 1,
        clock=units.clock + 1,
    )
    enemy_target = opponent.choose_targets(scenario, units)
    goal = opponent.march(scenario, units, enemy_target)
    target = jnp.concatenate([given.target, enemy_target])
    if shape.n_healers:
        enemies = scenario.healers >= n
        patient = jnp.where(
            enemies, opponent.choose_patients(scenario, units), target[scenario.healers]
        )
        target = target.at[scenario.healers].set(patient)
    walks = jnp.concatenate([given.walks, jnp.zeros(shape.n_enemies, bool)])
    sight = combat.look(scenario, units, target)
    attack = combat.aim(scenario, units, target, sight)
    fought = combat.strike(scenario, units, target, sight, attack, walks, delays)
    fought = combat.heal(scenario, fought, target, sight.gap)
    fought = combat.regenerate(scenario, fought)
    recovers = (units.struck == target) & (units.since_shot < scenario.backswing)
    near = sight.valid & (sight.gap <= scenario.range)
    fights = near | attack.aims | (sight.valid & recovers)
    follows = sight.valid
    distance = jnp.where(fights, 0.0, sight.gap - scenario.range + _CLOSER)
    if shape.n_healers:
        patient = target[scenario.healers]
        cares = (patient >= 0) & (units.health[patient] > 0)
        cares &= scenario.biological[patient]
        follows = follows.at[scenario.healers].set(cares)
        distance = distance.at[scenario.healers].set(
            sight.gap[scenario.healers] - HEAL_RANGE + _CLOSER
        )
    idle_x, idle_y = jnp.concatenate([given.x, goal.x]), jnp.concatenate([given.y, goal.y])
    marches = jnp.concatenate([given.walks, enemy_target < 0])
    there = jnp.sqrt(jnp.square(idle_x - units.x) + jnp.square(idle_y - units.y))
    course = movement.Course(
        x=jnp.where(follows, units.x[target], idle_x),
        y=jnp.where(follows, units.y[target], idle_y),
        distance=jnp.where(follows, distance, jnp.where(marches, there, 0.0)),
    )
    footing = pairs.Footing(fights=fights | (scenario.speed <= 0), idle=course.distance <= 0)
    return movement.move(scenario, fought._replace(target=target), course, footing)

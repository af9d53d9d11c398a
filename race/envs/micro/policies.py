"""Yardsticks: what a team does that has learned nothing."""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from race.envs.micro import battle
from race.envs.micro.scenario import Scenario
from race.envs.micro.state import EnvState
from race.types import Observation

Choose = Callable[[Scenario, EnvState, Observation, Key[Array, ""]], Int[Any, "n"]]


class Policy(NamedTuple):
    """A way to play for a whole team that needs no memory but the state."""

    choose: Choose
    """The agents' actions [n], from the map, the state, what the agents see, and a key."""
    any_distance: bool = False
    """Whether its orders to attack or heal hold past SMAC's mask (`smac.step`)."""


def random_actions(
    scenario: Scenario, env_state: EnvState, observation: Observation, key: Key[Array, ""]
) -> Int[Any, "n"]:
    """Uniform among the available actions."""
    del scenario, env_state
    lots = jax.random.uniform(key, observation.avail_actions.shape)
    return _first(jnp.where(observation.avail_actions, lots, -1.0))


def focus_fire(
    scenario: Scenario, env_state: EnvState, observation: Observation, key: Key[Array, ""]
) -> Int[Any, "n"]:
    """Everyone attacks the weakest enemy it may, or walks towards the nearest.

    The weakest has the least health and shield left, so agents near each other mostly agree on
    one. Healers heal the agent with the lowest share of its health, or walk to it.
    """
    del key
    n, units = scenario.shape.n_allies, env_state.units
    x, y, alive = units.x, units.y, units.health > 0
    available = observation.avail_actions
    dx, dy = x[None] - x[:n, None], y[None] - y[:n, None]
    distance = jnp.hypot(dx, dy)
    hurts = (scenario.damage + scenario.burst_damage)[:n] > 0
    strength = jnp.where(hurts, (units.health + units.shield)[None], jnp.inf)
    nearness = jnp.where(hurts & alive[None], distance, jnp.inf)
    if scenario.shape.ally_heals:
        friend = jnp.arange(scenario.shape.n_units) < n
        patient = (alive & friend & ~_heals(scenario))[None]
        need = jnp.where(patient, (units.health / scenario.max_health)[None], jnp.inf)
        healer = scenario.healing_columns[:, None]
        strength = jnp.where(healer, need, strength)
        nearness = jnp.where(healer, need + 0.001 * distance, nearness)
    target = jnp.argmin(nearness, axis=1)
    rows = jnp.arange(n)
    walk = _towards(dx[rows, target], dy[rows, target], available)
    attack = _weakest(scenario, strength, distance, available)
    choice = jnp.where(attack >= 0, attack, walk)
    return jnp.where(alive[:n], choice, battle.NO_OP).astype(jnp.int32)


def nearest(
    scenario: Scenario, env_state: EnvState, observation: Observation, key: Key[Array, ""]
) -> Int[Any, "n"]:
    """The enemies' own rule, as far as SMAC's actions allow it.

    Everyone stays with its target while that is in reach of its weapon, else attacks the nearest
    enemy that it may, or walks towards the nearest. Healers do as in `focus_fire`.
    """
    n, units = scenario.shape.n_allies, env_state.units
    dx, dy = units.x[None, n:] - units.x[:n, None], units.y[None, n:] - units.y[:n, None]
    distance = jnp.hypot(dx, dy)
    reach = scenario.range[:n, None] + scenario.radius[:n, None] + scenario.radius[None, n:]
    kept = units.target[:n, None] == jnp.arange(n, scenario.shape.n_units)[None]
    distance = jnp.where(kept & (distance <= reach), -1.0, distance)
    hurts = (scenario.damage + scenario.burst_damage)[:n, n:] > 0
    offered = observation.avail_actions[:, battle.FIRST_TARGET :] & hurts
    distance = jnp.where(offered, distance, jnp.inf)
    found = jnp.any(offered, axis=1) & ~scenario.healing_columns
    attack = battle.FIRST_TARGET + jnp.argmin(distance, axis=1)
    otherwise = focus_fire(scenario, env_state, observation, key)
    return jnp.where(found, attack, otherwise).astype(jnp.int32)


def heuristic(
    scenario: Scenario, env_state: EnvState, observation: Observation, key: Key[Array, ""]
) -> Int[Any, "n"]:
    """SMAC's heuristic mode: everyone attacks the enemy that was nearest until it is dead.

    Wherever that enemy is: the orders hold at any distance. Healers stay with the nearest agent
    that is hurt until it is whole or dead, and stop if there is none.
    """
    del observation, key
    n, units = scenario.shape.n_allies, env_state.units
    everyone, alive = jnp.arange(scenario.shape.n_units), units.health > 0
    dx, dy = units.x[None] - units.x[:n, None], units.y[None] - units.y[:n, None]
    healers = scenario.healing_columns[:, None]
    hurt = alive & (units.health < scenario.max_health) & (everyone < n) & ~_heals(scenario)
    wanted = jnp.where(healers, hurt[None], (alive & (everyone >= n))[None])
    kept = (units.target[:n, None] == everyone[None]) & wanted
    distance = jnp.where(wanted, jnp.where(kept, -1.0, jnp.hypot(dx, dy)), jnp.inf)
    target = jnp.argmin(distance, axis=1)
    action = battle.FIRST_TARGET + jnp.where(scenario.healing_columns, target, target - n)
    action = jnp.where(jnp.any(wanted, axis=1), action, battle.STOP)
    return jnp.where(alive[:n], action, battle.NO_OP).astype(jnp.int32)


POLICIES: Final[dict[str, Policy]] = {
    "random": Policy(random_actions),
    "scripted": Policy(focus_fire),
    "nearest": Policy(nearest),
    "heuristic": Policy(heuristic, any_distance=True),
}
"""By the names of the command line."""


def _heals(scenario: Scenario) -> Bool[Any, "U"]:
    enemies = jnp.zeros(scenario.shape.n_enemies, bool)
    return jnp.concatenate([scenario.healing_columns, enemies])


def _weakest(
    scenario: Scenario,
    strength: Float[Any, "n U"],
    distance: Float[Any, "n U"],
    available: Bool[Any, "n A"],
) -> Int[Any, "n"]:
    """The action against (for healers: for) the weakest available unit; -1 if there is none."""
    n, m = scenario.shape.n_allies, scenario.shape.n_enemies
    value = strength + 0.001 * distance
    named = value[:, n:]
    if scenario.shape.ally_heals:
        agents = jnp.pad(value[:, :n], ((0, 0), (0, m - n)), constant_values=jnp.inf)
        named = jnp.where(scenario.healing_columns[:, None], agents, named)
    named = jnp.where(available[:, battle.FIRST_TARGET :], named, jnp.inf)
    found = jnp.min(named, axis=1) < jnp.inf
    return jnp.where(found, battle.FIRST_TARGET + jnp.argmin(named, axis=1), -1)


def _towards(
    dx: Float[Any, "n"], dy: Float[Any, "n"], available: Bool[Any, "n A"]
) -> Int[Any, "n"]:
    """The available move that leads there most directly; to stop if all lead away."""
    gain = jnp.stack([jnp.zeros_like(dx), dy, -dy, dx, -dx], axis=1)
    open_ways = available[:, battle.STOP : battle.FIRST_TARGET]
    return battle.STOP + _first(jnp.where(open_ways, gain, -jnp.inf))


def _first(values: Float[Any, "n _"]) -> Int[Any, "n"]:
    return jnp.argmax(values, axis=1).astype(jnp.int32)

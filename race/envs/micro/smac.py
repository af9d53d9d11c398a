"""SMAC's interface: what agents observe, may do and are paid, to the last quirk.

Everything here follows the Python code of SMAC (github.com/oxwhirl/smac, commit d6aab33) with its
default settings. The dynamics between two observations are in `race.envs.micro.battle`.

Letters: ``n`` agents, ``m`` enemies, ``A`` actions (6 + m), ``O`` entries of an observation, ``S``
of the state.
"""

from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from race.envs.micro import battle
from race.envs.micro.scenario import REWARD_DEATH, REWARD_WIN, Scenario
from race.envs.micro.state import EnvState, Units, start
from race.types import Observation

SIGHT: Final = 9.0
"""Agents see units nearer than this, centre to centre, whatever their type."""
SHOOT: Final = 6.0
"""Agents may attack or heal units no further than this, centre to centre."""
PROBE: Final = 1
"""How far ahead a move looks for ground, in cells: half of what it asks for."""


class View(NamedTuple):
    """What SMAC reads of the units; ``U`` units, allies first, in the game's measures."""

    x: Float[Any, "U"]
    y: Float[Any, "U"]
    health: Float[Any, "U"]
    shield: Float[Any, "U"]
    energy: Float[Any, "U"]
    cooldown: Float[Any, "U"]


class Info(NamedTuple):
    """Facts about a step beyond its reward."""

    battle_won: Bool[Any, ""]
    dead_allies: Int[Any, ""]
    dead_enemies: Int[Any, ""]
    timed_out: Bool[Any, ""]
    """Whether the episode limit ended the battle. SMAC does not tell, and treats it as an end."""
    refused: Bool[Any, "n"]
    """Agents whose action was not available. They stopped (or did nothing, if dead) instead."""


class Timestep(NamedTuple):
    """The result of a step."""

    observation: Observation
    reward: Float[Any, ""]
    terminated: Bool[Any, ""]
    info: Info


def view(units: Units) -> View:
    """The part of the units that SMAC reads."""
    return View(units.x, units.y, units.health, units.shield, units.energy, units.cooldown)


def reset(scenario: Scenario, key: Key[Array, ""]) -> tuple[EnvState, Observation]:
    """A new battle.

    Units start at the same places for every key, as in SMAC's maps; the battle is 0, 1 or 2 game
    loops old when it is first seen (`battle.wait`).
    """
    place, delay = jax.random.split(key)
    env_state = start(scenario, place)
    env_state = env_state._replace(units=battle.wait(scenario, env_state.units, delay))
    return env_state, observe(scenario, view(env_state.units), env_state.last_actions)


def step(
    scenario: Scenario,
    env_state: EnvState,
    actions: Int[Any, "n"],
    key: Key[Array, ""],
    *,
    any_distance: bool = False,
) -> tuple[EnvState, Timestep]:
    """Half a second of battle under the agents' actions.

    An action that is not available is refused: the agent stops instead, or does nothing if it is
    dead, and ``info.refused`` tells. (SMAC ends the program.) After the end of a battle nothing
    changes any more and the reward is 0.

    Args:
        scenario: the map.
        env_state: the state before the step.
        actions: of the agents, which choose among the available ones.
        key: of the weapons' random delays.
        any_distance: obey orders to attack or heal whatever the distance, as SMAC's heuristic
            mode gives them past the mask.
    """
    before = view(env_state.units)
    available = avail_actions(scenario, before)
    rows = jnp.arange(scenario.shape.n_allies)
    legal = (actions >= 0) & (actions < scenario.shape.n_actions)
    legal &= available[rows, jnp.clip(actions, 0, scenario.shape.n_actions - 1)]
    alive = before.health[: scenario.shape.n_allies] > 0
    if any_distance:
        legal |= alive & (actions >= battle.FIRST_TARGET)
    instead = jnp.where(alive, battle.STOP, battle.NO_OP)
    taken = jnp.where(legal, actions, instead).astype(env_state.last_actions.dtype)
    given = battle.orders(scenario, env_state.units, taken)
    after = EnvState(
        units=battle.fight(scenario, env_state.units, given, key),
        steps=env_state.steps + 1,
        last_actions=taken,
        over=env_state.over,
    )
    over = env_state.over
    after = jax.tree.map(lambda old, new: jnp.where(over, old, new), env_state, after)
    reward, terminated, info = judge(scenario, before, view(after.units), after.steps)
    after = after._replace(over=terminated)
    observation = observe(scenario, view(after.units), after.last_actions)
    info = info._replace(refused=~legal)
    return after, Timestep(observation, jnp.where(over, 0.0, reward), terminated, info)


def avail_actions(scenario: Scenario, units: View) -> Bool[Any, "n A"]:
    """The actions each agent may choose.

    The dead may only do nothing. Moves ask whether the cell one unit ahead is walkable, for
    flyers too; the coordinate is cut towards zero, so that the move west (south) is offered on the
    western (southern) rim.
    """
    shape = scenario.shape
    n, width, height = shape.n_allies, shape.width, shape.height
    x, y, alive = units.x[:n], units.y[:n], units.health > 0
    column, row = jnp.floor(x).astype(jnp.int32), jnp.floor(y).astype(jnp.int32)

    def ahead(place: Float[Any, "n"]) -> Int[Any, "n"]:
        return jnp.floor(place).astype(jnp.int32) + PROBE

    def behind(place: Float[Any, "n"]) -> Int[Any, "n"]:
        cell = jnp.floor(place).astype(jnp.int32) - PROBE
        return jnp.where((place > 0) & (place < PROBE), 0, cell)

    def open_ground(column: Int[Any, "n"], row: Int[Any, "n"]) -> Bool[Any, "n"]:
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        clipped = jnp.clip(column, 0, width - 1), jnp.clip(row, 0, height - 1)
        return inside & scenario.walkable[clipped]

    moves = jnp.stack(
        [
            open_ground(column, ahead(y)),
            open_ground(column, behind(y)),
            open_ground(ahead(x), row),
            open_ground(behind(x), row),
        ],
        axis=1,
    )
    near = _square_distance(units, n, slice(n, None)) <= SHOOT**2
    targets = alive[None, n:] & near
    if shape.ally_heals:
        near = _square_distance(units, n, slice(None, n)) <= SHOOT**2
        patients = alive[None, :n] & near & ~scenario.healing_columns[None]
        patients = jnp.pad(patients, ((0, 0), (0, shape.n_enemies - n)))
        targets = jnp.where(scenario.healing_columns[:, None], patients, targets)
    living = alive[:n, None]
    return jnp.concatenate(
        [~living, living, living & moves, living & targets],
        axis=1,
    )


def observe(scenario: Scenario, units: View, last_actions: Int[Any, "n"]) -> Observation:
    """Observations, state and masks of a moment.

    Args:
        scenario: the map.
        units: as they are now.
        last_actions: what the agents did to come here; -1 after a reset.
    """
    available = avail_actions(scenario, units)
    return Observation(
        observations(scenario, units, available),
        global_state(scenario, units, last_actions),
        available,
    )


def observations(scenario: Scenario, units: View, available: Bool[Any, "n A"]) -> Float[Any, "n O"]:
    """What each agent sees: its moves, the enemies, the other agents, itself. The dead see zeros.

    The first entry of an enemy's row is the agent's own mask bit for the action of that number;
    for a healer it thus tells of an agent and not of the enemy.
    """
    n = scenario.shape.n_allies
    alive = units.health > 0
    ratios = _ratios(scenario, units)
    available_f = available.astype(jnp.float32)

    def rows(
        part: slice,
        first: Float[Any, "n others"],
        seen_as: Float[Any, "others features"],
    ) -> Float[Any, "n others _"]:
        dx = units.x[None, part] - units.x[:n, None]
        dy = units.y[None, part] - units.y[:n, None]
        square = dx * dx + dy * dy
        distance = jnp.sqrt(square)
        sees = (square < SIGHT**2) & alive[None, part] & alive[:n, None]
        seen = jnp.concatenate(
            [
                jnp.stack([first, distance / SIGHT, dx / SIGHT, dy / SIGHT], axis=-1),
                jnp.broadcast_to(seen_as[None], (n, *seen_as.shape)),
            ],
            axis=-1,
        )
        return jnp.where(sees[..., None], seen, 0.0)

    enemies = rows(slice(n, None), available_f[:, battle.FIRST_TARGET :], ratios.enemies)
    allies = rows(slice(None, n), jnp.ones((n, n)), ratios.allies)
    # All agents but oneself: row i of the others is agent i, or i + 1 from oneself on.
    me, other = jnp.arange(n)[:, None], jnp.arange(n - 1)[None]
    others = jnp.where((other < me)[..., None], allies[:, :-1], allies[:, 1:])
    moves = available_f[:, battle.NORTH : battle.FIRST_TARGET]
    own = jnp.where(alive[:n, None], ratios.allies, 0.0)
    return jnp.concatenate([moves, enemies.reshape(n, -1), others.reshape(n, -1), own], axis=1)


def global_state(scenario: Scenario, units: View, last_actions: Int[Any, "n"]) -> Float[Any, "S"]:
    """All agents, all enemies, and the agents' last actions. Rows of the dead are zeros."""
    shape, n = scenario.shape, scenario.shape.n_allies
    alive = units.health > 0
    ratios = _ratios(scenario, units)
    x = ((units.x - shape.width / 2) / shape.width)[:, None]
    y = ((units.y - shape.height / 2) / shape.height)[:, None]
    charge = jnp.where(scenario.healing_columns, units.energy[:n], units.cooldown[:n])
    charge = (charge / scenario.cooldown_scale)[:, None]
    allies = jnp.concatenate(
        [ratios.allies[:, :1], charge, x[:n], y[:n], ratios.allies[:, 1:]], axis=1
    )
    enemies = jnp.concatenate([ratios.enemies[:, :1], x[n:], y[n:], ratios.enemies[:, 1:]], axis=1)
    actions = last_actions[:, None] == jnp.arange(shape.n_actions)[None]
    return jnp.concatenate(
        [
            jnp.where(alive[:n, None], allies, 0.0).reshape(-1),
            jnp.where(alive[n:, None], enemies, 0.0).reshape(-1),
            actions.astype(jnp.float32).reshape(-1),
        ]
    )


def judge(
    scenario: Scenario, before: View, after: View, steps: Int[Any, ""]
) -> tuple[Float[Any, ""], Bool[Any, ""], Info]:
    """Reward, end and facts of a step.

    The reward counts what enemies lost in health and shield, 10 for each death and 200 for a win,
    as an absolute value: enemies that recover faster than they are hurt pay as well.

    Args:
        scenario: the map.
        before: the units before the step.
        after: the units after it.
        steps: of the episode, this one included.
    """
    n = scenario.shape.n_allies
    alive = after.health > 0
    lived, lives = before.health[n:] > 0, alive[n:]
    had, has = before.health[n:] + before.shield[n:], after.health[n:] + after.shield[n:]
    change = jnp.where(lives, had - has, had + REWARD_DEATH)
    reward = jnp.abs(jnp.sum(jnp.where(lived, change, 0.0)))
    allies_left, enemies_left = jnp.sum(alive[:n]), jnp.sum(lives)
    lost = (allies_left == 0) & (enemies_left > 0)
    won = (allies_left > 0) & (enemies_left == 0)
    if scenario.shape.n_healers:
        # On maps with healers a team of healers alone has lost, even if nobody is left at all.
        lost |= ~jnp.any(alive[:n] & ~scenario.healing_columns)
        won |= (enemies_left == 1) & jnp.any(lives & scenario.enemy_heals)
    won &= ~lost
    draw = (allies_left == 0) & (enemies_left == 0)
    ended = lost | won | draw
    timed_out = ~ended & (steps >= scenario.episode_limit)
    reward = (reward + jnp.where(won, REWARD_WIN, 0.0)) / scenario.reward_scale
    info = Info(
        battle_won=won,
        dead_allies=n - allies_left,
        dead_enemies=scenario.shape.n_enemies - enemies_left,
        timed_out=timed_out,
        refused=jnp.zeros(n, bool),
    )
    return reward, ended | timed_out, info


class _Ratios(NamedTuple):
    allies: Float[Any, "n features"]  # health, shield where the side has any, type
    enemies: Float[Any, "m features"]


def _ratios(scenario: Scenario, units: View) -> _Ratios:
    shape, n = scenario.shape, scenario.shape.n_allies
    health = (units.health / scenario.max_health)[:, None]
    shield = (units.shield / jnp.maximum(scenario.max_shield, 1.0))[:, None]

    def side(part: slice, shields: bool, types: Any) -> Float[Any, "_ features"]:
        columns = [health[part], *([shield[part]] if shields else []), types]
        return jnp.concatenate(columns, axis=1)

    return _Ratios(
        side(slice(None, n), shape.ally_shields, scenario.ally_types),
        side(slice(n, None), shape.enemy_shields, scenario.enemy_types),
    )


def _square_distance(units: View, n: int, part: slice) -> Float[Any, "n others"]:
    dx = units.x[:n, None] - units.x[None, part]
    dy = units.y[:n, None] - units.y[None, part]
    return dx * dx + dy * dy

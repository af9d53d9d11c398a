"""Battles played from start to end with every game loop kept, for pictures of them."""

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from race.envs.micro import Battle, battle, smac
from race.envs.micro.policies import Policy
from race.envs.micro.scenario import Scenario
from race.envs.micro.smac import Info, Timestep
from race.envs.micro.state import EnvState, Units
from race.types import Observation


class Recording(NamedTuple):
    """A battle that was played; ``L`` moments: the start, then after each game loop."""

    units: Units
    """As numpy arrays with a leading axis ``L``."""
    returns: Float[np.ndarray, "steps"]
    """Sum of the rewards after each step."""
    verdict: str
    """``won``, ``lost``, ``draw`` or ``time``; empty if the battle was not played to its end."""


Turn = tuple[Timestep, Units]
"""A step, and the units after each of its game loops."""


def step_and_film(
    scenario: Scenario,
    env_state: EnvState,
    actions: Int[Any, "n"],
    key: Key[Array, ""],
    *,
    any_distance: bool = False,
) -> tuple[EnvState, Timestep, Units]:
    """`race.envs.micro.smac.step`, and the units after each of its eight game loops.

    The film shows the actions that were taken, not those that were refused. After the end of a
    battle nothing moves.
    """
    after, timestep = smac.step(scenario, env_state, actions, key, any_distance=any_distance)
    given = battle.orders(scenario, env_state.units, after.last_actions)
    film = battle.film(scenario, env_state.units, given, key)

    def frozen_if_over(still: Array, moving: Array) -> Array:
        return jnp.where(env_state.over, jnp.broadcast_to(still, moving.shape), moving)

    return after, timestep, jax.tree.map(frozen_if_over, env_state.units, film)


def play(played: Battle, policy: Policy, seed: int, most_steps: int | None = None) -> Recording:
    """One battle under a policy. The same seed gives the same battle.

    Args:
        played: the map.
        policy: chooses the actions of all agents; it must be jittable.
        seed: of everything random, below 2**32.
        most_steps: stop after so many environment steps; None for the whole battle.
    """
    start, key = jax.random.split(jax.random.key(seed))
    env_state, observation = played.reset(start)
    limit = played.spec.episode_limit
    steps = limit if most_steps is None else min(most_steps, limit)

    def turns(env_state: EnvState, observation: Observation, key: Key[Array, ""]) -> Iterator[Turn]:
        for _ in range(steps):
            key, now = jax.random.split(key)
            env_state, timestep, film = _play_step(
                policy, played.scenario, env_state, observation, now
            )
            observation = timestep.observation
            yield timestep, film

    return _record(played.scenario, env_state.units, turns(env_state, observation, key))


def replay(played: Battle, actions: Int[Any, "steps n"], seed: int) -> Recording:
    """The battle that a `race.envs.micro.environment.MicroEnv` with this seed makes of actions.

    Args:
        played: the map.
        actions: of all agents at every step; what comes after the end is ignored.
        seed: of everything random, below 2**32.
    """
    key, now = jax.random.split(jax.random.key(seed))
    env_state, _ = played.reset(now)

    def turns(env_state: EnvState, key: Key[Array, ""]) -> Iterator[Turn]:
        for chosen in actions:
            key, now = jax.random.split(key)
            env_state, timestep, film = _film(played.scenario, env_state, jnp.asarray(chosen), now)
            yield timestep, film

    return _record(played.scenario, env_state.units, turns(env_state, key))


def _record(scenario: Scenario, units: Units, turns: Iterator[Turn]) -> Recording:
    """What the turns of a battle bring, up to its end if they reach it."""
    films = [jax.tree.map(lambda leaf: np.asarray(leaf)[None], units)]
    rewards: list[float] = []
    verdict = ""
    for timestep, film in turns:
        films.append(jax.tree.map(np.asarray, film))
        rewards.append(float(timestep.reward))
        if timestep.terminated:
            verdict = verdict_of(scenario, timestep.info)
            break
    units = jax.tree.map(lambda *leaves: np.concatenate(leaves), *films)
    return Recording(units, np.cumsum(np.array(rewards, np.float64)), verdict)


_film = jax.jit(step_and_film)


@functools.partial(jax.jit, static_argnums=0)
def _play_step(
    policy: Policy,
    scenario: Scenario,
    env_state: EnvState,
    observation: Observation,
    key: Key[Array, ""],
) -> tuple[EnvState, Timestep, Units]:
    mind, world = jax.random.split(key)
    actions = policy.choose(scenario, env_state, observation, mind)
    return step_and_film(scenario, env_state, actions, world, any_distance=policy.any_distance)


def verdict_of(scenario: Scenario, info: Info) -> str:
    """How a battle ended: ``won``, ``lost``, ``draw`` (nobody is left) or ``time``."""
    if info.battle_won:
        return "won"
    if info.timed_out:
        return "time"
    shape = scenario.shape
    nobody = info.dead_allies == shape.n_allies and info.dead_enemies == shape.n_enemies
    return "draw" if nobody else "lost"

"""Episodes on the device: all teams' environments in one compiled loop over time."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from race.algorithms.base import Teams
from race.programs import TRACES
from race.rollouts.choosing import Exploration, blank, choose
from race.rollouts.episodes import Played, no_episodes
from race.types import DeviceEnv, DiscreteSpec, Episode, Observation, Outcome


class _Now(NamedTuple):
    """The loop's state: everything at one tick."""

    tick: Int[Array, ""]
    env_state: Any
    key: Array  # [T], typed keys
    seen: Observation
    memory: Any
    running: Bool[Array, "T"]
    played: Played


def play(
    env: DeviceEnv,
    teams: Teams,
    seeds: UInt32[Any, "T"],
    how: Exploration | None,
    spec: DiscreteSpec,
    precision: str,
) -> Played:
    """One episode per team, in one compiled program that ends with the last of them.

    Environments whose episode has ended are masked: what they do no longer counts. Chance is that
    of the host: an environment begins with ``jax.random.key(seed)`` and each reset and each step
    takes ``key, now = jax.random.split(key)``.

    Args:
        env: the environment.
        teams: the teams.
        seeds: of the environments, below 2**31.
        how: who explores; None for nobody.
        spec: the task's sizes.
        precision: dtype of the observations and states of the episodes.
    """
    result: Played = _play(
        env.arrays, teams, seeds, how, reset=env.reset, step=env.step, spec=spec, dtype=precision
    )
    return result


@partial(jax.jit, static_argnames=("reset", "step", "spec", "dtype"))
def _play(
    arrays: Any,
    teams: Teams,
    seeds: Array,
    how: Exploration | None,
    *,
    reset: Any,
    step: Any,
    spec: DiscreteSpec,
    dtype: str,
) -> Played:
    TRACES["play"] += 1
    key, first = _split(jax.vmap(jax.random.key)(seeds))
    env_state, seen = jax.vmap(reset, in_axes=(None, 0))(arrays, first)
    n_teams = teams.heads.shape[0]
    running = jnp.ones(n_teams, bool)
    played = no_episodes(n_teams, spec, dtype)
    played = played._replace(episodes=_see(played.episodes, seen, running, jnp.zeros((), int)))

    def going(now: _Now) -> Bool[Array, ""]:
        return jnp.any(now.running) & (now.tick < spec.episode_limit)

    def tick(now: _Now) -> _Now:
        memory, action = choose(teams, now.memory, now.seen, now.tick, how)
        key, chance = _split(now.key)
        env_state, seen, outcome = jax.vmap(step, in_axes=(None, 0, 0, 0))(
            arrays, now.env_state, action, chance
        )
        played = _note(now.played, action, outcome, seen, now.running, now.tick)
        running = now.running & ~outcome.terminated & ~outcome.truncated
        return _Now(now.tick + 1, env_state, key, seen, memory, running, played)

    begin = _Now(jnp.zeros((), int), env_state, key, seen, blank(teams), running, played)
    return jax.lax.while_loop(going, tick, begin).played


def _split(keys: Array) -> tuple[Array, Array]:
    both = jax.vmap(jax.random.split)(keys)
    return both[:, 0], both[:, 1]


def _note(
    played: Played,
    action: Int[Array, "T N"],
    outcome: Outcome,
    seen: Observation,
    running: Bool[Array, "T"],
    tick: Int[Array, ""],
) -> Played:
    """Adds a step of the running episodes, and the moment after it."""
    reward = jnp.where(running, outcome.reward, 0.0)
    episodes = _see(played.episodes, seen, running, tick + 1)
    ended = (running & outcome.terminated).astype(episodes.terminated.dtype)
    taken = jnp.where(running[:, None], action, 0).astype(episodes.action.dtype)
    episodes = episodes._replace(
        action=episodes.action.at[:, tick].set(taken),
        reward=episodes.reward.at[:, tick].set(reward),
        terminated=episodes.terminated.at[:, tick].set(ended),
        length=episodes.length + running.astype(episodes.length.dtype),
    )
    return Played(episodes, played.episode_return + reward, played.won | (running & outcome.won))


def _see(
    episodes: Episode, seen: Observation, running: Bool[Array, "T"], place: Int[Array, ""]
) -> Episode:
    def put(column: Array, now: Array) -> Array:
        shown = jnp.where(running.reshape(-1, *[1] * (now.ndim - 1)), now, jnp.zeros_like(now))
        return column.at[:, place].set(shown.astype(column.dtype))

    return episodes._replace(
        obs=put(episodes.obs, seen.obs),
        state=put(episodes.state, seen.state),
        avail_actions=put(episodes.avail_actions, seen.avail_actions),
    )

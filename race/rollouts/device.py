"""Episodes on the device: all teams' environments in one compiled loop over time."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from race.programs import TRACES
from race.programs.cohort import stacked
from race.rollouts.choosing import blank, choose
from race.rollouts.episodes import Part, Played, no_episodes
from race.types import DeviceEnv, DiscreteSpec, Episode, Observation, Outcome


class _Now(NamedTuple):
    """The loop's state: everything at one tick, of ``C`` runs with ``T`` teams each."""

    tick: Int[Array, ""]
    env_state: Any
    key: Array  # [C T], typed keys
    seen: Observation
    memory: Any
    running: Bool[Array, "CT"]
    played: Played


def play(env: DeviceEnv, parts: Sequence[Part], spec: DiscreteSpec, precision: str) -> list[Played]:
    """One episode per team of each run, in one compiled program that ends with the last of them.

    Environments whose episode has ended are masked: what they do no longer counts. Chance is that
    of the host: an environment begins with ``jax.random.key(seed)`` and each reset and each step
    takes ``key, now = jax.random.split(key)``.

    Args:
        env: the environment.
        parts: what each run plays, with equally many teams.
        spec: the task's sizes.
        precision: dtype of the observations and states of the episodes.
    """
    result: list[Played] = _play(
        env.arrays, tuple(parts), reset=env.reset, step=env.step, spec=spec, dtype=precision
    )
    return result


@partial(jax.jit, static_argnames=("reset", "step", "spec", "dtype"))
def _play(
    arrays: Any, parts: tuple[Part, ...], *, reset: Any, step: Any, spec: DiscreteSpec, dtype: str
) -> list[Played]:
    TRACES["play"] += 1
    n_runs, n_teams = len(parts), parts[0].teams.count
    teams, how = (stacked(tuple(part[i] for part in parts)) for i in (0, 2))
    seeds = jnp.concatenate([part.seeds for part in parts])
    key, first = _split(jax.vmap(jax.random.key)(seeds))
    env_state, seen = jax.vmap(reset, in_axes=(None, 0))(arrays, first)
    running = jnp.ones(n_runs * n_teams, bool)
    played = no_episodes(n_runs * n_teams, spec, dtype)
    played = played._replace(episodes=_see(played.episodes, seen, running, jnp.zeros((), int)))

    def going(now: _Now) -> Bool[Array, ""]:
        return jnp.any(now.running) & (now.tick < spec.episode_limit)

    def tick(now: _Now) -> _Now:
        of_runs = jax.tree.map(lambda x: x.reshape(n_runs, n_teams, *x.shape[1:]), now.seen)
        memory, action = jax.vmap(choose, in_axes=(0, 0, 0, None, 0))(
            teams, now.memory, of_runs, now.tick, how
        )
        action = action.reshape(n_runs * n_teams, -1)
        key, chance = _split(now.key)
        env_state, seen, outcome = jax.vmap(step, in_axes=(None, 0, 0, 0))(
            arrays, now.env_state, action, chance
        )
        played = _note(now.played, action, outcome, seen, now.running, now.tick)
        running = now.running & ~outcome.terminated & ~outcome.truncated
        return _Now(now.tick + 1, env_state, key, seen, memory, running, played)

    memory = jax.vmap(blank)(teams)
    begin = _Now(jnp.zeros((), int), env_state, key, seen, memory, running, played)
    ended = jax.lax.while_loop(going, tick, begin).played

    def of_run(run: int) -> Played:
        part: Played = jax.tree.map(lambda x: x[run * n_teams : (run + 1) * n_teams], ended)
        return part

    return list(map(of_run, range(n_runs)))


def _split(keys: Array) -> tuple[Array, Array]:
    both = jax.vmap(jax.random.split)(keys)
    return both[:, 0], both[:, 1]


def _note(
    played: Played,
    action: Int[Array, "CT N"],
    outcome: Outcome,
    seen: Observation,
    running: Bool[Array, "CT"],
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
    episodes: Episode, seen: Observation, running: Bool[Array, "CT"], place: Int[Array, ""]
) -> Episode:
    def put(column: Array, now: Array) -> Array:
        shown = jnp.where(running.reshape(-1, *[1] * (now.ndim - 1)), now, jnp.zeros_like(now))
        return column.at[:, place].set(shown.astype(column.dtype))

    return episodes._replace(
        obs=put(episodes.obs, seen.obs),
        state=put(episodes.state, seen.state),
        avail_actions=put(episodes.avail_actions, seen.avail_actions),
    )

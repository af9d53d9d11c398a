"""How recurrent teams choose discrete actions, the same on the host and on the device."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from race.algorithms.base import Teams
from race.learners.facmac import logits
from race.method.exploration import explore, greedy
from race.method.normalisation import scaled
from race.networks.recurrent import embed_step, no_memory
from race.types import Observation


class Exploration(NamedTuple):
    """Who samples actions from its policies, and how many at random from what is available."""

    exploring: Bool[Array, "T"]
    epsilon: Float[Array, "T"]
    key: PRNGKeyArray


class Memory(NamedTuple):
    """What teams carry from moment to moment."""

    carry: Float[Array, "T N H"]
    last_action: Int[Array, "T N"]  # -1 before the first step


def blank(teams: Teams) -> Memory:
    """The memory of all teams before the first moment."""
    shape = teams.heads.shape[:2]
    return Memory(no_memory(teams.encoder, *shape), jnp.full(shape, -1, jnp.int32))


def choose(
    teams: Teams, memory: Memory, seen: Observation, tick: Int[Any, ""], how: Exploration | None
) -> tuple[Memory, Int[Array, "T N"]]:
    """The actions of all teams, agent i of each through its team's head i.

    Args:
        teams: the teams.
        memory: what they carry.
        seen: what they see, with a leading axis ``T``.
        tick: steps made before this one; the randomness of a step depends on it and the key alone.
        how: None if nobody explores.
    """
    embed = jax.vmap(embed_step) if teams.own_encoders else embed_step
    obs = seen.obs
    if teams.scaling is not None:
        assert teams.scaling.obs is not None
        obs = scaled(obs, teams.scaling.obs)
    z = embed(teams.encoder, memory.carry, obs, memory.last_action)
    scores = jax.vmap(logits)(z, teams.heads)
    action = greedy(scores, seen.avail_actions)
    if how is not None:
        key = jax.random.fold_in(how.key, tick)
        explored = explore(scores, seen.avail_actions, how.epsilon[:, None], key)
        action = jnp.where(how.exploring[:, None], explored, action)
    return Memory(z, action), action

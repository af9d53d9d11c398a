"""The signals of Eq. (3) over minibatches of episodes: which pairs MINE contrasts.

There is one MINE, because there is one encoder for all agents (Appendix A.1). A signal of a step is
averaged over the agents that have something to choose: an agent with one available action (a dead
one) has no part in it, and the signal of a step at which all are such is 0.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from race.config.shape import Shape
from race.learners.moments import Moments
from race.method.equations import mutual_information_signal, mutual_information_signal_across
from race.networks.dense import Mine, encode_embedding, encode_state

GROUP = 32
"""Steps among which MINE's pairs are made."""


def mutual_information(
    mine: Mine, moments: Moments, z: Float[Array, "T R N H"], key: PRNGKeyArray, shape: Shape
) -> Float[Array, "1 B"]:
    """Signals of every step, whose negatives are those of `Shape.mine_negatives`."""
    living = jnp.sum(moments.avail_actions, axis=-1) > 1
    counted = living.astype(z.dtype) * moments.real[..., None]
    if shape.mine_negatives == "episodes":
        return _against_other_episodes(mine, moments, z, counted, shape.batch_size)[None]
    return _against_other_steps(mine, moments, z, counted, key)[None]


def _against_other_steps(
    mine: Mine,
    moments: Moments,
    z: Float[Array, "T R N H"],
    counted: Float[Array, "T R N"],
    key: PRNGKeyArray,
) -> Float[Array, "B"]:
    """The same agent's embeddings at other steps are the negatives.

    The steps of a minibatch are thrown together and dealt out anew, `GROUP` at a time, in an order
    that depends on which steps they are and not on where in the minibatch they lie; a step's
    negatives are of the other steps of its group. All pairs of a minibatch would be a thousand
    times as many as its steps.
    """
    agents = z.shape[2]
    samples = z.shape[0] * z.shape[1]
    groups = -(-samples // GROUP)
    order = deal_out(key, moments.moment.reshape(-1), moments.real.reshape(-1) > 0)
    deal = jnp.concatenate([order, jnp.arange(samples, groups * GROUP)])

    def dealt(x: Array) -> Array:
        flat = x.reshape(samples, *x.shape[2:])
        missing = jnp.zeros((groups * GROUP - samples, *flat.shape[1:]), flat.dtype)
        return jnp.concatenate([flat, missing])[deal].reshape(groups, GROUP, *flat.shape[1:])

    state, embedding, count = dealt(moments.state), dealt(z), dealt(counted)
    x = encode_state(mine, state.reshape(groups * GROUP, -1)).reshape(groups, GROUP, -1)
    y = encode_embedding(mine, embedding.reshape(groups * GROUP * agents, -1))
    y = y.reshape(groups, GROUP, agents, -1)
    scores = jnp.einsum("gtm,gknm->gntk", x, y)
    signal = jax.vmap(jax.vmap(mutual_information_signal, in_axes=(0, 1)))(scores, count)
    total = jnp.sum(jnp.swapaxes(signal, 1, 2) * count, axis=2)
    mean = total / jnp.maximum(jnp.sum(count, axis=2), 1.0)
    return mean.reshape(-1)[jnp.argsort(deal)[:samples]]


def deal_out(key: PRNGKeyArray, moment: Int[Array, "B"], real: Bool[Array, "B"]) -> Int[Array, "B"]:
    """The samples of a minibatch in a random order of its steps; what is no step comes last."""
    bits = jax.vmap(lambda one: jax.random.bits(jax.random.fold_in(key, one)))(moment)
    # Two steps of the same number, one in a few million, are told apart by which they are.
    return jnp.lexsort((moment, bits, ~real))


def _against_other_episodes(
    mine: Mine,
    moments: Moments,
    z: Float[Array, "T R N H"],
    counted: Float[Array, "T R N"],
    episodes: int,
) -> Float[Array, "B"]:
    """The embeddings of all agents of the other episodes at the same time are the negatives."""
    agents, samples = z.shape[2], z.shape[0] * z.shape[1]
    x = encode_state(mine, moments.state.reshape(samples, -1))
    y = encode_embedding(mine, z.reshape(samples * agents, -1)).reshape(samples, agents, -1)
    places = of_each_time(moments.first, moments.real > 0, episodes)

    def at_places(flat: Array) -> Array:
        """Zeros where an episode is over, whatever stands in its slots."""
        there = (places < samples).reshape(*places.shape, *[1] * (flat.ndim - 1))
        return jnp.where(there, flat[jnp.minimum(places, samples - 1)], 0.0)

    count = at_places(counted.reshape(samples, agents))
    scores = jnp.einsum("tem,tfnm->tefn", at_places(x), at_places(y))
    signal = jax.vmap(mutual_information_signal_across)(scores, count)
    return jnp.zeros(samples, z.dtype).at[places].set(signal, mode="drop")


def of_each_time(
    first: Bool[Array, "T R"], real: Bool[Array, "T R"], episodes: int
) -> Int[Array, "T E"]:
    """The sample that is a step of each episode at each time, ``T R`` where there is none.

    Args:
        first: where episodes begin.
        real: where there is a step.
        episodes: ``E``, as many as begin or more.
    """
    slots, rows = first.shape
    slot = jnp.arange(slots)[:, None]
    time = slot - jax.lax.cummax(jnp.where(first, slot, 0), axis=0)
    begun = jnp.cumsum(first.astype(jnp.int32), axis=0)
    of_rows_before = jnp.cumsum(begun[-1]) - begun[-1]
    episode = of_rows_before[None] + begun - 1
    sample = jnp.arange(slots * rows).reshape(slots, rows)
    nowhere = jnp.full((slots, episodes), slots * rows)
    return nowhere.at[jnp.where(real, time, slots), episode].set(sample, mode="drop")

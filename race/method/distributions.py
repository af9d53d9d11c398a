"""Evolution by a distribution of teams: the cross-entropy method, and evolution strategies.

Arrays in, arrays out; teams are pytrees whose leaves begin with the population's axis. NaN fitness
counts as minus infinity.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from race.config.hyper import Number


def places(fitness: Float[Array, "P"]) -> Int[Array, "P"]:
    """Each team's place, 0 for the fittest; of equals the first is ahead."""
    keys = jnp.where(jnp.isnan(fitness), jnp.inf, -fitness)
    return jnp.argsort(jnp.argsort(keys, stable=True)).astype(jnp.int32)


def elite_weights(fitness: Float[Array, "P"], share: Number) -> Float[Array, "P"]:
    """Weights of the elites of the cross-entropy method, the others' are 0; their sum is 1.

    The better a team, the more it weighs: ``log(K + 1) - log(place + 1)`` of K elites, as in CEM-RL
    (Pourchot and Sigaud 2019).

    Args:
        fitness: of the population.
        share: of it that is elite; at least one team is.
    """
    size = fitness.shape[0]
    place = places(fitness).astype(jnp.float32)
    count = jnp.clip(jnp.round(share * jnp.float32(size)), 1.0, jnp.float32(size))
    weights = jnp.where(place < count, jnp.log(count + 1.0) - jnp.log(place + 1.0), 0.0)
    return weights / jnp.sum(weights)


def weighted_mean(teams: Any, weights: Float[Array, "P"]) -> Any:
    """The mean of teams by their weights; a weight of 0 keeps out what is not finite too."""

    def mean(leaf: Array) -> Array:
        w = _spread(weights, leaf)
        return jnp.sum(jnp.where(w != 0, w * leaf, 0.0), axis=0)

    return jax.tree.map(mean, teams)


def spread_around(
    teams: Any, centre: Any, weights: Float[Array, "P"], floor: Float[Array, ""]
) -> Any:
    """The diagonal variance of weighted teams around a centre, and a floor that is added to it.

    The centre is the old mean: teams that moved it stretch the distribution along their way.
    """
    squares = jax.tree.map(lambda leaf, c: jnp.square(leaf - c[None]), teams, centre)
    return jax.tree.map(lambda variance: variance + floor, weighted_mean(squares, weights))


def centred_ranks(fitness: Float[Array, "P"]) -> Float[Array, "P"]:
    """Ranks from -0.5 (the worst) to 0.5, the fitness shaping of Salimans et al. (2017)."""
    last = fitness.shape[0] - 1
    return 0.5 - places(fitness).astype(jnp.float32) / jnp.float32(last)


def ascent(teams: Any, mean: Any, fitness: Float[Array, "P"], noise: Number) -> Any:
    """The gradient of expected fitness by the mean, estimated from a population around it.

    ``1 / (P sigma) sum_j u_j (W_j - mean) / sigma`` with centred ranks u (Salimans et al. 2017).
    """
    ranks = centred_ranks(fitness)
    scale = 1.0 / (jnp.float32(fitness.shape[0]) * noise * noise)

    def gradient(leaf: Array, centre: Array) -> Array:
        return scale * jnp.sum(_spread(ranks, leaf) * (leaf - centre[None]), axis=0)

    return jax.tree.map(gradient, teams, mean)


def _spread(weights: Float[Array, "P"], leaf: Array) -> Array:
    return weights.reshape(-1, *[1] * (leaf.ndim - 1))

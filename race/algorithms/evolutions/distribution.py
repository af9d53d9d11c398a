"""Evolutions that draw every team anew from a distribution that they learn; beyond the paper.

The cross-entropy method and an evolution strategy. The MARL team takes the last place of a
generation and so is a sample like any other. Written plainly: both are a few lines over pytrees,
which a library of strategies would want flattened, and without a sample from elsewhere.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from race.algorithms import lineage
from race.algorithms.evolutions.base import Evolution
from race.algorithms.population import Population, fittest, met
from race.config.hyper import Hyper
from race.config.shape import Shape
from race.method.distributions import (
    ascent,
    centred_ranks,
    elite_weights,
    places,
    spread_around,
    weighted_mean,
)
from race.networks.optimization import Trainable, descend, init_trainable
from race.types import Spec, Team


class Gaussian(NamedTuple):
    """A distribution of teams, and how many generations were drawn from it."""

    mean: Team  # leaves [N, ...]
    variance: Team
    generations: Float[Array, ""]


def _init_cem(teams: Team) -> Gaussian:
    """That of the teams that are there."""
    mean = jax.tree.map(lambda leaf: jnp.mean(leaf, axis=0), teams)
    variance = jax.tree.map(lambda leaf: jnp.var(leaf, axis=0), teams)
    return Gaussian(mean, variance, jnp.zeros(()))


def _cem(
    population: Population,
    fitness: Float[Array, "P"],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> Population:
    """Mean and diagonal variance of the elites, to which a floor is added that decays."""
    old: Gaussian = population.memory
    weights = elite_weights(fitness, hyper.cem_elite_share)
    decay = hyper.cem_noise_decay**old.generations
    floor = hyper.cem_noise_end + (hyper.cem_noise_start - hyper.cem_noise_end) * decay
    new = Gaussian(
        weighted_mean(population.teams, weights),
        spread_around(population.teams, old.mean, weights, floor),
        old.generations + 1.0,
    )
    noise = _noise(key, population.teams)
    teams = jax.tree.map(
        lambda mean, variance, z: mean[None] + jnp.sqrt(variance)[None] * z,
        new.mean,
        new.variance,
        noise,
    )
    return _drawn(population, fitness, weights > 0, teams, spec)._replace(memory=new)


def _init_es(teams: Team) -> Trainable:
    """A mean among the teams that are there, with Adam's state."""
    return init_trainable(jax.tree.map(lambda leaf: jnp.mean(leaf, axis=0), teams))


def _es(
    population: Population,
    fitness: Float[Array, "P"],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> Population:
    """The mean climbs the estimated gradient by Adam; teams are mirrored pairs around it."""
    old: Trainable = population.memory
    uphill = ascent(population.teams, old.params, fitness, hyper.es_noise)
    downhill = jax.tree.map(jnp.negative, uphill)
    new = descend(old, downhill, hyper.es_learning_rate, jnp.inf)
    half = (shape.population_size + 1) // 2

    def mirrored(leaf: Array) -> Array:
        return jnp.concatenate([leaf[:half], -leaf[: leaf.shape[0] - half]])

    noise = jax.tree.map(mirrored, _noise(key, population.teams))
    teams = jax.tree.map(lambda mean, z: mean[None] + hyper.es_noise * z, new.params, noise)
    parents = centred_ranks(fitness) > 0
    return _drawn(population, fitness, parents, teams, spec)._replace(memory=new)


def _noise(key: PRNGKeyArray, teams: Team) -> Any:
    leaves, structure = jax.tree.flatten(teams)
    keys = jax.random.split(key, len(leaves))
    drawn = [jax.random.normal(k, leaf.shape) for k, leaf in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(structure, drawn)


def _drawn(
    population: Population,
    fitness: Float[Array, "P"],
    parents: Bool[Array, "P"],
    teams: Team,
    spec: Spec,
) -> Population:
    """The population of new teams; ``parents`` are those that the distribution moved towards."""
    population = fittest(population, fitness, jnp.argmin(places(fitness)))
    mask = jnp.asarray(spec.action_mask)[None, :, None]
    return met(population, parents)._replace(
        teams=teams._replace(heads=jnp.where(mask, teams.heads, 0.0)),
        worst=jnp.full((), fitness.shape[0] - 1, jnp.int32),
        record=lineage.replaced(population.record, jnp.ones(fitness.shape, bool), lineage.SAMPLED),
    )


cem = Evolution(_init_cem, _cem)
"""The cross-entropy method."""
es = Evolution(_init_es, _es)
"""An evolution strategy as in Salimans et al. (2017)."""

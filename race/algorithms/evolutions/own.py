"""An evolution of the user's own: a function named on the command line."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from race.algorithms import lineage
from race.algorithms.evolutions.base import Evolution
from race.algorithms.population import Population, fittest, met
from race.config.hyper import Hyper
from race.config.shape import Shape
from race.errors import ConfigError, blamed
from race.loading import own_function
from race.method.distributions import places
from race.types import Spec, Team

Operator = Callable[..., Any]
"""(heads [P, N, H + 1, A], fitness [P], key) -> heads; where whole teams evolve, of a `Team`."""

_HINT = (
    "Define one that takes heads [P, N, H + 1, A], fitness [P] and a random key, and returns heads "
    "of the same shape."
)


def evolution_by(name: str) -> Evolution:
    """The evolution by the function ``module:function``.

    Raises:
        ConfigError: if there is no such function.
    """
    operator: Operator = own_function(name, ConfigError, "Evolution", _HINT)

    def step(
        population: Population,
        fitness: Float[Array, "P"],
        key: PRNGKeyArray,
        spec: Spec,
        shape: Shape,
        hyper: Hyper,
    ) -> Population:
        return _step(operator, name, population, fitness, key, spec)

    return Evolution(lambda teams: None, step)


def _step(
    operator: Operator,
    name: str,
    population: Population,
    fitness: Float[Array, "P"],
    key: PRNGKeyArray,
    spec: Spec,
) -> Population:
    order = places(fitness)
    population = fittest(population, fitness, jnp.argmin(order))
    teams = _applied(operator, name, population.teams, fitness, key)
    # Padding stays what it is, whatever was made of it.
    mask = jnp.asarray(spec.action_mask)[None, :, None]
    teams = teams._replace(heads=jnp.where(mask, teams.heads, population.teams.heads))
    changed = jnp.zeros(fitness.shape, bool)
    for new, old in zip(*map(jax.tree.leaves, (teams, population.teams)), strict=True):
        changed = changed | jnp.any(new != old, axis=tuple(range(1, new.ndim)))
    # A team that it left alone has been chosen to live on.
    return met(population, ~changed)._replace(
        teams=teams,
        worst=jnp.argmax(order).astype(jnp.int32),
        record=lineage.replaced(population.record, changed, lineage.OWN),
    )


def _applied(
    operator: Operator, name: str, teams: Team, fitness: Float[Array, "P"], key: PRNGKeyArray
) -> Team:
    whole = teams.encoder is not None
    given: Any = teams if whole else teams.heads
    with blamed(ConfigError, f"Evolution {name} failed"):
        made = operator(given, fitness, key)
    structures: list[Any] = [jax.tree.structure(tree) for tree in (made, given)]
    if structures[0] != structures[1] or any(
        (jnp.shape(a), jnp.result_type(a)) != (b.shape, b.dtype)
        for a, b in zip(jax.tree.leaves(made), jax.tree.leaves(given), strict=True)
    ):
        found = jax.tree.map(lambda leaf: f"{jnp.result_type(leaf)}{list(jnp.shape(leaf))}", made)
        expected = jax.tree.map(lambda leaf: f"{leaf.dtype}{list(leaf.shape)}", given)
        raise ConfigError(
            f"Evolution {name} returned {found}; it must return teams as it was given them, "
            f"{expected}."
        )
    return made if whole else Team(None, made)

"""The paper's evolution: a genetic algorithm (Section 3.3)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from race.algorithms import lineage
from race.algorithms.evolutions.base import Evolution
from race.algorithms.population import Population, fittest, met
from race.config.hyper import Hyper
from race.config.shape import Shape
from race.method.crossover import breed, told_of_each_agent
from race.method.mutation import mutate_population
from race.method.selection import deal_places, select
from race.types import Spec, Team


def _init(teams: Team) -> None:
    return None


def evolve(
    population: Population,
    fitness: Float[Array, "P"],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> Population:
    """Selection, crossover and mutation; the elite stays as it is."""
    select_key, breed_key, mutate_key = jax.random.split(key, 3)
    mask = jnp.asarray(spec.action_mask)
    per_agent = shape.selection == "agent"
    chosen = select(fitness, shape.tournament_size, select_key, spec.n_agents, per_agent)
    if shape.places == "agent":
        chosen = deal_places(chosen, jax.random.fold_in(key, 3))
    population = fittest(population, fitness, chosen.elite)
    population = met(population, jnp.zeros(fitness.shape, bool).at[chosen.parent].set(True))
    made = breed(
        population.teams,
        chosen,
        mask,
        hyper.crossover_probability,
        breed_key,
        shape.elite_copy,
        shape.crossover,
    )
    if shape.places == "agent":
        made = told_of_each_agent(made)
    teams, changes = mutate_population(
        made.teams, chosen.elite, mask, hyper, mutate_key, shape.mutation_draw, shape.mutation
    )
    return population._replace(
        teams=teams,
        worst=chosen.worst.astype(jnp.int32),
        record=lineage.bred(population.record, made, changes, chosen.elite, fitness),
    )


ga = Evolution(_init, evolve)
"""The genetic algorithm."""

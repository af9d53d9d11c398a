"""A population of teams, the same whatever of a team evolves.

What evolves is a `race.types.Team`: the heads alone in RACE, whole networks elsewhere. How it
evolves is in `race.algorithms.evolutions`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from race.algorithms import lineage
from race.algorithms.lineage import Record, first_record
from race.config.hyper import Hyper
from race.method.crossover import inject
from race.types import Team


class Population(NamedTuple):
    """The teams, their roles in the last evolution, and where they come from."""

    teams: Team  # leaves [P, N, ...]
    champion: Team  # that of the highest fitness, as it played, whatever its heads learn later
    elite: Int[Array, ""]  # where it is, or was if the evolution keeps no teams
    worst: Int[Array, ""]  # the place that the MARL team takes
    injected: Int[Array, ""]  # where the MARL team was put last, -1 before the first time
    injection_counts: Int[Array, "3"]  # of the MARL team's fates: elite, parent, discarded
    record: Record
    memory: Any  # what the evolution remembers besides the teams


def population_of(state: Any) -> Population:
    """That of an algorithm's state which has one."""
    found: Population = state.population
    return found


def new_population(teams: Team, memory: Any) -> Population:
    """A population that has not played yet."""
    size, n_agents = teams.heads.shape[:2]
    return Population(
        teams=teams,
        champion=_of(teams, jnp.zeros((), jnp.int32)),
        elite=jnp.zeros((), jnp.int32),
        worst=jnp.zeros((), jnp.int32),
        injected=jnp.full((), -1, jnp.int32),
        injection_counts=jnp.zeros(3, jnp.int32),
        record=first_record(size, n_agents),
        memory=memory,
    )


def _of(teams: Team, place: Int[Array, ""]) -> Team:
    team: Team = jax.tree.map(lambda leaf: leaf[place], teams)
    return team


def fittest(
    population: Population, fitness: Float[Array, "P"], elite: Int[Array, ""]
) -> Population:
    """The population whose champion is the team at ``elite``; children are compared with parents.

    To be called with the teams that have played, before they evolve.
    """
    return population._replace(
        champion=_of(population.teams, elite),
        elite=elite.astype(jnp.int32),
        record=lineage.played(population.record, fitness),
    )


def met(population: Population, parents: Bool[Array, "P"]) -> Population:
    """The population with the fate of the injected team counted: elite, parent or discarded."""
    there = population.injected >= 0
    is_elite = population.injected == population.elite
    is_parent = ~is_elite & parents[population.injected] & there
    fate = jnp.stack([is_elite, is_parent, there & ~is_elite & ~is_parent]).astype(jnp.int32)
    return population._replace(injection_counts=population.injection_counts + fate)


def inject_team(population: Population, team: Team, key: PRNGKeyArray, hyper: Hyper) -> Population:
    """Line 11: the MARL team takes the worst team's place (never the elite's)."""
    happens = jax.random.uniform(key) < hyper.injection_probability
    place = population.worst
    entered = population._replace(
        teams=inject(population.teams, team, place),
        injected=place,
        record=lineage.injected(population.record, place),
    )
    left_out = population._replace(injected=jnp.full_like(place, -1))
    result: Population = jax.tree.map(
        lambda new, old: jnp.where(happens, new, old), entered, left_out
    )
    return result

"""How a population evolves: genetics, the cross-entropy method, evolution strategies, your own.

Teams and their fitness in, teams out. An evolution is added as a module here and a line in
`EVOLUTIONS`.
"""

from typing import Any

from jaxtyping import Array, Float, PRNGKeyArray

from race.algorithms.evolutions import distribution, genetic, own
from race.algorithms.evolutions.base import Evolution
from race.algorithms.population import Population, new_population
from race.config.hyper import Hyper
from race.config.settings import EVOLUTIONS as NAMES
from race.config.shape import Shape
from race.types import Spec, Team

EVOLUTIONS: dict[str, Evolution] = {
    "ga": genetic.ga,
    "cem": distribution.cem,
    "es": distribution.es,
}
assert tuple(EVOLUTIONS) == NAMES


def evolution_of(name: str) -> Evolution:
    """The evolution of a name; other names are functions of the user's own.

    Raises:
        ConfigError: if there is no such function.
    """
    return EVOLUTIONS[name] if name in EVOLUTIONS else own.evolution_by(name)


def start(teams: Team, spec: Spec, shape: Shape) -> Population:
    """A population of fresh teams."""
    memory: Any = evolution_of(shape.evolution).init(teams)
    return new_population(teams, memory)


def evolve(
    population: Population,
    fitness: Float[Array, "P"],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> Population:
    """Line 9 of Algorithm 1: the next generation of teams."""
    return evolution_of(shape.evolution).step(population, fitness, key, spec, shape, hyper)


__all__ = ["EVOLUTIONS", "Evolution", "evolution_of", "evolve", "start"]

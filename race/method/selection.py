"""Selection of a generation (Section 3.3): who reproduces, by fitness.

Fitness that is NaN never wins: it counts as minus infinity everywhere.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray


class Selection(NamedTuple):
    """Who reproduces: the roles of the teams of a generation.

    The second parent, and so who gives way to offspring, may be another one for each agent.
    """

    elite: Int[Array, ""]  # team of the highest fitness
    parent: Int[Array, "N"]  # winner of the tournament, never the elite
    replaced: Int[Array, "P-2 N"]  # all other teams, in the order in which they give way
    worst: Int[Array, ""]  # team of the lowest fitness


def rank(fitness: Float[Array, "P"], key: PRNGKeyArray) -> Int[Array, "P"]:
    """Teams from the fittest to the least fit; ties, and NaN with -inf, are ordered at random."""
    order = jax.random.permutation(key, fitness.shape[0])
    shuffled = fitness[order]
    keys = jnp.where(jnp.isnan(shuffled), jnp.inf, -shuffled)
    return order[jnp.argsort(keys, stable=True)]


def select(
    fitness: Float[Array, "P"],
    tournament_size: int,
    key: PRNGKeyArray,
    n_agents: int = 1,
    per_agent: bool = False,
) -> Selection:
    """Elite selection and the tournament for the second parent.

    The others give way from the fittest to the least fit.

    The tournament is held among the teams that are not the elite, drawn without replacement, so
    that crossover always has two different parents.

    Args:
        fitness: undiscounted episode returns, one per team; at least 3 teams.
        tournament_size: entrants of the tournament (the paper: 3), all teams at the most.
        key: random key.
        n_agents: agents of a team.
        per_agent: whether each agent has a tournament of its own, or one is for all.
    """
    rank_key, tournament_key = jax.random.split(key)
    ranked = rank(fitness, rank_key)
    others = ranked[1:]
    n_others = others.shape[0]

    def tournament(key: PRNGKeyArray) -> tuple[Int[Array, ""], Int[Array, "rest"]]:
        entrants = jax.random.permutation(key, n_others)[: min(tournament_size, n_others)]
        winner = jnp.min(entrants)  # ranked: the smallest place is the fittest
        # The places behind and before the winner, in order.
        places = jnp.arange(n_others - 1)
        return others[winner], others[places + (places >= winner).astype(places.dtype)]

    if per_agent:
        parent, rest = jax.vmap(tournament)(jax.random.split(tournament_key, n_agents))
    else:
        winner, behind = tournament(tournament_key)
        parent = jnp.broadcast_to(winner, (n_agents,))
        rest = jnp.broadcast_to(behind, (n_agents, n_others - 1))
    return Selection(ranked[0], parent, rest.T, ranked[-1])


def deal_places(chosen: Selection, key: PRNGKeyArray) -> Selection:
    """The same roles with places that give way in a random order, for each agent another.

    What is bred for the first of them, the second and so on (`race.method.crossover.breed`) then
    comes into another team for each agent. The paper leaves open whether it does; elite, second
    parent and the place of the lowest fitness are as they were.
    """
    keys = jax.random.split(key, chosen.replaced.shape[1])
    dealt = jax.vmap(jax.random.permutation, in_axes=(0, 1), out_axes=1)(keys, chosen.replaced)
    return chosen._replace(replaced=dealt)

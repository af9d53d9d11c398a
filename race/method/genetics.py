"""Agent-level genetic operators on policy representations (Section 3.3).

Each operator is written for one team or one pair of teams and vmapped over what is needed. A team
is an array of heads ``[N, H + 1, A]``: the last row holds the biases. Fitness that is NaN never
wins: it counts as minus infinity everywhere.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from race.config.hyper import Number
from race.config.settings import MutationDraw

Head = Float[Array, "N H1 A"]
Heads = Float[Array, "P N H1 A"]

# Of the weights that mutate, this share is perturbed strongly, and another such share is redrawn;
# the rest is perturbed weakly. Shares and strengths are those of the genetic algorithm that the
# paper takes over unchanged (Appendix A.1).
STRONG_SHARE = 0.05
RESET_SHARE = 0.05
STRONG_STRENGTH = 10.0
WEAK_STRENGTH = 0.1

# Strong perturbations multiply, so that without a bound some weights of a long line of teams grow
# to thousands and more. Behind a tanh that means no more than 10 does, but the PeVFA, which reads
# the weights, would diverge. The paper has no bound.
LARGEST_WEIGHT = 10.0


class Selection(NamedTuple):
    """Who reproduces: the roles of the teams of a generation."""

    elite: Int[Array, ""]  # team of the highest fitness
    parent: Int[Array, ""]  # winner of the tournament, never the elite
    replaced: Int[Array, "P-2"]  # all other teams, from the fittest to the least fit
    worst: Int[Array, ""]  # team of the lowest fitness


def rank(fitness: Float[Array, "P"], key: PRNGKeyArray) -> Int[Array, "P"]:
    """Teams from the fittest to the least fit; ties, and NaN with -inf, are ordered at random."""
    order = jax.random.permutation(key, fitness.shape[0])
    shuffled = fitness[order]
    keys = jnp.where(jnp.isnan(shuffled), jnp.inf, -shuffled)
    return order[jnp.argsort(keys, stable=True)]


def select(fitness: Float[Array, "P"], tournament_size: int, key: PRNGKeyArray) -> Selection:
    """Elite selection and the tournament for the second parent.

    The tournament is held among the teams that are not the elite, drawn without replacement, so
    that crossover always has two different parents.

    Args:
        fitness: undiscounted episode returns, one per team; at least 3 teams.
        tournament_size: entrants of the tournament (the paper: 3), all teams at the most.
        key: random key.
    """
    rank_key, tournament_key = jax.random.split(key)
    ranked = rank(fitness, rank_key)
    others = ranked[1:]
    n_others = others.shape[0]
    entrants = jax.random.permutation(tournament_key, n_others)[: min(tournament_size, n_others)]
    winner = jnp.min(entrants)  # ranked: the smallest place is the fittest
    # The places behind and before the winner, in order.
    places = jnp.arange(n_others - 1)
    rest = others[places + (places >= winner).astype(places.dtype)]
    return Selection(ranked[0], others[winner], rest, ranked[-1])


def crossover(first: Head, second: Head, key: PRNGKeyArray) -> tuple[Head, Head]:
    """Agent-level crossover: the parents with the heads of random agents exchanged.

    ``(W_i - W_i^{d_i}) u W_j^{d_i}`` and ``(W_j - W_j^{d_j}) u W_i^{d_j}``: each offspring takes
    the heads of a random subset d of agents from the other parent. Subsets are drawn
    independently, neither empty nor, for two agents or more, everybody, so that an offspring is
    a copy of neither parent.
    """
    n = first.shape[0]
    first_key, second_key = jax.random.split(key)
    into_first = _subset(first_key, n)[:, None, None]
    into_second = _subset(second_key, n)[:, None, None]
    return jnp.where(into_first, second, first), jnp.where(into_second, first, second)


def _subset(key: PRNGKeyArray, n: int) -> Bool[Array, "n"]:
    """A random subset of n agents, of uniform size from 1 to max(1, n - 1)."""
    size_key, order_key = jax.random.split(key)
    size = jax.random.randint(size_key, (), 1, max(2, n))
    return jax.random.permutation(order_key, n) < size


def mutate_agent(
    weights: Float[Array, "H1 A"],
    mask: Bool[Array, "A"],
    fraction: Number,
    key: PRNGKeyArray,
    draw: MutationDraw,
) -> Float[Array, "H1 A"]:
    """Perturbs one agent's head, the function P of Section 3.3.

    In each action's row of weights w, ``fraction`` (the paper's alpha) of the entries change in
    expectation: as many as the whole part of alpha times inputs, and one more with the probability
    of the rest. A change is mild, by N(0, (0.1 w)^2), or with probability 0.05 strong, by
    N(0, (10 w)^2), or with probability 0.05 a reset to N(0, 1). What changes is kept within
    `LARGEST_WEIGHT`. Biases and padding stay.

    Args:
        weights: the head; the last row holds the biases.
        mask: the actions that are not padding.
        fraction: alpha, in [0, 1].
        key: random key.
        draw: whether the kind of change is drawn once per action row or once per weight.
    """
    count_key, pick_key, kind_key, noise_key = jax.random.split(key, 4)
    w = weights[:-1]
    expected = fraction * jnp.asarray(w.shape[0], w.dtype)
    whole = jnp.floor(expected)
    one_more = jax.random.uniform(count_key, w.shape[1:]) < expected - whole
    n_picked = whole + one_more.astype(w.dtype)
    order = jnp.argsort(jax.random.uniform(pick_key, w.shape), axis=0)
    picked = jnp.argsort(order, axis=0).astype(w.dtype) < n_picked[None]
    kind = jax.random.uniform(kind_key, w.shape if draw == "weight" else (1, w.shape[1]))
    kind = jnp.broadcast_to(kind, w.shape)
    noise = jax.random.normal(noise_key, w.shape)
    strength = jnp.where(kind < STRONG_SHARE, STRONG_STRENGTH, WEAK_STRENGTH)
    perturbed = w + noise * strength * jnp.abs(w)
    reset = (kind >= STRONG_SHARE) & (kind < STRONG_SHARE + RESET_SHARE)
    mutated = jnp.clip(jnp.where(reset, noise, perturbed), -LARGEST_WEIGHT, LARGEST_WEIGHT)
    mutated = jnp.where(picked & mask[None], mutated, w)
    return jnp.concatenate([mutated, weights[-1:]], axis=0)


def mutate(
    team: Head,
    mask: Bool[Array, "N A"],
    fraction: Number,
    agent_probability: Number,
    key: PRNGKeyArray,
    draw: MutationDraw,
) -> Head:
    """Agent-level mutation: each agent is picked with ``agent_probability``, at least one is."""
    n = team.shape[0]
    pick_key, one_key, mutate_key = jax.random.split(key, 3)
    picked = jax.random.uniform(pick_key, (n,)) < agent_probability
    picked = picked | (~jnp.any(picked) & (jnp.arange(n) == jax.random.randint(one_key, (), 0, n)))
    mutated = jax.vmap(mutate_agent, in_axes=(0, 0, None, 0, None))(
        team, mask, fraction, jax.random.split(mutate_key, n), draw
    )
    return jnp.where(picked[:, None, None], mutated, team)


def breed(heads: Heads, chosen: Selection, key: PRNGKeyArray, elite_copy: bool) -> Heads:
    """Fills the places of the teams that are neither elite nor parent.

    From the fittest of these places down: with ``elite_copy`` a copy of the elite, then offspring
    of elite and parent. Each crossover gives two offspring, and there are as many crossovers as
    it takes.
    """
    places = chosen.replaced
    if elite_copy:
        heads = heads.at[places[0]].set(heads[chosen.elite])
        places = places[1:]
    n_replaced = places.shape[0]
    keys = jax.random.split(key, (n_replaced + 1) // 2)
    first, second = jax.vmap(crossover, in_axes=(None, None, 0))(
        heads[chosen.elite], heads[chosen.parent], keys
    )
    offspring = jnp.stack([first, second], axis=1).reshape(-1, *heads.shape[1:])
    return heads.at[places].set(offspring[:n_replaced])


def mutate_population(
    heads: Heads,
    elite: Int[Array, ""],
    mask: Bool[Array, "N A"],
    fraction: Number,
    team_probability: Number,
    agent_probability: Number,
    key: PRNGKeyArray,
    draw: MutationDraw,
) -> Heads:
    """Mutates each team but the elite with ``team_probability``."""
    n = heads.shape[0]
    pick_key, mutate_key = jax.random.split(key)
    picked = (jax.random.uniform(pick_key, (n,)) < team_probability) & (jnp.arange(n) != elite)
    mutated = jax.vmap(mutate, in_axes=(0, None, None, None, 0, None))(
        heads, mask, fraction, agent_probability, jax.random.split(mutate_key, n), draw
    )
    return jnp.where(picked[:, None, None, None], mutated, heads)


def inject(heads: Heads, marl_head: Head, place: Int[Array, ""]) -> Heads:
    """Puts the MARL team's heads into the population at ``place``."""
    return heads.at[place].set(marl_head)

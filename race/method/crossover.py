"""Crossover (Section 3.3): teams that are made of two others.

Each operator is written for one pair of teams and vmapped over what is needed. What of a team
evolves is a `race.types.Team`: all leaves begin with the agents' axis. A *row* is what leads to one
output of a layer: its weights and, in a head, its bias.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from race.config.hyper import Number
from race.config.settings import Level
from race.method.selection import Selection
from race.types import Team

Exchange = Callable[..., tuple[Any, Any]]
"""(first, second, mask, key) -> the first team with parts of the second, and per agent the share of
its rows that are the second's."""


class Bred(NamedTuple):
    """A new generation of teams, and where each agent's policy comes from, by places of old."""

    teams: Any  # leaves [P, N, ...]
    first: Int[Array, "P N"]
    second: Int[Array, "P N"]  # the first again where there is no other
    share: Float[Array, "P N"]  # of rows that are the second's


def exchange_agents(
    first: Team, second: Team, mask: Bool[Array, "N A"], key: PRNGKeyArray
) -> tuple[Team, Float[Array, "N"]]:
    """Agent-level crossover: ``(W_i - W_i^d) u W_j^d``, a random subset d of agents exchanged.

    The subset is neither empty nor, for two agents or more, everybody, so that an offspring is a
    copy of neither parent.
    """
    n = mask.shape[0]
    taken = _subset(key, n)
    child = jax.tree.map(
        lambda own, other: jnp.where(taken.reshape(n, *[1] * (own.ndim - 1)), other, own),
        first,
        second,
    )
    return child, taken.astype(jnp.float32)


def _subset(key: PRNGKeyArray, n: int) -> Bool[Array, "n"]:
    """A random subset of n agents, of uniform size from 1 to max(1, n - 1)."""
    size_key, order_key = jax.random.split(key)
    size = jax.random.randint(size_key, (), 1, max(2, n))
    return jax.random.permutation(order_key, n) < size


def exchange_rows(
    first: Team, second: Team, mask: Bool[Array, "N A"], key: PRNGKeyArray, some_layers: bool
) -> tuple[Team, Float[Array, "N"]]:
    """Crossover with no regard to agents: random rows of whole teams exchanged.

    Of every layer, which is that of all agents together, a random set of rows, of uniform size from
    1 to all but one. With ``some_layers`` layers take part with probability one half, one at the
    least.
    """
    own, structure = jax.tree.flatten(first)
    others = jax.tree.leaves(second)
    takes_part = jnp.ones(len(own), bool)
    layer_key, key = jax.random.split(key)
    if some_layers:
        takes_part = at_least_one(layer_key, (len(own),), 0.5)
    children, rows, taken_rows = [], jnp.zeros(mask.shape[0]), jnp.zeros(mask.shape[0])
    for index, (leaf, other) in enumerate(zip(own, others, strict=True)):
        # The heads are the last leaf; rows of padding in them are none.
        real = mask if index == len(own) - 1 else jnp.ones((leaf.shape[0], leaf.shape[-1]), bool)
        taken = _some_rows(jax.random.fold_in(key, index), real) & takes_part[index]
        spread = taken.reshape(leaf.shape[0], *[1] * (leaf.ndim - 2), leaf.shape[-1])
        children.append(jnp.where(spread, other, leaf))
        rows = rows + jnp.sum(real.astype(jnp.float32), axis=1)
        taken_rows = taken_rows + jnp.sum(taken.astype(jnp.float32), axis=1)
    return jax.tree.unflatten(structure, children), taken_rows / rows


def _some_rows(key: PRNGKeyArray, real: Bool[Array, "N o"]) -> Bool[Array, "N o"]:
    size_key, order_key = jax.random.split(key)
    size = jax.random.randint(size_key, (), 1, jnp.maximum(2, jnp.sum(real)))
    lots = jnp.where(real, jax.random.uniform(order_key, real.shape), jnp.inf).ravel()
    place = jnp.argsort(jnp.argsort(lots))
    return (place < size).reshape(real.shape)


def at_least_one(
    key: PRNGKeyArray, shape: tuple[int, ...], probability: Number
) -> Bool[Array, "*shape"]:
    """Draws each with a probability; where none comes out, one of them."""
    pick_key, one_key = jax.random.split(key)
    picked = jax.random.uniform(pick_key, shape) < probability
    size = picked.size
    one = (jnp.arange(size) == jax.random.randint(one_key, (), 0, size)).reshape(shape)
    return picked | (~jnp.any(picked) & one)


EXCHANGES: dict[Level, Exchange] = {
    "agent": exchange_agents,
    "parameter": partial(exchange_rows, some_layers=False),
    "layer": partial(exchange_rows, some_layers=True),
}
"""By level. ``layer`` is that of Khadka and Tumer (2018), for whole networks."""


def at_places(teams: Any, places: Int[Array, "K N"]) -> Any:
    """The teams made of agent i of the team at ``places[k, i]``."""
    agents = jnp.arange(places.shape[1])[None]
    return jax.tree.map(lambda leaf: leaf[places, agents], teams)


def breed(
    teams: Team,
    chosen: Selection,
    mask: Bool[Array, "N A"],
    probability: Number,
    key: PRNGKeyArray,
    elite_copy: bool,
    level: Level,
) -> Bred:
    """Fills the places of the teams that are neither elite nor parent.

    In the order of these places, for each agent its own: with ``elite_copy`` a copy of the elite,
    then offspring of elite and parent. Each crossover gives two offspring, one that begins as the
    elite and one as the parent, and there are as many crossovers as it takes.

    Args:
        teams: the population, leaves [P, N, ...].
        chosen: who reproduces.
        mask: the actions that are not padding.
        probability: of a crossover; without one the two are copies of their parents.
        key: random key.
        elite_copy: whether there is a copy of the elite.
        level: of what is exchanged.
    """
    agents = jnp.arange(mask.shape[0])[None]
    size = chosen.replaced.shape[0] + 2
    elite = jnp.broadcast_to(chosen.elite, chosen.parent.shape)
    own = jnp.broadcast_to(jnp.arange(size)[:, None], (size, mask.shape[0]))
    places, first = chosen.replaced, own
    if elite_copy:
        first = first.at[places[0], agents[0]].set(elite)
        places = places[1:]
    count = places.shape[0]
    pairs = (count + 1) // 2
    keys = jax.random.split(key, pairs)
    happens = jax.random.uniform(jax.random.fold_in(key, pairs), (pairs,)) < probability
    # Of each pair's two offspring.
    child_keys = jax.vmap(jax.random.split)(keys).reshape(-1)[:count]
    happens = jnp.repeat(happens, 2)[:count]
    of_elite = (jnp.arange(count) % 2 == 0)[:, None]
    begins = jnp.where(of_elite, elite[None], chosen.parent[None])
    gives = jnp.where(of_elite, chosen.parent[None], elite[None])
    bases, others = at_places(teams, begins), at_places(teams, gives)
    children, share = jax.vmap(EXCHANGES[level], in_axes=(0, 0, None, 0))(
        bases, others, mask, child_keys
    )

    def if_it_happens(child: Array, base: Array) -> Array:
        return jnp.where(happens.reshape(-1, *[1] * (child.ndim - 1)), child, base)

    children = jax.tree.map(if_it_happens, children, bases)
    share = jnp.where(happens[:, None], share, 0.0)
    copied = at_places(teams, first)
    return Bred(
        jax.tree.map(lambda leaf, child: leaf.at[places, agents].set(child), copied, children),
        first.at[places, agents].set(begins),
        first.at[places, agents].set(jnp.where(happens[:, None], gives, begins)),
        jnp.zeros(own.shape).at[places, agents].set(share),
    )


def told_of_each_agent(made: Bred) -> Bred:
    """The same, where an agent whose policy is one team's alone has no second.

    Where places were dealt to each agent, a team has agents of several offspring, and all of them
    may be one parent's: it is a copy then.
    """
    whole, none = made.share == 1, made.share == 0
    first = jnp.where(whole, made.second, made.first)
    second = jnp.where(whole | none, first, made.second)
    return made._replace(first=first, second=second, share=jnp.where(whole, 0.0, made.share))


def inject(teams: Team, team: Team, place: Int[Array, ""]) -> Team:
    """Puts a team into the population at ``place``."""
    injected: Team = jax.tree.map(lambda leaf, new: leaf.at[place].set(new), teams, team)
    return injected

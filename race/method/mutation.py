"""Mutation (Section 3.3): random changes of a team's weights.

Each operator is written for one layer, agent or team and vmapped over what is needed. Biases and
padding stay as they are. ``Kinds`` are the numbers of weights that a mutation changed strongly,
drew anew and changed mildly.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from race.config.hyper import Hyper, Number
from race.config.settings import Level, MutationDraw
from race.method.crossover import at_least_one
from race.types import Team

Kinds = Int[Array, "*n 3"]

STEPS = 23
"""Bits of a uniform random number in float32."""
SLICE = 16
"""Numbers that are counted at once."""


def smallest(lots: Float[Array, "i o"], count: Int[Array, "o"]) -> Bool[Array, "i o"]:
    """The ``count`` smallest of each column; of equal ones the first.

    Args:
        lots: uniform random numbers of `jax.random.uniform`, multiples of ``2**-23`` in [0, 1).
        count: from 0 to i.
    """
    # A bisection: sorting takes ten times as long. What fills the slices up is larger than all.
    size = lots.shape[0]
    whole = _columns((lots * 2.0**STEPS).astype(jnp.int32), 1 << STEPS)

    def narrow(step: Int[Array, ""], bound: Int[Array, "o"]) -> Int[Array, "o"]:
        trial = bound | jax.lax.shift_left(jnp.int32(1), STEPS - 1 - step)
        return jnp.where(_how_many(whole < trial[:, None]) < count, trial, bound)

    bound = jax.lax.fori_loop(0, STEPS, narrow, jnp.zeros(count.shape, jnp.int32))
    equal, place = whole == bound[:, None], jnp.arange(whole.shape[1])[None]

    # Hardly ever are there too many, and a cumulative sum takes longer than the bisection.
    def drop_last(surplus: tuple[Any, Any]) -> tuple[Any, Any]:
        too_many, end = surplus
        last = jnp.max(jnp.where(equal & (place < end[:, None]), place, -1), axis=1)
        return too_many - 1, jnp.where(too_many > 0, last, end)

    surplus = _how_many(whole <= bound[:, None]) - count, jnp.full(count.shape, size)
    _, end = jax.lax.while_loop(lambda surplus: jnp.any(surplus[0] > 0), drop_last, surplus)
    return ((whole < bound[:, None]) | (equal & (place < end[:, None])))[:, :size].T


def _columns(x: Array, added: int | bool = False) -> Array:
    """The columns of ``[..., i, o]`` as rows, filled up with what is added to whole slices."""
    rows = jnp.swapaxes(x, -1, -2)
    padding = [(0, 0)] * (x.ndim - 1) + [(0, -rows.shape[-1] % SLICE)]
    return jnp.pad(rows, padding, constant_values=added)


def _how_many(which: Bool[Array, "*o k"]) -> Int[Array, "*o"]:
    """How many along the last axis, one of `_columns`.

    Slice is added to slice: on processors the compiler's own sum takes four times as long.
    """
    slices = [which[..., k : k + SLICE] for k in range(0, which.shape[-1], SLICE)]
    return jnp.sum(sum(part.astype(jnp.int32) for part in slices), axis=-1)


def change(
    w: Float[Array, "i o"],
    picked: Bool[Array, "i o"],
    hyper: Hyper,
    kind_key: PRNGKeyArray,
    noise_key: PRNGKeyArray,
    draw: MutationDraw,
) -> tuple[Float[Array, "i o"], Kinds]:
    """The perturbation P of Section 3.3 of the picked weights of a layer.

    A change is mild, by N(0, (0.1 w)^2), or with probability 0.05 strong, by N(0, (10 w)^2), or
    with probability 0.05 a reset to N(0, 1): shares and strengths, numbers of ``hyper``, are those
    of the genetic algorithm that the paper takes over unchanged (Appendix A.1). What changes is
    kept within ``hyper.largest_weight``.

    Args:
        w: weights, one column for each output.
        picked: which change.
        hyper: the numbers.
        kind_key: random key of the kinds.
        noise_key: random key of the changes.
        draw: whether the kind of change is drawn once per column, an action's row, or per weight.
    """
    lot = jax.random.uniform(kind_key, w.shape if draw == "weight" else (1, w.shape[1]))
    lot = jnp.broadcast_to(lot, w.shape)
    noise = jax.random.normal(noise_key, w.shape)
    strong = lot < hyper.strong_share
    reset = ~strong & (lot < hyper.strong_share + hyper.reset_share)
    strength = jnp.where(strong, hyper.strong_strength, hyper.mild_strength)
    # Strong perturbations multiply, so that without a bound some weights of a long line of teams
    # grow to thousands and more. Behind a tanh that means no more than 10 does, but the PeVFA,
    # which reads the weights, would diverge. The paper has no bound.
    largest = hyper.largest_weight
    mutated = jnp.clip(
        jnp.where(reset, noise, w + noise * strength * jnp.abs(w)), -largest, largest
    )
    # Where a column has one kind it is counted once.
    of_kind = jnp.stack([strong, reset, ~strong & ~reset])
    if draw == "weight":
        kinds = _how_many(_columns(picked[None] & of_kind))
    else:
        kinds = jnp.where(of_kind[:, 0], _how_many(_columns(picked))[None], 0)
    return jnp.where(picked, mutated, w), jnp.sum(kinds, axis=1)


def mutate_layer(
    w: Float[Array, "i o"],
    mask: Bool[Array, "o"],
    hyper: Hyper,
    key: PRNGKeyArray,
    draw: MutationDraw,
) -> tuple[Float[Array, "i o"], Kinds]:
    """Perturbs a layer of one agent: in each column the same share of weights.

    ``hyper.mutation_fraction`` (the paper's alpha) of the entries change in expectation: as many as
    the whole part of alpha times inputs, and one more with the probability of the rest.
    """
    count_key, pick_key, kind_key, noise_key = jax.random.split(key, 4)
    expected = hyper.mutation_fraction * jnp.asarray(w.shape[0], w.dtype)
    whole = jnp.floor(expected)
    one_more = jax.random.uniform(count_key, w.shape[1:]) < expected - whole
    count = whole.astype(jnp.int32) + one_more.astype(jnp.int32)
    picked = smallest(jax.random.uniform(pick_key, w.shape), count)
    return change(w, picked & mask[None], hyper, kind_key, noise_key, draw)


def mutate_agents(
    team: Team, mask: Bool[Array, "N A"], hyper: Hyper, key: PRNGKeyArray, draw: MutationDraw
) -> tuple[Team, Kinds]:
    """Agent-level mutation: each agent is picked with a probability, at least one is."""
    n = mask.shape[0]
    pick_key, one_key, mutate_key = jax.random.split(key, 3)
    picked = jax.random.uniform(pick_key, (n,)) < hyper.agent_mutation_probability
    picked = picked | (~jnp.any(picked) & (jnp.arange(n) == jax.random.randint(one_key, (), 0, n)))
    keys = jax.random.split(mutate_key, n)

    def mutate(w: Array, real: Array, index: int) -> Any:
        # Heads, the last leaf, have the agents' own keys.
        own = keys if index == 0 else jax.vmap(lambda key: jax.random.fold_in(key, 3 + index))(keys)
        return jax.vmap(mutate_layer, in_axes=(0, 0, None, 0, None))(w, real, hyper, own, draw)

    mutated, kinds = _on_weights(mutate, team, mask)
    mutated = jax.tree.map(
        lambda new, old: jnp.where(picked.reshape(n, *[1] * (old.ndim - 1)), new, old),
        mutated,
        team,
    )
    return mutated, jnp.where(picked[:, None], kinds, 0)


def mutate_parameters(
    team: Team, mask: Bool[Array, "N A"], hyper: Hyper, key: PRNGKeyArray, draw: MutationDraw
) -> tuple[Team, Kinds]:
    """Mutation with no regard to agents: weights drawn over the whole team.

    In expectation as many as `mutate_agents` changes: alpha times the share of agents it picks.
    """
    n, p = mask.shape[0], hyper.agent_mutation_probability
    agents = p + (1.0 - p) ** n / n
    return _spread(team, mask, hyper, hyper.mutation_fraction * agents, key, draw)


def mutate_layers(
    team: Team, mask: Bool[Array, "N A"], hyper: Hyper, key: PRNGKeyArray, draw: MutationDraw
) -> tuple[Team, Kinds]:
    """Mutation of whole networks (Khadka and Tumer 2018): weights drawn over random layers.

    Each layer of each agent is picked with ``hyper.agent_mutation_probability``, at least one is.
    """
    pick_key, key = jax.random.split(key)
    layers = sum(_is_layer(leaf) for leaf in jax.tree.leaves(team))
    shape = (layers, mask.shape[0])
    picked = at_least_one(pick_key, shape, hyper.agent_mutation_probability)
    share = jnp.where(picked, hyper.mutation_fraction, 0.0)
    return _spread(team, mask, hyper, share, key, draw)


def _spread(
    team: Team,
    mask: Bool[Array, "N A"],
    hyper: Hyper,
    share: Number | Float[Array, "layers N"],
    key: PRNGKeyArray,
    draw: MutationDraw,
) -> tuple[Team, Kinds]:
    """Each weight changes with the probability ``share``, of all or of each layer of each agent."""

    def mutate(w: Array, real: Array, index: int) -> Any:
        pick_key, kind_key, noise_key = jax.random.split(jax.random.fold_in(key, index), 3)
        n = w.shape[0]
        limit = share[index] if isinstance(share, jax.Array) and share.ndim else share
        limit = jnp.broadcast_to(jnp.asarray(limit), (n,))
        picked = (jax.random.uniform(pick_key, w.shape) < limit[:, None, None]) & real[:, None]
        keys = jax.random.split(kind_key, n), jax.random.split(noise_key, n)
        return jax.vmap(change, in_axes=(0, 0, None, 0, 0, None))(w, picked, hyper, *keys, draw)

    return _on_weights(mutate, team, mask)


def _is_layer(leaf: Array) -> bool:
    return leaf.ndim == 3


def _on_weights(
    mutate: Callable[[Array, Array, int], Any], team: Team, mask: Bool[Array, "N A"]
) -> tuple[Team, Kinds]:
    """A mutation of the weights of every layer, ``[N, i, o]``; they are numbered, heads are 0.

    Heads have their biases in their last row; those of other layers are leaves of their own.
    """
    leaves, structure = jax.tree.flatten(team)
    *networks, heads = leaves
    weights, kinds = mutate(heads[:, :-1], mask, 0)
    heads = jnp.concatenate([weights, heads[:, -1:]], axis=1)
    changed, index = [], 0
    for leaf in networks:
        if _is_layer(leaf):
            index += 1
            real = jnp.ones((leaf.shape[0], leaf.shape[2]), bool)
            leaf, more = mutate(leaf, real, index)
            kinds = kinds + more
        changed.append(leaf)
    return jax.tree.unflatten(structure, [*changed, heads]), kinds


MUTATIONS: dict[Level, Any] = {
    "agent": mutate_agents,
    "parameter": mutate_parameters,
    "layer": mutate_layers,
}


def mutate_population(
    teams: Team,
    elite: Int[Array, ""],
    mask: Bool[Array, "N A"],
    hyper: Hyper,
    key: PRNGKeyArray,
    draw: MutationDraw,
    level: Level,
) -> tuple[Team, Int[Array, "P N 3"]]:
    """Mutates each team but the elite with ``hyper.mutation_probability``.

    Returns:
        The teams, and how many weights of each agent changed, by kind.
    """
    n = teams.heads.shape[0]
    pick_key, mutate_key = jax.random.split(key)
    lots = jax.random.uniform(pick_key, (n,))
    picked = (lots < hyper.mutation_probability) & (jnp.arange(n) != elite)
    operator = MUTATIONS[level]
    mutated, kinds = jax.vmap(lambda team, key: operator(team, mask, hyper, key, draw))(
        teams, jax.random.split(mutate_key, n)
    )
    teams = jax.tree.map(
        lambda new, old: jnp.where(picked.reshape(n, *[1] * (old.ndim - 1)), new, old),
        mutated,
        teams,
    )
    return teams, jnp.where(picked[:, None, None], kinds, 0)

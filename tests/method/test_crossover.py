"""Crossover and injection against their definitions."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from frequencies import KEYS, assert_frequency

from race.method import crossover
from race.method.selection import Selection, deal_places
from race.types import Team

TEAMS = (1, 2, 6)


def signed_heads(teams: int, agents: int) -> jax.Array:
    """Heads [P, N, 4, 3] whose entries tell team and agent: 100 * team + 10 * agent + 1."""
    team, agent = np.meshgrid(np.arange(teams), np.arange(agents), indexing="ij")
    value = 100.0 * team + 10.0 * agent + 1.0
    heads = np.broadcast_to(value[:, :, None, None], (teams, agents, 4, 3))
    return jnp.asarray(heads, jnp.float32)


def whole_teams(teams: int, agents: int) -> Team:
    """Networks and heads, every entry of which tells team and agent."""
    heads = signed_heads(teams, agents)
    sign = heads[..., :1, :1]
    weight = jnp.broadcast_to(sign, (teams, agents, 5, 2))
    bias = jnp.broadcast_to(sign[..., 0], (teams, agents, 2))
    return Team({"bias": bias, "weight": weight}, heads)


def of_roles(size: int, agents: int, elite: int, parent: int) -> Selection:
    others = [t for t in range(size) if t not in (elite, parent)]
    replaced = jnp.broadcast_to(jnp.array(others)[:, None], (len(others), agents))
    return Selection(jnp.int32(elite), jnp.full(agents, parent), replaced, replaced[-1, 0])


@pytest.mark.parametrize("agents", TEAMS)
def test_agents_exchange_whole_policies(agents: int) -> None:
    parents, mask = whole_teams(2, agents), jnp.ones((agents, 3), bool)
    one, two = (jax.tree.map(lambda leaf, t=t: leaf[t], parents) for t in (0, 1))
    exchange = jax.jit(jax.vmap(crossover.exchange_agents, in_axes=(None, None, None, 0)))
    child, share = exchange(one, two, mask, KEYS)
    taken = np.asarray(share) == 1
    assert np.isin(share, [0, 1]).all()
    for leaf, own, other in zip(*map(jax.tree.leaves, (child, one, two)), strict=True):
        chosen = taken.reshape(*taken.shape, *[1] * (own.ndim - 1))
        np.testing.assert_array_equal(leaf, np.where(chosen, other, own))
    sizes = taken.sum(axis=1)
    most = max(1, agents - 1)
    for size in range(1, most + 1):
        assert_frequency((sizes == size).sum(), 1 / most, len(KEYS))
    assert sizes.min() >= 1
    assert sizes.max() <= most
    for agent in range(agents):
        assert_frequency(taken[:, agent].sum(), 0.5 if agents > 1 else 1.0, len(KEYS))


@pytest.mark.parametrize("level", ["parameter", "layer"])
def test_rows_are_exchanged_with_no_regard_to_agents(level: Any) -> None:
    mask = jnp.array([[True, True, False], [True, True, True]])
    parents = whole_teams(2, 2)
    one, two = (jax.tree.map(lambda leaf, t=t: leaf[t], parents) for t in (0, 1))
    exchange = jax.jit(jax.vmap(crossover.EXCHANGES[level], in_axes=(None, None, None, 0)))
    child, share = exchange(one, two, mask, KEYS)
    taken: dict[str, np.ndarray] = {}
    leaves = {
        "bias": child.encoder["bias"],
        "weight": child.encoder["weight"],
        "heads": child.heads,
    }
    owns = {"bias": one.encoder["bias"], "weight": one.encoder["weight"], "heads": one.heads}
    for name, leaf in leaves.items():
        other = np.asarray(leaf) != np.asarray(owns[name])
        if other.ndim == 4:  # a row goes whole or not at all
            assert (other == other[:, :, :1]).all()
            other = other[:, :, 0]
        taken[name] = other
    assert not taken["heads"][:, 0, 2].any()  # padding
    rows = {name: own.shape[0] * own.shape[-1] for name, own in owns.items()} | {"heads": 5}
    sizes = {name: other.sum(axis=(1, 2)) for name, other in taken.items()}
    part = 1.0
    if level == "layer":
        # Each of three layers with one half; where none comes out, one of them.
        part = 0.5 + 0.5**3 / 3
        assert sum((size > 0).astype(int) for size in sizes.values()).min() == 1
    for name, size in sizes.items():
        assert size.max() <= rows[name] - 1
        assert_frequency((size > 0).sum(), part, len(KEYS))
        for k in range(1, rows[name]):
            assert_frequency((size == k).sum(), part / (rows[name] - 1), len(KEYS))
    # Every row is as likely as any other: half of those of a layer that takes part.
    for row in range(3):
        assert_frequency(taken["heads"][:, 1, row].sum(), part / 2, len(KEYS))
    expected = sum(taken[name].sum(axis=2) for name in taken) / (np.array([2, 3]) + 4)
    np.testing.assert_allclose(share, expected, rtol=1e-6)


def test_both_levels_exchange_half_of_all_rows() -> None:
    """The same expected amount, so that only the level differs."""
    mask = jnp.array([[True, False, False], [True, True, True]])
    one, two = (Team(None, heads) for heads in signed_heads(2, 2))
    for level in ("agent", "parameter"):
        exchange = jax.jit(
            jax.vmap(crossover.EXCHANGES[level], in_axes=(None, None, None, 0))  # type: ignore[index]
        )
        child, _ = exchange(one, two, mask, KEYS)
        taken = (np.asarray(child.heads) != np.asarray(one.heads))[:, :, 0] & np.asarray(mask)
        per_child = taken.sum(axis=(1, 2))
        error = 5 * per_child.std() / np.sqrt(len(KEYS))
        assert abs(per_child.mean() - 4 / 2) < error


@pytest.mark.parametrize("copy", [False, True], ids=["no copy", "copy"])
@pytest.mark.parametrize(("size", "agents"), [(3, 1), (3, 2), (5, 2), (8, 6)])
def test_breeding_replaces_exactly_those_that_do_not_reproduce(
    size: int, agents: int, copy: bool
) -> None:
    heads, mask = signed_heads(size, agents), jnp.ones((agents, 3), bool)
    elite, parent = size - 1, 0
    chosen = of_roles(size, agents, elite, parent)
    breed = partial(crossover.breed, elite_copy=copy, level="agent")
    bred = jax.jit(jax.vmap(breed, in_axes=(None, None, None, None, 0)))(
        Team(None, heads), chosen, mask, 1.0, KEYS[:100]
    )
    made, heads, places = np.asarray(bred.teams.heads), np.asarray(heads), range(1, size - 1)
    share = np.asarray(bred.share)
    first, second = np.asarray(bred.first), np.asarray(bred.second)
    # What is told of where policies come from is where they come from.
    source = np.where(share > 0.5, second, first)
    np.testing.assert_array_equal(made, heads[source, np.arange(agents)])
    for kept in (elite, parent):
        assert (made[:, kept] == heads[kept]).all()
        assert (first[:, kept] == kept).all()
    if copy:
        # The fittest of the places is the elite's copy; the elite stays where it is.
        assert (made[:, 1] == heads[elite]).all()
        assert (first[:, 1] == elite).all()
        assert (second[:, 1] == elite).all()
        places = places[1:]
    for k, place in enumerate(places):
        # One offspring begins as the elite, the next as the parent.
        assert (first[:, place] == (elite, parent)[k % 2]).all()
        assert (second[:, place] == (parent, elite)[k % 2]).all()
        if agents > 1:
            assert (share[:, place].min(axis=1) == 0).all()
            assert (share[:, place].max(axis=1) == 1).all()
    if agents > 2 and len(places) > 2:
        # Each crossover has a key of its own.
        assert (made[:, places[0]] != made[:, places[2]]).any(axis=(1, 2, 3)).mean() > 0.5


@pytest.mark.parametrize("probability", [0.0, 0.3])
def test_without_a_crossover_offspring_are_copies_of_their_parents(probability: float) -> None:
    heads, mask = signed_heads(6, 2), jnp.ones((2, 3), bool)
    chosen = of_roles(6, 2, 4, 0)
    breed = partial(crossover.breed, elite_copy=False, level="agent")
    breed = jax.jit(jax.vmap(breed, in_axes=(None, None, None, None, 0)))
    bred = breed(Team(None, heads), chosen, mask, probability, KEYS)
    made = np.asarray(bred.teams.heads)
    for k, place in enumerate((1, 2, 3, 5)):
        is_copy = (made[:, place] == np.asarray(heads)[(4, 0)[k % 2]]).all(axis=(1, 2, 3))
        assert_frequency(is_copy.sum(), 1 - probability, len(KEYS))
        np.testing.assert_array_equal(is_copy, (np.asarray(bred.share[:, place]) == 0).all(axis=1))
        np.testing.assert_array_equal(
            is_copy, np.asarray(bred.first == bred.second)[:, place].all(axis=1)
        )


def test_agents_may_have_parents_of_their_own() -> None:
    heads, mask = signed_heads(5, 2), jnp.ones((2, 3), bool)
    replaced = jnp.array([[1, 0], [2, 2], [3, 3]])
    chosen = Selection(jnp.int32(4), jnp.array([0, 1]), replaced, jnp.int32(3))
    breed = jax.jit(partial(crossover.breed, elite_copy=True, level="agent"))
    bred = breed(Team(None, heads), chosen, mask, 1.0, KEYS[0])
    assert bred.first[:2].tolist() == [[0, 4], [4, 1]]  # parent and the elite's copy, by agent
    assert bred.first[2].tolist() == [4, 4]
    assert bred.second[2].tolist() == [0, 1]
    assert bred.first[3].tolist() == [0, 1]
    source = np.where(bred.share > 0.5, bred.second, bred.first)
    np.testing.assert_array_equal(bred.teams.heads, heads[source, jnp.arange(2)])


@pytest.mark.parametrize("level", ["agent", "parameter"])
def test_places_of_each_agent_hold_what_ranked_places_hold(level: Any) -> None:
    """Every agent has the same heads as with ranked places, each somewhere."""
    teams, mask = whole_teams(6, 3), jnp.ones((3, 3), bool)
    ranked = of_roles(6, 3, 4, 1)

    def both(key: jax.Array) -> Any:
        breed = partial(crossover.breed, elite_copy=True, level=level)
        dealt = deal_places(ranked, jax.random.fold_in(key, 9))
        return [breed(teams, chosen, mask, 1.0, key) for chosen in (ranked, dealt)], dealt.replaced

    (one, two), places = jax.jit(jax.vmap(both))(KEYS[:200])
    apart = np.asarray(places)
    for kept in (4, 1):
        for leaf, old in zip(*map(jax.tree.leaves, (two.teams, teams)), strict=True):
            assert (np.asarray(leaf)[:, kept] == np.asarray(old)[kept]).all()
    of_one, of_two = (
        [*jax.tree.leaves(made.teams), made.first, made.second, made.share] for made in (one, two)
    )
    for a, b in zip(of_one, of_two, strict=True):
        for k, place in enumerate((0, 2, 3, 5)):
            for agent in range(3):
                there = apart[:, k, agent]
                moved = np.asarray(b)[np.arange(len(there)), there, agent]
                np.testing.assert_array_equal(moved, np.asarray(a)[:, place, agent])
    together = (apart == apart[:, :, :1]).all(axis=2)
    assert_frequency(together[:, 0].sum(), 1 / 16, len(together))


def test_an_agent_of_one_team_alone_has_no_second() -> None:
    none, whole, part = 0.0, 1.0, 0.25
    made = crossover.Bred(
        None,
        first=jnp.array([[4, 1, 4], [4, 4, 1]]),
        second=jnp.array([[4, 4, 1], [1, 1, 4]]),
        share=jnp.array([[none, whole, none], [whole, part, none]]),
    )
    told = crossover.told_of_each_agent(made)
    assert told.first.tolist() == [[4, 4, 4], [1, 4, 1]]
    assert told.second.tolist() == [[4, 4, 4], [1, 1, 1]]
    assert told.share.tolist() == [[0, 0, 0], [0, 0.25, 0]]


@pytest.mark.parametrize("place", [0, 2])
def test_injection_replaces_one_team(place: int) -> None:
    teams = whole_teams(3, 2)
    marl = jax.tree.map(lambda leaf: jnp.full(leaf.shape[1:], -1.0), teams)
    injected = jax.jit(crossover.inject)(teams, marl, jnp.int32(place))
    for new, old in zip(jax.tree.leaves(injected), jax.tree.leaves(teams), strict=True):
        for team in range(3):
            assert jnp.array_equal(
                new[team], jnp.full_like(old[0], -1) if team == place else old[team]
            )

"""Selection against its definition."""

from functools import partial
from math import comb
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from frequencies import KEYS, assert_frequency

from race.method import selection


@partial(jax.jit, static_argnums=1)
def select_many(fitness: jax.Array, tournament_size: int) -> Any:
    """Of teams of one agent, whose axis is taken away."""
    chosen = jax.vmap(selection.select, in_axes=(None, None, 0))(fitness, tournament_size, KEYS)
    return chosen._replace(parent=chosen.parent[:, 0], replaced=chosen.replaced[:, :, 0])


@pytest.mark.parametrize(("size", "tournament_size"), [(3, 3), (5, 1), (5, 3), (5, 10), (8, 3)])
def test_roles_and_the_tournament(size: int, tournament_size: int) -> None:
    fitness = np.random.default_rng(size).permutation(size).astype(np.float32) - 2
    chosen = jax.tree.map(np.asarray, select_many(jnp.asarray(fitness), tournament_size))
    assert (chosen.elite == fitness.argmax()).all()
    assert (chosen.worst == fitness.argmin()).all()
    assert (chosen.parent != chosen.elite).all()
    roles = np.concatenate([chosen.elite[:, None], chosen.parent[:, None], chosen.replaced], axis=1)
    assert (np.sort(roles, axis=1) == np.arange(size)).all()
    assert (np.diff(fitness[chosen.replaced], axis=1) < 0).all()  # from the fittest down

    # The best of k drawn without replacement from n: place r of the others wins with
    # probability C(n - 1 - r, k - 1) / C(n, k).
    others = np.argsort(-fitness)[1:]
    n, k = size - 1, min(tournament_size, size - 1)
    for place, team in enumerate(others):
        p = comb(n - 1 - place, k - 1) / comb(n, k)
        assert_frequency((chosen.parent == team).sum(), p, len(KEYS))


def test_the_tournament_does_not_depend_on_where_teams_sit() -> None:
    one = select_many(jnp.array([5.0, 4.0, 3.0, 2.0, 1.0]), 3)
    two = select_many(jnp.array([1.0, 2.0, 3.0, 4.0, 5.0]), 3)
    assert (one.elite == 4 - two.elite).all()
    assert (one.parent == 4 - two.parent).all()


def test_ties_are_fair() -> None:
    everyone = select_many(jnp.zeros(5), 3)
    for team in range(5):
        assert_frequency((everyone.elite == team).sum(), 1 / 5, len(KEYS))
        assert_frequency((everyone.parent == team).sum(), 1 / 5, len(KEYS))
        assert_frequency((everyone.worst == team).sum(), 1 / 5, len(KEYS))
    assert (everyone.worst != everyone.elite).all()
    two = select_many(jnp.array([1.0, 9.0, 0.0, 9.0, 2.0]), 3)
    assert set(np.unique(two.elite)) == {1, 3}
    assert_frequency((two.elite == 1).sum(), 1 / 2, len(KEYS))


def test_fitness_that_is_not_finite_never_beats_one_that_is() -> None:
    nan, inf = np.nan, np.inf
    # Three of the four others enter, so that at least one entrant is finite.
    chosen = select_many(jnp.array([nan, -7.0, -inf, 2.0, -9.0]), 3)
    assert (chosen.elite == 3).all()
    assert np.isin(chosen.parent, [1, 4]).all()
    assert np.isin(chosen.worst, [0, 2]).all()


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_fitness_that_is_nowhere_finite_still_gives_roles(value: float) -> None:
    chosen = select_many(jnp.full(4, value), 3)
    assert (chosen.elite != chosen.parent).all()
    assert (chosen.elite != chosen.worst).all()
    roles = np.concatenate([chosen.elite[:, None], chosen.parent[:, None], chosen.replaced], axis=1)
    assert (np.sort(roles, axis=1) == np.arange(4)).all()


@pytest.mark.parametrize("per_agent", [False, True])
def test_places_are_dealt_to_each_agent_by_itself(per_agent: bool) -> None:
    fitness = jnp.array([1.0, 9.0, 0.0, 4.0, 2.0])

    def both(key: jax.Array) -> Any:
        chosen = selection.select(fitness, 10, key, 2, per_agent)
        return chosen, selection.deal_places(chosen, jax.random.fold_in(key, 3))

    chosen, dealt = jax.jit(jax.vmap(both))(KEYS)
    for name in ("elite", "parent", "worst"):
        np.testing.assert_array_equal(getattr(dealt, name), getattr(chosen, name))
    assert (np.asarray(dealt.worst) == 2).all()
    before, after = np.asarray(chosen.replaced), np.asarray(dealt.replaced)
    np.testing.assert_array_equal(np.sort(after, axis=1), np.sort(before, axis=1))
    for team in (4, 0, 2):
        for rank in range(3):
            for agent in range(2):
                assert_frequency((after[:, rank, agent] == team).sum(), 1 / 3, len(KEYS))
            # Agents know nothing of each other.
            both_there = (after[:, rank] == team).all(axis=1)
            assert_frequency(both_there.sum(), 1 / 9, len(KEYS))


@pytest.mark.parametrize("per_agent", [False, True])
def test_agents_share_a_tournament_or_have_one_each(per_agent: bool) -> None:
    fitness = jnp.array([1.0, 9.0, 0.0, 4.0, 2.0])
    chosen = jax.jit(jax.vmap(lambda key: selection.select(fitness, 2, key, 3, per_agent)))(KEYS)
    parent, replaced = np.asarray(chosen.parent), np.asarray(chosen.replaced)
    assert (np.asarray(chosen.elite) == 1).all()
    for agent in range(3):
        roles = np.concatenate([parent[:, agent, None], replaced[:, :, agent]], axis=1)
        assert (np.sort(roles, axis=1) == [0, 2, 3, 4]).all()
        assert (np.diff(np.asarray(fitness)[replaced[:, :, agent]], axis=1) < 0).all()
        # Of the four others two enter, and three of the six pairs hold the fittest.
        assert_frequency((parent[:, agent] == 3).sum(), 1 / 2, len(KEYS))
    alike = (parent == parent[:, :1]).all(axis=1)
    if per_agent:
        both = ((parent[:, 0] == 3) & (parent[:, 1] == 3)).sum()
        assert_frequency(both, 1 / 4, len(KEYS))
    else:
        assert alike.all()

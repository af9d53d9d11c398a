"""Genetic operators against their definitions; statistics at five standard errors."""

from functools import partial
from math import comb
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.method import genetics

KEYS = jax.random.split(jax.random.key(7), 2000)
TEAMS = (1, 2, 6)


def assert_frequency(count: Any, p: float, draws: int) -> None:
    """``count`` of ``draws`` independent draws is what probability p gives."""
    assert abs(int(count) - draws * p) <= 5 * np.sqrt(draws * p * (1 - p)) + 1e-9


def signed_heads(teams: int, agents: int) -> jax.Array:
    """Heads [P, N, 4, 3] whose entries tell team and agent: 100 * team + 10 * agent + 1."""
    team, agent = np.meshgrid(np.arange(teams), np.arange(agents), indexing="ij")
    value = 100.0 * team + 10.0 * agent + 1.0
    heads = np.broadcast_to(value[:, :, None, None], (teams, agents, 4, 3))
    return jnp.asarray(heads, jnp.float32)


# --- selection -----------------------------------------------------------------------------


@partial(jax.jit, static_argnums=1)
def select_many(fitness: jax.Array, tournament_size: int) -> genetics.Selection:
    return jax.vmap(genetics.select, in_axes=(None, None, 0))(fitness, tournament_size, KEYS)


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


# --- crossover -----------------------------------------------------------------------------


@pytest.mark.parametrize("agents", TEAMS)
def test_crossover_exchanges_whole_heads_of_the_same_agent(agents: int) -> None:
    parents = signed_heads(2, agents)
    exchange = jax.jit(jax.vmap(genetics.crossover, in_axes=(None, None, 0)))
    children = exchange(parents[0], parents[1], KEYS)
    heads = np.asarray(parents)
    taken = []  # per offspring: which agents come from the other parent, [keys, N]
    for child, own, other in zip(children, (0, 1), (1, 0), strict=True):
        from_own = (np.asarray(child) == heads[own]).all(axis=(2, 3))
        from_other = (np.asarray(child) == heads[other]).all(axis=(2, 3))
        assert (from_own ^ from_other).all()
        taken.append(from_other)

    for subsets in taken:
        sizes = subsets.sum(axis=1)
        most = max(1, agents - 1)
        for size in range(1, most + 1):
            assert_frequency((sizes == size).sum(), 1 / most, len(KEYS))
        assert sizes.min() >= 1
        assert sizes.max() <= most
        for agent in range(agents):
            assert_frequency(subsets[:, agent].sum(), 0.5 if agents > 1 else 1.0, len(KEYS))
    # d_i and d_j are drawn independently of each other.
    if agents > 1:
        both = (taken[0][:, 0] & taken[1][:, 0]).sum()
        assert_frequency(both, 0.25, len(KEYS))


@pytest.mark.parametrize("copy", [False, True], ids=["no copy", "copy"])
@pytest.mark.parametrize(("size", "agents"), [(3, 1), (3, 2), (5, 2), (5, 6), (8, 6)])
def test_breeding_replaces_exactly_those_that_do_not_reproduce(
    size: int, agents: int, copy: bool
) -> None:
    heads = signed_heads(size, agents)
    elite, parent = size - 1, 0
    replaced = jnp.array([t for t in range(size) if t not in (elite, parent)])
    chosen = genetics.Selection(jnp.int32(elite), jnp.int32(parent), replaced, replaced[-1])
    bred = np.asarray(
        jax.jit(jax.vmap(partial(genetics.breed, elite_copy=copy), in_axes=(None, None, 0)))(
            heads, chosen, KEYS[:100]
        )
    )
    heads, places = np.asarray(heads), np.asarray(replaced)
    for kept in (elite, parent):
        assert (bred[:, kept] == heads[kept]).all()
    if copy:
        # The fittest of the places is the elite's copy; the elite stays where it is.
        assert (bred[:, places[0]] == heads[elite]).all()
        places = places[1:]
    for place in places:
        from_elite = (bred[:, place] == heads[elite]).all(axis=(2, 3))
        from_parent = (bred[:, place] == heads[parent]).all(axis=(2, 3))
        assert (from_elite ^ from_parent).all()
        if agents > 1:
            assert not from_elite.all(axis=1).any()
            assert not from_parent.all(axis=1).any()
    if agents > 2 and len(places) > 2:
        # Each crossover has a key of its own.
        first, third = bred[:, places[0]], bred[:, places[-1 if copy else 2]]
        assert (first != third).any(axis=(1, 2, 3)).mean() > 0.5


# --- mutation ------------------------------------------------------------------------------

H = 8
DRAWS = ("row", "weight")
MASK = jnp.array([True, True, False])


def head_with_padding(agents: int = 1) -> jax.Array:
    """Weights away from zero; the padded column is not zero, to see that it is left alone."""
    return 1.0 + jax.random.uniform(jax.random.key(5), (agents, H + 1, 3))


@pytest.mark.parametrize("draw", DRAWS)
@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.25, 0.7, 1.0])
def test_mutation_changes_the_fraction_of_each_row_in_expectation(
    fraction: float, draw: genetics.MutationDraw
) -> None:
    head = head_with_padding()[0]
    mutate = jax.jit(
        jax.vmap(partial(genetics.mutate_agent, head, MASK, draw=draw), in_axes=(None, 0))
    )
    mutated = np.asarray(mutate(jnp.float32(fraction), KEYS))
    changed = mutated != np.asarray(head)
    # The whole part of alpha times inputs, and one more with the probability of the rest.
    whole, rest = divmod(fraction * H, 1.0)
    counts = changed[:, :-1, :2].sum(axis=1)
    assert np.isin(counts, [whole, whole + 1] if rest > 0 else [whole]).all()
    for row in range(2):
        assert_frequency((counts[:, row] > whole).sum(), rest, len(KEYS))
    if 0 < rest < 1:
        # Rows draw their numbers for themselves.
        assert_frequency((counts > whole).all(axis=1).sum(), rest**2, len(KEYS))
    assert not changed[:, -1].any()  # biases
    assert not changed[:, :, 2].any()  # padding
    # Every weight is as likely to be picked as any other, and rows are picked for themselves.
    for count in changed[:, :-1, :2].sum(axis=0).ravel():
        assert_frequency(count, fraction, len(KEYS))
    if fraction == 0.25:
        assert (changed[:, :, 0] != changed[:, :, 1]).any(axis=1).mean() > 0.9


def test_mutated_weights_are_bounded_and_others_are_left_alone() -> None:
    head = jnp.full((1, 301, 2), 50.0)
    key = jax.random.key(0)
    mutated = genetics.mutate_agent(head[0], jnp.ones(2, bool), 0.5, key, "weight")[:-1]
    changed = np.asarray(mutated != 50.0)
    assert changed.sum() == 300
    assert np.abs(np.asarray(mutated)[changed]).max() == genetics.LARGEST_WEIGHT


def changes(
    rows: int, draw: genetics.MutationDraw, monkeypatch: pytest.MonkeyPatch
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """New weights, relative changes, and which are resets, of ``rows`` rows of 1,000 weights.

    The weights are so large that resets, strong and weak changes are told apart by their size.
    """
    monkeypatch.setattr(genetics, "LARGEST_WEIGHT", float("inf"))
    w = jnp.where(jnp.arange(1001)[:, None] % 2 == 0, 1e4, -2e4) * jnp.ones((1001, rows))
    mutated = genetics.mutate_agent(w, jnp.ones(rows, bool), 1.0, jax.random.key(3), draw)[:-1]
    new, old = np.asarray(mutated, float), np.asarray(w[:-1], float)
    return new, (new - old) / np.abs(old), np.abs(new) < 6


def test_drawn_by_row_all_changes_of_a_row_are_of_one_kind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, change, reset = changes(2000, "row", monkeypatch)
    by_reset = reset.mean(axis=0)
    # Of 1,000 strong changes some 952 are larger than 0.6, of as many weak ones none.
    by_strong = ((np.abs(change) > 0.6) & ~reset).mean(axis=0)
    kinds = np.stack([by_reset > 0.999, by_strong > 0.9, (by_reset < 0.01) & (by_strong < 0.01)])
    assert (kinds.sum(axis=0) == 1).all()
    for kind, share in zip(kinds, (0.05, 0.05, 0.9), strict=True):
        assert_frequency(kind.sum(), share, 2000)
    np.testing.assert_allclose(np.median(np.abs(change[:, kinds[2]])), 0.0674, rtol=0.02)
    np.testing.assert_allclose(np.median(np.abs(change[:, kinds[1]])), 6.745, rtol=0.05)


def test_drawn_by_weight_shares_and_strengths(monkeypatch: pytest.MonkeyPatch) -> None:
    new, change, reset = changes(100, "weight", monkeypatch)
    n = new.size
    weak = ~reset & (np.abs(change) < 0.6)
    strong = ~reset & ~weak
    # 4.8 % of the strong changes are smaller than 0.6.
    small = 0.0478
    assert_frequency(reset.sum(), 0.05, n)
    assert_frequency(strong.sum(), 0.05 * (1 - small), n)
    assert_frequency(weak.sum(), 0.9 + 0.05 * small, n)
    assert abs(new[reset].mean()) < 5 / np.sqrt(0.05 * n)
    np.testing.assert_allclose(new[reset].std(), 1.0, atol=5 / np.sqrt(0.1 * n))
    # The typical change, read at the median, which the few misclassified hardly move.
    np.testing.assert_allclose(np.median(np.abs(change[weak])), 0.1 * 0.6745, rtol=0.02)
    np.testing.assert_allclose(np.median(np.abs(change[strong])), 10 * 0.712, rtol=0.05)
    for kind in (weak, strong):
        assert_frequency((change[kind] > 0).sum(), 0.5, int(kind.sum()))


@pytest.mark.parametrize(("agents", "probability"), [(1, 0.5), (6, 0.5), (2, 0.0), (2, 1.0)])
def test_mutation_picks_agents_and_at_least_one(agents: int, probability: float) -> None:
    team = jnp.concatenate([head_with_padding()] * agents)
    mask = jnp.stack([MASK] * agents)
    mutate = jax.jit(jax.vmap(partial(genetics.mutate, team, mask, 0.25, probability, draw="row")))
    mutated = np.asarray(mutate(KEYS))
    picked = (mutated != np.asarray(team)).any(axis=(2, 3))
    assert picked.any(axis=1).all()
    p = probability + (1 - probability) ** agents / agents
    for agent in range(agents):
        assert_frequency(picked[:, agent].sum(), p, len(KEYS))
    # The agents were equal: each has drawn its own changes.
    both = picked[:, 0] & picked[:, -1]
    assert agents == 1 or (mutated[both, 0] != mutated[both, -1]).any(axis=(1, 2)).all()
    if probability == 0:
        assert (picked.sum(axis=1) == 1).all()
    else:
        assert_frequency(picked.all(axis=1).sum(), probability**agents if agents > 1 else 1, 2000)


@pytest.mark.parametrize(("size", "probability"), [(3, 1.0), (8, 0.9)])
def test_each_team_but_the_elite_mutates_with_the_probability(
    size: int, probability: float
) -> None:
    heads = jnp.stack([head_with_padding(2)] * size)
    mask, elite = jnp.array([[True, True, False], [True, False, False]]), jnp.int32(1)

    mutate = jax.jit(
        jax.vmap(
            partial(
                genetics.mutate_population, heads, elite, mask, 0.25, probability, 0.5, draw="row"
            )
        )
    )
    mutated = np.asarray(mutate(KEYS[:1000]))
    changed = mutated != np.asarray(heads)
    teams = changed.any(axis=(2, 3, 4))
    assert not teams[:, 1].any()
    for team in (t for t in range(size) if t != 1):
        assert_frequency(teams[:, team].sum(), probability, 1000)
    padded = ~np.broadcast_to(np.asarray(mask)[:, None], (2, H + 1, 3))
    assert not changed[..., padded].any()
    assert not changed[:, :, :, -1].any()
    # The teams were equal: each has drawn its own changes.
    both = teams[:, 0] & teams[:, 2]
    assert (mutated[both, 0] != mutated[both, 2]).any(axis=(1, 2, 3)).all()


# --- injection -----------------------------------------------------------------------------


@pytest.mark.parametrize("place", [0, 2])
def test_injection_replaces_one_team(place: int) -> None:
    heads, marl = signed_heads(3, 2), jnp.full((2, 4, 3), -1.0)
    injected = jax.jit(genetics.inject)(heads, marl, jnp.int32(place))
    for team in range(3):
        assert jnp.array_equal(injected[team], marl if team == place else heads[team])

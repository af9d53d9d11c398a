"""Mutation against its definition."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from frequencies import KEYS, assert_frequency

from race.config.hyper import Hyper, hyper_of
from race.config.presets import resolve
from race.config.settings import Config, MutationDraw
from race.method import mutation
from race.types import Team

H = 8
DRAWS = ("row", "weight")
MASK = jnp.array([True, True, False])


def numbers(**changes: float) -> Hyper:
    hyper = hyper_of(resolve(Config("probe/target")))
    changed = {name: np.float32(value) for name, value in changes.items()}
    return hyper._replace(mutation_fraction=np.float32(0.25))._replace(**changed)


def head_with_padding(agents: int = 1) -> jax.Array:
    """Weights away from zero; the padded column is not zero, to see that it is left alone."""
    return 1.0 + jax.random.uniform(jax.random.key(5), (agents, H + 1, 3))


def whole_team(agents: int) -> Team:
    key = jax.random.key(6)
    weight = 1.0 + jax.random.uniform(key, (agents, 5, 4))
    return Team({"bias": weight[:, 0], "weight": weight}, head_with_padding(agents))


@partial(jax.jit, static_argnames="draw")
def mutate_layers(w: Any, mask: Any, hyper: Hyper, keys: Any, draw: MutationDraw) -> Any:
    return jax.vmap(lambda key: mutation.mutate_layer(w, mask, hyper, key, draw))(keys)


@partial(jax.jit, static_argnames="level")
def mutate_teams(team: Team, mask: Any, hyper: Hyper, keys: Any, level: Any) -> Any:
    operator = mutation.MUTATIONS[level]
    return jax.vmap(lambda key: operator(team, mask, hyper, key, "row"))(keys)


# --- which weights ----------------------------------------------------------------------------


@pytest.mark.parametrize("values", [8, 2**23])
def test_the_smallest_of_each_column_are_those_that_sorting_finds(values: int) -> None:
    """Also where many are equal."""
    rng = np.random.default_rng(0)
    lots = (rng.integers(0, values, (300, 40)) / 2.0**23).astype(np.float32)
    lots[:, :2] = [[0.0, 1 - 2.0**-23]]
    count = np.concatenate([[0, 300, 1, 299], rng.integers(0, 301, 36)])
    count[0] = 7
    lots[5:9, 3], count[3] = 0.0, 0  # none, where the smallest possible is there
    picked = jax.jit(mutation.smallest)(jnp.asarray(lots), jnp.asarray(count, jnp.int32))
    place = np.argsort(np.argsort(lots, axis=0, kind="stable"), axis=0)
    np.testing.assert_array_equal(picked, place < count)


@pytest.mark.parametrize("draw", DRAWS)
@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.25, 0.7, 1.0])
def test_mutation_changes_the_fraction_of_each_row_in_expectation(
    fraction: float, draw: MutationDraw
) -> None:
    w, hyper = head_with_padding()[0, :-1], numbers(mutation_fraction=fraction)
    mutated, kinds = mutate_layers(w, MASK, hyper, KEYS, draw)
    changed = np.asarray(mutated) != np.asarray(w)
    # The whole part of alpha times inputs, and one more with the probability of the rest.
    whole, rest = divmod(float(np.float32(fraction)) * H, 1.0)
    counts = changed[:, :, :2].sum(axis=1)
    assert np.isin(counts, [whole, whole + 1] if rest > 0 else [whole]).all()
    for row in range(2):
        assert_frequency((counts[:, row] > whole).sum(), rest, len(KEYS))
    if 0 < rest < 1:
        # Rows draw their numbers for themselves.
        assert_frequency((counts > whole).all(axis=1).sum(), rest**2, len(KEYS))
    assert not changed[:, :, 2].any()  # padding
    np.testing.assert_array_equal(np.asarray(kinds).sum(axis=1), changed.sum(axis=(1, 2)))
    # Every weight is as likely to be picked as any other, and rows are picked for themselves.
    for count in changed[:, :, :2].sum(axis=0).ravel():
        assert_frequency(count, fraction, len(KEYS))
    if fraction == 0.25:
        assert (changed[:, :, 0] != changed[:, :, 1]).any(axis=1).mean() > 0.9


# --- how they change --------------------------------------------------------------------------


@pytest.mark.parametrize("largest", [10.0, 3.0, np.inf])
def test_mutated_weights_are_bounded_and_others_are_left_alone(largest: float) -> None:
    w, hyper = jnp.full((300, 2), 50.0), numbers(mutation_fraction=0.5, largest_weight=largest)
    mutated = mutate_layers(w, jnp.ones(2, bool), hyper, KEYS[:1], "weight")[0][0]
    changed = np.asarray(mutated != 50.0)
    assert changed.sum() == 300
    most = np.abs(np.asarray(mutated)[changed]).max()
    assert most == largest if np.isfinite(largest) else most > 100


def changes(
    rows: int, draw: MutationDraw, **given: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """New weights, relative changes, which are resets, and kinds, of rows of 1,000 weights.

    The weights are so large that resets, strong and weak changes are told apart by their size.
    """
    w = jnp.where(jnp.arange(1000)[:, None] % 2 == 0, 1e4, -2e4) * jnp.ones((1000, rows))
    hyper = numbers(mutation_fraction=1.0, largest_weight=np.inf, **given)
    mutated, kinds = mutate_layers(w, jnp.ones(rows, bool), hyper, KEYS[:1], draw)
    new, old = np.asarray(mutated[0], float), np.asarray(w, float)
    return new, (new - old) / np.abs(old), np.abs(new) < 6, np.asarray(kinds[0])


def test_drawn_by_row_all_changes_of_a_row_are_of_one_kind() -> None:
    _, change, reset, counted = changes(1000, "row")
    by_reset = reset.mean(axis=0)
    # Of 1,000 strong changes some 952 are larger than 0.6, of as many weak ones none.
    by_strong = ((np.abs(change) > 0.6) & ~reset).mean(axis=0)
    kinds = np.stack([by_strong > 0.9, by_reset > 0.999, (by_reset < 0.01) & (by_strong < 0.01)])
    assert (kinds.sum(axis=0) == 1).all()
    np.testing.assert_array_equal(counted, 1000 * kinds.sum(axis=1))
    for kind, share in zip(kinds, (0.05, 0.05, 0.9), strict=True):
        assert_frequency(kind.sum(), share, 1000)
    np.testing.assert_allclose(np.median(np.abs(change[:, kinds[2]])), 0.0674, rtol=0.02)
    np.testing.assert_allclose(np.median(np.abs(change[:, kinds[0]])), 6.745, rtol=0.05)


@pytest.mark.parametrize(
    ("strong_share", "reset_share", "strong_strength", "mild_strength"),
    [(0.05, 0.05, 10.0, 0.1), (0.2, 0.1, 20.0, 0.05)],
)
def test_drawn_by_weight_shares_and_strengths(
    strong_share: float, reset_share: float, strong_strength: float, mild_strength: float
) -> None:
    given = {"strong_share": strong_share, "reset_share": reset_share}
    given |= {"strong_strength": strong_strength, "mild_strength": mild_strength}
    new, change, reset, counted = changes(100, "weight", **given)
    n = new.size
    weak = ~reset & (np.abs(change) < 6 * mild_strength)
    strong = ~reset & ~weak
    # 4.8 % of strong changes of strength 10 are smaller than 0.6.
    small = 0.0478 if strong_strength == 10 else 0.012
    assert_frequency(reset.sum(), reset_share, n)
    assert_frequency(strong.sum(), strong_share * (1 - small), n)
    assert_frequency(weak.sum(), 1 - strong_share - reset_share + strong_share * small, n)
    for count, share in zip(counted[:2], (strong_share, reset_share), strict=True):
        assert_frequency(count, share, n)
    assert counted.sum() == n
    assert abs(new[reset].mean()) < 5 / np.sqrt(reset_share * n)
    np.testing.assert_allclose(new[reset].std(), 1.0, atol=5 / np.sqrt(2 * reset_share * n))
    # The typical change, read at the median, which the few misclassified hardly move.
    np.testing.assert_allclose(np.median(np.abs(change[weak])), mild_strength * 0.6745, rtol=0.03)
    typical = strong_strength * (0.712 if strong_strength == 10 else 0.684)
    np.testing.assert_allclose(np.median(np.abs(change[strong])), typical, rtol=0.05)
    for kind in (weak, strong):
        assert_frequency((change[kind] > 0).sum(), 0.5, int(kind.sum()))


# --- whose weights ----------------------------------------------------------------------------


@pytest.mark.parametrize(("agents", "probability"), [(1, 0.5), (6, 0.5), (6, 0.0), (6, 1.0)])
def test_mutation_picks_agents_and_at_least_one(agents: int, probability: float) -> None:
    heads = jnp.concatenate([head_with_padding()] * agents)
    mask, hyper = jnp.stack([MASK] * agents), numbers(agent_mutation_probability=probability)
    teams, kinds = mutate_teams(Team(None, heads), mask, hyper, KEYS, "agent")
    mutated = np.asarray(teams.heads)
    picked = (mutated != np.asarray(heads)).any(axis=(2, 3))
    np.testing.assert_array_equal(picked, np.asarray(kinds).sum(axis=2) > 0)
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


@pytest.mark.parametrize("level", ["agent", "parameter", "layer"])
def test_levels_differ_in_whose_weights_change_and_not_in_how_many(level: Any) -> None:
    """Over whole teams: biases and padding stay, all layers change, by the same expected amount."""
    mask = jnp.array([[True, True, False], [True, False, False]])
    team = whole_team(2)
    hyper = numbers(mutation_fraction=0.25, agent_mutation_probability=0.5)
    mutated, kinds = mutate_teams(team, mask, hyper, KEYS, level)
    weight = np.asarray(mutated.encoder["weight"]) != np.asarray(team.encoder["weight"])
    heads = np.asarray(mutated.heads) != np.asarray(team.heads)
    assert jnp.array_equal(mutated.encoder["bias"][0], team.encoder["bias"])
    assert not heads[:, :, -1].any()
    assert not heads[:, ~np.broadcast_to(np.asarray(mask)[:, None], (2, H + 1, 3))].any()
    heads = heads[:, :, :-1]
    np.testing.assert_array_equal(
        np.asarray(kinds).sum(axis=2), weight.sum(axis=(2, 3)) + heads.sum(axis=(2, 3))
    )
    # The share of agents that are picked, or of 4 layers of agents.
    picked = 0.5 + (0.5**4 / 4 if level == "layer" else 0.5**2 / 2)
    for changed in (weight, heads[:, :, :, 0]):
        per_team = changed.reshape(len(KEYS), -1).mean(axis=1)
        error = 5 * per_team.std() / np.sqrt(len(KEYS))
        assert abs(per_team.mean() - 0.25 * picked) < error
    touched = weight.any(axis=(2, 3)), heads.any(axis=(2, 3))
    if level == "agent":  # the whole of an agent, or nothing of it
        np.testing.assert_array_equal(*touched)
        assert (touched[0].sum(axis=1) == 1).any()
    else:
        assert (touched[0] != touched[1]).any()


def test_drawn_by_row_the_parameters_of_an_action_change_alike() -> None:
    heads = jnp.full((2, 201, 3), 1e7)
    hyper = numbers(mutation_fraction=0.8, largest_weight=np.inf)
    mask = jnp.ones((2, 3), bool)
    team, kinds = mutate_teams(Team(None, heads), mask, hyper, KEYS[:300], "parameter")
    reset = np.abs(np.asarray(team.heads)[:, :, :-1]) < 6
    changed = np.asarray(team.heads)[:, :, :-1] != 1e7
    alike = (reset.sum(axis=2) == 0) | (reset.sum(axis=2) == changed.sum(axis=2))
    assert alike.all()
    assert_frequency((reset.any(axis=2)).sum(), 0.05, 300 * 6)
    np.testing.assert_array_equal(np.asarray(kinds)[:, :, 1], reset.sum(axis=(2, 3)))


@pytest.mark.parametrize(("size", "probability"), [(3, 1.0), (8, 0.9)])
def test_each_team_but_the_elite_mutates_with_the_probability(
    size: int, probability: float
) -> None:
    heads = jnp.stack([head_with_padding(2)] * size)
    mask, elite = jnp.array([[True, True, False], [True, False, False]]), jnp.int32(1)
    hyper = numbers(mutation_probability=probability)
    mutate = jax.jit(
        jax.vmap(
            lambda key: mutation.mutate_population(
                Team(None, heads), elite, mask, hyper, key, "row", "agent"
            )
        )
    )
    team, kinds = mutate(KEYS[:1000])
    mutated = np.asarray(team.heads)
    changed = mutated != np.asarray(heads)
    teams = changed.any(axis=(2, 3, 4))
    np.testing.assert_array_equal(np.asarray(kinds).sum(axis=3) > 0, changed.any(axis=(3, 4)))
    assert not teams[:, 1].any()
    for each in (t for t in range(size) if t != 1):
        assert_frequency(teams[:, each].sum(), probability, 1000)
    padded = ~np.broadcast_to(np.asarray(mask)[:, None], (2, H + 1, 3))
    assert not changed[..., padded].any()
    assert not changed[:, :, :, -1].any()
    # The teams were equal: each has drawn its own changes.
    both = teams[:, 0] & teams[:, 2]
    assert (mutated[both, 0] != mutated[both, 2]).any(axis=(1, 2, 3)).all()

"""The cross-entropy method's and the evolution strategy's estimates, against float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.method import distributions

FITNESS = np.array([3.0, -1.0, 7.0, np.nan, 7.0, 0.5])  # 2 and 4 are equals, 3 is the worst
ORDER = [2, 4, 0, 5, 1, 3]


def teams() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {"a": rng.normal(size=(6, 2, 3)), "b": rng.normal(size=(6, 4))}


def as_jax(tree: dict[str, np.ndarray]) -> dict[str, jax.Array]:
    return {name: jnp.asarray(leaf, jnp.float32) for name, leaf in tree.items()}


def test_places() -> None:
    found = distributions.places(jnp.asarray(FITNESS, jnp.float32))
    assert np.argsort(found).tolist() == ORDER


@pytest.mark.parametrize(("share", "count"), [(0.5, 3), (0.0, 1), (1.0, 6), (0.34, 2)])
def test_elites_weigh_by_their_places(share: float, count: int) -> None:
    found = distributions.elite_weights(jnp.asarray(FITNESS, jnp.float32), np.float32(share))
    raw = np.zeros(6)
    for place, team in enumerate(ORDER[:count]):
        raw[team] = np.log(count + 1) - np.log(place + 1)
    np.testing.assert_allclose(found, raw / raw.sum(), rtol=1e-5)


def test_mean_and_variance_of_elites() -> None:
    weights = np.array([0.5, 0.0, 0.3, 0.0, 0.2, 0.0])
    given, centre = teams(), {name: leaf[1] + 1.0 for name, leaf in teams().items()}
    mean = distributions.weighted_mean(as_jax(given), jnp.asarray(weights, jnp.float32))
    variance = distributions.spread_around(
        as_jax(given), as_jax(centre), jnp.asarray(weights, jnp.float32), jnp.float32(0.01)
    )
    for name, leaf in given.items():
        by = weights.reshape(-1, *[1] * (leaf.ndim - 1))
        np.testing.assert_allclose(mean[name], (by * leaf).sum(0), rtol=1e-4, atol=1e-6)
        squares = by * (leaf - centre[name]) ** 2
        np.testing.assert_allclose(variance[name], squares.sum(0) + 0.01, rtol=1e-4)


def test_what_does_not_weigh_need_not_be_finite() -> None:
    given = as_jax(teams())
    given["b"] = given["b"].at[3].set(jnp.nan)
    weights = jnp.array([0.5, 0.0, 0.5, 0.0, 0.0, 0.0])
    mean = distributions.weighted_mean(given, weights)
    assert np.isfinite(mean["b"]).all()


def test_the_gradient_of_ranked_fitness() -> None:
    ranks = distributions.centred_ranks(jnp.asarray(FITNESS, jnp.float32))
    expected = np.empty(6)
    expected[ORDER] = np.linspace(0.5, -0.5, 6)
    np.testing.assert_allclose(ranks, expected, atol=1e-6)
    given, centre = teams(), {name: leaf.mean(axis=0) for name, leaf in teams().items()}
    found = distributions.ascent(
        as_jax(given), as_jax(centre), jnp.asarray(FITNESS, jnp.float32), np.float32(0.2)
    )
    for name, leaf in given.items():
        away = (leaf - centre[name]) / 0.2
        by = expected.reshape(-1, *[1] * (leaf.ndim - 1))
        np.testing.assert_allclose(
            found[name], (by * away).sum(0) / (6 * 0.2), rtol=1e-3, atol=1e-5
        )

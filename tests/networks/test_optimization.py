"""Gradient steps against Adam worked out in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.networks.optimization import copy, descend, init_trainable, track


def adam(params: np.ndarray, gradients: list[np.ndarray], rate: float, clip: float) -> np.ndarray:
    m = v = np.zeros_like(params)
    for t, g in enumerate(gradients, start=1):
        norm = np.sqrt(np.sum(g**2))
        g = g * min(1.0, clip / norm)
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        params = params - rate * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
    return params


@pytest.mark.parametrize("clip", [1e6, 0.5])
def test_descend_is_adam_with_a_clipped_global_norm(clip: float) -> None:
    rng = np.random.default_rng(0)
    start = rng.normal(size=6)
    gradients = [rng.normal(size=6), 3 * rng.normal(size=6), 0.01 * rng.normal(size=6)]

    def tree(flat: np.ndarray) -> dict[str, jax.Array]:
        flat = flat.astype(np.float32)
        return {"a": jnp.asarray(flat[:4].reshape(2, 2)), "b": jnp.asarray(flat[4:])}

    trained = init_trainable(tree(start))
    for gradient in gradients:
        trained = descend(trained, tree(gradient), 0.01, clip)
    expected = tree(adam(start, gradients, 0.01, clip))
    for name in expected:
        np.testing.assert_allclose(trained.params[name], expected[name], rtol=1e-5, atol=1e-6)


def test_clipping_joins_all_leaves_and_spares_small_gradients() -> None:
    zeros = {"a": jnp.zeros(1), "b": jnp.zeros(1)}
    gradient = {"a": jnp.array([3.0]), "b": jnp.array([4.0])}

    def first_moment(clip: float) -> list[float]:
        state = descend(init_trainable(zeros), gradient, 1e-3, clip).optimizer
        moments = [leaf for leaf in jax.tree.leaves(state) if leaf.shape == (1,)]
        return [float(leaf[0]) for leaf in moments[:2]]

    np.testing.assert_allclose(first_moment(5.0), [0.3, 0.4], rtol=1e-6)
    np.testing.assert_allclose(first_moment(1.0), [0.06, 0.08], rtol=1e-6)


def test_zero_gradient_moves_nothing() -> None:
    params = {"w": jnp.arange(3.0)}
    stepped = descend(init_trainable(params), {"w": jnp.zeros(3)}, 0.1, 1.0)
    assert stepped.params["w"].tolist() == [0.0, 1.0, 2.0]


def test_track_moves_by_the_rate() -> None:
    target, online = {"w": jnp.array([0.0, 4.0])}, {"w": jnp.array([1.0, 0.0])}
    np.testing.assert_allclose(track(target, online, 0.25)["w"], [0.25, 3.0])
    assert track(target, online, 1.0)["w"].tolist() == [1.0, 0.0]


def test_copy_shares_no_buffer() -> None:
    original = {"w": jnp.arange(4.0)}
    copied = copy(original)
    assert copied["w"].unsafe_buffer_pointer() != original["w"].unsafe_buffer_pointer()
    assert jnp.array_equal(copied["w"], original["w"])

"""Exploration with discrete actions: samples, their gradients, and the share that is random."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.method.exploration import epsilon, explore, greedy, gumbel_softmax, masked

A, DRAWS = 5, 4000
KEY = jax.random.key(0)
LOGITS = jnp.array([0.5, -1.0, 1.5, 30.0, 0.0])
AVAILABLE = jnp.array([True, True, True, False, True])
"""The action of by far the largest logit is not available."""


def many(x: Any) -> Any:
    return jnp.broadcast_to(x, (DRAWS, *x.shape))


def noise_like(logits: Any, key: Any = KEY) -> Any:
    return jax.random.gumbel(key, logits.shape, logits.dtype)


def policy() -> np.ndarray:
    """The softmax over available actions, in float64."""
    e = np.where(np.asarray(AVAILABLE), np.exp(np.asarray(LOGITS, np.float64)), 0.0)
    return np.asarray(e / e.sum())


def assert_distribution(actions: Any, expected: np.ndarray) -> None:
    """Counts within five standard deviations, and none where nothing is expected."""
    counts = np.bincount(np.asarray(actions), minlength=A)
    assert counts.sum() == DRAWS
    assert (counts[expected == 0] == 0).all()
    deviation = np.sqrt(DRAWS * expected * (1 - expected))
    assert (np.abs(counts - DRAWS * expected) <= 5 * deviation).all()


# --- samples that gradients pass through --------------------------------------------------------


def test_samples_are_one_hot_and_distributed_as_the_policy() -> None:
    samples = np.asarray(gumbel_softmax(many(LOGITS), many(AVAILABLE), noise_like(many(LOGITS))))
    assert samples.shape == (DRAWS, A)
    np.testing.assert_allclose(
        np.sort(samples, axis=-1), np.tile([0, 0, 0, 0, 1], (DRAWS, 1)), atol=1e-6
    )
    assert_distribution(samples.argmax(axis=-1), policy())


def test_what_is_not_available_is_never_sampled() -> None:
    """Whatever its logit, and wherever it stands."""
    keys = jax.random.split(KEY, 2)
    available = jax.random.bernoulli(keys[0], 0.4, (DRAWS, A)).at[:, 2].set(True)
    logits = jnp.where(available, -50.0, 50.0)
    samples = gumbel_softmax(logits, available, noise_like(logits, keys[1]))
    assert (jnp.where(available, 0.0, samples) == 0).all()
    np.testing.assert_allclose(samples.sum(axis=-1), 1.0, atol=1e-6)


def test_the_gradient_is_that_of_the_softmax_of_the_perturbed_logits() -> None:
    """The noise is the one thing that is taken from the package's own source of it."""
    score = jnp.array([1.0, -2.0, 0.5, 7.0, 3.0])
    noise = np.asarray(jax.random.gumbel(KEY, (A,)), np.float64)

    def value(logits: Any) -> Any:
        return jnp.sum(score * gumbel_softmax(logits, AVAILABLE, noise_like(logits)))

    e = np.where(np.asarray(AVAILABLE), np.exp(np.asarray(LOGITS, np.float64) + noise), 0.0)
    p = e / e.sum()
    assert int(np.argmax(p)) == int(
        np.argmax(gumbel_softmax(LOGITS, AVAILABLE, noise_like(LOGITS)))
    )
    # d/dx_j of sum_i s_i p_i is p_j (s_j - sum_i s_i p_i).
    expected = p * (np.asarray(score) - (p * np.asarray(score)).sum())
    got = jax.grad(value)(LOGITS)
    assert np.abs(expected).max() > 0.05
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-6)
    assert got[3] == 0
    # The value itself is that of the action sampled, not of a mixture.
    np.testing.assert_allclose(value(LOGITS), score[int(np.argmax(p))], rtol=1e-5)


@pytest.mark.parametrize("only", range(A))
def test_where_one_action_is_available_there_is_no_gradient(only: int) -> None:
    score = jnp.arange(1.0, 1.0 + A)
    available = jnp.arange(A) == only

    def value(logits: Any) -> Any:
        return jnp.sum(score * gumbel_softmax(logits, available, noise_like(logits)))

    assert value(LOGITS) == score[only]
    assert (jax.grad(value)(LOGITS) == 0).all()


# --- choices ------------------------------------------------------------------------------------


def test_greedy_is_the_best_of_what_is_available() -> None:
    logits = jnp.array([[1.0, 3.0, 2.0], [1.0, 3.0, 2.0], [-5e4, 3.0, 2.0]])
    available = jnp.array([[True, True, True], [True, False, True], [True, False, False]])
    got = greedy(logits, available)
    assert got.tolist() == [1, 2, 0]
    assert got.dtype == jnp.int32
    kept = masked(logits, available)
    assert jnp.array_equal(kept[available], logits[available])
    assert (jax.nn.softmax(kept, axis=-1)[~available] == 0).all()


def test_epsilon_falls_in_a_line_and_then_stays() -> None:
    got = [epsilon(step, 0.5, 0.1, 1000) for step in (0, 250, 500, 1000, 1001, 10**9)]
    np.testing.assert_allclose(got, [0.5, 0.4, 0.3, 0.1, 0.1, 0.1], rtol=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_share_of_choices_is_uniform_among_available_actions(share: float) -> None:
    uniform = np.asarray(AVAILABLE) / 4.0
    got = explore(many(LOGITS), many(AVAILABLE), jnp.float32(share), KEY)
    assert got.shape == (DRAWS,)
    assert got.dtype == jnp.int32
    assert_distribution(got, share * uniform + (1 - share) * policy())


def test_which_choices_are_random_is_drawn_for_each_agent() -> None:
    """Agents all but certain of action 0: whoever does another chose at random."""
    shape = (DRAWS, 2, A)
    certain = jnp.broadcast_to(jnp.where(jnp.arange(A) == 0, 100.0, 0.0), shape)
    got = explore(certain, jnp.ones(shape, bool), jnp.float32(0.5), KEY)
    random = np.asarray(got != 0)
    p = 0.5 * 4 / 5
    for frequency, expected in ((random.mean(axis=0), p), (random.all(axis=1).mean(), p * p)):
        bound = 5 * np.sqrt(expected * (1 - expected) / DRAWS)
        assert (np.abs(frequency - expected) < bound).all()

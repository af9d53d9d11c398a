"""Equations (1) to (7) against values worked out by hand."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.method import equations as eq

LN2 = np.log(2.0)


def bound_of(scores: Any) -> Any:
    """Eq. (3) of a batch's scores."""
    return eq.mutual_information_bound(eq.mutual_information_signal(scores))


def ln(*rows: list[float]) -> list[list[float]]:
    return np.log(np.array(rows)).tolist()


# Scores are logarithms, so that sp(ln x) = ln(1 + x) is a power of two.
CASES: dict[str, tuple[Callable[..., Any], list[Any], Any]] = {
    "td_target": (
        partial(eq.td_target, discount=0.9),
        [[1.0, 2.0, -1.0], [0.0, 1.0, 0.0], [10.0, 10.0, -4.0]],
        [10.0, 2.0, -4.6],
    ),
    "td_target without a future": (
        partial(eq.td_target, discount=0.0),
        [[1.0, -2.0], [0.0, 0.0], [7.0, 7.0]],
        [1.0, -2.0],
    ),
    # First critic (0 + 4) / 2, second critic (4 + 1) / 2.
    "td_loss of twins": (eq.td_loss, [[[1.0, 2.0], [3.0, 5.0]], [1.0, 4.0]], 4.5),
    "td_loss of one critic": (eq.td_loss, [[[1.0, 2.0]], [1.0, 4.0]], 2.0),
    "vfm": (eq.value_function_maximization_loss, [[1.0, 3.0], [10.0, -2.0]], -6.0),
    "signal of two samples": (
        eq.mutual_information_signal,
        [ln([3, 1], [7, 1])],
        [-np.log(4 / 3) - LN2, -LN2 - 3 * LN2],
    ),
    # Rows are states: the negatives of state 0 are the scores 3 and 1 of its own row.
    "signal of three samples": (
        eq.mutual_information_signal,
        [ln([1, 3, 1], [7, 1 / 3, 15], [1, 1, 1])],
        [-LN2 - 1.5 * LN2, -2 * LN2 - 3.5 * LN2, -2 * LN2],
    ),
    "signal of right large scores": (
        eq.mutual_information_signal,
        [[[1e4, -1e4], [-1e4, 1e4]]],
        [0.0, 0.0],
    ),
    "signal of wrong large scores": (
        eq.mutual_information_signal,
        [[[-1e4, 1e4], [1e4, -1e4]]],
        [-2e4, -2e4],
    ),
    "bound": (eq.mutual_information_bound, [[-2.5, -5.5, -2.0]], -10 / 3),
    "bound of three samples": (
        bound_of,
        [ln([1, 3, 1], [7, 1 / 3, 15], [1, 1, 1])],
        -(2.5 + 5.5 + 2) / 3 * LN2,
    ),
    "best_target": (eq.best_target, [[1.0, 5.0, -2.0], [2.0, 4.0, -2.0]], [2.0, 5.0, -2.0]),
    "state_value_loss": (eq.state_value_loss, [[1.0, 2.0], [4.0, 2.0]], 4.5),
    "weights": (eq.value_weights, [[3.0, 1.0, 2.0]], [1.0, 0.0, 0.5]),
    "weights of negative values": (eq.value_weights, [[-3.0, -1.0]], [0.0, 1.0]),
    "weights of equal values": (eq.value_weights, [[7.0, 7.0, 7.0]], [0.0, 0.0, 0.0]),
    "weights of large values": (eq.value_weights, [[1e30, -1e30, 0.0]], [1.0, 0.0, 0.5]),
    "vmm": (eq.value_aware_mi_loss, [[1.0, 0.0, 0.5], [-2.0, -100.0, -4.0]], 4 / 3),
    "vmm summed over each of two episodes": (
        partial(eq.value_aware_mi_loss, episodes=jnp.float32(2.0)),
        [[1.0, 0.0, 0.5], [-2.0, -100.0, -4.0]],
        2.0,
    ),
    # Two episodes of two agents; the second of episode 1 is dead. Of the first state, the own pairs
    # are 1 and 1/3, the negative is 3; of the second the own pair is 1, negatives are 7 and 1.
    "signal across two episodes": (
        eq.mutual_information_signal_across,
        [
            np.log([[[1.0, 1 / 3], [3.0, 31.0]], [[7.0, 1.0], [1.0, 63.0]]]).tolist(),
            [[1.0, 1.0], [1.0, 0.0]],
        ],
        [-1.5 * LN2 - 2 * LN2, -LN2 - 2 * LN2],
    ),
    "signal across episodes of which one is left": (
        eq.mutual_information_signal_across,
        [[[[5.0, -3.0], [9.0, 9.0]], [[9.0, 9.0], [9.0, 9.0]]], [[1.0, 1.0], [0.0, 0.0]]],
        [0.0, 0.0],
    ),
    "encoder_loss": (partial(eq.encoder_loss, vmm_weight=0.1), [2.0, 3.0], 2.3),
    "marl_policy_loss": (eq.marl_policy_loss, [[1.0, 3.0]], -2.0),
}


def plain(function: Callable[..., Any], args: list[Any]) -> Any:
    return function(*args)


def jitted(function: Callable[..., Any], args: list[Any]) -> Any:
    return jax.jit(function)(*args)


def vmapped(function: Callable[..., Any], args: list[Any]) -> Any:
    """The case's own row, between rows of other values."""
    stacks = [jnp.stack([0.5 * a - 1.0, a, 2.0 * a + 1.0]) for a in args]
    return jax.vmap(function)(*stacks)[1]


@pytest.mark.parametrize("way", [plain, jitted, vmapped], ids=lambda f: f.__name__)
@pytest.mark.parametrize("case", CASES)
def test_hand_worked(case: str, way: Callable[..., Any]) -> None:
    function, args, expected = CASES[case]
    result = way(function, [jnp.asarray(a, jnp.float32) for a in args])
    assert result.dtype == jnp.float32
    assert result.shape == np.shape(expected)
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-6)


def test_signal_against_the_double_loop() -> None:
    scores = np.random.default_rng(0).normal(scale=3, size=(6, 6))

    def sp(x: float) -> float:
        return float(np.log1p(np.exp(x)))

    expected = [
        -sp(-scores[t, t]) - np.mean([sp(scores[t, k]) for k in range(6) if k != t])
        for t in range(6)
    ]
    signal = eq.mutual_information_signal(jnp.asarray(scores, jnp.float32))
    np.testing.assert_allclose(signal, expected, rtol=1e-5)


def test_terminated_cuts_the_future_and_truncated_does_not() -> None:
    reward, next_value = jnp.array([1.0, 1.0]), jnp.array([50.0, 50.0])
    y = eq.td_target(reward, jnp.array([1.0, 0.0]), next_value, 0.5)
    assert y.tolist() == [1.0, 26.0]


def test_bound_prefers_matched_pairs() -> None:
    matched = bound_of(10.0 * jnp.eye(4))
    mismatched = bound_of(10.0 * (1.0 - jnp.eye(4)))
    blind = bound_of(jnp.zeros((4, 4)))
    assert mismatched < blind < matched
    np.testing.assert_allclose(blind, -2 * LN2, rtol=1e-6)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_gradients_of_the_signal_stay_finite(size: float) -> None:
    scores = size * jax.random.normal(jax.random.key(0), (5, 5))
    gradient = jax.grad(bound_of)(scores)
    assert jnp.isfinite(gradient).all()


def test_gradient_through_equal_weights_is_finite() -> None:
    gradient = jax.grad(lambda v: jnp.sum(eq.value_weights(v) * jnp.arange(3.0)))(jnp.ones(3))
    assert jnp.isfinite(gradient).all()


def test_weights_ignore_the_values_scale_and_offset() -> None:
    value = jax.random.normal(jax.random.key(1), (20,))
    np.testing.assert_allclose(
        eq.value_weights(3.0 * value - 5.0), eq.value_weights(value), atol=1e-5
    )


# --- masks --------------------------------------------------------------------------------------

REAL = np.array([True, False, True, True, False, False, True])

# Equation -> the shapes of what it is given before its mask; the samples are the last axis.
MASKED: dict[str, tuple[Callable[..., Any], list[tuple[int, ...]]]] = {
    "expectation": (eq.expectation, [()]),
    "expectation of rows": (eq.expectation, [(2, 3)]),
    "td_loss of one critic": (eq.td_loss, [(1,), ()]),
    "td_loss of twins": (eq.td_loss, [(2,), ()]),
    "vfm": (eq.value_function_maximization_loss, [(), ()]),
    "bound": (eq.mutual_information_bound, [()]),
    "state_value_loss": (eq.state_value_loss, [(), ()]),
    "vmm": (eq.value_aware_mi_loss, [(), ()]),
    "marl_policy_loss": (eq.marl_policy_loss, [()]),
}


def samples(shapes: list[tuple[int, ...]]) -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    return [rng.normal(size=(*shape, REAL.size)).astype(np.float32) for shape in shapes]


@pytest.mark.parametrize("padding", [0.0, -1e6, 1e6, np.nan, np.inf])
@pytest.mark.parametrize("case", MASKED)
def test_a_masked_batch_is_the_batch_without_its_padding(case: str, padding: float) -> None:
    function, shapes = MASKED[case]
    given = samples(shapes)
    alone = function(*(jnp.asarray(x[..., REAL]) for x in given))
    padded = [jnp.asarray(np.where(REAL, x, np.float32(padding))) for x in given]
    masked = jax.jit(function)(*padded, jnp.asarray(REAL, jnp.float32))
    assert masked.dtype == jnp.float32
    np.testing.assert_allclose(masked, alone, rtol=1e-5)
    # Without the mask the padding would count.
    assert not np.allclose(function(*padded), alone, rtol=1e-3)


@pytest.mark.parametrize("case", [case for case in MASKED if "rows" not in case])
def test_padding_gets_no_gradient(case: str) -> None:
    function, shapes = MASKED[case]
    given = samples(shapes)
    places = tuple(range(len(given)))
    alone = jax.grad(function, argnums=places)(*(jnp.asarray(x[..., REAL]) for x in given))
    mask = jnp.asarray(REAL, jnp.float32)
    masked = jax.grad(function, argnums=places)(*map(jnp.asarray, given), mask)
    for a, m in zip(alone, masked, strict=True):
        np.testing.assert_allclose(np.asarray(m)[..., REAL], a, rtol=1e-5)
        assert (np.asarray(m)[..., ~REAL] == 0).all()


@pytest.mark.parametrize("case", MASKED)
def test_a_mask_of_ones_is_no_mask(case: str) -> None:
    function, shapes = MASKED[case]
    given = [jnp.asarray(x) for x in samples(shapes)]
    np.testing.assert_allclose(
        function(*given, jnp.ones(REAL.size)), function(*given), rtol=1e-5, atol=1e-7
    )


@pytest.mark.parametrize("padding", [-1e6, 0.0, 1e6, np.nan])
def test_weights_normalise_over_the_real_samples(padding: float) -> None:
    (value,) = samples([()])
    padded = jnp.asarray(np.where(REAL, value, np.float32(padding)))
    weights = eq.value_weights(padded, jnp.asarray(REAL, jnp.float32))
    alone = eq.value_weights(jnp.asarray(value[REAL]))
    np.testing.assert_allclose(np.asarray(weights)[REAL], alone, rtol=1e-6)
    assert sorted(np.asarray(weights)[REAL].tolist())[:: REAL.sum() - 1] == [0.0, 1.0]


@pytest.mark.parametrize("padding", [-1e4, 0.0, 1e4])
def test_negatives_are_the_real_samples(padding: float) -> None:
    scores = 3.0 * np.random.default_rng(4).normal(size=(REAL.size, REAL.size))
    both = REAL[:, None] & REAL
    padded = jnp.asarray(np.where(both, scores, padding), jnp.float32)
    signal = eq.mutual_information_signal(padded, jnp.asarray(REAL, jnp.float32))
    n = int(REAL.sum())
    alone = eq.mutual_information_signal(jnp.asarray(scores[both].reshape(n, n), jnp.float32))
    np.testing.assert_allclose(np.asarray(signal)[REAL], alone, rtol=1e-5)
    every = eq.mutual_information_signal(padded)
    assert not np.allclose(np.asarray(every)[REAL], alone, rtol=1e-3)


def test_a_lone_sample_has_no_negatives() -> None:
    scores = jnp.array([[np.log(3.0), 5.0], [5.0, 5.0]], jnp.float32)
    signal = eq.mutual_information_signal(scores, jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(signal[0], -np.log(4 / 3), rtol=1e-6)

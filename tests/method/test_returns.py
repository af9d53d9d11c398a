"""Lambda returns against hand-worked cases and against the n-step returns they are made of."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.method.returns import lambda_returns

T = 4
LENGTHS = (4, 1, 3, 2)
ENDS = (1.0, 1.0, 0.0, 0.0)
"""Whether the task itself ended each episode; the others were cut off."""


Columns = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""Rewards, terminations, next values, and where steps were made, [T, 4]."""


def batch(padding: float = 0.0) -> Columns:
    """Unequal episodes."""
    rng = np.random.default_rng(0)
    reward, value = rng.normal(size=(2, T, len(LENGTHS)))
    terminated = np.zeros((T, len(LENGTHS)))
    for e, (length, end) in enumerate(zip(LENGTHS, ENDS, strict=True)):
        terminated[length - 1, e] = end
        for column in (reward, value, terminated):
            column[length:, e] = padding
    reward, terminated, value = (jnp.asarray(x, jnp.float32) for x in (reward, terminated, value))
    return reward, terminated, value, jnp.asarray(np.arange(T)[:, None] < np.array(LENGTHS))


def returns(columns: Columns, td_lambda: float) -> np.ndarray:
    return np.asarray(lambda_returns(*columns, 0.9, td_lambda))


def test_a_case_worked_out_by_hand() -> None:
    """Discount 1/2, lambda 1/4; values of the moments after the steps are 8, 4, 16.

    Cut off after step 2, the last target bootstraps from the moment after it::

        G_2 = 3 + 1/2 * 16                          = 11
        G_1 = 2 + 1/2 * (3/4 *  4 + 1/4 * 11)       = 2 + 1/2 * 5.75    = 4.875
        G_0 = 1 + 1/2 * (3/4 *  8 + 1/4 * 4.875)    = 1 + 1/2 * 7.21875 = 4.609375

    Where the task ended at step 2 instead::

        G_2 = 3
        G_1 = 2 + 1/2 * (3/4 *  4 + 1/4 * 3)        = 2 + 1/2 * 3.75    = 3.875
        G_0 = 1 + 1/2 * (3/4 *  8 + 1/4 * 3.875)    = 1 + 1/2 * 6.96875 = 4.484375
    """
    reward, value = jnp.array([1.0, 2.0, 3.0]), jnp.array([8.0, 4.0, 16.0])
    acted = jnp.ones(3, bool)
    cut = lambda_returns(reward, jnp.zeros(3), value, acted, 0.5, 0.25)
    ended = lambda_returns(reward, jnp.array([0.0, 0.0, 1.0]), value, acted, 0.5, 0.25)
    assert cut.tolist() == [4.609375, 4.875, 11.0]
    assert ended.tolist() == [4.484375, 3.875, 3.0]


def test_lambda_0_looks_one_step_ahead() -> None:
    reward, terminated, value, acted = batch()
    expected = reward + 0.9 * (1.0 - terminated) * value
    np.testing.assert_allclose(
        returns((reward, terminated, value, acted), 0.0), jnp.where(acted, expected, 0.0), rtol=1e-6
    )


def test_lambda_1_is_the_discounted_sum_and_what_follows_a_cut() -> None:
    reward, terminated, value, acted = batch()
    got = returns((reward, terminated, value, acted), 1.0)
    for e, (steps, end) in enumerate(zip(LENGTHS, ENDS, strict=True)):
        for t in range(steps):
            total = sum(0.9 ** (k - t) * float(reward[k, e]) for k in range(t, steps))
            if not end:
                total += 0.9 ** (steps - t) * float(value[steps - 1, e])
            np.testing.assert_allclose(got[t, e], total, rtol=1e-5)


@pytest.mark.parametrize("td_lambda", [0.3, 0.8])
def test_between_them_n_step_returns_are_weighted_by_powers_of_lambda(td_lambda: float) -> None:
    """The forward view; the longest return has the weight that is left."""
    reward, terminated, value, _ = (np.asarray(column, np.float64) for column in batch())
    got = returns(batch(), td_lambda)
    for e, steps in enumerate(LENGTHS):
        for t in range(steps):
            expected, left = 0.0, 1.0
            for n in range(1, steps - t + 1):
                last = t + n - 1
                ahead = sum(0.9**k * reward[t + k, e] for k in range(n))
                ahead += 0.9**n * value[last, e] * (1 - terminated[last, e])
                weight = left if last == steps - 1 else left * (1 - td_lambda)
                left -= weight
                expected += weight * ahead
            np.testing.assert_allclose(got[t, e], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("padding", [1e6, np.inf, np.nan])
@pytest.mark.parametrize("td_lambda", [0.0, 0.8, 1.0])
def test_what_stands_behind_the_end_changes_nothing(padding: float, td_lambda: float) -> None:
    got = returns(batch(padding), td_lambda)
    np.testing.assert_array_equal(got, returns(batch(), td_lambda))
    behind = np.arange(T)[:, None] >= np.array(LENGTHS)
    assert (got[behind] == 0).all()
    assert (got[~behind] != 0).all()


def test_what_follows_an_end_of_the_task_counts_for_nothing() -> None:
    """The value of the moment after it may be anything; after a cut it may not."""
    reward, terminated, value, acted = batch()
    usual = returns((reward, terminated, value, acted), 0.8)
    for e, (steps, end) in enumerate(zip(LENGTHS, ENDS, strict=True)):
        spoiled = value.at[steps - 1, e].set(jnp.nan)
        got = returns((reward, terminated, spoiled, acted), 0.8)
        others = np.arange(len(LENGTHS)) != e
        np.testing.assert_array_equal(got[:, others], usual[:, others])
        if end:
            np.testing.assert_array_equal(got, usual)
        else:
            assert np.isnan(got[:steps, e]).all()


def test_unequal_episodes_are_worked_out_one_by_one() -> None:
    columns = batch(padding=5.0)
    together = returns(columns, 0.8)
    for e, steps in enumerate(LENGTHS):
        reward, terminated, value = (column[:steps, e] for column in columns[:3])
        alone = lambda_returns(reward, terminated, value, jnp.ones(steps, bool), 0.9, 0.8)
        np.testing.assert_allclose(together[:steps, e], alone, rtol=1e-6)


def test_an_episode_without_a_step_has_no_targets() -> None:
    reward, terminated, value, acted = batch()
    got = returns((reward, terminated, value, jnp.zeros_like(acted)), 0.8)
    assert (got == 0).all()


def test_compiled_and_over_further_axes() -> None:
    columns = batch()
    eager = returns(columns, 0.8)
    one = partial(lambda_returns, discount=0.9, td_lambda=0.8)
    np.testing.assert_allclose(jax.jit(one)(*columns), eager, rtol=1e-6)
    each = jax.vmap(one, in_axes=1, out_axes=1)(*columns)
    np.testing.assert_allclose(each, eager, rtol=1e-6)
    folded = [c.reshape(T, 2, 2) for c in columns]
    np.testing.assert_allclose(one(*folded), eager.reshape(T, 2, 2), rtol=1e-6)


def test_an_impatient_learner_sees_rewards_alone() -> None:
    reward, terminated, value, acted = batch()
    np.testing.assert_array_equal(
        lambda_returns(reward, terminated, value, acted, 0.0, 0.8), reward
    )


@pytest.mark.parametrize("padding", [0.0, np.nan])
def test_episodes_that_lie_end_to_end_are_worked_out_one_by_one(padding: float) -> None:
    """Behind each lies the moment after its last step, where no step was made."""
    columns = batch(padding=5.0)
    together = returns(columns, 0.8)
    pieces: list[list[np.ndarray]] = [[], [], [], []]
    for e, steps in enumerate(LENGTHS):
        for piece, column in zip(pieces, columns, strict=True):
            piece.append(np.asarray(column[:steps, e]))
            piece.append(np.full(1, False if column.dtype == bool else padding, piece[0].dtype))
    reward, terminated, value, acted = (jnp.asarray(np.concatenate(piece)) for piece in pieces)
    got = lambda_returns(reward, terminated, value, acted, 0.9, 0.8)
    expected = [np.append(together[:steps, e], 0.0) for e, steps in enumerate(LENGTHS)]
    np.testing.assert_allclose(got, np.concatenate(expected), rtol=1e-6)

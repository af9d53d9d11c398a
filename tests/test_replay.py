"""The replay buffer against a deque."""

from collections import deque

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from race.replay import Replay, init_replay, insert, sample
from race.types import EnvSpec, Transition

CAPACITY, ROWS = 7, 5
SPEC = EnvSpec("t", 2, ((0,), (1,)), ((0,), (1,)), (-1.0, -1.0), (1.0, 1.0), 5)

_insert = jax.jit(insert)
_sample = jax.jit(sample, static_argnames="batch_size")


def rows_from(first: int, length: int = ROWS) -> Transition:
    """Transitions first, first + 1, ..., each recognisable in every column."""
    n = np.arange(first, first + length, dtype=np.float32)
    wide = np.stack([n, n + 0.25], axis=1)
    return Transition(wide, -wide, 2 * n, n % 2, wide + 0.5)


def filled(inserted: int) -> Replay:
    replay, first = init_replay(SPEC, CAPACITY), 0
    while first < inserted:
        count = min(ROWS, inserted - first)
        replay = _insert(replay, rows_from(first), jnp.int32(count))
        first += count
    return replay


@settings(deadline=None, max_examples=60)
@given(st.lists(st.integers(0, ROWS), max_size=8))
def test_holds_what_a_deque_holds(counts: list[int]) -> None:
    replay, model, first = init_replay(SPEC, CAPACITY), deque[int](maxlen=CAPACITY), 1
    for count in counts:
        # Rows behind `count` must not be stored: they are poisoned.
        rows = rows_from(first)
        for column in rows:
            column[count:] = np.nan
        replay = _insert(replay, rows, jnp.int32(count))
        model.extend(range(first, first + count))
        first += count
    assert int(replay.inserted) == sum(counts)
    data = jax.tree.map(np.asarray, replay.data)
    stored = data.state[:, 0]
    assert sorted(stored[: len(model)].tolist()) == [float(n) for n in model]
    assert (stored[len(model) :] == 0).all()
    for place, n in enumerate(stored[: len(model)]):
        expected = rows_from(int(n), 1)
        for column, new in zip(data, expected, strict=True):
            np.testing.assert_array_equal(column[place], new[0])


def test_newest_rows_lie_over_the_oldest() -> None:
    replay = filled(9)
    assert replay.data.state[:, 0].tolist() == [7, 8, 2, 3, 4, 5, 6]


def test_rows_as_long_as_the_capacity() -> None:
    replay = insert(
        filled(3), jax.tree.map(jnp.asarray, rows_from(10, CAPACITY)), jnp.int32(CAPACITY)
    )
    assert sorted(replay.data.state[:, 0].tolist()) == list(range(10, 17))


def test_starts_empty_in_float32() -> None:
    replay = init_replay(SPEC, CAPACITY)
    assert replay.capacity == CAPACITY
    assert int(replay.inserted) == 0
    assert {column.dtype for column in replay.data} == {jnp.dtype(jnp.float32)}
    assert replay.data.next_state.shape == (CAPACITY, 2)


@pytest.mark.parametrize(("inserted", "present"), [(1, 1), (4, 4), (7, 7), (16, 7)])
def test_sampling_is_uniform_over_what_is_stored(inserted: int, present: int) -> None:
    draws = 7000
    batch = _sample(filled(inserted), batch_size=draws, key=jax.random.key(3))
    numbers, counts = np.unique(np.asarray(batch.state[:, 0]), return_counts=True)
    assert numbers.tolist() == list(range(inserted - present, inserted))
    p = 1 / present
    assert (np.abs(counts - draws * p) <= 5 * np.sqrt(draws * p * (1 - p))).all()


def test_sampled_columns_belong_together() -> None:
    batch = _sample(filled(12), batch_size=20, key=jax.random.key(0))
    n = batch.state[:, 0]
    np.testing.assert_array_equal(batch.reward, 2.0 * n)
    np.testing.assert_array_equal(batch.terminated, n % 2.0)
    np.testing.assert_array_equal(batch.next_state[:, 1], n + 0.75)


def test_samples_differ_between_keys() -> None:
    replay = filled(7)
    one, two = (_sample(replay, batch_size=20, key=jax.random.key(k)) for k in (0, 1))
    assert not jnp.array_equal(one.reward, two.reward)

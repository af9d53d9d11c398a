"""The replay buffer against a deque."""

from collections import deque

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from race.replay.buffer import (
    Layout,
    Replay,
    distinct_places,
    init_replay,
    insert,
    sample,
    slots_of,
)
from race.rollouts.episodes import empty_episode
from race.rollouts.transitions import empty_transition
from race.types import DiscreteSpec, EnvSpec, Episode, Transition

CAPACITY, ROWS = 7, 5
SPEC = EnvSpec("t", 2, ((0,), (1,)), ((0,), (1,)), (-1.0, -1.0), (1.0, 1.0), 5)
DISCRETE = DiscreteSpec("d", n_agents=2, obs_size=3, state_size=4, n_actions=5, episode_limit=6)
ITEM = empty_transition(SPEC)

_insert = jax.jit(insert)
_sample = jax.jit(sample, static_argnames="batch_size")
_distinct_places = jax.jit(distinct_places, static_argnames="batch_size")
_slots_of = jax.jit(slots_of)


def rows_from(first: int, length: int = ROWS) -> Transition:
    """Transitions first, first + 1, ..., each recognisable in every column."""
    n = np.arange(first, first + length, dtype=np.float32)
    wide = np.stack([n, n + 0.25], axis=1)
    return Transition(wide, -wide, 2 * n, n % 2, wide + 0.5)


def filled(inserted: int) -> Replay:
    replay, first = init_replay(ITEM, CAPACITY), 0
    while first < inserted:
        count = min(ROWS, inserted - first)
        replay = _insert(replay, rows_from(first), jnp.int32(count))
        first += count
    return replay


@settings(deadline=None, max_examples=60)
@given(st.lists(st.integers(0, ROWS), max_size=8))
def test_holds_what_a_deque_holds(counts: list[int]) -> None:
    replay, model, first = init_replay(ITEM, CAPACITY), deque[int](maxlen=CAPACITY), 1
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
    replay = init_replay(ITEM, CAPACITY)
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


# --- whole episodes -----------------------------------------------------------------------------


def episodes_from(first: int, length: int = ROWS) -> Episode:
    """Episodes first, first + 1, ..., every entry of which tells number, column and moment."""
    numbers = np.arange(first, first + length)
    steps = DISCRETE.episode_limit
    empty = empty_episode(DISCRETE, "float32", length)
    ones = [np.ones_like(column) for column in empty]

    def fill(column: np.ndarray, scale: float) -> np.ndarray:
        """[n, moments, ...] of ``scale * (100 n + moment)``."""
        moments = 100 * numbers[:, None] + np.arange(column.shape[1])
        told = scale * moments.reshape(*moments.shape, *[1] * (column.ndim - 2))
        return (told * column).astype(column.dtype)

    obs, state, available, action, reward, terminated, _ = ones
    return Episode(
        obs=fill(obs, 1.0),
        state=fill(state, -1.0),
        avail_actions=np.broadcast_to(
            (numbers % 2 == 0)[:, None, None, None], available.shape
        ).copy(),
        action=(fill(action.astype(np.int64), 1.0) % 5).astype(action.dtype),
        reward=fill(reward, 2.0),
        terminated=fill(terminated, 3.0),
        length=(numbers % steps + 1).astype(np.int32),
    )


def filled_with_episodes(inserted: int) -> Replay:
    replay, first = init_replay(empty_episode(DISCRETE, "float32"), CAPACITY), 0
    while first < inserted:
        count = min(ROWS, inserted - first)
        replay = _insert(replay, episodes_from(first), jnp.int32(count))
        first += count
    return replay


@pytest.mark.parametrize("precision", ["float16", "float32"])
def test_columns_have_the_shapes_and_types_of_the_item(precision: str) -> None:
    item = empty_episode(DISCRETE, precision)
    replay = init_replay(item, CAPACITY)
    assert replay.capacity == CAPACITY
    assert replay.data.obs.dtype == precision
    for column, one in zip(replay.data, item, strict=True):
        assert column.shape == (CAPACITY, *one.shape)
        assert column.dtype == one.dtype
        assert not np.asarray(column).any()


def test_slots_hold_the_moments_of_their_episodes_and_nothing_else() -> None:
    replay = filled_with_episodes(12)
    # Place 3 holds episode 10 since the eleventh was stored, place 6 still episode 6.
    numbers = {3: 10, 6: 6}
    lengths = {place: int(replay.data.length[place]) for place in numbers}
    assert lengths == {3: 5, 6: 1}
    place = np.array([[3, 6], [3, 6], [3, 0], [3, 3], [3, 3], [3, 3], [0, 0]], np.int32)
    time = np.array([[0, 0], [1, 1], [2, -1], [3, 0], [4, 1], [5, 2], [-1, -1]], np.int32)
    slots = _slots_of(replay, Layout(jnp.asarray(place), jnp.asarray(time)))
    for slot, row in np.ndindex(place.shape):
        t, there = time[slot, row], place[slot, row]
        step = bool(0 <= t < lengths.get(there, 0)) and t >= 0
        assert bool(slots.real[slot, row]) == (t >= 0)
        assert bool(slots.acted[slot, row]) == step
        assert bool(slots.first[slot, row]) == (t == 0)
        whole = episodes_from(numbers.get(there, 0), 1)
        for name in ("obs", "state", "avail_actions"):
            expected = getattr(whole, name)[0, t] if t >= 0 else 0
            np.testing.assert_array_equal(getattr(slots, name)[slot, row], expected)
        for name in ("action", "reward", "terminated"):
            expected = getattr(whole, name)[0, t] if step else 0
            np.testing.assert_array_equal(getattr(slots, name)[slot, row], expected)
        before = whole.action[0, t - 1] if t > 0 else -1
        np.testing.assert_array_equal(slots.last_action[slot, row], before)
    for name in ("obs", "state", "avail_actions", "action", "reward", "terminated"):
        assert getattr(slots, name).dtype == getattr(replay.data, name).dtype


@pytest.mark.parametrize(("inserted", "present"), [(2, 2), (5, 5), (7, 7), (16, 7)])
def test_distinct_places_are_uniform_subsets_of_what_is_stored(inserted: int, present: int) -> None:
    replay, size, draws = filled_with_episodes(inserted), 2, 2000
    keys = jax.random.split(jax.random.key(5), draws)
    places = np.asarray(jax.vmap(lambda key: _distinct_places(replay, size, key))(keys))
    assert places.dtype == np.int32
    assert (places[:, 0] != places[:, 1]).all()
    assert set(places.ravel().tolist()) == set(range(present))
    for column in places.T:
        counts = np.bincount(column, minlength=present)
        p = 1 / present
        assert (np.abs(counts - draws * p) <= 5 * np.sqrt(draws * p * (1 - p))).all()


def test_all_that_is_stored_can_be_drawn_at_once() -> None:
    places = _distinct_places(filled_with_episodes(5), 5, jax.random.key(0))
    assert sorted(places.tolist()) == list(range(5))

"""Episodes laid end to end: each whole, in one row, and nowhere else."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from race.replay.packing import ROWS, bins, layouts, rows_for

LIMIT = 9
episode_lengths = st.lists(st.integers(1, LIMIT), min_size=1, max_size=40)


@given(episode_lengths)
def test_every_episode_is_in_one_row_and_no_row_overflows(lengths: list[int]) -> None:
    rows = bins(lengths, LIMIT)
    assert sorted(e for row in rows for e in row) == list(range(len(lengths)))
    assert all(sum(lengths[e] for e in row) <= LIMIT for row in rows)


@given(episode_lengths)
def test_at_most_one_row_is_no_more_than_half_full(lengths: list[int]) -> None:
    filled = sorted(sum(lengths[e] for e in row) for row in bins(lengths, LIMIT))
    assert all(2 * moments > LIMIT for moments in filled[1:])


@given(st.lists(st.lists(st.integers(1, LIMIT), min_size=5, max_size=5), min_size=1, max_size=4))
def test_layouts_hold_every_moment_once_in_order(lengths: list[list[int]]) -> None:
    steps = len(lengths)
    places = np.stack([np.random.default_rng(s).permutation(50)[:5] for s in range(steps)])
    layout = layouts(places, np.array(lengths), LIMIT, room=steps + 1)
    assert layout.time.shape == layout.place.shape
    assert layout.time.shape[:2] == (steps + 1, LIMIT + 1)
    assert layout.time.shape[2] in ROWS
    assert (layout.time[steps] == -1).all()
    for step in range(steps):
        # Down the rows, one after the other, every episode counts from 0 to its length.
        time, place = layout.time[step].T.ravel(), layout.place[step].T.ravel()
        starts = np.flatnonzero(time == 0)
        assert sorted(place[starts].tolist()) == sorted(places[step].tolist())
        for start in starts.tolist():
            length = lengths[step][places[step].tolist().index(place[start])]
            row_end = (start // (LIMIT + 1) + 1) * (LIMIT + 1)
            assert start + length + 1 <= row_end
            there = slice(start, start + length + 1)
            assert time[there].tolist() == list(range(length + 1))
            assert (place[there] == place[start]).all()
        assert (time >= 0).sum() == sum(lengths[step]) + 5


def test_rows_are_those_in_use() -> None:
    assert [rows_for(n) for n in ROWS] == list(ROWS)
    assert [rows_for(n) for n in (7, 9, 13, 31)] == [8, 10, 16, 32]
    assert [rows_for(n) for n in (33, 64, 65)] == [64, 64, 128]


def test_never_more_rows_than_episodes() -> None:
    places = np.arange(7)[None]
    assert layouts(places, np.full((1, 7), LIMIT), LIMIT).time.shape == (1, LIMIT + 1, 7)


@pytest.mark.parametrize("count", [1, 3])
def test_as_many_rows_as_the_fullest_minibatch_needs(count: int) -> None:
    places = np.arange(6)[None].repeat(count, axis=0)
    lengths = np.full((count, 6), LIMIT)
    lengths[1:] = 1
    assert layouts(places, lengths, LIMIT).time.shape == (count, LIMIT + 1, 6)

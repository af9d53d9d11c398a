"""Laying a minibatch of episodes of unequal lengths end to end in rows.

Most episodes are far shorter than the longest in a buffer. Side by side they would be
mostly padding; end to end in rows as long as an episode can be, they are not. What is computed of
an episode does not depend on where it lies.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from race.replay.buffer import Layout

ROWS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32)
"""Numbers of rows that are used: few, because each is a program, which takes seconds to compile
and some 2,500 of the 65,530 memory mappings that Linux allows a process."""


def rows_for(needed: int) -> int:
    """The smallest number of rows in use that is large enough; beyond `ROWS` a power of two."""
    return next((rows for rows in ROWS if rows >= needed), 1 << (needed - 1).bit_length())


def bins(lengths: Sequence[int], size: int) -> list[list[int]]:
    """Which episodes share a row: first fit, longest first.

    Args:
        lengths: moments of each episode, none more than ``size``.
        size: slots of a row.

    Returns:
        For each row, the episodes in it, by their places in ``lengths``.
    """
    rows: list[list[int]] = []
    free: list[int] = []
    for episode in sorted(range(len(lengths)), key=lambda e: -lengths[e]):
        row = next((r for r, left in enumerate(free) if left >= lengths[episode]), len(rows))
        if row == len(rows):
            rows.append([])
            free.append(size)
        rows[row].append(episode)
        free[row] -= lengths[episode]
    return rows


def widened(layout: Layout, rows: int) -> Layout:
    """The same with empty rows behind the others, ``rows`` in all."""
    more = [(0, 0), (0, 0), (0, rows - layout.time.shape[2])]
    return Layout(np.pad(layout.place, more), np.pad(layout.time, more, constant_values=-1))


def layouts(
    places: Int[np.ndarray, "steps B"],
    lengths: Int[np.ndarray, "steps B"],
    limit: int,
    room: int | None = None,
) -> Layout:
    """The layouts of several minibatches, in as many rows as the fullest of them needs.

    There are never more rows than episodes.

    Args:
        places: of the episodes in the buffer.
        lengths: their steps.
        limit: most steps of an episode.
        room: size of the result's leading axis, if that is to be more than the minibatches.

    Returns:
        With a leading axis ``room``; empty behind the last minibatch.
    """
    size = limit + 1
    found = [bins((minibatch + 1).tolist(), size) for minibatch in lengths]
    rows = min(rows_for(max(map(len, found))), places.shape[1])
    shape = (max(room or 0, len(found)), size, rows)
    place, time = np.zeros(shape, np.int32), np.full(shape, -1, np.int32)
    for step, minibatch in enumerate(found):
        for row, episodes in enumerate(minibatch):
            slot = 0
            for episode in episodes:
                moments = int(lengths[step, episode]) + 1
                place[step, slot : slot + moments, row] = places[step, episode]
                time[step, slot : slot + moments, row] = np.arange(moments)
                slot += moments
    return Layout(place, time)

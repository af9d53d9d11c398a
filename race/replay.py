"""A ring buffer on the device, of transitions or of whole episodes.

It is written and read inside compiled functions.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from race.types import Episode


class Replay(NamedTuple):
    """The newest ``capacity`` items."""

    data: Any  # a NamedTuple of columns, leading axis: capacity
    inserted: Int[Array, ""]  # items ever inserted

    @property
    def capacity(self) -> int:
        """Items that fit."""
        return int(jax.tree.leaves(self.data)[0].shape[0])


def init_replay(item: Any, capacity: int) -> Replay:
    """An empty buffer for items of the shapes and dtypes of ``item``."""
    data = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), item)
    return Replay(data, jnp.zeros((), jnp.int32))


def insert(replay: Replay, rows: Any, count: Int[Array, ""]) -> Replay:
    """Appends the first ``count`` of ``rows``, over the oldest items once full.

    ``rows`` has a fixed length (no longer than the capacity), so that one compiled program serves
    rollouts of any length.
    """
    capacity = replay.capacity
    offsets = jnp.arange(jax.tree.leaves(rows)[0].shape[0], dtype=jnp.int32)
    # Rows behind `count` point outside the buffer, where a scatter drops them.
    places = jnp.where(offsets < count, (replay.inserted + offsets) % capacity, capacity)
    data = jax.tree.map(
        lambda column, new: column.at[places].set(new, mode="drop"), replay.data, rows
    )
    return Replay(data, replay.inserted + count)


def sample(replay: Replay, batch_size: int, key: PRNGKeyArray) -> Any:
    """A minibatch drawn uniformly, with replacement, from what is stored."""
    places = jax.random.randint(key, (batch_size,), 0, _filled(replay))
    return jax.tree.map(lambda column: column[places], replay.data)


def distinct_places(replay: Replay, batch_size: int, key: PRNGKeyArray) -> Int[Array, "B"]:
    """Places of a minibatch drawn uniformly, without replacement; there must be that many."""
    lots = jax.random.uniform(key, (replay.capacity,))
    taken = jnp.arange(replay.capacity, dtype=jnp.int32) < _filled(replay)
    return jax.lax.top_k(jnp.where(taken, lots, -1.0), batch_size)[1].astype(jnp.int32)


def episodes_at(replay: Replay, places: Int[Array, "B"], steps: int) -> Episode:
    """The first ``steps`` steps of some episodes, none of which is longer."""
    data: Episode = replay.data

    def cut(column: Array, moments: int) -> Array:
        size = (moments, *column.shape[2:])

        def one(place: Int[Array, ""]) -> Array:
            zero = jnp.zeros_like(place)
            start = (place, *[zero] * (column.ndim - 1))
            return jax.lax.dynamic_slice(column, start, (1, *size))[0]

        # Not in a loop, which would copy the whole column into its state.
        return jax.vmap(one)(places)

    return Episode(
        obs=cut(data.obs, steps + 1),
        state=cut(data.state, steps + 1),
        avail_actions=cut(data.avail_actions, steps + 1),
        action=cut(data.action, steps),
        reward=cut(data.reward, steps),
        terminated=cut(data.terminated, steps),
        length=data.length[places],
    )


def _filled(replay: Replay) -> Int[Array, ""]:
    return jnp.minimum(replay.inserted, replay.capacity)

"""A ring buffer on the device, of transitions or of whole episodes.

It is written and read inside compiled functions.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from race.types import Episode, Slots


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


class Layout(NamedTuple):
    """Which moment of which episode lies in which slot of a minibatch (`race.replay.packing`)."""

    place: Int[Any, "L R"]  # of the episode in the buffer; 0 in empty slots
    time: Int[Any, "L R"]  # of the moment in its episode; -1 in empty slots


def slots_of(replay: Replay, layout: Layout) -> Slots:
    """The minibatch of a layout. Empty slots hold zeros."""
    data: Episode = replay.data
    real, time = layout.time >= 0, jnp.maximum(layout.time, 0)
    acted = real & (time < data.length[layout.place])
    before = jnp.maximum(time - 1, 0)
    made = jnp.minimum(time, data.reward.shape[1] - 1)  # no step follows the last moment

    def at(column: Array, time: Array, there: Array) -> Array:
        found = column[layout.place, time]
        shown = there.reshape(*there.shape, *[1] * (found.ndim - 2))
        return jnp.where(shown, found, jnp.zeros_like(found))

    last_action = data.action[layout.place, before].astype(jnp.int32)
    return Slots(
        obs=at(data.obs, time, real),
        state=at(data.state, time, real),
        avail_actions=at(data.avail_actions, time, real),
        action=at(data.action, made, acted),
        last_action=jnp.where((layout.time > 0)[..., None], last_action, -1),
        reward=at(data.reward, made, acted),
        terminated=at(data.terminated, made, acted),
        first=layout.time == 0,
        acted=acted,
        real=real,
        moment=layout.place * data.obs.shape[1] + time,
    )


def _filled(replay: Replay) -> Int[Array, ""]:
    return jnp.minimum(replay.inserted, replay.capacity)

"""A ring buffer on the device, of transitions or of whole episodes.

It is written and read inside compiled functions.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from race.types import Episode, Slots


class Replay(NamedTuple):
    """The newest ``capacity`` items."""

    data: Any  # a NamedTuple of columns, leading axis: capacity
    inserted: Int[Array, ""]  # items ever inserted
    own: Bool[Array, "capacity"] | None = None  # made by the MARL team; None: nobody asks

    @property
    def capacity(self) -> int:
        """Items that fit."""
        return int(jax.tree.leaves(self.data)[0].shape[0])


def init_replay(item: Any, capacity: int, owned: bool = False) -> Replay:
    """An empty buffer for items of the shapes and dtypes of ``item``.

    ``owned``: it remembers which items the MARL team made.
    """
    data = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), item)
    own = jnp.zeros(capacity, bool) if owned else None
    return Replay(data, jnp.zeros((), jnp.int32), own)


def insert(
    replay: Replay, rows: Any, count: Int[Array, ""], own: Bool[Array, "R"] | None = None
) -> Replay:
    """Appends the first ``count`` of ``rows``, over the oldest items once full.

    ``rows`` has a fixed length (no longer than the capacity), so that one compiled program serves
    rollouts of any length. ``own``: which the MARL team made, where the buffer remembers; None:
    none of them.
    """
    capacity = replay.capacity
    offsets = jnp.arange(jax.tree.leaves(rows)[0].shape[0], dtype=jnp.int32)
    # Rows behind `count` point outside the buffer, where a scatter drops them.
    places = jnp.where(offsets < count, (replay.inserted + offsets) % capacity, capacity)
    data = jax.tree.map(
        lambda column, new: column.at[places].set(new, mode="drop"), replay.data, rows
    )
    remembered = replay.own
    if remembered is not None:
        made = jnp.zeros(len(offsets), bool) if own is None else own
        remembered = remembered.at[places].set(made, mode="drop")
    return Replay(data, replay.inserted + count, remembered)


class Sources(NamedTuple):
    """Who made what is stored: how many of the first items the MARL team did, and others did."""

    own: Int[Array, "capacity"]
    others: Int[Array, "capacity"]


def sources_of(replay: Replay) -> Sources | None:
    """What `sample` needs to tell them apart, once for many minibatches; None: it need not."""
    if replay.own is None:
        return None
    taken = _taken(replay)
    counts = (jnp.cumsum(taken & made, dtype=jnp.int32) for made in (replay.own, ~replay.own))
    return Sources(*counts)


def sample(
    replay: Replay,
    batch_size: int,
    key: PRNGKeyArray,
    own_share: Float[Any, ""] | float = 0.0,
    sources: Sources | None = None,
) -> Any:
    """A minibatch drawn uniformly, with replacement, from what is stored.

    With ``sources``, the nearest number to ``own_share`` of it are items that the MARL team made
    and the rest others', each drawn uniformly; where there are none of a kind, all are of the
    other.
    """
    if sources is None:
        places = jax.random.randint(key, (batch_size,), 0, _filled(replay))
    else:
        n_own = jnp.where(sources.own[-1] > 0, _wanted(batch_size, own_share), 0)
        n_own = jnp.where(sources.others[-1] > 0, n_own, batch_size)
        own, others = (
            _places_of(counts, batch_size, one)
            for counts, one in zip(sources, jax.random.split(key), strict=True)
        )
        places = jnp.where(jnp.arange(batch_size) < n_own, own, others)
    return jax.tree.map(lambda column: column[places], replay.data)


def _wanted(batch_size: int, share: Float[Any, ""] | float) -> Int[Array, ""]:
    return jnp.round(jnp.asarray(share) * batch_size).astype(jnp.int32)


def _places_of(counts: Int[Array, "capacity"], n: int, key: PRNGKeyArray) -> Int[Array, "n"]:
    """Places of ``n`` of the items that raise ``counts``, uniformly, with replacement."""
    rank = jax.random.randint(key, (n,), 0, jnp.maximum(counts[-1], 1))
    return jnp.searchsorted(counts, rank, side="right").astype(jnp.int32)


def distinct_places(
    replay: Replay, batch_size: int, key: PRNGKeyArray, own_share: Float[Any, ""] | float = 0.0
) -> Int[Array, "B"]:
    """Places of a minibatch drawn uniformly, without replacement; there must be that many.

    Where the buffer remembers who made what, the nearest number to ``own_share`` of them are of
    the MARL team, or as near to it as what there is allows.
    """
    lots, taken = jax.random.uniform(key, (replay.capacity,)), _taken(replay)
    if replay.own is None:
        return _highest(lots, taken, batch_size)
    own, others = taken & replay.own, taken & ~replay.own
    n_own = _wanted(batch_size, own_share)
    n_own = jnp.clip(n_own, batch_size - jnp.sum(others), jnp.sum(own))
    turn = jnp.arange(batch_size, dtype=jnp.int32)
    first, rest = (_highest(lots, kind, batch_size) for kind in (own, others))
    return jnp.where(turn < n_own, first, rest[jnp.maximum(turn - n_own, 0)])


def _highest(
    lots: Float[Array, "capacity"], among: Bool[Array, "capacity"], count: int
) -> Int[Array, "count"]:
    return jax.lax.top_k(jnp.where(among, lots, -1.0), count)[1].astype(jnp.int32)


def columns(replay: Replay) -> dict[str, Any]:
    """All that is kept of the items, by name."""
    own = {} if replay.own is None else {"own": replay.own}
    return replay.data._asdict() | own


def with_columns(replay: Replay, found: dict[str, Any], inserted: int) -> Replay:
    """A buffer of the same shapes with other `columns`."""
    data = replay.data._replace(**{name: found[name] for name in replay.data._fields})
    return Replay(data, jnp.asarray(inserted, jnp.int32), found.get("own"))


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


def _taken(replay: Replay) -> Bool[Array, "capacity"]:
    return jnp.arange(replay.capacity, dtype=jnp.int32) < _filled(replay)


def _filled(replay: Replay) -> Int[Array, ""]:
    return jnp.minimum(replay.inserted, replay.capacity)

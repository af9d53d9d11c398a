"""A ring buffer of transitions on the device, written and read inside compiled functions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from race.types import EnvSpec, Transition


class Replay(NamedTuple):
    """The newest ``capacity`` transitions."""

    data: Transition  # leading axis: capacity
    inserted: Int[Array, ""]  # transitions ever inserted

    @property
    def capacity(self) -> int:
        """Transitions that fit."""
        return self.data.reward.shape[-1]


def init_replay(spec: EnvSpec, capacity: int) -> Replay:
    """An empty buffer, float32."""
    return Replay(
        Transition(
            state=jnp.zeros((capacity, spec.state_size), jnp.float32),
            action=jnp.zeros((capacity, spec.joint_action_size), jnp.float32),
            reward=jnp.zeros(capacity, jnp.float32),
            terminated=jnp.zeros(capacity, jnp.float32),
            next_state=jnp.zeros((capacity, spec.state_size), jnp.float32),
        ),
        jnp.zeros((), jnp.int32),
    )


def insert(replay: Replay, rows: Transition, count: Int[Array, ""]) -> Replay:
    """Appends the first ``count`` of ``rows``, over the oldest transitions once full.

    ``rows`` has a fixed length (no longer than the capacity), so that one compiled program serves
    episodes of any length.
    """
    offsets = jnp.arange(rows.reward.shape[0], dtype=jnp.int32)
    # Rows behind `count` point outside the buffer, where a scatter drops them.
    places = jnp.where(
        offsets < count, (replay.inserted + offsets) % replay.capacity, replay.capacity
    )
    data = jax.tree.map(
        lambda column, new: column.at[places].set(new, mode="drop"), replay.data, rows
    )
    return Replay(data, replay.inserted + count)


def sample(replay: Replay, batch_size: int, key: PRNGKeyArray) -> Transition:
    """A minibatch drawn uniformly, with replacement, from what is stored."""
    filled = jnp.minimum(replay.inserted, replay.capacity)
    places = jax.random.randint(key, (batch_size,), 0, filled)
    return jax.tree.map(lambda column: column[places], replay.data)

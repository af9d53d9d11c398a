"""Minibatches as networks are shown them, where observations are normalised."""

from typing import Any

import jax.numpy as jnp

from race.method.normalisation import Scaling, scaled
from race.types import Slots, Transition


def as_shown(batch: Any, scaling: Scaling | None) -> Any:
    """A minibatch of what environments showed, as networks see it; without a scaling as it is.

    Empty slots stay zeros.
    """
    if scaling is None:
        return batch
    if isinstance(batch, Transition):
        state, later = (scaled(x, scaling.state) for x in (batch.state, batch.next_state))
        return batch._replace(state=state, next_state=later)
    assert isinstance(batch, Slots)
    assert scaling.obs is not None
    real = batch.real
    obs = jnp.where(real[..., None, None], scaled(batch.obs, scaling.obs), 0.0)
    state = jnp.where(real[..., None], scaled(batch.state, scaling.state), 0.0)
    return batch._replace(obs=obs, state=state)

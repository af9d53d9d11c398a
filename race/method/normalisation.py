"""Observations brought to mean 0 and variance 1 by what all teams have seen so far.

Statistics are kept on the host in float64 and merged exactly (Chan et al. 1983, Eq. 2.1); what is
applied is in float32. Every entry of every agent's observation, and of the state, has its own.
"""

from typing import Any, Final, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from race.types import EnvSpec, Spec

CLIP: Final = 10.0
"""Largest magnitude of what is left, in standard deviations, as in OpenAI's baselines."""
VARIANCE_FLOOR: Final = 1e-8
"""What is added to a variance, so that an entry that never changes stays 0, as in gymnasium's
``NormalizeObservation``."""
_PIECE = 4096  # rows taken at once, so that float64 takes little memory


class Running(NamedTuple):
    """Number, mean, and sum of squared deviations from it, of the entries ``*e``; float64."""

    number: NDArray[np.float64]  # [], how many samples
    mean: NDArray[np.float64]
    squares: NDArray[np.float64]


class Observed(NamedTuple):
    """What all teams of a run have seen when they chose an action."""

    obs: Running | None
    """Of each agent, [N, O]; None where observations are parts of the state."""
    state: Running
    """[S]."""


class Affine(NamedTuple):
    """``(x - mean) * factor``, before it is clipped; float32."""

    mean: Any
    factor: Any


class Scaling(NamedTuple):
    """How networks are shown what is observed: a pytree of arrays."""

    obs: Affine | None
    state: Affine


def unseen(*shape: int) -> Running:
    """Statistics of nothing."""
    return Running(np.zeros(()), np.zeros(shape), np.zeros(shape))


def running_of(samples: Float[np.ndarray, "n *e"]) -> Running:
    """Statistics of some samples."""
    total = unseen(*samples.shape[1:])
    for first in range(0, len(samples), _PIECE):
        piece = samples[first : first + _PIECE].astype(np.float64)
        mean = piece.mean(axis=0)
        squares = np.square(piece - mean).sum(axis=0)
        total = merged(total, Running(np.asarray(float(len(piece))), mean, squares))
    return total


def merged(one: Running, other: Running) -> Running:
    """Statistics of the samples of both."""
    count = float(one.number + other.number)
    if count == 0:
        return one
    share, apart = float(other.number) / count, other.mean - one.mean
    squares = one.squares + other.squares + np.square(apart) * (float(one.number) * share)
    return Running(np.asarray(count), one.mean + apart * share, squares)


def nothing_observed(spec: Spec) -> Observed:
    """What a run of a task has seen before its first step."""
    if isinstance(spec, EnvSpec):
        return Observed(None, unseen(spec.state_size))
    return Observed(unseen(spec.n_agents, spec.obs_size), unseen(spec.state_size))


def observed_more(before: Observed, now: Observed) -> Observed:
    """What was seen before, and now."""
    obs = before.obs
    if obs is not None and now.obs is not None:
        obs = merged(obs, now.obs)
    return Observed(obs, merged(before.state, now.state))


def scaling_of(observed: Observed) -> Scaling:
    """How networks are shown what is observed, after what has been seen; as it is after nothing."""
    obs = None if observed.obs is None else affine_of(observed.obs)
    return Scaling(obs, affine_of(observed.state))


def affine_of(seen: Running) -> Affine:
    """To mean 0 and variance 1."""
    variance = seen.squares / seen.number if seen.number > 0 else np.ones_like(seen.squares)
    floor = VARIANCE_FLOOR if seen.number > 0 else 0.0
    factor = 1 / np.sqrt(variance + floor)
    return Affine(seen.mean.astype(np.float32), factor.astype(np.float32))


def scaled(x: Float[Any, "..."], affine: Affine) -> Float[Array, "..."]:
    """What networks see in place of ``x`` [*b, *e], in float32."""
    x = jnp.asarray(x).astype(jnp.float32)
    mean, factor = (jnp.broadcast_to(part, x.shape) for part in affine)
    return jnp.clip((x - mean) * factor, -CLIP, CLIP)

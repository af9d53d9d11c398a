"""Where a run's randomness comes from: its seed, a purpose, and a counter of the run."""

from enum import IntEnum

import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from numpy.typing import NDArray


class Purpose(IntEnum):
    """What randomness is for. Every use has its own stream, numbered by a counter of the run."""

    INIT = 0
    WARM_UP = 1
    ROLLOUT = 2
    EVOLUTION = 3
    LEARNING = 4
    EVALUATION = 5
    INJECTION = 6
    SURROGATE = 7


def root_key(seed: int, purpose: Purpose) -> PRNGKeyArray:
    """The random key of one purpose of a run."""
    return jax.random.fold_in(jax.random.key(seed), int(purpose))


def host_seeds(seed: int, purpose: Purpose, index: int, count: int) -> NDArray[np.int64]:
    """Seeds for environments, from the run's seed, the purpose and a counter."""
    sequence = np.random.SeedSequence((seed, int(purpose), index))
    return sequence.generate_state(count).astype(np.int64)


def seed_again(seed: int, attempt: int) -> int:
    """The seed of an episode that is begun anew, from that of the first attempt; below 2**31."""
    return int(np.random.SeedSequence((seed, attempt)).generate_state(1)[0]) >> 1

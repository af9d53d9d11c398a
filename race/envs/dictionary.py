"""What an environment with discrete actions shows: its space, and a moment as the dictionary."""

from typing import Any

import numpy as np
from gymnasium import spaces

from race.types import Observation


def space_of(n_agents: int, obs_size: int, state_size: int, n_actions: int) -> spaces.Space[Any]:
    """The observation space of a task of these sizes."""
    return spaces.Dict(
        {
            "obs": spaces.Box(-np.inf, np.inf, (n_agents, obs_size), np.float32),
            "state": spaces.Box(-np.inf, np.inf, (state_size,), np.float32),
            "avail_actions": spaces.MultiBinary([n_agents, n_actions]),
        }
    )


def as_dictionary(observation: Observation) -> dict[str, Any]:
    """A moment that was made on the device, as a member of that space."""
    return {
        "obs": np.asarray(observation.obs),
        "state": np.asarray(observation.state),
        "avail_actions": np.asarray(observation.avail_actions).astype(np.int8),
    }

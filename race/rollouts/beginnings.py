"""Where the beginnings of episodes ended, when a population is judged by no more than them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from race.types import Rollout


class Beginnings(NamedTuple):
    """What ``T`` teams had come to after some steps, or at the end of a shorter episode."""

    rewards: Float[np.ndarray, "T"]
    """Their discounted sum."""
    weight: Float[np.ndarray, "T"]
    """What the value of the state counts for: the discount of all these steps; 0 after an end."""
    state: Float[np.ndarray, "T S"]
    """Where they were."""


def beginnings(rollout: Rollout, teams: int, steps: int, discount: float) -> Beginnings:
    """The beginnings of teams' episodes, which may go on.

    Args:
        rollout: at least a step of each of the teams.
        teams: how many; the first ones.
        steps: of a beginning.
        discount: gamma.
    """
    found: list[tuple[float, float, np.ndarray]] = []
    transitions = rollout.transitions
    for team in range(teams):
        rows = np.flatnonzero(rollout.team == team)[:steps]
        factors = discount ** np.arange(len(rows) + 1, dtype=np.float64)
        ended = transitions.terminated[rows[-1]] > 0
        rewards = float(factors[:-1] @ transitions.reward[rows].astype(np.float64))
        found.append((rewards, 0.0 if ended else factors[-1], transitions.next_state[rows[-1]]))
    rewards, weights, states = zip(*found, strict=True)
    return Beginnings(np.array(rewards), np.array(weights), np.stack(states))

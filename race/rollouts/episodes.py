"""What rollouts of tasks with discrete actions bring back."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt32

from race.algorithms.base import Teams
from race.method.normalisation import Observed, running_of
from race.rollouts.choosing import Exploration
from race.types import DiscreteSpec, Episode


class Played(NamedTuple):
    """One episode of each of ``T`` teams."""

    episodes: Episode  # leading axis T
    episode_return: Float[Any, "T"]
    won: Bool[Any, "T"]


class Part(NamedTuple):
    """The teams of one run, the seeds of their environments, and how they explore, if they do."""

    teams: Teams
    seeds: UInt32[Any, "T"]  # below 2**31
    how: Exploration | None


def empty_episode(spec: DiscreteSpec, precision: str, *batch: int) -> Episode:
    """An episode without a step, or a batch of them, as they are stored.

    Observations and states are of the given precision, actions are whole numbers of 8 bits (16,
    where there are more than 256 of them), masks are booleans.
    """
    steps, n = spec.episode_limit, spec.n_agents
    number = np.uint8 if spec.n_actions <= 256 else np.uint16
    return Episode(
        obs=np.zeros((*batch, steps + 1, n, spec.obs_size), precision),
        state=np.zeros((*batch, steps + 1, spec.state_size), precision),
        avail_actions=np.zeros((*batch, steps + 1, n, spec.n_actions), bool),
        action=np.zeros((*batch, steps, n), number),
        reward=np.zeros((*batch, steps), np.float32),
        terminated=np.zeros((*batch, steps), np.float32),
        length=np.zeros(batch, np.int32),
    )


def no_episodes(teams: int, spec: DiscreteSpec, precision: str) -> Played:
    """Nothing played yet, on the device."""
    episodes = Episode(*map(jnp.asarray, empty_episode(spec, precision, teams)))
    return Played(episodes, jnp.zeros(teams), jnp.zeros(teams, bool))


def seen_in(episodes: Episode) -> Observed:
    """What the teams of some episodes saw whenever they chose an action."""
    lengths = np.asarray(episodes.length)
    chose = np.arange(np.shape(episodes.reward)[1])[None] < lengths[:, None]
    obs, state = (np.asarray(x)[:, :-1][chose] for x in (episodes.obs, episodes.state))
    return Observed(running_of(obs), running_of(state))

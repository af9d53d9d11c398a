"""Test episodes: what a trained team is worth, without exploration noise."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from race.algorithms.base import Teams
from race.programs import act
from race.rollouts.host import EnvPool, collect
from race.types import EnvSpec


class Score(NamedTuple):
    """Undiscounted returns of one team's test episodes."""

    returns: NDArray[np.float64]  # [episodes]
    lengths: NDArray[np.int64]  # [episodes]

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(self.returns.mean())

    @property
    def std(self) -> float:
        """Standard deviation of the returns over episodes."""
        return float(self.returns.std())


def evaluate(
    pool: EnvPool,
    encoder: Any,
    heads: Mapping[str, Float[Array, "N H1 A"]],
    seeds: NDArray[np.int64],
    spec: EnvSpec,
    base: str,
) -> dict[str, Score]:
    """Plays one episode per seed with each team, all teams on the same seeds, all at once.

    Args:
        pool: ``len(heads) * len(seeds)`` environments.
        encoder: the shared encoders.
        heads: the teams by name.
        seeds: seeds of the episodes.
        spec: the task.
        base: name of the learner whose policies these are.
    """
    n = len(seeds)
    stacked = jnp.repeat(jnp.stack(list(heads.values())), n, axis=0)
    teams = Teams(encoder, stacked)

    def choose(states: NDArray[np.float32], _: int) -> NDArray[np.float32]:
        return np.asarray(act(teams, states, spec=spec, base=base))

    rollout = collect(pool, choose, np.tile(seeds, len(heads)))
    return {
        name: Score(
            rollout.episode_return[i * n : (i + 1) * n], rollout.episode_length[i * n : (i + 1) * n]
        )
        for i, name in enumerate(heads)
    }

"""The interface of an algorithm."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from race.algorithms.population import Population
from race.method.normalisation import Scaling
from race.types import Team

Losses = dict[str, Float[Array, ""]]


class Teams(eqx.Module):
    """All acting teams: the population first, the MARL team last, where there are such."""

    encoder: Any  # of all teams; or with a leading axis T, then one for each agent of each team
    heads: Float[Array, "T N H1 A"]
    own_encoders: bool = eqx.field(static=True, default=False)
    scaling: Scaling | None = None  # of what environments show them; None: as it is

    @property
    def count(self) -> int:
        """T."""
        return int(self.heads.shape[0])

    def again(self, population: int, marl: int) -> "Teams":
        """The teams as often as they play: the population first, one round after the other.

        Args:
            population: how often each of its teams plays.
            marl: how often the last team does, which is the MARL team; 0 if there is none.
        """
        if population == 1 and marl <= 1:
            return self
        first = np.arange(self.count - (marl > 0))
        return self.at(np.r_[np.tile(first, population), np.full(marl, self.count - 1)])

    def at(self, places: Any) -> "Teams":
        """The teams of some places."""
        encoder = self.encoder
        if self.own_encoders:
            encoder = jax.tree.map(lambda leaf: leaf[places], encoder)
        return Teams(encoder, self.heads[places], self.own_encoders, self.scaling)


class Tested(NamedTuple):
    """Teams that are tested, over the encoders that they share."""

    encoder: Any
    heads: dict[str, Float[Array, "N H1 A"]]  # by name: "marl", "champion"


class Algorithm(NamedTuple):
    """Pure functions over one state pytree. ``spec`` and ``shape`` are static, ``hyper`` is not."""

    init: Callable[..., Any]
    """(key, spec, shape, hyper) -> state."""
    teams: Callable[..., Teams]
    """(state, spec, shape) -> the teams that act."""
    tested: Callable[..., tuple[Tested, ...]]
    """(state, spec) -> the MARL team (``marl``), if there is one, and the team of best training
    fitness (``champion``), if there is a population."""
    evolve: Callable[..., Population] | None
    """(population, fitness [P], key, spec, shape, hyper) -> population; line 9 of Algorithm 1. None
    unless there is a population."""
    update: Callable[..., tuple[Any, Losses, Losses]]
    """(state, batch, step, key, spec, shape, hyper) -> state, critic losses, policy losses; lines
    8, 10 and 13. Policy losses are zero on steps where the policy delay idles."""
    entrant: Callable[..., Team] | None
    """(state, shape) -> the MARL team as it enters the population in line 11; None unless there
    are both."""
    population: Callable[[Any], Population | None]
    """state -> the population, if there is one."""
    expected: Callable[..., Float[Array, "P"]] | None
    """(state, states [P S], spec, shape) -> what each team of the population is worth where it is,
    by the PeVFA; None without one. For tasks with continuous actions."""
    critic_losses: tuple[str, ...]
    policy_losses: tuple[str, ...]


def when(due: bool | Bool[Array, ""], step: Any, idle: Any, state: Any) -> Any:
    """``step(state)`` if it is due, else ``idle(state)``; no branch is compiled that never runs."""
    if isinstance(due, bool):
        return step(state) if due else idle(state)
    return jax.lax.cond(due, step, idle, state)

"""The interface of an algorithm."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from race.types import Spec

Losses = dict[str, Float[Array, ""]]


class Teams(NamedTuple):
    """All acting teams: the population first, the MARL team last."""

    encoder: Any
    heads: Float[Array, "T N H1 A"]


class Algorithm(NamedTuple):
    """Pure functions over one state pytree. ``spec`` and ``shape`` are static, ``hyper`` is not."""

    init: Callable[..., Any]
    """(key, spec, shape) -> state."""
    teams: Callable[..., Teams]
    """(state, spec) -> the teams that act."""
    champion: Callable[[Any], Float[Array, "N H1 A"]]
    """state -> heads of the team of best training fitness."""
    evolve: Callable[..., Any]
    """(state, fitness [P], key, spec, shape, hyper) -> state; lines 9 of Algorithm 1."""
    update: Callable[..., tuple[Any, Losses, Losses]]
    """(state, batch, step, key, spec, shape, hyper) -> state, critic losses, policy losses; lines
    8, 10 and 13. Policy losses are zero on steps where the policy delay idles."""
    inject: Callable[..., Any]
    """(state, key, hyper) -> state; line 11."""
    injection_counts: Callable[[Any], Array | np.ndarray]
    """state -> how often the injected team became elite, parent, discarded; shape [3]."""
    critic_losses: tuple[str, ...]
    policy_losses: tuple[str, ...]


def tested_teams(
    algorithm: Algorithm, state: Any, spec: Spec, has_population: bool
) -> tuple[Any, dict[str, Float[Array, "N H1 A"]]]:
    """Encoders, and heads of the teams that are tested: ``marl`` and, if any, ``champion``."""
    encoder, heads = algorithm.teams(state, spec)
    tested = {"marl": heads[-1]}
    if has_population:
        tested["champion"] = algorithm.champion(state)
    return encoder, tested


def when(due: bool | Bool[Array, ""], step: Any, idle: Any, state: Any) -> Any:
    """``step(state)`` if it is due, else ``idle(state)``; no branch is compiled that never runs."""
    if isinstance(due, bool):
        return step(state) if due else idle(state)
    return jax.lax.cond(due, step, idle, state)

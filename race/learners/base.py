"""The interface of a base MARL method, on which algorithms are written once."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float

Values = Float[Array, "K B"]


class Learner(NamedTuple):
    """A base MARL method: pure functions over its networks.

    ``spec`` is the task's `EnvSpec` and ``config`` the `LearnerConfig`; parameters of networks
    are pytrees that only the learner looks into.
    """

    init_encoder: Callable[..., Any]
    """(key, spec, config) -> encoders of all agents."""
    init_head: Callable[..., Float[Array, "N H1 A"]]
    """(key, spec, config) -> one team's policy representations."""
    init_critic: Callable[..., Any]
    """(key, spec, config) -> the MARL critic Q_psi."""
    init_pevfa: Callable[..., Any]
    """(key, spec, config, embedding_size) -> the PeVFA Q_theta."""
    encode: Callable[..., Float[Array, "N B H"]]
    """(encoder, spec, state [B, S]) -> embeddings z of every agent."""
    act: Callable[..., Float[Array, "B U"]]
    """(z, head, spec) -> the team's joint action."""
    smooth: Callable[..., Float[Array, "B U"]]
    """(action, key, config) -> the action at which a target is evaluated."""
    q_marl: Callable[..., Values]
    """(critic, state, action) -> Q_psi(s, u) of each critic."""
    q_team: Callable[..., Values]
    """(pevfa, spec, state, action, head) -> Q_theta(s, u, W) of each critic."""
    pessimistic: Callable[[Values], Float[Array, "B"]]
    """The value that targets use, of the ensemble's."""
    first_critic: Callable[[Any], Any]
    """The part of a critic (of Q_psi) that policies maximise."""
    first_pevfa: Callable[[Any], Any]
    """The part of a PeVFA (of Q_theta) that encoders maximise."""

"""The interface of a base MARL method, on which algorithms are written once."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float

Values = Float[Array, "K B"]


class Samples(NamedTuple):
    """The steps of a minibatch, ``B`` in all: where actions were taken, and which."""

    moments: Any
    """What the networks see there; only the learner looks into it."""
    action: Array
    """The joint actions, in the form that the learner's critics take."""
    mask: Float[Array, "B"] | None
    """1 where a step is real, 0 where it is padding; None if all are real."""


class Learner(NamedTuple):
    """A base MARL method: pure functions over its networks.

    ``spec`` is the task's spec, ``shape`` the run's `Shape`, ``hyper`` its `Hyper`; parameters of
    networks are pytrees that only the learner looks into. ``B`` samples of a minibatch are
    transitions or the steps of whole episodes; ``B'`` moments are those at which targets are
    evaluated.
    """

    init_encoder: Callable[..., Any]
    """(key, spec, shape) -> the encoders of all agents."""
    init_own_encoder: Callable[..., Any]
    """(key, spec, shape) -> those of a team that shares none: one per agent, leaves [N, ...]."""
    of_each_agent: Callable[[Any], Any]
    """The MARL team's encoders -> the same as one per agent, leaves [N, ...]."""
    init_head: Callable[..., Float[Array, "_ H1 A"]]
    """(key, spec, shape) -> the MARL team's policy representations: one per agent, or one that
    all agents share."""
    init_heads: Callable[..., Float[Array, "N H1 A"]]
    """(key, spec, shape) -> those of a team of the population, one per agent."""
    init_critic: Callable[..., Any]
    """(key, spec, shape) -> the MARL critic Q_psi."""
    init_pevfa: Callable[..., Any]
    """(key, spec, shape) -> the PeVFA Q_theta."""
    init_value: Callable[..., Any]
    """(key, spec, shape) -> the state-value net V_zeta."""
    init_mine: Callable[..., Any]
    """(key, spec, shape) -> MINE networks T_omega, one per encoder."""
    now: Callable[..., Samples]
    """(batch, spec) -> the steps of a minibatch."""
    later: Callable[..., Any]
    """(batch, spec) -> the moments that targets need."""
    encode: Callable[..., Float[Array, "..."]]
    """(encoder, moments, spec) -> embeddings z of every agent."""
    act: Callable[..., Array]
    """(z, head, moments, key, spec) -> the team's joint actions, through which policies are
    trained."""
    target_action: Callable[..., Array]
    """(z, head, moments, key, spec, hyper) -> the joint actions at which a target is evaluated."""
    q_marl: Callable[..., Values]
    """(critic, moments, action, spec) -> Q_psi(s, u) of each critic."""
    q_team: Callable[..., Values]
    """(pevfa, moments, action, head, spec) -> Q_theta(s, u, W) of each critic."""
    pessimistic: Callable[[Values], Float[Array, "B"]]
    """The value that targets use, of the ensemble's."""
    td_target: Callable[..., Float[Array, "B"]]
    """(batch, values [B'], hyper) -> the targets y of Eq. (1)."""
    first_critic: Callable[[Any], Any]
    """The part of a critic (of Q_psi) that policies maximise."""
    first_pevfa: Callable[[Any], Any]
    """The part of a PeVFA (of Q_theta) that encoders maximise."""
    state_values: Callable[..., Float[Array, "B"]]
    """(value, moments) -> V_zeta(s)."""
    mutual_information: Callable[..., Float[Array, "M B"]]
    """(mine, moments, z, key, shape) -> the signals I_t below Eq. (3) of each MINE."""
    episodes: Callable[[Any], Float[Array, ""]] | None
    """moments -> how many episodes the steps of a minibatch are of; None where they are
    transitions."""
    policy_due: Callable[..., bool | Bool[Array, ""]]
    """(step, shape) -> whether this gradient step also trains policies and moves targets."""
    scale_output: Callable[..., Any]
    """(critic or PeVFA, number) -> the same with its last layer multiplied."""
    follow: Callable[..., Any]
    """(target, online, step, shape, hyper) -> the targets after this gradient step."""

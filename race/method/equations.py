"""Equations (1) to (7) of the paper, one pure function each: arrays in, arrays out.

Shapes are those of one batch; every function can be jitted and vmapped. None of them stops a
gradient: which parameters an equation trains is decided where it is used, by what is
differentiated. Symbols are the paper's.

A batch of whole episodes holds padding behind their ends. ``mask`` is 1 for its real samples and 0
for padding, and every expectation E_D is over the real ones; None, where all samples are real.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from race.config.hyper import Number

Scalar = Float[Array, ""]
Mask = Float[Array, "B"] | None


def expectation(values: Float[Array, "*k B"], mask: Mask = None) -> Float[Array, "*k"]:
    """``E_D``: the mean over the real samples of a batch."""
    if mask is None:
        return jnp.mean(values, axis=-1)
    # A sum of products would spread a NaN of the padding to everything.
    real = jnp.where(mask > 0, values, 0.0)
    return jnp.sum(real, axis=-1) / jnp.sum(mask)


def td_target(
    reward: Float[Array, "B"],
    terminated: Float[Array, "B"],
    next_value: Float[Array, "B"],
    discount: Number,
) -> Float[Array, "B"]:
    """One-step target ``y = r + gamma (1 - terminated) Q'(s', pi(s'))`` inside Eq. (1).

    Args:
        reward: r.
        terminated: 1 where the task ended at s', else 0. A time limit is not an end.
        next_value: the target network's value of s', ``Q_psi'(s', pi'_marl(s'))`` for the MARL
            critic or ``Q_theta'(s', pi_j(s'), W_j)`` for the PeVFA.
        discount: gamma.
    """
    return reward + discount * (1.0 - terminated) * next_value


def td_loss(value: Float[Array, "K B"], target: Float[Array, "B"], mask: Mask = None) -> Scalar:
    """Eq. (1): ``E_D[(y - Q(s, u))^2]``, summed over the K critics of an ensemble.

    L_psi with Q_psi of the MARL critic, L_theta with Q_theta of the PeVFA.
    """
    return jnp.sum(expectation(jnp.square(value - target[None]), mask))


def value_function_maximization_loss(
    marl_value: Float[Array, "B"], team_value: Float[Array, "B"], mask: Mask = None
) -> Scalar:
    """Eq. (2): ``L_VFM = -E[Q_psi(s, pi_marl(s)) + Q_theta(s, pi_j(s), W_j)]``.

    Args:
        marl_value: ``Q_psi(s, pi_marl(s))``, the MARL critic of the MARL team's actions.
        team_value: ``Q_theta(s, pi_j(s), W_j)``, the PeVFA of a population team's actions.
        mask: of the samples.
    """
    return -expectation(marl_value + team_value, mask)


def mutual_information_signal(scores: Float[Array, "B B"], mask: Mask = None) -> Float[Array, "B"]:
    """The per-step signal ``I_t(z_t, s_t)`` below Eq. (3).

    ``I_t = -sp(-T(s_t, z_t)) - E_{k != t}[sp(T(s_t, z_k))]`` with ``sp(x) = log(1 + exp(x))``.
    The embeddings of the other samples of the batch stand for the product of the marginals.

    Args:
        scores: ``T_omega(s_t, z_k)``, row t the state, column k the embedding; B at least 2.
        mask: of the samples. Where it leaves fewer than two, there is no second term.
    """
    paired = jnp.diagonal(scores)
    negative = jax.nn.softplus(scores)
    if mask is None:
        unpaired = jnp.sum(negative, axis=1) - jnp.diagonal(negative)
        return -jax.nn.softplus(-paired) - unpaired / (scores.shape[0] - 1)
    others = mask[None] * (1.0 - jnp.eye(scores.shape[0], dtype=mask.dtype))
    unpaired = jnp.sum(others * negative, axis=1) / jnp.maximum(jnp.sum(others, axis=1), 1.0)
    return -jax.nn.softplus(-paired) - unpaired


def mutual_information_signal_across(
    scores: Float[Array, "E E N"], mask: Float[Array, "E N"]
) -> Float[Array, "E"]:
    """The signal ``I_t(z_t, s_t)`` below Eq. (3) at one time of E episodes of N agents.

    It is the mean over the agents' pairs ``(s_t, z_t)`` of an episode. The embeddings of all agents
    of the other episodes stand for the product of the marginals; not so those of the other agents
    of the same episode, which come with this very state.

    Args:
        scores: ``T_omega(s, z)``, the state of the first axis, the embedding of the others.
        mask: the embeddings that count. An episode without any has the signal 0; so has one beside
            which there is no other, since nothing would keep its scores from growing.
    """
    own = jnp.diagonal(scores, axis1=0, axis2=1).T
    apart = mask[None] * (1.0 - jnp.eye(scores.shape[0], dtype=mask.dtype))[:, :, None]
    n_own, n_apart = jnp.sum(mask, axis=1), jnp.sum(apart, axis=(1, 2))
    paired = -jnp.sum(mask * jax.nn.softplus(-own), axis=1) / jnp.maximum(n_own, 1.0)
    unpaired = jnp.sum(apart * jax.nn.softplus(scores), axis=(1, 2)) / jnp.maximum(n_apart, 1.0)
    return jnp.where((n_own > 0) & (n_apart > 0), paired - unpaired, 0.0)


def mutual_information_bound(signal: Float[Array, "B"], mask: Mask = None) -> Scalar:
    """Eq. (3): the lower bound ``I_lb(z; s)``, the mean of the per-step signals."""
    return expectation(signal, mask)


def best_target(
    marl_target: Float[Array, "B"], team_target: Float[Array, "B"]
) -> Float[Array, "B"]:
    """``F(s)`` of Eq. (4): the larger of the two targets that Eq. (1) computed.

    The paper writes ``r + max(Q_psi', Q_theta')``; the discount and the termination that Eq. (1)
    puts between r and Q' are taken to be meant here too.
    """
    return jnp.maximum(marl_target, team_target)


def state_value_loss(
    value: Float[Array, "B"], target: Float[Array, "B"], mask: Mask = None
) -> Scalar:
    """Eq. (4): ``L_zeta = E_D[(V_zeta(s) - F(s))^2]``."""
    return expectation(jnp.square(value - target), mask)


def value_weights(
    value: Float[Array, "B"], mask: Mask = None, awareness: Number = 1.0
) -> Float[Array, "B"]:
    """The min-max normalised state values of Eq. (5), in [0, 1] where samples are real.

    Equal values, for which the paper's fraction is 0/0, all get weight 0.

    Args:
        value: of the states.
        mask: of the samples.
        awareness: 0 for weights that are all 1; between 0 and 1 they are mixed.
    """
    real = None if mask is None else mask > 0
    low = jnp.min(value, where=real, initial=jnp.inf)
    high = jnp.max(value, where=real, initial=-jnp.inf)
    spread = high - low
    weights = (value - low) / jnp.where(spread > 0, spread, jnp.ones_like(spread))
    return (1.0 - awareness) + awareness * weights


def value_aware_mi_loss(
    weights: Float[Array, "B"],
    signal: Float[Array, "B"],
    mask: Mask = None,
    episodes: Scalar | None = None,
) -> Scalar:
    """Eq. (5): ``L_VMM = -E_D[w(s_t) I_t(z_t, s_t)]`` with the weights of `value_weights`.

    Args:
        weights: w.
        signal: I_t.
        mask: of the samples.
        episodes: how many the samples are of. If given, the expectation is over episodes, of each
            of which it takes the sum over its steps; else it is over steps.
    """
    if episodes is None:
        return -expectation(weights * signal, mask)
    real = jnp.ones_like(signal) if mask is None else mask
    return -jnp.sum(jnp.where(real > 0, weights * signal, 0.0)) / episodes


def encoder_loss(vfm: Scalar, vmm: Scalar, vmm_weight: Number) -> Scalar:
    """Eq. (6): ``L_phi = L_VFM + beta L_VMM``."""
    return vfm + vmm_weight * vmm


def marl_policy_loss(marl_value: Float[Array, "B"], mask: Mask = None) -> Scalar:
    """Eq. (7): ``L_MARL(W_marl) = -E_D[Q_psi(s, pi_marl(s))]``."""
    return -expectation(marl_value, mask)

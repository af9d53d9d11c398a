"""Central critics: the MARL critic, the PeVFA (a critic with a policy embedding), state values."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from race.config.hyper import Number
from race.networks.dense import (
    Dense,
    PolicyEmbedding,
    before_activation,
    embed_policy,
    head_vectors,
    init_dense,
    init_policy_embedding,
    stack,
)
from race.types import EnvSpec


class Critic(eqx.Module):
    """An ensemble of K central critics ``Q(s, u)``, stacked on the leading axis."""

    first: Dense  # weight [K, S + U, h1]
    hidden: Dense  # weight [K, h1, h2]
    out: Dense  # weight [K, h2, 1]
    layer_norm: bool = eqx.field(static=True)  # before each activation


def init_critic(
    key: PRNGKeyArray,
    spec: EnvSpec,
    hidden_sizes: tuple[int, int],
    count: int,
    layer_norm: bool,
    further_inputs: int = 0,
) -> Critic:
    """Fresh critics; ``further_inputs`` only narrows the first layer's initial range."""
    h1, h2 = hidden_sizes
    inputs = spec.state_size + spec.joint_action_size
    critics = []
    for critic_key in jax.random.split(key, count):
        k1, k2, k3 = jax.random.split(critic_key, 3)
        critics.append(
            Critic(
                init_dense(k1, inputs, h1, fan_in=inputs + further_inputs),
                init_dense(k2, h1, h2),
                init_dense(k3, h2, 1),
                layer_norm,
            )
        )
    return stack(critics)


def q_values(
    critic: Critic,
    state: Float[Array, "B S"],
    action: Float[Array, "B U"],
    shift: Float[Array, "K h1"] | None = None,
) -> Float[Array, "K B"]:
    """``Q(s, u)`` of each critic of the ensemble.

    Args:
        critic: the ensemble.
        state: global states.
        action: joint actions in [-1, 1].
        shift: what inputs that are the same for the whole batch add to the first layer.
    """
    x = jnp.concatenate([state, action], axis=1)
    # One copy per critic: without them the product comes out transposed, which costs far more.
    x = critic.first(jnp.broadcast_to(x, (critic.first.bias.shape[0], *x.shape)))
    if shift is not None:
        x = x + shift[:, None]
    x = jax.nn.leaky_relu(before_activation(x, critic.layer_norm))
    x = critic.hidden(x)
    x = jax.nn.leaky_relu(before_activation(x, critic.layer_norm))
    return critic.out(x)[:, :, 0]


def first_critic(critic: Critic) -> Critic:
    """The ensemble's first critic alone, which TD3 maximises over policies."""
    return jax.tree.map(lambda leaf: leaf[:1], critic)


class Pevfa(eqx.Module):
    """The policy-extended critic ``Q_theta(s, u, W_j)`` (Table 2).

    The embedding of a team is one vector for the whole batch, so its 64 inputs enter the first
    layer as a shift of the bias instead of 64 more columns of every sample.
    """

    critic: Critic
    embedding: PolicyEmbedding  # of all critics, or one each: leading axis K
    embedding_weight: Float[Array, "K E h1"]


def init_pevfa(
    key: PRNGKeyArray,
    spec: EnvSpec,
    hidden_sizes: tuple[int, int],
    count: int,
    layer_norm: bool,
    embedding_size: int,
    embedding_each: bool = False,
) -> Pevfa:
    """A fresh PeVFA; ``hidden_sizes[1]`` is also the size of the observation embeddings.

    ``layer_norm`` is of the critic: the policy embedding is not normalised. With
    ``embedding_each`` every critic has a policy embedding of its own.
    """
    critic_key, embedding_key, weight_key = jax.random.split(key, 3)
    critic = init_critic(critic_key, spec, hidden_sizes, count, layer_norm, embedding_size)
    fan_in = spec.state_size + spec.joint_action_size + embedding_size
    bound = 1.0 / np.sqrt(fan_in)

    def embedding(key: PRNGKeyArray) -> PolicyEmbedding:
        return init_policy_embedding(key, hidden_sizes[1] + 1, embedding_size)

    each = jax.random.split(embedding_key, count) if embedding_each else ()
    return Pevfa(
        critic,
        stack([embedding(key) for key in each]) if embedding_each else embedding(embedding_key),
        jax.random.uniform(
            weight_key, (count, embedding_size, hidden_sizes[0]), minval=-bound, maxval=bound
        ),
    )


def pevfa_values(
    pevfa: Pevfa,
    spec: EnvSpec,
    state: Float[Array, "B S"],
    action: Float[Array, "B U"],
    head: Float[Array, "N H1 A"],
) -> Float[Array, "K B"]:
    """``Q_theta(s, u, W_j)`` of each critic, for one team's policy representations."""
    vectors = head_vectors(head, spec)
    if _has_one_each(pevfa):
        e = jax.vmap(embed_policy, in_axes=(0, None))(pevfa.embedding, vectors)
        shift = jnp.einsum("ke,keh->kh", e, pevfa.embedding_weight)
    else:
        e = embed_policy(pevfa.embedding, vectors)
        shift = jnp.einsum("e,keh->kh", e, pevfa.embedding_weight)
    return q_values(pevfa.critic, state, action, shift)


def first_pevfa(pevfa: Pevfa) -> Pevfa:
    """The first critic of the PeVFA alone."""
    embedding = pevfa.embedding
    if _has_one_each(pevfa):
        embedding = jax.tree.map(lambda leaf: leaf[:1], embedding)
    return Pevfa(first_critic(pevfa.critic), embedding, pevfa.embedding_weight[:1])


def _has_one_each(pevfa: Pevfa) -> bool:
    return pevfa.embedding.layers[0].bias.ndim == 2


def scale_output(critic: Critic | Pevfa, scale: Number) -> Critic | Pevfa:
    """A critic or PeVFA with its last layer multiplied."""

    def last(critic: Critic | Pevfa) -> Dense:
        return (critic.critic if isinstance(critic, Pevfa) else critic).out

    scaled: Critic | Pevfa = eqx.tree_at(last, critic, last(critic).scaled(scale))
    return scaled


class StateValue(eqx.Module):
    """The state-value network ``V_zeta(s)`` (Appendix A.1)."""

    layers: tuple[Dense, ...]


def init_state_value(
    key: PRNGKeyArray, state_size: int, hidden_sizes: tuple[int, ...]
) -> StateValue:
    """A fresh state-value network."""
    sizes = (state_size, *hidden_sizes, 1)
    keys = jax.random.split(key, len(sizes) - 1)
    return StateValue(tuple(map(init_dense, keys, sizes[:-1], sizes[1:])))


def state_values(
    network: StateValue,
    state: Float[Array, "B S"],
    activation: Callable[[Array], Array] = jax.nn.leaky_relu,
) -> Float[Array, "B"]:
    """``V_zeta(s)``."""
    *hidden, out = network.layers
    x = state
    for layer in hidden:
        x = activation(layer(x))
    return out(x)[:, 0]

"""The recurrent observation encoder of tasks with discrete actions, one for all agents.

A dense layer, then a GRU (Cho et al. 2014), whose state is the embedding z. An agent's input is its
observation, its last action and its number. What is not recurrent is computed for all moments at
once; the scan over time holds one matrix product per moment.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from race.networks.dense import Dense, before_activation, init_dense
from race.networks.gru import Gates, gru, gru_step


class GruEncoder(eqx.Module):
    """The encoder Z_phi: weights of the GRU's gates side by side, reset, update, candidate."""

    obs: Dense  # weight [O, H]
    last_action: Float[Array, "*stack A H"]
    agent: Float[Array, "*stack N H"]
    into: Dense  # weight [H, 3 H], input to gates
    recurrent: Dense  # weight [H, 3 H], state to gates
    layer_norm: bool = eqx.field(static=True)  # before the activation of the dense layer


def init_gru_encoder(
    key: PRNGKeyArray, obs_size: int, n_actions: int, n_agents: int, size: int, layer_norm: bool
) -> GruEncoder:
    """A fresh encoder; each layer uniform in ``+-1/sqrt(inputs)``."""
    keys = jax.random.split(key, 5)
    inputs = obs_size + n_actions + n_agents
    bound = 1.0 / np.sqrt(inputs)

    def rows(key: PRNGKeyArray, count: int) -> Array:
        return jax.random.uniform(key, (count, size), minval=-bound, maxval=bound)

    return GruEncoder(
        init_dense(keys[0], obs_size, size, fan_in=inputs),
        rows(keys[1], n_actions),
        rows(keys[2], n_agents),
        init_dense(keys[3], size, 3 * size),
        init_dense(keys[4], size, 3 * size),
        layer_norm,
    )


def of_each_agent(encoder: GruEncoder) -> GruEncoder:
    """An encoder per agent, all leaves ``[N, ...]``, that do what the one for all agents does."""
    agents = encoder.agent.shape[0]
    every = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (agents, *leaf.shape)), encoder)
    return dataclasses.replace(every, agent=encoder.agent[:, None])


def no_memory(encoder: GruEncoder, *batch: int) -> Float[Array, "*b H"]:
    """The state of the GRU before the first moment."""
    return jnp.zeros((*batch, encoder.recurrent.weight.shape[-2]), encoder.recurrent.weight.dtype)


def gate_inputs(
    encoder: GruEncoder, obs: Float[Array, "*b N O"], last_action: Int[Array, "*b N"]
) -> Gates:
    """What the observations add to the GRU's gates, ``[..., N, H]`` each.

    Args:
        encoder: the encoder.
        obs: observations.
        last_action: the actions before them; -1 at the first moment of an episode.
    """
    # A product with one-hot rows: the gradient of a table look-up is a slow scatter.
    chosen = jax.nn.one_hot(last_action, encoder.last_action.shape[0], dtype=obs.dtype)
    both = jnp.concatenate([obs, chosen], axis=-1)
    weight = jnp.concatenate([encoder.obs.weight, encoder.last_action])
    x = both @ weight
    shift = encoder.agent + encoder.obs.bias[None]
    x = x + jnp.broadcast_to(shift, x.shape)
    x = jax.nn.relu(before_activation(x, encoder.layer_norm)).reshape(-1, x.shape[-1])
    weights, biases = _gates(encoder.into)
    shape = (*last_action.shape, -1)
    return Gates(*((x @ w + b[None]).reshape(shape) for w, b in zip(weights, biases, strict=True)))


def _gates(layer: Dense) -> tuple[Gates, Gates]:
    """Weights and biases of a layer's three parts."""
    size = layer.bias.shape[0] // 3
    parts = [slice(gate * size, (gate + 1) * size) for gate in range(3)]
    return (
        Gates(*(layer.weight[:, part] for part in parts)),
        Gates(*(layer.bias[part] for part in parts)),
    )


def embed_step(
    encoder: GruEncoder,
    carry: Float[Array, "*b N H"],
    obs: Float[Array, "*b N O"],
    last_action: Int[Array, "*b N"],
) -> Float[Array, "*b N H"]:
    """One moment: the next state of the GRU, which is the embedding z.

    The encoder is one for all agents, or of each agent (`of_each_agent`).
    """
    if encoder.recurrent.bias.ndim == 2:

        def of_one(own: GruEncoder, carry: Array, obs: Array, last: Array) -> Array:
            after = embed_step(own, carry[..., None, :], obs[..., None, :], last[..., None])
            return after[..., 0, :]

        every = jax.vmap(of_one, in_axes=(0, -2, -2, -1), out_axes=-2)
        together: Array = every(encoder, carry, obs, last_action)
        return together
    inputs = gate_inputs(encoder, obs, last_action)
    size = carry.shape[-1]
    flat = Gates(*(a.reshape(-1, size) for a in inputs))
    after = gru_step(*_gates(encoder.recurrent), carry.reshape(-1, size), flat)
    return after.reshape(carry.shape)


def embed_episodes(
    encoder: GruEncoder,
    obs: Float[Array, "L R N O"],
    last_action: Int[Array, "L R N"],
    first: Bool[Array, "L R"],
) -> Float[Array, "L R N H"]:
    """Embeddings of every moment of whole episodes; the memory is blank at each ``first``."""
    inputs = gate_inputs(encoder, obs, last_action)
    moments, rows, agents, size = inputs.reset.shape
    flat = Gates(*(a.reshape(moments, rows * agents, size) for a in inputs))
    keep = jnp.repeat(1.0 - first.astype(obs.dtype), agents, axis=1)
    return gru(*_gates(encoder.recurrent), flat, keep).reshape(moments, rows, agents, size)

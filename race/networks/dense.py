"""Networks as pytrees of weights: dense layers, encoders of all agents, heads, MINE.

Weights are stored input first, ``[in, out]``, with an optional leading axis for what is stacked
(agents, critics), so that one batched matrix product serves the whole stack. All initial values
are uniform in ``+-1/sqrt(in)``, the default of the code the paper builds on.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from race.config.hyper import Number
from race.types import EnvSpec


class Dense(eqx.Module):
    """``x @ weight + bias``, or one such layer per entry of the leading axis."""

    weight: Float[Array, "*stack i o"]
    bias: Float[Array, "*stack o"]

    def __call__(self, x: Float[Array, "... i"]) -> Float[Array, "... o"]:
        """Maps ``[*stack, B, in]`` to ``[*stack, B, out]``."""
        return jnp.matmul(x, self.weight) + self.bias[..., None, :]

    def scaled(self, scale: Number) -> "Dense":
        """The layer with weights and biases multiplied."""
        return Dense(self.weight * scale, self.bias * scale)


def init_dense(
    key: PRNGKeyArray, size_in: int, size_out: int, *, fan_in: int | None = None
) -> Dense:
    """One layer, uniform in ``+-1/sqrt(fan_in)``; ``fan_in`` is the inputs that are not padding."""
    bound = 1.0 / np.sqrt(fan_in or size_in)
    weight_key, bias_key = jax.random.split(key)
    return Dense(
        jax.random.uniform(weight_key, (size_in, size_out), minval=-bound, maxval=bound),
        jax.random.uniform(bias_key, (size_out,), minval=-bound, maxval=bound),
    )


VARIANCE_FLOOR = 1e-5
"""What layer normalisation adds to a variance, so that equal entries stay finite."""


def normalise(x: Float[Array, "*b h"]) -> Float[Array, "*b h"]:
    """Layer normalisation (Ba et al. 2016) without a learned scale: mean 0, variance 1."""
    centred = x - jnp.mean(x, axis=-1, keepdims=True)
    variance = jnp.mean(jnp.square(centred), axis=-1, keepdims=True)
    return centred * jax.lax.rsqrt(variance + VARIANCE_FLOOR)


def before_activation(x: Float[Array, "*b h"], layer_norm: bool) -> Float[Array, "*b h"]:
    """What goes into an activation: a layer's sums, normalised where the network says so."""
    return normalise(x) if layer_norm else x


def stack(trees: list[Any]) -> Any:
    """Stacks equal pytrees along a new leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


class Encoder(eqx.Module):
    """The nonlinear observation encoders Z_phi of all agents, stacked (Table 1, left).

    Where one serves all agents, the stack holds that one, and ``agent`` is what the agent's number
    adds to its first layer.
    """

    hidden: Dense  # weight [N, O, h1]
    out: Dense  # weight [N, h1, H]
    layer_norm: bool = eqx.field(static=True)  # before each activation
    agent: Float[Array, "N h1"] | None = None


def init_encoder(
    key: PRNGKeyArray,
    spec: EnvSpec,
    hidden_sizes: tuple[int, ...],
    layer_norm: bool,
    shared_agents: bool = False,
) -> Encoder:
    """Fresh encoders, one per agent or one for all.

    Rows of padded observation entries are never used.
    """
    h1, h2 = hidden_sizes
    if shared_agents:
        k1, k2, k3 = jax.random.split(key, 3)
        inputs = spec.obs_size + spec.n_agents
        layers = stack([init_dense(k1, spec.obs_size, h1, fan_in=inputs)])
        numbers = init_dense(k3, spec.n_agents, h1, fan_in=inputs).weight
        return Encoder(layers, stack([init_dense(k2, h1, h2)]), layer_norm, numbers)
    agents = []
    for agent_key, size in zip(jax.random.split(key, spec.n_agents), spec.obs_sizes, strict=True):
        k1, k2 = jax.random.split(agent_key)
        agents.append(
            Encoder(
                init_dense(k1, spec.obs_size, h1, fan_in=size), init_dense(k2, h1, h2), layer_norm
            )
        )
    return stack(agents)


def encode(encoder: Encoder, spec: EnvSpec, state: Float[Array, "B S"]) -> Float[Array, "N B H"]:
    """Gathers each agent's observation from the states and encodes it, ``z = Z_phi(o)``."""
    obs = jnp.moveaxis(jnp.take(state, spec.obs_gather, axis=1), 1, 0)  # [N, B, O]
    if not spec.obs_mask.all():
        obs = obs * jnp.asarray(spec.obs_mask, obs.dtype)[:, None, :]
    if encoder.agent is None:
        x = encoder.hidden(obs)
    else:
        # All agents are samples of one layer, to which their numbers add.
        n, b = obs.shape[:2]
        x = encoder.hidden(obs.reshape(1, n * b, -1)).reshape(n, b, -1) + encoder.agent[:, None]
        x = x.reshape(1, n * b, -1)
    x = encoder.out(jnp.tanh(before_activation(x, encoder.layer_norm)))
    x = x.reshape(*obs.shape[:2], -1)
    return jnp.tanh(before_activation(x, encoder.layer_norm))


def init_head(key: PRNGKeyArray, spec: EnvSpec, embedding_size: int) -> Float[Array, "N H1 A"]:
    """A team's linear policy representations W: ``H`` rows of weights, then one of biases.

    Columns of padded action entries are zero, and stay zero.
    """
    bound = 1.0 / np.sqrt(embedding_size)
    shape = (spec.n_agents, embedding_size + 1, spec.action_size)
    head = jax.random.uniform(key, shape, minval=-bound, maxval=bound)
    return head * jnp.asarray(spec.action_mask, head.dtype)[:, None, :]


def init_one_head(key: PRNGKeyArray, embedding_size: int, actions: int) -> Float[Array, "H1 A"]:
    """One agent's linear policy representation."""
    bound = 1.0 / np.sqrt(embedding_size)
    return jax.random.uniform(key, (embedding_size + 1, actions), minval=-bound, maxval=bound)


def act(
    z: Float[Array, "N B H"], head: Float[Array, "N H1 A"], spec: EnvSpec
) -> Float[Array, "B U"]:
    """The team's joint action ``tanh(z W[1:d] + W[d+1])`` of Section 3.1, each in [-1, 1]."""
    padded = jnp.tanh(jnp.matmul(z, head[:, :-1]) + head[:, -1:])  # [N, B, A]
    return join_actions(jnp.moveaxis(padded, 0, 1), spec)


def act_teams(
    z: Float[Array, "N T H"], heads: Float[Array, "T N H1 A"], spec: EnvSpec
) -> Float[Array, "T U"]:
    """Joint actions of several teams, row t of the embeddings through the heads of team t."""
    padded = jnp.tanh(jnp.einsum("nth,tnha->tna", z, heads[:, :, :-1]) + heads[:, :, -1])
    return join_actions(padded, spec)


def join_actions(padded: Float[Array, "B N A"], spec: EnvSpec) -> Float[Array, "B U"]:
    """The joint action in the environment's order, without padding."""
    flat = padded.reshape(padded.shape[0], spec.n_agents * spec.action_size)
    return jnp.take(flat, spec.joint_gather, axis=1)


def head_vectors(head: Float[Array, "N H1 A"], spec: EnvSpec) -> Float[Array, "U H1"]:
    """A team as the vectors that produce its joint action, one of ``H + 1`` per action entry."""
    columns = jnp.moveaxis(head, 1, 2).reshape(spec.n_agents * spec.action_size, head.shape[1])
    return jnp.take(columns, spec.joint_gather, axis=0)


class PolicyEmbedding(eqx.Module):
    """The embedding of a team's policy representations (Table 2, right)."""

    layers: tuple[Dense, Dense, Dense]


def init_policy_embedding(key: PRNGKeyArray, vector_size: int, size: int) -> PolicyEmbedding:
    """Three layers from vectors of ``vector_size = H + 1`` entries to ``size`` units."""
    k1, k2, k3 = jax.random.split(key, 3)
    return PolicyEmbedding(
        (init_dense(k1, vector_size, size), init_dense(k2, size, size), init_dense(k3, size, size))
    )


def embed_policy(embedding: PolicyEmbedding, vectors: Float[Array, "U H1"]) -> Float[Array, "E"]:
    """Encodes each action entry's vector, then averages over action entries (Appendix A.1).

    As in Table 2, nothing follows the third layer.
    """
    return jnp.mean(embed_vectors(embedding, vectors), axis=0)


def embed_vectors(embedding: PolicyEmbedding, vectors: Float[Array, "U H1"]) -> Float[Array, "U E"]:
    """The embedding of each action entry's vector."""
    first, second, out = embedding.layers
    x = jax.nn.leaky_relu(first(vectors))
    x = jax.nn.leaky_relu(second(x))
    return out(x)


class Mine(eqx.Module):
    """MINE networks T_omega of all agents, stacked (Appendix A.1)."""

    state_hidden: Dense  # weight [N, S, M]
    state_out: Dense  # weight [N, M, M]
    embedding: Dense  # weight [N, H, M]
    embedding_out: Dense | None = None  # weight [N, M, M]; beyond the paper, which has one layer


def init_mine(
    key: PRNGKeyArray, spec: EnvSpec, embedding_size: int, size: int, layers: int, count: int
) -> Mine:
    """Fresh networks, one per encoder (Appendix A.1), with 1 or 2 layers for embeddings."""
    keys = jax.random.split(key, count)
    return stack([init_one_mine(k, spec.state_size, embedding_size, size, layers) for k in keys])


def init_one_mine(
    key: PRNGKeyArray, state_size: int, embedding_size: int, size: int, layers: int
) -> Mine:
    """A fresh network, not stacked."""
    k1, k2, k3 = jax.random.split(key, 3)
    return Mine(
        init_dense(k1, state_size, size),
        init_dense(k2, size, size),
        init_dense(k3, embedding_size, size),
        # A key beside the others, so that these are the same with one layer and with two.
        init_dense(jax.random.fold_in(key, 3), size, size) if layers == 2 else None,
    )


def encode_state(mine: Mine, state: Float[Array, "*b S"]) -> Float[Array, "*b M"]:
    """What `mine_scores` compares an embedding's encoding with (Appendix A.1)."""
    return jax.nn.leaky_relu(mine.state_out(jax.nn.leaky_relu(mine.state_hidden(state))))


def encode_embedding(mine: Mine, z: Float[Array, "*b H"]) -> Float[Array, "*b M"]:
    """The encoding of an embedding, which no activation follows.

    It is one layer (Appendix A.1), or two with a leaky_relu between them.
    """
    x = mine.embedding(z)
    return x if mine.embedding_out is None else mine.embedding_out(jax.nn.leaky_relu(x))


def mine_scores(
    mine: Mine, state: Float[Array, "B S"], z: Float[Array, "N B H"]
) -> Float[Array, "N B B"]:
    """``T_omega(s_t, z_k)`` for every state t and embedding k of the batch, per agent.

    One network may serve all agents.

    The paper gives the two encoders and leaves open how they meet; here it is the inner product,
    which scores all B^2 pairs with one matrix product.
    """
    # One copy per network, as in the critics.
    count = mine.state_out.bias.shape[0]
    x = jnp.broadcast_to(state, (count, *state.shape))
    x = encode_state(mine, x)
    y = encode_embedding(mine, z.reshape(count, -1, z.shape[2])).reshape(*z.shape[:2], -1)
    x = jnp.broadcast_to(x, (z.shape[0], *x.shape[1:]))
    return jnp.einsum("ntm,nkm->ntk", x, y)

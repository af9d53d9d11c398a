"""FACMAC's factored critic: the agents' utilities, mixed by a monotonic network; and its PeVFA.

``Q_tot(s, u) = mix_s(Q_1(o_1, u_1), ..., Q_N(o_N, u_N))`` (Peng et al. 2021), where the mixer's
weights come from hypernetworks of the state and are not negative, so that ``Q_tot`` rises with
every utility (Rashid et al. 2018).

One network serves the utilities of all agents, or each agent has its own: then the weights have a
leading axis ``N``, and what goes in as ``[N, B, ...]`` comes out as ``[N, B]``. Where one serves
all, agents and samples are laid out alike.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from race.config.hyper import Number
from race.networks.dense import (
    Dense,
    PolicyEmbedding,
    before_activation,
    embed_vectors,
    init_dense,
    init_policy_embedding,
)


class Utilities(eqx.Module):
    """The utilities ``Q_i(o_i, u_i)``."""

    first: Dense  # weight [*stack, O + A, h1]
    hidden: Dense  # weight [*stack, h1, h2]
    out: Dense  # weight [*stack, h2, 1]
    layer_norm: bool = eqx.field(static=True)  # before each activation


class Mixer(eqx.Module):
    """The hypernetworks of the mixer, their first layers side by side.

    ``G`` units of the hypernetworks' hidden layers, ``M`` units of the mixer. The columns of
    ``first`` are: G that lead to the mixer's first weights, G that lead to its second, M that lead
    to the second bias, and M that are the first bias.
    """

    first: Dense  # weight [S, 2 G + 2 M]
    weights_in: Dense  # weight [G, N * M]
    weights_out: Dense  # weight [G, M]
    bias_out: Dense  # weight [M, 1]


class FactoredCritic(eqx.Module):
    """Utilities and mixer."""

    utilities: Utilities
    mixer: Mixer


class FactoredPevfa(eqx.Module):
    """Critic PeVFA and Mixer PeVFA: both take the policy embedding of a team as a further input.

    With ``of_agents`` the utility of an agent takes the embedding of that agent's policy instead,
    and the mixer that of the team. An embedding is one vector for the whole batch, so in each first
    layer it is a shift of the bias. In the mixer it stands beside the state, as an input of the
    hypernetworks: behind weights that are not negative, where the utilities go in, it could only
    push one way.
    """

    critic: FactoredCritic
    embedding: PolicyEmbedding
    utility_weight: Float[Array, "*stack E h1"]
    mixer_weight: Float[Array, "E W"]
    of_agents: bool = eqx.field(static=True, default=False)


def init_utilities(
    key: PRNGKeyArray,
    obs_size: int,
    action_size: int,
    sizes: tuple[int, int],
    layer_norm: bool,
    further_inputs: int = 0,
    padding: int = 0,
) -> Utilities:
    """A fresh network; ``further_inputs`` and ``padding`` only change the first layer's range."""
    k1, k2, k3 = jax.random.split(key, 3)
    inputs = obs_size + action_size
    return Utilities(
        init_dense(k1, inputs, sizes[0], fan_in=inputs + further_inputs - padding),
        init_dense(k2, *sizes),
        init_dense(k3, sizes[1], 1),
        layer_norm,
    )


def init_mixer(
    key: PRNGKeyArray,
    state_size: int,
    n_agents: int,
    size: int,
    hypernet_size: int,
    further_inputs: int = 0,
) -> Mixer:
    """A fresh mixer."""
    k1, k2, k3, k4 = jax.random.split(key, 4)
    fan_in = state_size + further_inputs
    return Mixer(
        init_dense(k1, state_size, 2 * hypernet_size + 2 * size, fan_in=fan_in),
        init_dense(k2, hypernet_size, n_agents * size),
        init_dense(k3, hypernet_size, size),
        init_dense(k4, size, 1),
    )


def utility_values(
    utilities: Utilities, inputs: Float[Array, "*stack B OA"], shift: Array | None = None
) -> Float[Array, "*stack B"]:
    """``Q_i(o_i, u_i)`` of observations and actions side by side.

    Args:
        utilities: the networks.
        inputs: an observation, then an action, per row.
        shift: what inputs that are the same for the whole batch add to the first layer,
            ``[*stack, h1]``; or what others add to each row, ``[*stack, B, h1]``.
    """
    x = utilities.first(inputs)
    if shift is not None:
        x = x + (shift if shift.ndim == x.ndim else shift[..., None, :])
    x = jax.nn.relu(before_activation(x, utilities.layer_norm))
    x = utilities.hidden(x)
    x = jax.nn.relu(before_activation(x, utilities.layer_norm))
    return utilities.out(x)[..., 0]


def mix(
    mixer: Mixer,
    state: Float[Array, "B S"],
    utilities: Float[Array, "B N"],
    shift: Float[Array, "W"] | None = None,
) -> Float[Array, "B"]:
    """``Q_tot``: ``v(s) + |w_2(s)| elu(|W_1(s)| q + b_1(s))``.

    Args:
        mixer: the hypernetworks.
        state: global states.
        utilities: of all agents.
        shift: what inputs that are the same for the whole batch add to the first layers.
    """
    size, hypernet = mixer.bias_out.weight.shape[0], mixer.weights_out.weight.shape[0]
    x = mixer.first(state)
    if shift is not None:
        x = x + shift[None]
    hidden, bias_in = jax.nn.relu(x[:, : 2 * hypernet + size]), x[:, 2 * hypernet + size :]
    weights_in = jnp.abs(mixer.weights_in(hidden[:, :hypernet]))
    weights_out = jnp.abs(mixer.weights_out(hidden[:, hypernet : 2 * hypernet]))
    bias_out = mixer.bias_out(hidden[:, 2 * hypernet :])[:, 0]
    n_agents = utilities.shape[1]
    mixed = bias_in
    for agent in range(n_agents):
        columns = weights_in[:, agent * size : (agent + 1) * size]
        mixed = mixed + utilities[:, agent, None] * columns
    return jnp.sum(jax.nn.elu(mixed) * weights_out, axis=1) + bias_out


def init_pevfa(
    key: PRNGKeyArray,
    critic: FactoredCritic,
    head_rows: int,
    embedding_size: int,
    of_agents: bool = False,
) -> FactoredPevfa:
    """A fresh PeVFA around a fresh critic, whose ``further_inputs`` are ``embedding_size``.

    Args:
        key: random key.
        critic: utilities and mixer.
        head_rows: entries ``H + 1`` of the vector that produces one entry of an action.
        embedding_size: units of the policy embedding.
        of_agents: whether utilities see the embeddings of their agents' own policies.
    """
    k1, k2, k3 = jax.random.split(key, 3)
    first, mixer_first = critic.utilities.first.weight, critic.mixer.first.weight

    def weight(key: PRNGKeyArray, like: Array) -> Array:
        bound = 1.0 / np.sqrt(like.shape[-2] + embedding_size)
        shape = (*like.shape[:-2], embedding_size, like.shape[-1])
        return jax.random.uniform(key, shape, minval=-bound, maxval=bound)

    return FactoredPevfa(
        critic,
        init_policy_embedding(k1, head_rows, embedding_size),
        weight(k2, first),
        weight(k3, mixer_first),
        of_agents,
    )


def scale_output(
    critic: FactoredCritic | FactoredPevfa, scale: Number
) -> FactoredCritic | FactoredPevfa:
    """A critic or PeVFA with the last layer of its utilities multiplied."""

    def last(critic: FactoredCritic | FactoredPevfa) -> Dense:
        inner = critic.critic if isinstance(critic, FactoredPevfa) else critic
        return inner.utilities.out

    scaled: FactoredCritic | FactoredPevfa = eqx.tree_at(last, critic, last(critic).scaled(scale))
    return scaled


def embedding_shifts(
    pevfa: FactoredPevfa, vectors: Float[Array, "U H1"], agents: Int[np.ndarray, "U"]
) -> tuple[Array, Array]:
    """What a team's policies add to the first layers of utilities and of hypernetworks.

    Args:
        pevfa: the PeVFA.
        vectors: the team's heads, one row per entry of the agents' actions.
        agents: whose each row is; every agent has one at least.

    Returns:
        The shift of the utilities, ``[N, h1]`` where networks or embeddings are the agents' own,
        else ``[h1]``; and that of the hypernetworks, ``[W]``.
    """
    each = embed_vectors(pevfa.embedding, vectors)
    team = jnp.mean(each, axis=0)
    if pevfa.of_agents:
        own = (agents[None] == np.unique(agents)[:, None]).astype(np.float32)
        of_each = jnp.asarray(own / own.sum(axis=1, keepdims=True), each.dtype) @ each  # [N, E]
        product = "ne,neh->nh" if pevfa.utility_weight.ndim == 3 else "ne,eh->nh"
        to_utilities = jnp.einsum(product, of_each, pevfa.utility_weight)
    else:
        to_utilities = jnp.matmul(team, pevfa.utility_weight)
    return to_utilities, jnp.matmul(team, pevfa.mixer_weight)

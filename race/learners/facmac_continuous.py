"""FACMAC on continuous actions: MADDPG with a factored critic (Peng et al. 2021).

Deterministic policies, transitions, and one utility network per agent, which sees what the agent
observes and does; the utilities are mixed by a monotonic network of the state. As MADDPG it has one
critic, no policy delay and no smoothing (`race.config.presets.resolve`).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from race.config.shape import Shape
from race.learners.maddpg import maddpg
from race.networks import factored
from race.networks.dense import head_vectors, stack
from race.networks.factored import FactoredCritic, FactoredPevfa
from race.types import EnvSpec


def new_critic(
    key: PRNGKeyArray, spec: EnvSpec, shape: Shape, further_inputs: int = 0
) -> FactoredCritic:
    """Fresh utilities, one network per agent, and a fresh mixer."""
    mixer_key, *keys = jax.random.split(key, 1 + spec.n_agents)
    obs_size, action_size = spec.obs_size, spec.action_size
    utilities = [
        factored.init_utilities(
            agent_key,
            obs_size,
            action_size,
            shape.critic_sizes,
            shape.layer_norm,
            further_inputs,
            padding=obs_size + action_size - obs - action,
        )
        for agent_key, obs, action in zip(keys, spec.obs_sizes, spec.action_sizes, strict=True)
    ]
    size, hypernet = shape.mixer_size, shape.hypernet_size
    mixer = factored.init_mixer(
        mixer_key, spec.state_size, spec.n_agents, size, hypernet, further_inputs
    )
    return FactoredCritic(stack(utilities), mixer)


def new_pevfa(key: PRNGKeyArray, spec: EnvSpec, shape: Shape) -> FactoredPevfa:
    """A fresh Critic PeVFA and Mixer PeVFA."""
    critic_key, pevfa_key = jax.random.split(key)
    size = shape.policy_embedding_size
    critic = new_critic(critic_key, spec, shape, size)
    of_agents = shape.utility_embedding == "agent"
    return factored.init_pevfa(pevfa_key, critic, shape.embedding_size + 1, size, of_agents)


def _values(
    critic: FactoredCritic,
    state: Float[Array, "B S"],
    action: Float[Array, "B U"],
    spec: EnvSpec,
    shifts: tuple[Array | None, Array | None] = (None, None),
) -> Float[Array, "1 B"]:
    observed = jnp.moveaxis(jnp.take(state, spec.obs_gather, axis=1), 1, 0)  # [N, B, O]
    done = jnp.moveaxis(jnp.take(action, _own_entries(spec), axis=1), 1, 0)  # [N, B, A]
    obs_mask = jnp.asarray(spec.obs_mask, state.dtype)[:, None]
    action_mask = jnp.asarray(spec.action_mask, state.dtype)[:, None]
    inputs = jnp.concatenate([observed * obs_mask, done * action_mask], axis=2)
    utilities = factored.utility_values(critic.utilities, inputs, shifts[0])
    return factored.mix(critic.mixer, state, utilities.T, shifts[1])[None]


def _own_entries(spec: EnvSpec) -> np.ndarray:
    """The joint action's entries of every agent, [N, A]; padding points at entry 0."""
    own = np.zeros((spec.n_agents, spec.action_size), np.int32)
    for agent, entries in enumerate(spec.action_index):
        own[agent, : len(entries)] = entries
    return own


def q_marl(
    critic: FactoredCritic, state: Float[Array, "B S"], action: Float[Array, "B U"], spec: EnvSpec
) -> Float[Array, "1 B"]:
    """``Q_psi(s, u)``."""
    return _values(critic, state, action, spec)


def q_team(
    pevfa: FactoredPevfa,
    state: Float[Array, "B S"],
    action: Float[Array, "B U"],
    head: Float[Array, "N H1 A"],
    spec: EnvSpec,
) -> Float[Array, "1 B"]:
    """``Q_theta(s, u, W)``."""
    agents = spec.joint_gather // spec.action_size
    shifts = factored.embedding_shifts(pevfa, head_vectors(head, spec), agents)
    return _values(pevfa.critic, state, action, spec, shifts)


def same_critic(critic: FactoredCritic) -> FactoredCritic:
    """There is only one."""
    return critic


def same_pevfa(pevfa: FactoredPevfa) -> FactoredPevfa:
    """There is only one."""
    return pevfa


facmac_continuous = maddpg._replace(
    init_critic=new_critic,
    init_pevfa=new_pevfa,
    q_marl=q_marl,
    q_team=q_team,
    first_critic=same_critic,
    first_pevfa=same_pevfa,
    scale_output=factored.scale_output,
)
"""FACMAC on tasks with continuous actions."""

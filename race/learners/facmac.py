"""FACMAC on discrete actions: recurrent policies, a factored critic, whole episodes.

As in its paper and its configuration for SMAC (Peng et al. 2021, Appendix): one recurrent encoder
and one head for all agents, centralised policy gradients through straight-through Gumbel-softmax
samples of all agents' policies, utilities of all agents in one network, a monotonic mixer, and
TD(lambda) targets at the target policies' best actions.

A minibatch of episodes comes as `Slots`; its samples are all slots but the last of each row, time
first: ``B = (L - 1) * R``. Joint actions are one-hot, ``[B, N, A]``.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from race.config.hyper import Hyper
from race.config.shape import Shape
from race.learners.base import Learner, Samples
from race.learners.moments import Moments
from race.learners.signals import mutual_information
from race.method.exploration import greedy, gumbel_softmax
from race.method.returns import lambda_returns
from race.networks import critics, factored
from race.networks.critics import StateValue
from race.networks.dense import Mine, init_one_head, init_one_mine
from race.networks.factored import FactoredCritic, FactoredPevfa
from race.networks.recurrent import (
    GruEncoder,
    embed_episodes,
    init_gru_encoder,
    of_each_agent,
)
from race.types import DiscreteSpec, Slots

Head = Float[Array, "_ H1 A"]


def new_encoder(key: PRNGKeyArray, spec: DiscreteSpec, shape: Shape) -> GruEncoder:
    """A fresh encoder, one for all agents."""
    size, layer_norm = shape.embedding_size, shape.layer_norm
    return init_gru_encoder(key, spec.obs_size, spec.n_actions, spec.n_agents, size, layer_norm)


def new_own_encoder(key: PRNGKeyArray, spec: DiscreteSpec, shape: Shape) -> GruEncoder:
    """Fresh encoders, one per agent."""
    keys = jax.random.split(key, spec.n_agents)
    every = jax.vmap(lambda key: new_encoder(key, spec, shape))(keys)
    # Of the numbers of all agents, which each has drawn, its own.
    own = every.agent[jnp.arange(spec.n_agents), jnp.arange(spec.n_agents)]
    return dataclasses.replace(every, agent=own[:, None])


def new_head(key: PRNGKeyArray, spec: DiscreteSpec, shape: Shape) -> Float[Array, "1 H1 A"]:
    """A fresh head for all agents: the MARL team has but one (Appendix A.1)."""
    return init_one_head(key, shape.embedding_size, spec.n_actions)[None]


def new_heads(key: PRNGKeyArray, spec: DiscreteSpec, shape: Shape) -> Float[Array, "N H1 A"]:
    """Fresh heads of a team of the population, one per agent."""
    keys = jax.random.split(key, spec.n_agents)
    heads = [init_one_head(k, shape.embedding_size, spec.n_actions) for k in keys]
    return jnp.stack(heads)


def new_critic(
    key: PRNGKeyArray, spec: DiscreteSpec, shape: Shape, further_inputs: int = 0
) -> FactoredCritic:
    """Fresh utilities, one network for all agents, and a fresh mixer."""
    utility_key, mixer_key = jax.random.split(key)
    return FactoredCritic(
        factored.init_utilities(
            utility_key,
            spec.obs_size,
            spec.n_actions,
            shape.critic_sizes,
            shape.layer_norm,
            further_inputs,
        ),
        factored.init_mixer(
            mixer_key,
            spec.state_size,
            spec.n_agents,
            shape.mixer_size,
            shape.hypernet_size,
            further_inputs,
        ),
    )


def new_pevfa(key: PRNGKeyArray, spec: DiscreteSpec, shape: Shape) -> FactoredPevfa:
    """A fresh Critic PeVFA and Mixer PeVFA."""
    critic_key, pevfa_key = jax.random.split(key)
    size = shape.policy_embedding_size
    critic = new_critic(critic_key, spec, shape, size)
    of_agents = shape.utility_embedding == "agent"
    return factored.init_pevfa(pevfa_key, critic, shape.embedding_size + 1, size, of_agents)


def new_value(key: PRNGKeyArray, spec: DiscreteSpec, shape: Shape) -> StateValue:
    """A fresh state-value net."""
    return critics.init_state_value(key, spec.state_size, shape.value_sizes)


def new_mine(key: PRNGKeyArray, spec: DiscreteSpec, shape: Shape) -> Mine:
    """A fresh MINE network: one, because there is one encoder (Appendix A.1)."""
    size, layers = shape.mine_size, shape.mine_embedding_layers
    return init_one_mine(key, spec.state_size, shape.embedding_size, size, layers)


def now(batch: Slots, spec: DiscreteSpec) -> Samples:
    """The slots of steps: all but the last, in which no step can be."""
    before: Slots = jax.tree.map(lambda column: column[:-1], batch)
    real = before.acted.astype(jnp.float32)
    taken = before.action.reshape(-1, spec.n_agents).astype(jnp.int32)
    action = jax.nn.one_hot(taken, spec.n_actions, dtype=jnp.float32)
    return Samples(_moments(before, real), action, real.reshape(-1))


def later(batch: Slots, spec: DiscreteSpec) -> Moments:
    """All slots, because the encoder remembers."""
    return _moments(batch, batch.real.astype(jnp.float32))


def _moments(slots: Slots, real: Float[Array, "L R"]) -> Moments:
    return Moments(
        obs=slots.obs.astype(jnp.float32),
        last_action=slots.last_action,
        avail_actions=slots.avail_actions,
        state=slots.state.astype(jnp.float32),
        first=slots.first,
        real=real,
        moment=slots.moment,
    )


def encode(encoder: GruEncoder, moments: Moments, spec: DiscreteSpec) -> Float[Array, "L R N H"]:
    """Embeddings of every agent at every moment."""
    return embed_episodes(encoder, moments.obs, moments.last_action, moments.first)


def logits(z: Float[Array, "*b N H"], head: Head) -> Float[Array, "*b N A"]:
    """``z W[1:d] + W[d+1]`` of every agent: through its own head, or the one of all."""
    if head.shape[0] == 1:
        product = z @ head[0, :-1]
    else:
        product = jnp.einsum("...nh,nha->...na", z, head[:, :-1])
    return product + jnp.broadcast_to(head[:, -1], product.shape)


def act(
    z: Float[Array, "L R N H"],
    head: Head,
    moments: Moments,
    key: PRNGKeyArray,
    spec: DiscreteSpec,
) -> Float[Array, "B N A"]:
    """Samples of all agents' policies, with the gradient of a softmax."""
    noise = gumbel_noise(key, moments.moment, moments.avail_actions.shape[2:])
    action = gumbel_softmax(logits(z, head), moments.avail_actions, noise)
    return action.reshape(-1, *action.shape[2:])


def gumbel_noise(
    key: PRNGKeyArray, moment: Int[Array, "L R"], shape: tuple[int, ...]
) -> Float[Array, "L R N A"]:
    """Gumbel noise of each moment, wherever in a minibatch it lies."""

    def of_one(moment: Int[Array, ""]) -> Float[Array, "N A"]:
        return jax.random.gumbel(jax.random.fold_in(key, moment), shape)

    return jax.vmap(jax.vmap(of_one))(moment)


def target_action(
    z: Float[Array, "L R N H"],
    head: Head,
    moments: Moments,
    key: PRNGKeyArray,
    spec: DiscreteSpec,
    hyper: Hyper,
) -> Float[Array, "B N A"]:
    """The policies' best actions."""
    action = greedy(logits(z, head), moments.avail_actions)
    return jax.nn.one_hot(action.reshape(-1, spec.n_agents), spec.n_actions, dtype=z.dtype)


def _values(
    critic: FactoredCritic,
    moments: Moments,
    action: Float[Array, "B N A"],
    shifts: tuple[Array | None, Array | None] = (None, None),
) -> Float[Array, "1 B"]:
    samples, agents, actions = action.shape
    obs = moments.obs.reshape(samples * agents, -1)
    inputs = jnp.concatenate([obs, action.reshape(samples * agents, actions)], axis=1)
    shift, of_mixer = shifts
    if shift is not None and shift.ndim == 2:  # one for each agent
        shift = jnp.broadcast_to(shift, (samples, *shift.shape)).reshape(samples * agents, -1)
    utilities = factored.utility_values(critic.utilities, inputs, shift)
    state = moments.state.reshape(samples, -1)
    return factored.mix(critic.mixer, state, utilities.reshape(samples, agents), of_mixer)[None]


def q_marl(
    critic: FactoredCritic, moments: Moments, action: Float[Array, "B N A"], spec: DiscreteSpec
) -> Float[Array, "1 B"]:
    """``Q_psi(s, u)``."""
    return _values(critic, moments, action)


def q_team(
    pevfa: FactoredPevfa,
    moments: Moments,
    action: Float[Array, "B N A"],
    head: Float[Array, "N H1 A"],
    spec: DiscreteSpec,
) -> Float[Array, "1 B"]:
    """``Q_theta(s, u, W)``."""
    vectors = jnp.swapaxes(head, 1, 2).reshape(-1, head.shape[1])
    agents = np.repeat(np.arange(head.shape[0]), head.shape[2])
    shifts = factored.embedding_shifts(pevfa, vectors, agents)
    return _values(pevfa.critic, moments, action, shifts)


def only(values: Float[Array, "1 B"]) -> Float[Array, "B"]:
    """There is one critic."""
    return values[0]


def td_target(batch: Slots, value: Float[Array, "moments"], hyper: Hyper) -> Float[Array, "B"]:
    """TD(lambda) targets of every step; ``value`` holds those of all slots."""
    by_slot = value.reshape(batch.reward.shape)
    return lambda_returns(
        batch.reward[:-1],
        batch.terminated[:-1],
        by_slot[1:],
        batch.acted[:-1],
        hyper.discount,
        hyper.td_lambda,
    ).reshape(-1)


def same(network: Any) -> Any:
    """There is only one."""
    return network


def state_values(value: StateValue, moments: Moments) -> Float[Array, "B"]:
    """``V_zeta(s)``."""
    state = moments.state.reshape(-1, moments.state.shape[-1])
    return critics.state_values(value, state, jax.nn.relu)


def episodes(moments: Moments) -> Float[Array, ""]:
    """How many there are; each has a step, and so its first moment, among them."""
    return jnp.sum(moments.first.astype(jnp.float32))


def policy_due(step: Int[Array, ""], shape: Shape) -> bool:
    """Policies are trained at every step."""
    return True


def follow(target: Any, online: Any, step: Int[Array, ""], shape: Shape, hyper: Hyper) -> Any:
    """Targets become copies of the networks after every so many gradient steps."""
    due = (step + 1) % shape.target_update_every == 0
    return jax.tree.map(lambda t, o: jnp.where(due, o, t), target, online)


facmac = Learner(
    init_encoder=new_encoder,
    init_own_encoder=new_own_encoder,
    of_each_agent=of_each_agent,
    init_head=new_head,
    init_heads=new_heads,
    init_critic=new_critic,
    init_pevfa=new_pevfa,
    init_value=new_value,
    init_mine=new_mine,
    now=now,
    later=later,
    encode=encode,
    act=act,
    target_action=target_action,
    q_marl=q_marl,
    q_team=q_team,
    pessimistic=only,
    td_target=td_target,
    first_critic=same,
    first_pevfa=same,
    state_values=state_values,
    mutual_information=mutual_information,
    episodes=episodes,
    policy_due=policy_due,
    scale_output=factored.scale_output,
    follow=follow,
)
"""FACMAC, the paper's base method on discrete tasks."""

"""MATD3: TD3 with central critics and decentralised actors.

The critics see the global state and the joint action; target actions are smoothed, targets use
the smaller of two critics, policies follow every second critic step (Ackermann et al. 2019;
Fujimoto et al. 2018). The actors are the encoder and linear head of Table 1, also without a
population, so that RACE and its baseline differ in nothing else.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from race.config.hyper import Hyper
from race.config.shape import Shape
from race.learners.base import Learner, Samples
from race.method.equations import mutual_information_signal, td_target
from race.networks import critics
from race.networks import dense as networks
from race.networks.critics import Critic, Pevfa, StateValue, first_critic, first_pevfa
from race.networks.dense import Encoder, Mine, mine_scores
from race.networks.optimization import track
from race.types import EnvSpec, Transition

N_CRITICS = 2


def new_encoder(key: PRNGKeyArray, spec: EnvSpec, shape: Shape) -> Encoder:
    """Fresh encoders of all agents, or one for all."""
    sizes, layer_norm = shape.hidden_sizes, shape.layer_norm
    return networks.init_encoder(key, spec, sizes, layer_norm, shape.shared_agents)


def as_they_are(encoder: Encoder) -> Encoder:
    """There is one per agent anyway."""
    return encoder


def new_head(key: PRNGKeyArray, spec: EnvSpec, shape: Shape) -> Float[Array, "N H1 A"]:
    """A fresh team."""
    return networks.init_head(key, spec, shape.embedding_size)


def critics_of(key: PRNGKeyArray, spec: EnvSpec, shape: Shape, count: int) -> Critic:
    """A fresh ensemble."""
    return critics.init_critic(key, spec, shape.critic_sizes, count, shape.layer_norm)


def pevfas_of(key: PRNGKeyArray, spec: EnvSpec, shape: Shape, count: int) -> Pevfa:
    """A fresh ensemble of PeVFAs over one policy embedding."""
    sizes, size = shape.critic_sizes, shape.policy_embedding_size
    each = shape.policy_embedding == "each"
    return critics.init_pevfa(key, spec, sizes, count, shape.layer_norm, size, each)


def new_critic(key: PRNGKeyArray, spec: EnvSpec, shape: Shape) -> Critic:
    """A fresh twin critic."""
    return critics_of(key, spec, shape, N_CRITICS)


def new_pevfa(key: PRNGKeyArray, spec: EnvSpec, shape: Shape) -> Pevfa:
    """A fresh twin PeVFA."""
    return pevfas_of(key, spec, shape, N_CRITICS)


def new_value(key: PRNGKeyArray, spec: EnvSpec, shape: Shape) -> StateValue:
    """A fresh state-value net."""
    return critics.init_state_value(key, spec.state_size, shape.value_sizes)


def new_mine(key: PRNGKeyArray, spec: EnvSpec, shape: Shape) -> Mine:
    """One fresh MINE network per encoder."""
    count = 1 if shape.shared_agents else spec.n_agents
    size, layers = shape.mine_size, shape.mine_embedding_layers
    return networks.init_mine(key, spec, shape.embedding_size, size, layers, count)


def now(batch: Transition, spec: EnvSpec) -> Samples:
    """All transitions are real; the networks see the states."""
    return Samples(batch.state, batch.action, None)


def later(batch: Transition, spec: EnvSpec) -> Float[Array, "B S"]:
    """The next states."""
    state: Array = batch.next_state
    return state


def encode(encoder: Encoder, state: Float[Array, "B S"], spec: EnvSpec) -> Float[Array, "N B H"]:
    """Embeddings of every agent's observation."""
    return networks.encode(encoder, spec, state)


def act(
    z: Float[Array, "N B H"],
    head: Float[Array, "N H1 A"],
    state: Float[Array, "B S"],
    key: PRNGKeyArray,
    spec: EnvSpec,
) -> Float[Array, "B U"]:
    """The policies are deterministic."""
    return networks.act(z, head, spec)


def smooth(action: Float[Array, "B U"], key: PRNGKeyArray, hyper: Hyper) -> Float[Array, "B U"]:
    """Target policy smoothing: clipped Gaussian noise, then the action's own bounds."""
    noise = hyper.smoothing_noise * jax.random.normal(key, action.shape, action.dtype)
    noise = jnp.clip(noise, -hyper.smoothing_clip, hyper.smoothing_clip)
    return jnp.clip(action + noise, -1.0, 1.0)


def target_action(
    z: Float[Array, "N B H"],
    head: Float[Array, "N H1 A"],
    state: Float[Array, "B S"],
    key: PRNGKeyArray,
    spec: EnvSpec,
    hyper: Hyper,
) -> Float[Array, "B U"]:
    """The policies' actions, smoothed."""
    return smooth(networks.act(z, head, spec), key, hyper)


def q_marl(
    critic: Critic, state: Float[Array, "B S"], action: Float[Array, "B U"], spec: EnvSpec
) -> Float[Array, "K B"]:
    """``Q_psi(s, u)`` of each critic."""
    return critics.q_values(critic, state, action)


def q_team(
    pevfa: Pevfa,
    state: Float[Array, "B S"],
    action: Float[Array, "B U"],
    head: Float[Array, "N H1 A"],
    spec: EnvSpec,
) -> Float[Array, "K B"]:
    """``Q_theta(s, u, W)`` of each critic."""
    return critics.pevfa_values(pevfa, spec, state, action, head)


def smaller(values: Float[Array, "K B"]) -> Float[Array, "B"]:
    """Clipped double Q-learning: the smaller value of the ensemble."""
    return jnp.min(values, axis=0)


def one_step_target(
    batch: Transition, next_value: Float[Array, "B"], hyper: Hyper
) -> Float[Array, "B"]:
    """The target of Eq. (1)."""
    return td_target(batch.reward, batch.terminated, next_value, hyper.discount)


def state_values(value: StateValue, state: Float[Array, "B S"]) -> Float[Array, "B"]:
    """``V_zeta(s)``."""
    return critics.state_values(value, state)


def mutual_information(
    mine: Mine,
    state: Float[Array, "B S"],
    z: Float[Array, "N B H"],
    key: PRNGKeyArray,
    shape: Shape,
) -> Float[Array, "M B"]:
    """Signals of every encoder; the other samples of the batch are the negatives.

    That of an encoder of all agents is their mean.
    """
    signal = jax.vmap(mutual_information_signal)(mine_scores(mine, state, z))
    if mine.state_out.bias.shape[0] < signal.shape[0]:
        return jnp.mean(signal, axis=0, keepdims=True)
    return signal


def policy_due(step: Int[Array, ""], shape: Shape) -> Bool[Array, ""]:
    """Every ``policy_delay``-th step."""
    return (step + 1) % shape.policy_delay == 0


def follow(target: Any, online: Any, step: Int[Array, ""], shape: Shape, hyper: Hyper) -> Any:
    """Targets move a little towards the networks."""
    return track(target, online, hyper.target_update_rate)


matd3 = Learner(
    init_encoder=new_encoder,
    init_own_encoder=new_encoder,
    of_each_agent=as_they_are,
    init_head=new_head,
    init_heads=new_head,
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
    pessimistic=smaller,
    td_target=one_step_target,
    first_critic=first_critic,
    first_pevfa=first_pevfa,
    state_values=state_values,
    mutual_information=mutual_information,
    episodes=None,
    policy_due=policy_due,
    scale_output=critics.scale_output,
    follow=follow,
)
"""MATD3, the paper's base method on continuous tasks."""

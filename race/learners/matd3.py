"""MATD3: TD3 with central critics and decentralised actors.

The critics see the global state and the joint action; target actions are smoothed, targets use
the smaller of two critics, policies follow every second critic step (Ackermann et al. 2019;
Fujimoto et al. 2018). The actors are the encoder and linear head of Table 1, also without a
population, so that RACE and its baseline differ in nothing else.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from race.config import LearnerConfig
from race.critics import (
    Critic,
    Pevfa,
    first_critic,
    first_pevfa,
    init_critic,
    init_pevfa,
    pevfa_values,
    q_values,
)
from race.learners.base import Learner
from race.networks import Encoder, act, encode, init_encoder, init_head
from race.types import EnvSpec

N_CRITICS = 2


def new_encoder(key: PRNGKeyArray, spec: EnvSpec, config: LearnerConfig) -> Encoder:
    """Fresh encoders of all agents."""
    return init_encoder(key, spec, config.hidden_sizes)


def new_head(key: PRNGKeyArray, spec: EnvSpec, config: LearnerConfig) -> Float[Array, "N H1 A"]:
    """A fresh team."""
    return init_head(key, spec, config.hidden_sizes[1])


def new_critic(key: PRNGKeyArray, spec: EnvSpec, config: LearnerConfig) -> Critic:
    """A fresh twin critic."""
    return init_critic(key, spec, config.hidden_sizes, N_CRITICS)


def new_pevfa(
    key: PRNGKeyArray, spec: EnvSpec, config: LearnerConfig, embedding_size: int
) -> Pevfa:
    """A fresh twin PeVFA."""
    return init_pevfa(key, spec, config.hidden_sizes, N_CRITICS, embedding_size)


def smooth(
    action: Float[Array, "B U"], key: PRNGKeyArray, config: LearnerConfig
) -> Float[Array, "B U"]:
    """Target policy smoothing: clipped Gaussian noise, then the action's own bounds."""
    if config.smoothing_noise == 0:
        return action
    noise = config.smoothing_noise * jax.random.normal(key, action.shape, action.dtype)
    noise = jnp.clip(noise, -config.smoothing_clip, config.smoothing_clip)
    return jnp.clip(action + noise, -1.0, 1.0)


def smaller(values: Float[Array, "K B"]) -> Float[Array, "B"]:
    """Clipped double Q-learning: the smaller value of the ensemble."""
    return jnp.min(values, axis=0)


matd3 = Learner(
    init_encoder=new_encoder,
    init_head=new_head,
    init_critic=new_critic,
    init_pevfa=new_pevfa,
    encode=encode,
    act=act,
    smooth=smooth,
    q_marl=q_values,
    q_team=pevfa_values,
    pessimistic=smaller,
    first_critic=first_critic,
    first_pevfa=first_pevfa,
)
"""MATD3, the paper's base method on continuous tasks."""

"""The gradient learner alone: MATD3 and MADDPG, the paper's baselines."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from race.algorithms.base import Algorithm, Losses, Teams
from race.config import Config
from race.equations import marl_policy_loss, td_loss, td_target
from race.learners import LEARNERS
from race.optimization import Trainable, copy, descend, init_trainable, track
from race.types import EnvSpec, Transition


class Targets(NamedTuple):
    """Target networks, marked by a prime in the paper."""

    encoder: Any
    head: Float[Array, "N H1 A"]
    critic: Any


class MarlState(NamedTuple):
    """All that learns."""

    encoder: Trainable
    head: Trainable
    critic: Trainable
    target: Targets


def init(key: PRNGKeyArray, spec: EnvSpec, config: Config) -> MarlState:
    """A fresh learner whose targets equal its networks."""
    learner = LEARNERS[config.base]
    encoder_key, head_key, critic_key = jax.random.split(key, 3)
    encoder = learner.init_encoder(encoder_key, spec, config.learner)
    head = learner.init_head(head_key, spec, config.learner)
    critic = learner.init_critic(critic_key, spec, config.learner)
    return MarlState(
        init_trainable(encoder),
        init_trainable(head),
        init_trainable(critic),
        Targets(copy(encoder), copy(head), copy(critic)),
    )


def update(
    state: MarlState,
    batch: Transition,
    step: Int[Array, ""],
    key: PRNGKeyArray,
    spec: EnvSpec,
    config: Config,
) -> tuple[MarlState, Losses, Losses]:
    """One gradient step: the critic always, the policy when its delay is over."""
    learner, hyper = LEARNERS[config.base], config.learner
    target = state.target

    z_next = learner.encode(target.encoder, spec, batch.next_state)
    next_action = learner.smooth(learner.act(z_next, target.head, spec), key, hyper)
    next_value = learner.pessimistic(learner.q_marl(target.critic, batch.next_state, next_action))
    y = td_target(batch.reward, batch.terminated, next_value, hyper.discount)

    def critic_loss(critic: Any) -> Float[Array, ""]:
        return td_loss(learner.q_marl(critic, batch.state, batch.action), y)

    loss, gradient = jax.value_and_grad(critic_loss)(state.critic.params)
    critic = descend(state.critic, gradient, hyper.critic_learning_rate, hyper.gradient_clip)
    state = state._replace(critic=critic)

    def policy_step(state: MarlState) -> tuple[MarlState, Losses]:
        maximised = learner.first_critic(state.critic.params)

        def policy_loss(encoder: Any, head: Any) -> Float[Array, ""]:
            action = learner.act(learner.encode(encoder, spec, batch.state), head, spec)
            return marl_policy_loss(learner.q_marl(maximised, batch.state, action)[0])

        loss, (encoder_gradient, head_gradient) = jax.value_and_grad(policy_loss, argnums=(0, 1))(
            state.encoder.params, state.head.params
        )
        rate, clip = hyper.actor_learning_rate, hyper.gradient_clip
        encoder = descend(state.encoder, encoder_gradient, rate, clip)
        head = descend(state.head, head_gradient, rate, clip)
        online = Targets(encoder.params, head.params, state.critic.params)
        moved = track(state.target, online, hyper.target_update_rate)
        return MarlState(encoder, head, state.critic, moved), {"policy": loss}

    def idle(state: MarlState) -> tuple[MarlState, Losses]:
        return state, {"policy": jnp.zeros(())}

    state, policy_losses = jax.lax.cond(
        (step + 1) % hyper.policy_delay == 0, policy_step, idle, state
    )
    return state, {"critic": loss}, policy_losses


def teams(state: MarlState) -> Teams:
    """The one team there is."""
    return Teams(state.encoder.params, state.head.params[None])


def _champion(state: MarlState) -> Float[Array, "N H1 A"]:
    return state.head.params


def _evolve(
    state: MarlState, fitness: Float[Array, "P"], key: PRNGKeyArray, spec: EnvSpec, config: Config
) -> MarlState:
    return state


def _inject(state: MarlState) -> MarlState:
    return state


def _injection_counts(state: MarlState) -> Int[Array, "3"]:
    return jnp.zeros(3, jnp.int32)


marl = Algorithm(
    init=init,
    teams=teams,
    champion=_champion,
    evolve=_evolve,
    update=update,
    inject=_inject,
    injection_counts=_injection_counts,
    critic_losses=("critic",),
    policy_losses=("policy",),
)
"""A MARL method without a population."""

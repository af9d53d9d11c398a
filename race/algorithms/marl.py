"""The gradient learner alone: MATD3, MADDPG and FACMAC, the paper's baselines."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from race.algorithms.base import Algorithm, Losses, Teams, Tested, when
from race.config.hyper import Hyper
from race.config.shape import Shape
from race.learners import learner_of
from race.method.equations import marl_policy_loss, td_loss
from race.networks.optimization import Trainable, copy, descend, init_trainable
from race.types import Spec


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


def init(key: PRNGKeyArray, spec: Spec, shape: Shape, hyper: Hyper) -> MarlState:
    """A fresh learner whose targets equal its networks."""
    learner = learner_of(shape)
    encoder_key, head_key, critic_key = jax.random.split(key, 3)
    encoder = learner.init_encoder(encoder_key, spec, shape)
    head = hyper.last_layer_scale * learner.init_head(head_key, spec, shape)
    critic = learner.init_critic(critic_key, spec, shape)
    critic = learner.scale_output(critic, hyper.last_layer_scale)
    return MarlState(
        init_trainable(encoder),
        init_trainable(head),
        init_trainable(critic),
        Targets(copy(encoder), copy(head), copy(critic)),
    )


def update(
    state: MarlState,
    batch: Any,
    step: Int[Array, ""],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> tuple[MarlState, Losses, Losses]:
    """One gradient step: the critic always, the policy when its delay is over."""
    learner = learner_of(shape)
    target = state.target
    target_key, policy_key = jax.random.split(key)
    now, taken, mask = learner.now(batch, spec)
    later = learner.later(batch, spec)

    z_next = learner.encode(target.encoder, later, spec)
    next_action = learner.target_action(z_next, target.head, later, target_key, spec, hyper)
    next_value = learner.pessimistic(learner.q_marl(target.critic, later, next_action, spec))
    y = learner.td_target(batch, next_value, hyper)

    def critic_loss(critic: Any) -> Float[Array, ""]:
        return td_loss(learner.q_marl(critic, now, taken, spec), y, mask)

    loss, gradient = jax.value_and_grad(critic_loss)(state.critic.params)
    critic = descend(state.critic, gradient, hyper.critic_learning_rate, hyper.gradient_clip)
    state = state._replace(critic=critic)

    def policy_step(state: MarlState) -> tuple[MarlState, Losses]:
        maximised = learner.first_critic(state.critic.params)

        def policy_loss(encoder: Any, head: Any) -> Float[Array, ""]:
            z = learner.encode(encoder, now, spec)
            action = learner.act(z, head, now, policy_key, spec)
            return marl_policy_loss(learner.q_marl(maximised, now, action, spec)[0], mask)

        loss, (encoder_gradient, head_gradient) = jax.value_and_grad(policy_loss, argnums=(0, 1))(
            state.encoder.params, state.head.params
        )
        clip = hyper.gradient_clip
        encoder = descend(state.encoder, encoder_gradient, hyper.encoder_learning_rate, clip)
        head = descend(state.head, head_gradient, hyper.actor_learning_rate, clip)
        online = Targets(encoder.params, head.params, state.critic.params)
        moved = learner.follow(state.target, online, step, shape, hyper)
        return MarlState(encoder, head, state.critic, moved), {"policy": loss}

    def idle(state: MarlState) -> tuple[MarlState, Losses]:
        return state, {"policy": jnp.zeros(())}

    state, policy_losses = when(learner.policy_due(step, shape), policy_step, idle, state)
    return state, {"critic": loss}, policy_losses


def heads_of(state: MarlState, n_agents: int) -> Float[Array, "N H1 A"]:
    """The team with a head for every agent, also where its agents share one."""
    head = state.head.params
    return jnp.broadcast_to(head, (n_agents, *head.shape[1:]))


def teams(state: MarlState, spec: Spec, shape: Shape) -> Teams:
    """The one team there is."""
    return Teams(state.encoder.params, heads_of(state, spec.n_agents)[None])


def tested(state: MarlState, spec: Spec) -> tuple[Tested, ...]:
    """The one team there is."""
    return (Tested(state.encoder.params, {"marl": heads_of(state, spec.n_agents)}),)


def _population(state: MarlState) -> None:
    return None


marl = Algorithm(
    init=init,
    teams=teams,
    tested=tested,
    evolve=None,
    update=update,
    entrant=None,
    population=_population,
    expected=None,
    critic_losses=("critic",),
    policy_losses=("policy",),
)
"""A MARL method without a population."""

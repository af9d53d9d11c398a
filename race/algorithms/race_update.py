"""What RACE's gradient steps do: lines 8, 10 and 13 of Algorithm 1 on one minibatch.

Written once against the learner's interface. A choice of `Shape` is a branch of Python; numbers of
`Hyper` are arguments.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from race.config.hyper import Hyper
from race.config.shape import Shape
from race.learners import learner_of
from race.learners.base import Samples, Values
from race.method.equations import (
    best_target,
    encoder_loss,
    marl_policy_loss,
    mutual_information_bound,
    state_value_loss,
    td_loss,
    value_aware_mi_loss,
    value_function_maximization_loss,
    value_weights,
)
from race.networks.optimization import (
    descend_all,
    descend_plainly,
    graft,
    parameters,
    weigh_gradient,
)
from race.types import Spec

Losses = dict[str, Float[Array, ""]]
CRITIC_LOSSES = ("critic", "pevfa", "value")
POLICY_LOSSES = ("policy", "vfm", "vmm", "mine")


class Targets(NamedTuple):
    """Target networks, marked by a prime in the paper. Population teams have none."""

    encoder: Any
    head: Float[Array, "_ H1 A"]
    critic: Any
    pevfa: Any


class Critics(NamedTuple):
    """What line 8 trains, or its gradients. Without a critic the PeVFA is the MARL team's too."""

    critic: Any  # Q_psi, or None
    pevfa: Any  # Q_theta
    value: Any  # V_zeta


class Policies(NamedTuple):
    """What lines 10 and 13 train, or its gradients."""

    encoder: Any  # Z_phi
    head: Any  # W_marl
    mine: Any  # T_omega


class Drawn(NamedTuple):
    """A team that was drawn, with the heads that are kept of it: one where its agents share it."""

    heads: Float[Array, "_ H1 A"]
    place: Int[Array, ""]  # in the population; P is the MARL team


def of_all_agents(head: Float[Array, "_ H1 A"], spec: Spec) -> Float[Array, "N H1 A"]:
    """A team with a head for every agent, also where its agents share one."""
    return jnp.broadcast_to(head, (spec.n_agents, *head.shape[1:]))


def _marl_values(
    critic: Any,
    pevfa: Any,
    moments: Any,
    action: Array,
    head: Float[Array, "_ H1 A"],
    spec: Spec,
    shape: Shape,
) -> Values:
    """Q_psi of the MARL team's actions, or its Q_theta where one PeVFA serves all teams."""
    learner = learner_of(shape)
    if not shape.one_pevfa:
        return learner.q_marl(critic, moments, action, spec)
    # As for the population, values are climbed through actions, not through the embedding.
    team = jax.lax.stop_gradient(of_all_agents(head, spec))
    return learner.q_team(pevfa, moments, action, team, spec)


def draw_teams(
    heads: Float[Array, "P _ H1 A"],
    marl_head: Float[Array, "_ H1 A"],
    key: PRNGKeyArray,
    shape: Shape,
) -> tuple[Drawn, Drawn]:
    """The team W_j of Eq. (1) and that of Eq. (2), of the population or of all teams."""
    n = shape.population_size + shape.marl_among_teams

    def team(key: PRNGKeyArray) -> Drawn:
        place = jax.random.randint(key, (), 0, n)
        if not shape.marl_among_teams:
            return Drawn(heads[place], place)
        drawn = heads[jnp.minimum(place, n - 2)]
        marl = jnp.broadcast_to(marl_head, drawn.shape)
        return Drawn(jnp.where(place == n - 1, marl, drawn), place)

    first = team(key)
    return first, first if shape.team_draw == "once" else team(jax.random.fold_in(key, 2))


def train_critics(
    critics: Critics,
    target: Targets,
    policies: Policies,
    batch: Any,
    samples: Samples,
    team: Float[Array, "N H1 A"],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> tuple[Critics, Losses, Float[Array, "B"]]:
    """Line 8: Eq. (1) for both critics and Eq. (4); also returns V(s) of the batch."""
    learner = learner_of(shape)
    now, taken, mask = samples
    later = learner.later(batch, spec)
    marl_key, team_key = jax.random.split(key)

    # One pass of the target encoders serves both teams. Eq. (1) gives a prime to the MARL team's
    # policies alone; W_j has no slowly moving copy, but the encoder below it has.
    z = learner.encode(target.encoder, later, spec)
    marl_action = learner.target_action(z, target.head, later, marl_key, spec, hyper)
    if shape.pevfa_target == "target":
        team_action = learner.target_action(z, team, later, team_key, spec, hyper)
    else:
        online = learner.encode(policies.encoder, later, spec)
        as_it_is = hyper._replace(smoothing_noise=0.0)
        team_action = learner.target_action(online, team, later, team_key, spec, as_it_is)
    marl_next = _marl_values(
        target.critic, target.pevfa, later, marl_action, target.head, spec, shape
    )
    team_next = learner.q_team(target.pevfa, later, team_action, team, spec)
    y_marl, y_team = (
        learner.td_target(batch, learner.pessimistic(q), hyper) for q in (marl_next, team_next)
    )
    best = best_target(y_marl, y_team)

    def loss(critics: Critics) -> tuple[Float[Array, ""], tuple[Losses, Float[Array, "B"]]]:
        value = learner.state_values(critics.value, now)
        q_marl = _marl_values(critics.critic, critics.pevfa, now, taken, policies.head, spec, shape)
        losses = {
            "critic": td_loss(q_marl, y_marl, mask),
            "pevfa": td_loss(learner.q_team(critics.pevfa, now, taken, team, spec), y_team, mask),
            "value": state_value_loss(value, best, mask),
        }
        # The three share no parameter: the gradient of the sum is each one's own. One PeVFA for
        # all teams learns of both.
        return losses["critic"] + losses["pevfa"] + losses["value"], (losses, value)

    gradient, (losses, value) = jax.grad(loss, has_aux=True)(parameters(critics))
    rates = Critics(*[hyper.critic_learning_rate] * 3)
    return descend_all(critics, gradient, rates, hyper.gradient_clip), losses, value


def train_policies(
    policies: Policies,
    critics: Critics,
    target: Targets,
    samples: Samples,
    kept: Float[Array, "_ H1 A"],
    value: Float[Array, "B"],
    step: Int[Array, ""],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> tuple[Policies, Targets, Losses, Float[Array, "_ H1 A"] | None]:
    """Lines 10 and 13: Eq. (7) for W_marl, Eq. (6) for the encoders, Eq. (3) for MINE.

    Also returns the team W_j after a step of its own, where heads of the population learn.
    """
    learner = learner_of(shape)
    now, _, mask = samples
    team = of_all_agents(kept, spec)
    marl_key, team_key, pairs_key = jax.random.split(key, 3)
    of_critics = parameters(critics)
    critic = None if shape.one_pevfa else learner.first_critic(of_critics.critic)
    pevfa = learner.first_pevfa(of_critics.pevfa)
    weights = value_weights(value, mask, hyper.value_awareness)
    episodes = None
    if shape.vmm_reduction == "sum":
        assert learner.episodes is not None
        episodes = learner.episodes(now)

    def loss(policies: Policies, own: Any) -> tuple[Float[Array, ""], Losses]:
        z = learner.encode(policies.encoder, now, spec)
        # The weights of Eq. (2)'s terms are of what goes on into the encoders: W_marl learns by
        # Eq. (7) whatever they are. They multiply gradients of actions, the smallest arrays there
        # are.
        fixed_z, fixed_head = jax.lax.stop_gradient((z, policies.head))
        of_encoder = learner.act(z, fixed_head, now, marl_key, spec)
        marl_action = graft(
            learner.act(fixed_z, policies.head, now, marl_key, spec),
            weigh_gradient(of_encoder, hyper.vfm_marl_weight),
        )
        team_action = learner.act(z, team, now, team_key, spec)
        team_action = weigh_gradient(team_action, hyper.vfm_team_weight)
        if shape.heads_learn:
            # As for W_marl: the weight is of the encoders' part, and W_j climbs through actions.
            climbing = learner.act(fixed_z, of_all_agents(own, spec), now, team_key, spec)
            team_action = graft(climbing, team_action)
        q_marl = _marl_values(critic, pevfa, now, marl_action, policies.head, spec, shape)[0]
        q_team = learner.q_team(pevfa, now, team_action, team, spec)[0]
        # The encoders climb the value-weighted signal, MINE the plain bound, each with the other
        # held fixed. Both are the same numbers and are computed once.
        fixed_mine = jax.lax.stop_gradient(policies.mine)
        signal = learner.mutual_information(fixed_mine, now, z, pairs_key, shape)
        plain = learner.mutual_information(policies.mine, now, fixed_z, pairs_key, shape)
        vmm = jax.vmap(value_aware_mi_loss, in_axes=(None, 0, None, None))(
            weights, signal, mask, episodes
        )
        bound = jax.vmap(mutual_information_bound, in_axes=(0, None))(plain, mask)
        vfm = value_function_maximization_loss(q_marl, q_team, mask)
        # Encoders and MINEs, of which there are equally many, share no parameter among themselves:
        # sums train each on its own terms.
        # W_marl enters through q_marl alone: its gradient is that of Eq. (7).
        total = encoder_loss(vfm, jnp.sum(vmm), hyper.vmm_weight) - jnp.sum(bound)
        losses = {
            "policy": marl_policy_loss(q_marl, mask),
            "vfm": vfm,
            "vmm": jnp.mean(vmm),
            "mine": -jnp.mean(bound),
        }
        return total, losses

    own = kept if shape.heads_learn else None
    (gradient, of_team), losses = jax.grad(loss, argnums=(0, 1), has_aux=True)(
        parameters(policies), own
    )
    if own is not None:
        # Beyond the paper, whose population evolves alone. A memory of gradients would be another
        # team's after evolution, so that there is none.
        own = descend_plainly(own, of_team, hyper.head_learning_rate, hyper.gradient_clip)
    rates = Policies(
        hyper.encoder_learning_rate, hyper.actor_learning_rate, hyper.critic_learning_rate
    )
    policies = descend_all(policies, gradient, rates, hyper.gradient_clip)
    trained = parameters(policies)
    online = Targets(trained.encoder, trained.head, of_critics.critic, of_critics.pevfa)
    return policies, learner.follow(target, online, step, shape, hyper), losses, own

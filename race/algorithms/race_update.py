"""What RACE's gradient steps do: lines 8, 10 and 13 of Algorithm 1 on one minibatch.

Written once against the learner's interface. A choice of `Shape` is a branch of Python; numbers of
`Hyper` are arguments.
"""

from collections.abc import Callable
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
    """A team that was drawn, with the heads that are kept of it: one where its agents share it.

    Or several, if a gradient step draws several (``k`` is the axis K then, else there is none).
    """

    heads: Float[Array, "*k _ H1 A"]
    place: Int[Array, "*k"]  # in the population; P is the MARL team


def of_all_agents(head: Float[Array, "*k _ H1 A"], spec: Spec) -> Float[Array, "*k N H1 A"]:
    """A team with a head for every agent, also where its agents share one."""
    *several, _, inputs, actions = head.shape
    return jnp.broadcast_to(head, (*several, spec.n_agents, inputs, actions))


def _of_each(function: Callable[..., Any], shape: Shape) -> Callable[..., Any]:
    """What is written for the team that a gradient step draws, for each of them if it draws K."""
    return jax.vmap(function) if shape.teams_per_batch > 1 else function


def _over_teams(x: Float[Array, "..."], shape: Shape) -> Float[Array, "..."]:
    """The mean over the drawn teams ``[K, ...]``, in place of an expectation over all teams."""
    return jnp.mean(x, axis=0) if shape.teams_per_batch > 1 else x


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
    """The team W_j of Eq. (1) and that of Eq. (2), of the population or of all teams.

    Or K different ones each, with as many teams in a gradient step.
    """
    n = shape.population_size + shape.marl_among_teams

    def at(place: Int[Array, ""]) -> Drawn:
        if not shape.marl_among_teams:
            return Drawn(heads[place], place)
        drawn = heads[jnp.minimum(place, n - 2)]
        marl = jnp.broadcast_to(marl_head, drawn.shape)
        return Drawn(jnp.where(place == n - 1, marl, drawn), place)

    def draw(key: PRNGKeyArray) -> Drawn:
        if shape.teams_per_batch > 1:
            drawn: Drawn = jax.vmap(at)(jax.random.permutation(key, n)[: shape.teams_per_batch])
            return drawn
        return at(jax.random.randint(key, (), 0, n))

    first = draw(key)
    return first, first if shape.team_draw == "once" else draw(jax.random.fold_in(key, 2))


def train_critics(
    critics: Critics,
    target: Targets,
    policies: Policies,
    batch: Any,
    samples: Samples,
    team: Float[Array, "*k N H1 A"],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> tuple[Critics, Losses, Float[Array, "B"]]:
    """Line 8: Eq. (1) for both critics and Eq. (4); also returns V(s) of the batch.

    Of several teams the losses of the PeVFA and of V are means; chance in target actions is the
    same for all of them.
    """
    learner = learner_of(shape)
    now, taken, mask = samples
    later = learner.later(batch, spec)
    marl_key, team_key = jax.random.split(key)

    # One pass of the target encoders serves both teams. Eq. (1) gives a prime to the MARL team's
    # policies alone; W_j has no slowly moving copy, but the encoder below it has.
    z = learner.encode(target.encoder, later, spec)
    marl_action = learner.target_action(z, target.head, later, marl_key, spec, hyper)
    below, smoothing = z, hyper
    if shape.pevfa_target == "online":
        below = learner.encode(policies.encoder, later, spec)
        smoothing = hyper._replace(smoothing_noise=0.0)

    def next_action(team: Float[Array, "N H1 A"]) -> Array:
        return learner.target_action(below, team, later, team_key, spec, smoothing)

    def next_values(team: Float[Array, "N H1 A"], action: Array) -> Values:
        return learner.q_team(target.pevfa, later, action, team, spec)

    def td_target(values: Float[Array, "K moments"]) -> Float[Array, "B"]:
        return learner.td_target(batch, learner.pessimistic(values), hyper)

    team_action = _of_each(next_action, shape)(team)
    marl_next = _marl_values(
        target.critic, target.pevfa, later, marl_action, target.head, spec, shape
    )
    team_next = _of_each(next_values, shape)(team, team_action)
    y_marl, y_team = td_target(marl_next), _of_each(td_target, shape)(team_next)
    best = _of_each(lambda y: best_target(y_marl, y), shape)(y_team)

    def loss(critics: Critics) -> tuple[Float[Array, ""], tuple[Losses, Float[Array, "B"]]]:
        value = learner.state_values(critics.value, now)

        def pevfa_loss(team: Float[Array, "N H1 A"], y: Float[Array, "B"]) -> Float[Array, ""]:
            return td_loss(learner.q_team(critics.pevfa, now, taken, team, spec), y, mask)

        def value_loss(best: Float[Array, "B"]) -> Float[Array, ""]:
            return state_value_loss(value, best, mask)

        q_marl = _marl_values(critics.critic, critics.pevfa, now, taken, policies.head, spec, shape)
        losses = {
            "critic": td_loss(q_marl, y_marl, mask),
            "pevfa": _over_teams(_of_each(pevfa_loss, shape)(team, y_team), shape),
            "value": _over_teams(_of_each(value_loss, shape)(best), shape),
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
    kept: Float[Array, "*k _ H1 A"],
    value: Float[Array, "B"],
    step: Int[Array, ""],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> tuple[Policies, Targets, Losses, Float[Array, "*k _ H1 A"] | None]:
    """Lines 10 and 13: Eq. (7) for W_marl, Eq. (6) for the encoders, Eq. (3) for MINE.

    Also returns the team W_j after a step of its own, where heads of the population learn. Of
    several teams the second term of Eq. (2) is the mean, and each takes the step it would alone.
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

        def act(z: Array, team: Float[Array, "*k N H1 A"]) -> Array:
            every = _of_each(lambda team: learner.act(z, team, now, team_key, spec), shape)
            actions: Array = every(team)
            return actions

        def value_of(team: Float[Array, "N H1 A"], action: Array) -> Float[Array, "B"]:
            return learner.q_team(pevfa, now, action, team, spec)[0]

        team_action = act(z, team)
        team_action = weigh_gradient(team_action, hyper.vfm_team_weight)
        if shape.heads_learn:
            # As for W_marl: the weight is of the encoders' part, and W_j climbs through actions.
            team_action = graft(act(fixed_z, of_all_agents(own, spec)), team_action)
        q_marl = _marl_values(critic, pevfa, now, marl_action, policies.head, spec, shape)[0]
        q_team = _over_teams(_of_each(value_of, shape)(team, team_action), shape)
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
        def climb(head: Float[Array, "_ H1 A"], gradient: Any) -> Any:
            whole = shape.teams_per_batch * gradient  # of the mean over teams it has its share
            return descend_plainly(head, whole, hyper.head_learning_rate, hyper.gradient_clip)

        own = _of_each(climb, shape)(own, of_team)
    rates = Policies(
        hyper.encoder_learning_rate, hyper.actor_learning_rate, hyper.critic_learning_rate
    )
    policies = descend_all(policies, gradient, rates, hyper.gradient_clip)
    trained = parameters(policies)
    online = Targets(trained.encoder, trained.head, of_critics.critic, of_critics.pevfa)
    return policies, learner.follow(target, online, step, shape, hyper), losses, own

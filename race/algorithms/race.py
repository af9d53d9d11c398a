"""RACE: a MARL team and a population of teams over shared observation encoders.

Written once against the learner's interface. Lines are those of Algorithm 1 of the paper, whose
one iteration is: roll out all teams (3-6), evolve (9), then for each minibatch train the critics
(8), the MARL team (10) and the encoders (13), then inject the MARL team (11).

The paper lists 8 before 9 and trains each part once per iteration; like the code it builds on,
the parts are interleaved minibatch by minibatch here, and evolution comes first, so that the
PeVFA learns the values of the teams that act next.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from race.algorithms.base import Algorithm, Losses, Teams, when
from race.config.hyper import Hyper
from race.config.shape import Shape
from race.learners import learner_of
from race.learners.base import Samples
from race.method.crossover import breed, inject
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
from race.method.mutation import mutate_population
from race.method.selection import select
from race.networks.optimization import copy, descend, graft, init_trainable, weigh_gradient
from race.types import Spec, Team


class Targets(NamedTuple):
    """Target networks, marked by a prime in the paper. Population teams have none."""

    encoder: Any
    head: Float[Array, "_ H1 A"]
    critic: Any
    pevfa: Any


class Critics(NamedTuple):
    """What line 8 trains, or its gradients."""

    critic: Any  # Q_psi
    pevfa: Any  # Q_theta
    value: Any  # V_zeta


class Policies(NamedTuple):
    """What lines 10 and 13 train, or its gradients."""

    encoder: Any  # Z_phi
    head: Any  # W_marl
    mine: Any  # T_omega


class RaceState(NamedTuple):
    """All that learns and evolves."""

    policies: Policies  # of Trainable
    critics: Critics  # of Trainable
    target: Targets
    heads: Float[Array, "P N H1 A"]  # the population
    elite: Int[Array, ""]
    worst: Int[Array, ""]
    injected: Int[Array, ""]  # where the MARL team was put last, -1 before the first time
    injection_counts: Int[Array, "3"]  # elite, parent, discarded


def init(key: PRNGKeyArray, spec: Spec, shape: Shape) -> RaceState:
    """Line 1."""
    learner = learner_of(shape)
    keys = jax.random.split(key, 7)
    encoder = learner.init_encoder(keys[0], spec, shape)
    head = learner.init_head(keys[1], spec, shape)
    critic = learner.init_critic(keys[2], spec, shape)
    pevfa = learner.init_pevfa(keys[3], spec, shape)
    value = learner.init_value(keys[4], spec, shape)
    mine = learner.init_mine(keys[5], spec, shape)
    # Vmapped, since a program of hundreds of teams one after the other takes minutes to compile.
    heads = jax.vmap(lambda team_key: learner.init_heads(team_key, spec, shape))(
        jax.random.split(keys[6], shape.population_size)
    )
    return RaceState(
        policies=Policies(*map(init_trainable, (encoder, head, mine))),
        critics=Critics(*map(init_trainable, (critic, pevfa, value))),
        target=copy(Targets(encoder, head, critic, pevfa)),
        heads=heads,
        elite=jnp.zeros((), jnp.int32),
        worst=jnp.zeros((), jnp.int32),
        injected=jnp.full((), -1, jnp.int32),
        injection_counts=jnp.zeros(3, jnp.int32),
    )


def teams(state: RaceState, spec: Spec) -> Teams:
    """The population and, last, the MARL team, all over the same encoders."""
    heads = jnp.concatenate([state.heads, _marl_team(state)[None]])
    return Teams(state.policies.encoder.params, heads)


def _marl_team(state: RaceState) -> Float[Array, "N H1 A"]:
    """The MARL team with a head for every agent, also where its agents share one."""
    return jnp.broadcast_to(state.policies.head.params, state.heads.shape[1:])


def evolve(
    state: RaceState,
    fitness: Float[Array, "P"],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> RaceState:
    """Line 9: selection, agent-level crossover and mutation; and what became of the injected."""
    select_key, breed_key, mutate_key = jax.random.split(key, 3)
    mask = jnp.asarray(spec.action_mask)
    chosen = select(fitness, shape.tournament_size, select_key, spec.n_agents)
    bred = breed(
        Team(None, state.heads),
        chosen,
        mask,
        hyper.crossover_probability,
        breed_key,
        shape.elite_copy,
        "agent",
    )
    teams, _ = mutate_population(
        bred.teams, chosen.elite, mask, hyper, mutate_key, shape.mutation_draw, "agent"
    )
    is_elite = state.injected == chosen.elite
    is_parent = state.injected == chosen.parent[0]
    is_discarded = (state.injected >= 0) & ~is_elite & ~is_parent
    fate = jnp.stack([is_elite, is_parent, is_discarded]).astype(jnp.int32)
    return state._replace(
        heads=teams.heads,
        elite=chosen.elite.astype(jnp.int32),
        worst=chosen.worst.astype(jnp.int32),
        injection_counts=state.injection_counts + fate,
    )


def update(
    state: RaceState,
    batch: Any,
    step: Int[Array, ""],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> tuple[RaceState, Losses, Losses]:
    """Lines 8, 10 and 13 on one minibatch, with one team W_j drawn from the population."""
    learner = learner_of(shape)
    team_key, critic_key, policy_key = jax.random.split(key, 3)
    team = state.heads[jax.random.randint(team_key, (), 0, shape.population_size)]
    samples = learner.now(batch, spec)
    state, critic_losses, value = _train_critics(
        state, batch, samples, team, critic_key, spec, shape, hyper
    )

    def policy_step(state: RaceState) -> tuple[RaceState, Losses]:
        return _train_policies(state, samples, team, value, step, policy_key, spec, shape, hyper)

    def idle(state: RaceState) -> tuple[RaceState, Losses]:
        return state, {name: jnp.zeros(()) for name in POLICY_LOSSES}

    state, policy_losses = when(learner.policy_due(step, shape), policy_step, idle, state)
    return state, critic_losses, policy_losses


def _train_critics(
    state: RaceState,
    batch: Any,
    samples: Samples,
    team: Float[Array, "N H1 A"],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> tuple[RaceState, Losses, Float[Array, "B"]]:
    """Line 8: Eq. (1) for both critics and Eq. (4); also returns V(s) of the batch."""
    learner, target = learner_of(shape), state.target
    now, taken, mask = samples
    later = learner.later(batch, spec)
    marl_key, team_key = jax.random.split(key)

    # One pass of the target encoders serves both teams. Eq. (1) gives a prime to the MARL team's
    # policies alone; W_j has no slowly moving copy, but the encoder below it has.
    z = learner.encode(target.encoder, later, spec)
    marl_action = learner.target_action(z, target.head, later, marl_key, spec, hyper)
    team_action = learner.target_action(z, team, later, team_key, spec, hyper)
    marl_next = learner.q_marl(target.critic, later, marl_action, spec)
    team_next = learner.q_team(target.pevfa, later, team_action, team, spec)
    y_marl, y_team = (
        learner.td_target(batch, learner.pessimistic(q), hyper) for q in (marl_next, team_next)
    )
    best = best_target(y_marl, y_team)

    def loss(critics: Critics) -> tuple[Float[Array, ""], tuple[Losses, Float[Array, "B"]]]:
        value = learner.state_values(critics.value, now)
        losses = {
            "critic": td_loss(learner.q_marl(critics.critic, now, taken, spec), y_marl, mask),
            "pevfa": td_loss(learner.q_team(critics.pevfa, now, taken, team, spec), y_team, mask),
            "value": state_value_loss(value, best, mask),
        }
        # The three share no parameter: the gradient of the sum is each one's own.
        return losses["critic"] + losses["pevfa"] + losses["value"], (losses, value)

    params = Critics(*(trained.params for trained in state.critics))
    gradient, (losses, value) = jax.grad(loss, has_aux=True)(params)
    critics = Critics(
        *(
            descend(trained, g, hyper.critic_learning_rate, hyper.gradient_clip)
            for trained, g in zip(state.critics, gradient, strict=True)
        )
    )
    return state._replace(critics=critics), losses, value


def _train_policies(
    state: RaceState,
    samples: Samples,
    team: Float[Array, "N H1 A"],
    value: Float[Array, "B"],
    step: Int[Array, ""],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> tuple[RaceState, Losses]:
    """Lines 10 and 13: Eq. (7) for W_marl, Eq. (6) for the encoders, Eq. (3) for MINE."""
    learner = learner_of(shape)
    now, _, mask = samples
    marl_key, team_key, pairs_key = jax.random.split(key, 3)
    critic = learner.first_critic(state.critics.critic.params)
    pevfa = learner.first_pevfa(state.critics.pevfa.params)
    weights = value_weights(value, mask, hyper.value_awareness)

    def loss(policies: Policies) -> tuple[Float[Array, ""], Losses]:
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
        q_marl = learner.q_marl(critic, now, marl_action, spec)[0]
        q_team = learner.q_team(pevfa, now, team_action, team, spec)[0]
        # The encoders climb the value-weighted signal, MINE the plain bound, each with the other
        # held fixed. Both are the same numbers and are computed once.
        fixed_mine = jax.lax.stop_gradient(policies.mine)
        signal = learner.mutual_information(fixed_mine, now, z, pairs_key)
        plain = learner.mutual_information(policies.mine, now, fixed_z, pairs_key)
        vmm = jax.vmap(value_aware_mi_loss, in_axes=(None, 0, None))(weights, signal, mask)
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

    params = Policies(*(trained.params for trained in state.policies))
    gradient, losses = jax.grad(loss, has_aux=True)(params)
    rates = Policies(
        hyper.actor_learning_rate, hyper.actor_learning_rate, hyper.critic_learning_rate
    )
    policies = Policies(*map(descend, state.policies, gradient, rates, [hyper.gradient_clip] * 3))
    online = Targets(
        policies.encoder.params,
        policies.head.params,
        state.critics.critic.params,
        state.critics.pevfa.params,
    )
    target = learner.follow(state.target, online, step, shape, hyper)
    return state._replace(policies=policies, target=target), losses


def inject_marl(state: RaceState, key: PRNGKeyArray, hyper: Hyper) -> RaceState:
    """Line 11: the MARL team replaces the team of lowest fitness (never the elite)."""
    happens = jax.random.uniform(key) < hyper.injection_probability
    teams = inject(Team(None, state.heads), Team(None, _marl_team(state)), state.worst)
    return state._replace(
        heads=jnp.where(happens, teams.heads, state.heads),
        injected=jnp.where(happens, state.worst, -1),
    )


def _champion(state: RaceState) -> Float[Array, "N H1 A"]:
    return state.heads[state.elite]


def _injection_counts(state: RaceState) -> Int[Array, "3"]:
    return state.injection_counts


CRITIC_LOSSES = ("critic", "pevfa", "value")
POLICY_LOSSES = ("policy", "vfm", "vmm", "mine")

race = Algorithm(
    init=init,
    teams=teams,
    champion=_champion,
    evolve=evolve,
    update=update,
    inject=inject_marl,
    injection_counts=_injection_counts,
    critic_losses=CRITIC_LOSSES,
    policy_losses=POLICY_LOSSES,
)
"""RACE over any learner."""

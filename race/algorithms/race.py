"""RACE: a MARL team and a population of teams over shared observation encoders.

Written once against the learner's interface. Lines are those of Algorithm 1 of the paper, whose
one iteration is: roll out all teams (3-6), evolve (9), then for each minibatch train the critics
(8), the MARL team (10) and the encoders (13), then inject the MARL team (11).

The paper lists 8 before 9 and trains each part once per iteration; like the code it builds on,
the parts are interleaved minibatch by minibatch here, and evolution comes first, so that the
PeVFA learns the values of the teams that act next.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from race.algorithms.base import Algorithm, Losses, Teams, Tested, when
from race.algorithms.evolutions import evolve
from race.algorithms.evolutions import start as start_population
from race.algorithms.population import Population, population_of
from race.algorithms.race_update import (
    CRITIC_LOSSES,
    POLICY_LOSSES,
    Critics,
    Policies,
    Targets,
    draw_teams,
    of_all_agents,
    train_critics,
    train_policies,
)
from race.config.hyper import Hyper
from race.config.shape import Shape
from race.learners import learner_of
from race.networks.optimization import copy, init_trainable, parameters
from race.types import DiscreteSpec, Spec, Team


class RaceState(NamedTuple):
    """All that learns and evolves."""

    policies: Policies  # of Trainable
    critics: Critics  # of Trainable
    target: Targets
    population: Population  # of heads

    @property
    def heads(self) -> Float[Array, "P _ H1 A"]:
        """The teams of the population: a head for each agent, or one for all agents of a team."""
        heads: Array = self.population.teams.heads
        return heads


def init(key: PRNGKeyArray, spec: Spec, shape: Shape, hyper: Hyper) -> RaceState:
    """Line 1."""
    learner = learner_of(shape)
    keys = jax.random.split(key, 7)
    scale = hyper.last_layer_scale
    encoder = learner.init_encoder(keys[0], spec, shape)
    head = scale * learner.init_head(keys[1], spec, shape)
    critic = None
    if not shape.one_pevfa:
        critic = learner.scale_output(learner.init_critic(keys[2], spec, shape), scale)
    pevfa = learner.scale_output(learner.init_pevfa(keys[3], spec, shape), scale)
    value = learner.init_value(keys[4], spec, shape)
    mine = learner.init_mine(keys[5], spec, shape)
    # Vmapped, since a program of hundreds of teams one after the other takes minutes to compile.
    new_team = learner.init_head if shape.team_heads == "shared" else learner.init_heads
    heads = jax.vmap(lambda team_key: new_team(team_key, spec, shape))(
        jax.random.split(keys[6], shape.population_size)
    )
    return RaceState(
        policies=Policies(*map(init_trainable, (encoder, head, mine))),
        critics=Critics(
            None if shape.one_pevfa else init_trainable(critic),
            init_trainable(pevfa),
            init_trainable(value),
        ),
        target=copy(Targets(encoder, head, critic, pevfa)),
        population=start_population(Team(None, heads), spec, shape),
    )


def teams(state: RaceState, spec: Spec, shape: Shape) -> Teams:
    """The population and, last, the MARL team, all over the same encoders."""
    own = jax.vmap(lambda team: of_all_agents(team, spec))(state.heads)
    marl = of_all_agents(state.policies.head.params, spec)
    heads = jnp.concatenate([own, marl[None]])
    return Teams(state.policies.encoder.params, heads)


def update(
    state: RaceState,
    batch: Any,
    step: Int[Array, ""],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> tuple[RaceState, Losses, Losses]:
    """Lines 8, 10 and 13 on one minibatch, with one team W_j of the population or with several."""
    learner = learner_of(shape)
    team_key, critic_key, policy_key = jax.random.split(key, 3)
    policies = parameters(state.policies)
    team, climbing = draw_teams(state.heads, policies.head, team_key, shape)
    samples = learner.now(batch, spec)
    critics, critic_losses, value = train_critics(
        state.critics,
        state.target,
        policies,
        batch,
        samples,
        of_all_agents(team.heads, spec),
        critic_key,
        spec,
        shape,
        hyper,
    )

    def policy_step(moving: tuple[Policies, Targets]) -> tuple[Policies, Targets, Losses, Any]:
        policies, target = moving
        return train_policies(
            policies,
            critics,
            target,
            samples,
            climbing.heads,
            value,
            step,
            policy_key,
            spec,
            shape,
            hyper,
        )

    def idle(moving: tuple[Policies, Targets]) -> tuple[Policies, Targets, Losses, Any]:
        losses = {name: jnp.zeros(()) for name in POLICY_LOSSES}
        return *moving, losses, climbing.heads if shape.heads_learn else None

    # The population stays outside: what goes through a branch may be copied at each step.
    policies, target, policy_losses, climbed = when(
        learner.policy_due(step, shape), policy_step, idle, (state.policies, state.target)
    )
    moved = state._replace(policies=policies, critics=critics, target=target)
    if climbed is not None:
        moved = moved._replace(population=_with_heads(state.population, climbing.place, climbed))
    return moved, critic_losses, policy_losses


def _with_heads(
    population: Population, place: Int[Array, "*k"], heads: Float[Array, "*k _ H1 A"]
) -> Population:
    """The population in which teams have other heads; the MARL team, drawn, has no place there."""
    everyone = population.teams.heads.at[place].set(heads, mode="drop")
    return population._replace(teams=population.teams._replace(heads=everyone))


def expected(
    state: RaceState, states: Float[Array, "P S"], spec: Spec, shape: Shape
) -> Float[Array, "P"]:
    """``Q_theta(s, pi_j(s), W_j)`` of the population, each team in a state of its own."""
    learner = learner_of(shape)
    encoder, pevfa = state.policies.encoder.params, state.critics.pevfa.params
    unused = jax.random.key(0)  # policies of continuous actions are deterministic

    def of_one(head: Float[Array, "N H1 A"], at: Float[Array, "S"]) -> Float[Array, ""]:
        moments = at[None]
        z = learner.encode(encoder, moments, spec)
        action = learner.act(z, head, moments, unused, spec)
        values = learner.q_team(pevfa, moments, action, head, spec)
        return learner.pessimistic(values)[0]

    return jax.vmap(of_one)(state.heads, states)


def evolve_heads(
    population: Population,
    fitness: Float[Array, "P"],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> Population:
    """Line 9; a team whose agents share a head evolves as one of a single agent."""
    if shape.team_heads == "shared":
        assert isinstance(spec, DiscreteSpec)
        spec = dataclasses.replace(spec, n_agents=1)
    return evolve(population, fitness, key, spec, shape, hyper)


def entrant(state: RaceState, shape: Shape) -> Team:
    """Of line 11: the MARL team's heads, as many as teams of the population have."""
    return Team(None, jnp.broadcast_to(state.policies.head.params, state.heads.shape[1:]))


def tested(state: RaceState, spec: Spec) -> tuple[Tested, ...]:
    """The MARL team and the champion, over the same encoders."""
    teams = {"marl": state.policies.head.params, "champion": state.population.champion.heads}
    heads = {name: of_all_agents(head, spec) for name, head in teams.items()}
    return (Tested(state.policies.encoder.params, heads),)


race = Algorithm(
    init=init,
    teams=teams,
    tested=tested,
    evolve=evolve_heads,
    update=update,
    entrant=entrant,
    population=population_of,
    expected=expected,
    critic_losses=CRITIC_LOSSES,
    policy_losses=POLICY_LOSSES,
)
"""RACE over any learner."""

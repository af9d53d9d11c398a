"""MERL: a MARL team beside a population of whole teams, which share a replay buffer alone.

Majumdar et al. (2020) as the paper compares with it: one team reward serves both (Section 4.1). The
MARL team learns as it does without a population, from everybody's experience, and enters the
population whole. With agent-level operators it is RACE without shared encoders.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from race.algorithms.base import Algorithm, Losses, Teams, Tested
from race.algorithms.ea import whole_teams
from race.algorithms.evolutions import evolve
from race.algorithms.marl import MarlState, heads_of, marl
from race.algorithms.population import Population, population_of
from race.config.hyper import Hyper
from race.config.shape import Shape
from race.learners import learner_of
from race.types import Spec, Team


class MerlState(NamedTuple):
    """All that learns and evolves."""

    marl: MarlState
    population: Population  # of whole teams


def init(key: PRNGKeyArray, spec: Spec, shape: Shape, hyper: Hyper) -> MerlState:
    """A fresh learner and a fresh population."""
    marl_key, population_key = jax.random.split(key)
    learned = marl.init(marl_key, spec, shape, hyper)
    return MerlState(learned, whole_teams(population_key, spec, shape))


def entrant(state: MerlState, shape: Shape) -> Team:
    """The whole MARL team."""
    encoder = learner_of(shape).of_each_agent(state.marl.encoder.params)
    return Team(encoder, heads_of(state.marl, state.population.teams.heads.shape[1]))


def teams(state: MerlState, spec: Spec, shape: Shape) -> Teams:
    """The population and, last, the MARL team."""
    every: Team = jax.tree.map(
        lambda leaf, one: jnp.concatenate([leaf, one[None]]),
        state.population.teams,
        entrant(state, shape),
    )
    return Teams(every.encoder, every.heads, own_encoders=True)


def tested(state: MerlState, spec: Spec) -> tuple[Tested, ...]:
    """The MARL team, and the champion with its own encoders."""
    encoder, heads = state.population.champion
    return *marl.tested(state.marl, spec), Tested(encoder, {"champion": heads})


def update(
    state: MerlState,
    batch: Any,
    step: Int[Array, ""],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> tuple[MerlState, Losses, Losses]:
    """A gradient step of the MARL team."""
    learned, critic, policy = marl.update(state.marl, batch, step, key, spec, shape, hyper)
    return state._replace(marl=learned), critic, policy


merl = Algorithm(
    init=init,
    teams=teams,
    tested=tested,
    evolve=evolve,
    update=update,
    entrant=entrant,
    population=population_of,
    expected=None,
    critic_losses=marl.critic_losses,
    policy_losses=marl.policy_losses,
)
"""MERL over any learner."""

"""EA: a population of whole teams without gradients (Khadka and Tumer 2018), a baseline.

Each agent of each team has an encoder and a head of its own, of the base method's sizes.
"""

from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Int, PRNGKeyArray

from race.algorithms.base import Algorithm, Losses, Teams, Tested
from race.algorithms.evolutions import evolve
from race.algorithms.evolutions import start as start_population
from race.algorithms.population import Population, population_of
from race.config.hyper import Hyper
from race.config.shape import Shape
from race.learners import learner_of
from race.types import Spec, Team


class EaState(NamedTuple):
    """All that evolves."""

    population: Population  # of whole teams


def whole_teams(key: PRNGKeyArray, spec: Spec, shape: Shape) -> Population:
    """A fresh population of teams that share nothing."""
    learner = learner_of(shape)

    def team(key: PRNGKeyArray) -> Team:
        encoder_key, head_key = jax.random.split(key)
        encoder = learner.init_own_encoder(encoder_key, spec, shape)
        return Team(encoder, learner.init_heads(head_key, spec, shape))

    teams = jax.vmap(team)(jax.random.split(key, shape.population_size))
    return start_population(teams, spec, shape)


def init(key: PRNGKeyArray, spec: Spec, shape: Shape, hyper: Hyper) -> EaState:
    """A fresh population."""
    return EaState(whole_teams(key, spec, shape))


def teams(state: EaState, spec: Spec, shape: Shape) -> Teams:
    """The population."""
    encoder, heads = state.population.teams
    return Teams(encoder, heads, own_encoders=True)


def tested(state: EaState, spec: Spec) -> tuple[Tested, ...]:
    """The champion."""
    encoder, heads = state.population.champion
    return (Tested(encoder, {"champion": heads}),)


def _update(
    state: EaState,
    batch: Any,
    step: Int[Array, ""],
    key: PRNGKeyArray,
    spec: Spec,
    shape: Shape,
    hyper: Hyper,
) -> tuple[EaState, Losses, Losses]:
    return state, {}, {}


ea = Algorithm(
    init=init,
    teams=teams,
    tested=tested,
    evolve=evolve,
    update=_update,
    entrant=None,
    population=population_of,
    expected=None,
    critic_losses=(),
    policy_losses=(),
)
"""Evolution alone."""

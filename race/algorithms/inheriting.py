"""A run that begins with another run's teams instead of random ones.

The MARL team begins as the other run's MARL team, with targets that equal it, and the first team of
the population as its champion; where the other run has only one of the two, it serves as both.
Everything else (critics, the other teams, optimisers) begins as it does in any run.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from race.algorithms.ea import EaState
from race.algorithms.marl import MarlState
from race.algorithms.merl import MerlState
from race.algorithms.population import Population
from race.algorithms.race import RaceState
from race.networks.optimization import copy, init_trainable
from race.types import Team


class Inherited(NamedTuple):
    """What a run can begin with, in the forms of its state; None where it has no such."""

    encoder: Any  # of the MARL team
    head: Any  # of the MARL team: [N, H1, A], or [1, H1, A] for all agents
    team: Team | None  # of the population; its encoder is None where all teams share one


def parts(state: Any) -> Inherited:
    """What of a state would be inherited, as it stands."""
    match state:
        case MarlState():
            return Inherited(state.encoder.params, state.head.params, None)
        case RaceState():
            policies = state.policies
            team = _first(state.population)
            return Inherited(policies.encoder.params, policies.head.params, team)
        case MerlState():
            return parts(state.marl)._replace(team=_first(state.population))
        case EaState():
            return Inherited(None, None, _first(state.population))
    raise TypeError(f"no state of an algorithm: {type(state).__name__}")


def begun_with(state: Any, inherited: Inherited) -> Any:
    """A fresh state with other teams in the places of its own."""
    encoder, head, team = inherited
    match state:
        case MarlState():
            target = state.target._replace(encoder=copy(encoder), head=copy(head))
            own = (init_trainable(copy(encoder)), init_trainable(copy(head)))
            return state._replace(encoder=own[0], head=own[1], target=target)
        case RaceState():
            own = (init_trainable(copy(encoder)), init_trainable(copy(head)))
            return state._replace(
                policies=state.policies._replace(encoder=own[0], head=own[1]),
                target=state.target._replace(encoder=copy(encoder), head=copy(head)),
                population=_with_first(state.population, team),
            )
        case MerlState():
            return state._replace(
                marl=begun_with(state.marl, inherited),
                population=_with_first(state.population, team),
            )
        case EaState():
            return state._replace(population=_with_first(state.population, team))
    raise TypeError(f"no state of an algorithm: {type(state).__name__}")


def _first(population: Population) -> Team:
    team: Team = jax.tree.map(lambda leaf: leaf[0], population.teams)
    return team


def _with_first(population: Population, team: Team | None) -> Population:
    teams = jax.tree.map(lambda leaf, one: leaf.at[0].set(jnp.asarray(one)), population.teams, team)
    return population._replace(teams=teams, champion=copy(team))

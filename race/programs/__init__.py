"""The compiled programs of a run. Each is traced once per run; `TRACES` counts it.

`race.programs.cohort` holds those of several runs at once.
"""

from collections import Counter
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from race.algorithms import Algorithm
from race.algorithms.base import Losses, Teams
from race.algorithms.population import Population, inject_team
from race.config.hyper import Hyper
from race.config.shape import Shape
from race.learners import LEARNERS
from race.method.normalisation import Scaling, scaled
from race.networks.dense import act_teams
from race.replay.buffer import (
    Layout,
    Replay,
    distinct_places,
    insert,
    sample,
    slots_of,
    sources_of,
)
from race.replay.shown import as_shown
from race.types import EnvSpec, Spec, Team

TRACES: Counter[str] = Counter()
"""How often each program was traced in this process: one more than expected is a slow surprise."""

INSERT_ROWS = 2048
"""Transitions written to the replay buffer at a time."""


def empty_losses(algorithm: Algorithm) -> Losses:
    """Sums of losses before the first gradient step of a generation."""
    names = (*algorithm.critic_losses, *algorithm.policy_losses)
    return {name: jnp.zeros(()) for name in names}


@partial(
    jax.jit,
    static_argnames=("algorithm", "spec", "shape"),
    donate_argnames=("state", "sums"),
)
def learn(
    state: Any,
    sums: Losses,
    replay: Replay,
    key: PRNGKeyArray,
    first_step: Int[Array, ""],
    n_steps: Int[Array, ""],
    *,
    hyper: Hyper,
    algorithm: Algorithm,
    spec: Spec,
    shape: Shape,
    layouts: Layout | None = None,
    scaling: Scaling | None = None,
) -> tuple[Any, Losses]:
    """Gradient steps ``first_step`` to ``first_step + n_steps - 1`` of a run, in one program.

    The randomness of a step depends on ``key`` and the step's number alone, so that steps may be
    split over calls in any way. Minibatches of episodes are those of the ``layouts``, one a step.
    The buffer holds what environments showed; ``scaling`` says how networks see it.

    Returns:
        The state and ``sums`` with the steps' losses added.
    """
    TRACES["learn"] += 1
    sources = sources_of(replay)

    def body(i: Int[Array, ""], carry: tuple[Any, Losses]) -> tuple[Any, Losses]:
        state, sums = carry
        step = first_step + i
        sample_key, update_key = jax.random.split(jax.random.fold_in(key, step))
        if layouts is None:
            batch = sample(replay, shape.batch_size, sample_key, hyper.own_share, sources)
        else:
            batch = slots_of(replay, jax.tree.map(lambda column: column[i], layouts))
        batch = as_shown(batch, scaling)
        state, critic, policy = algorithm.update(state, batch, step, update_key, spec, shape, hyper)
        losses = critic | policy
        return state, {name: sums[name] + losses[name] for name in sums}

    return jax.lax.fori_loop(0, n_steps, body, (state, sums))


@partial(jax.jit, static_argnames=("room", "shape"))
def draw(
    replay: Replay,
    key: PRNGKeyArray,
    first_step: Int[Array, ""],
    n_steps: Int[Array, ""],
    *,
    hyper: Hyper,
    room: int,
    shape: Shape,
) -> tuple[Int[Array, "room B"], Int[Array, "room B"]]:
    """The minibatches of episodes of some gradient steps: their places and their lengths.

    The first ``n_steps`` rows are drawn; the others are there for one program to serve every
    number of steps up to ``room``.
    """
    TRACES["draw"] += 1

    def body(i: Int[Array, ""], places: Int[Array, "room B"]) -> Int[Array, "room B"]:
        sample_key, _ = jax.random.split(jax.random.fold_in(key, first_step + i))
        drawn = distinct_places(replay, shape.batch_size, sample_key, hyper.own_share)
        return places.at[i].set(drawn)

    places = jnp.zeros((room, shape.batch_size), jnp.int32)
    places = jax.lax.fori_loop(0, n_steps, body, places)
    return places, replay.data.length[places]


def evolve(
    state: Any,
    fitness: Float[Array, "P"],
    key: PRNGKeyArray,
    *,
    hyper: Hyper,
    algorithm: Algorithm,
    spec: Spec,
    shape: Shape,
) -> Any:
    """One evolution of the population; the arrays of the old one are gone.

    Only the population goes through the program: with all that learns, handing the arrays over
    takes longer than the evolution.
    """
    population = _evolve(
        state.population, fitness, key, hyper=hyper, algorithm=algorithm, spec=spec, shape=shape
    )
    return state._replace(population=population)


def inject(
    state: Any, key: PRNGKeyArray, *, hyper: Hyper, algorithm: Algorithm, shape: Shape
) -> Any:
    """The MARL team enters the population; the arrays of the old one are gone."""
    assert algorithm.entrant is not None
    entrant = algorithm.entrant(state, shape)
    return state._replace(population=_inject(state.population, entrant, key, hyper=hyper))


@partial(jax.jit, static_argnames=("algorithm", "spec", "shape"), donate_argnames="population")
def _evolve(
    population: Population,
    fitness: Float[Array, "P"],
    key: PRNGKeyArray,
    *,
    hyper: Hyper,
    algorithm: Algorithm,
    spec: Spec,
    shape: Shape,
) -> Population:
    TRACES["evolve"] += 1
    assert algorithm.evolve is not None
    return algorithm.evolve(population, fitness, key, spec, shape, hyper)


@partial(jax.jit, donate_argnames="population")
def _inject(population: Population, team: Team, key: PRNGKeyArray, *, hyper: Hyper) -> Population:
    TRACES["inject"] += 1
    return inject_team(population, team, key, hyper)


@partial(jax.jit, donate_argnames="replay")
def store(
    replay: Replay, rows: Any, count: Int[Array, ""], own: Bool[Any, "R"] | None = None
) -> Replay:
    """Writes the first ``count`` of some transitions or episodes; ``own``: the MARL team's."""
    TRACES["store"] += 1
    return insert(replay, rows, count, own)


@partial(jax.jit, static_argnames=("spec", "base"))
def act(
    teams: Teams,
    state: Float[Array, "T S"] | Float[np.ndarray, "T S"],
    *,
    spec: EnvSpec,
    base: str,
) -> Float[Array, "T U"]:
    """The joint actions of all teams, each in its own state: one batched call per tick."""
    TRACES["act"] += 1
    return joint_actions(teams, jnp.asarray(state), spec=spec, base=base)


def joint_actions(
    teams: Teams, state: Float[Array, "T S"], *, spec: EnvSpec, base: str
) -> Float[Array, "T U"]:
    """What `act` compiles."""
    if teams.scaling is not None:
        state = scaled(state, teams.scaling.state)
    encode = LEARNERS[base].encode
    if not teams.own_encoders:
        return act_teams(encode(teams.encoder, state, spec), teams.heads, spec)
    each = jax.vmap(lambda encoder, one: encode(encoder, one[None], spec)[:, 0])
    z = each(teams.encoder, state)
    return act_teams(jnp.moveaxis(z, 0, 1), teams.heads, spec)


@partial(jax.jit, static_argnames=("algorithm", "spec", "shape"))
def start(
    key: PRNGKeyArray, *, hyper: Hyper, algorithm: Algorithm, spec: Spec, shape: Shape
) -> Any:
    """The state of an algorithm before its first step."""
    TRACES["start"] += 1
    return algorithm.init(key, spec, shape, hyper)


@partial(jax.jit, static_argnames=("algorithm", "spec", "shape"))
def expected(
    state: Any,
    states: Float[Array, "P S"] | Float[np.ndarray, "P S"],
    *,
    algorithm: Algorithm,
    spec: Spec,
    shape: Shape,
    scaling: Scaling | None = None,
) -> Float[Array, "P"]:
    """What each team of the population is worth where it is, by the PeVFA."""
    TRACES["expected"] += 1
    assert algorithm.expected is not None
    shown = jnp.asarray(states)
    if scaling is not None:
        shown = scaled(shown, scaling.state)
    return algorithm.expected(state, shown, spec, shape)


@jax.jit
def all_finite(state: Any) -> Bool[Array, ""]:
    """Whether every number of a state is finite."""
    leaves = [leaf for leaf in jax.tree.leaves(state) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))

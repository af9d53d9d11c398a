"""Teams with networks of their own: EA, MERL, and RACE without sharing."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race import programs
from race.algorithms import algorithm_of, ea, marl, merl, race
from race.algorithms.base import Teams
from race.algorithms.population import inject_team
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config, FacmacConfig, RaceConfig
from race.config.shape import shape_of
from race.learners import facmac
from race.networks.recurrent import of_each_agent
from race.rollouts.choosing import blank, choose
from race.types import DiscreteSpec, EnvSpec, Observation

SPEC = DiscreteSpec("tiny", 3, 5, 6, 4, 5)


def discrete(algo: str, **race: Any) -> Config:
    facmac = FacmacConfig(
        hidden_size=4, utility_sizes=(3, 3), mixer_size=2, hypernet_size=2, batch_size=2
    )
    config = Config("tiny", algo=algo, facmac=facmac, race=RaceConfig(**race))  # type: ignore[arg-type]
    return resolve(config, discrete=True)


def start(config: Config, spec: Any) -> Any:
    algorithm = algorithm_of(config)
    return algorithm.init(jax.random.key(0), spec, shape_of(config), hyper_of(config))


def assert_equal(one: Any, other: Any) -> None:
    for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True):
        np.testing.assert_array_equal(a, b)


def assert_close(one: Any, other: Any) -> None:
    for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


# --- how they act -----------------------------------------------------------------------------


def test_identical_teams_equal_one_team(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config]
) -> None:
    """Teams with encoders of their own that are the same act as teams that share them."""
    config = tiny_config("race", "matd3")
    state = start(config, tiny_spec)
    together = race.teams(state, tiny_spec, shape_of(config))
    count = together.count
    apart = Teams(
        jax.tree.map(lambda leaf: jnp.stack([leaf] * count), together.encoder),
        together.heads,
        own_encoders=True,
    )
    states = np.random.default_rng(0).normal(size=(count, tiny_spec.state_size))
    states = states.astype(np.float32)
    one, other = (
        programs.act(teams, states, spec=tiny_spec, base="matd3") for teams in (together, apart)
    )
    assert_close(one, other)
    same = jnp.repeat(together.heads[:1], count, axis=0)
    alike = Teams(apart.encoder, same, own_encoders=True)
    actions = programs.act(alike, states[[0] * count], spec=tiny_spec, base="matd3")
    assert_close(actions, np.tile(one[:1], (count, 1)))


def test_identical_recurrent_teams_equal_one_team() -> None:
    config = discrete("race")
    state = start(config, SPEC)
    together = race.teams(state, SPEC, shape_of(config))
    own = of_each_agent(together.encoder)
    apart = Teams(
        jax.tree.map(lambda leaf: jnp.stack([leaf] * together.count), own),
        together.heads,
        own_encoders=True,
    )
    lone = Teams(own, together.heads)
    rng = np.random.default_rng(0)
    shape = (together.count, SPEC.n_agents)
    memories = [blank(teams) for teams in (together, apart, lone)]
    step = jax.jit(choose)
    for tick in range(3):
        seen = Observation(
            jnp.asarray(rng.normal(size=(*shape, SPEC.obs_size)), jnp.float32),
            jnp.zeros((together.count, SPEC.state_size)),
            jnp.asarray(rng.random((*shape, SPEC.n_actions)) < 0.7).at[:, :, 0].set(True),
        )
        chosen = []
        for index, teams in enumerate((together, apart, lone)):
            memories[index], action = step(teams, memories[index], seen, jnp.int32(tick), None)
            chosen.append(np.asarray(action))
        for memory, action in zip(memories[1:], chosen[1:], strict=True):
            np.testing.assert_array_equal(action, chosen[0])
            assert_close(memory.carry, memories[0].carry)


def test_agents_of_a_fresh_team_have_networks_of_their_own() -> None:
    encoder = facmac.init_own_encoder(jax.random.key(0), SPEC, shape_of(discrete("ea")))
    for leaf in jax.tree.leaves(encoder):
        assert leaf.shape[0] == SPEC.n_agents
        assert not np.array_equal(leaf[0], leaf[1])
    assert encoder.agent.shape == (3, 1, 4)


# --- what they are made of --------------------------------------------------------------------


def test_merl_learns_as_the_learner_alone(
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
    batch_of: Callable[..., Any],
    compiled: Callable[..., Any],
) -> None:
    config, alone = tiny_config("merl", "matd3"), tiny_config("marl", "matd3")
    state, batch = start(config, tiny_spec), batch_of(tiny_spec, 3)
    got = compiled(merl, "update", tiny_spec, config)(state, batch, jnp.int32(1), jax.random.key(0))
    expected = compiled(marl, "update", tiny_spec, alone)(
        state.marl, batch, jnp.int32(1), jax.random.key(0)
    )
    assert_equal((got[0].marl, *got[1:]), expected)
    assert_equal(got[0].population, state.population)


def check_injection(config: Config, spec: Any) -> None:
    state = start(config, spec)
    roles = state.population._replace(worst=jnp.int32(2))
    entrant = merl.entrant(state, shape_of(config))
    entered = inject_team(roles, entrant, jax.random.key(0), hyper_of(config))
    after = state._replace(population=entered)
    teams = merl.teams(state, spec, shape_of(config))
    last = teams.at(slice(teams.count - 1, None))
    entered = jax.tree.map(lambda leaf: leaf[2:3], after.population.teams)
    assert_equal((entered.encoder, entered.heads), (last.encoder, last.heads))
    for team in (0, 1, 3, 4):
        kept = [jax.tree.map(lambda x, t=team: x[t], s.population.teams) for s in (after, state)]
        assert_equal(*kept)


def test_the_whole_marl_team_is_injected(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config]
) -> None:
    check_injection(tiny_config("merl", "matd3"), tiny_spec)
    check_injection(discrete("merl"), SPEC)


@pytest.mark.parametrize("levels", ["agent", "layer"])
def test_whole_networks_evolve(
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
    compiled: Callable[..., Any],
    levels: Any,
) -> None:
    """Elite and biases stay; encoders and heads of others change, over agents or layers."""
    operators = {"crossover": levels, "mutation": levels, "mutation_probability": 1.0}
    config = tiny_config("ea", "matd3", race={**operators, "crossover_probability": 0.0})
    state, fitness = start(config, tiny_spec), jnp.array([1.0, 5.0, 2.0, 4.0, 3.0])
    evolve = compiled(ea, "evolve", tiny_spec, config)
    before = state.population.teams
    # The fittest place is the elite's copy's, then come one of the elite and one of the parent.
    copies = jax.tree.map(lambda leaf: leaf[jnp.array([3, 1, 1, 3, 1])], before)
    for seed in range(3):
        after = evolve(state, fitness, jax.random.key(seed)).population
        elite = [jax.tree.map(lambda leaf: leaf[1], teams) for teams in (after.teams, before)]
        assert_equal(*elite)
        assert_equal(after.champion, elite[0])
        new, old = after.teams, copies
        mutant = slice(2, 5)
        for name in ("hidden", "out"):
            layer, kept = getattr(new.encoder, name), getattr(old.encoder, name)
            assert_equal(layer.bias[mutant], kept.bias[mutant])
        changed = [
            np.asarray(a != b).reshape(5, 2, -1).any(axis=2)
            for a, b in (
                (new.encoder.hidden.weight, old.encoder.hidden.weight),
                (new.encoder.out.weight, old.encoder.out.weight),
                (new.heads, old.heads),
            )
        ]
        told = np.asarray(after.record.now.changes).sum(axis=2) > 0
        np.testing.assert_array_equal(told, np.any(changed, axis=0))
        assert not told[1].any()
        assert told[[0, 2, 3, 4]].any(axis=1).all()


def test_the_settings_of_the_genetic_algorithm_of_whole_networks() -> None:
    for algo in ("ea", "merl"):
        race = resolve(Config("mamujoco/HalfCheetah-2x3", algo=algo)).race  # type: ignore[arg-type]
        assert (race.crossover, race.mutation, race.mutation_draw) == ("layer", "layer", "weight")
        assert (race.mutation_fraction, race.tournament_size) == (0.1, 3)
    unshared = resolve(Config("mamujoco/HalfCheetah-2x3", race=RaceConfig(sharing=False)))
    assert (unshared.race.crossover, unshared.race.mutation) == ("agent", "agent")
    assert unshared.race.mutation_fraction == 0.7
    assert algorithm_of(unshared) is merl

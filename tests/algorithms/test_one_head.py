"""Teams of the population whose agents share a head."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evolving import evolving
from test_race_update import gradient_of
from tiny_episodes import (
    SPEC,
    A,
    H,
    N,
    laid_out,
    random_batch,
    start,
    stepper,
    tiny_facmac,
    with_heads,
)

from race.algorithms import race
from race.algorithms.population import inject_team
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config, RaceConfig
from race.config.shape import shape_of
from race.errors import ConfigError
from race.learners.facmac import facmac
from race.networks import factored
from race.training.inheriting import made_to_fit

P = 4


@pytest.fixture(scope="module")
def config(tiny_config: Callable[..., Config]) -> Config:
    return tiny_facmac(tiny_config, team_heads="shared", crossover="parameter")


@pytest.fixture(scope="module")
def state(config: Config) -> Any:
    return start(config)


def start_apart(config: Config) -> Any:
    """The same with a head for each agent."""
    race = dataclasses.replace(config.race, team_heads="agent")
    return start(dataclasses.replace(config, race=race))


def test_all_agents_of_a_team_act_through_its_head(state: Any, config: Config) -> None:
    assert state.heads.shape == (P, 1, H + 1, A)
    assert len(np.unique(np.asarray(state.heads), axis=0)) == P
    acting = race.teams(state, SPEC, shape_of(config)).heads
    marl = state.policies.head.params
    expected = np.repeat(np.concatenate([state.heads, marl[None]]), N, axis=1)
    np.testing.assert_array_equal(acting, expected)
    ((_, tested),) = race.tested(state, SPEC)
    np.testing.assert_array_equal(tested["marl"], expected[-1])
    champion = state.population.champion.heads
    np.testing.assert_array_equal(tested["champion"], np.repeat(champion, N, axis=0))


def test_the_embedding_of_each_agent_is_that_of_the_team(state: Any, config: Config) -> None:
    """So that it does not matter which of the two utilities see, and choosing is refused."""
    shape = dataclasses.replace(shape_of(config), utility_embedding="agent")
    pevfa = facmac.init_pevfa(jax.random.key(2), SPEC, shape)
    assert pevfa.of_agents
    agents = np.repeat(np.arange(N), A)
    for head, alike in ((state.heads[0], True), (start_apart(config).heads[0], False)):
        heads = jnp.broadcast_to(head, (N, *head.shape[1:]))
        vectors = jnp.swapaxes(heads, 1, 2).reshape(-1, H + 1)
        own, _ = factored.embedding_shifts(pevfa, vectors, agents)
        team, _ = factored.embedding_shifts(
            dataclasses.replace(pevfa, of_agents=False), vectors, agents
        )
        assert np.allclose(own, np.broadcast_to(team, own.shape), atol=1e-6) == alike


@pytest.mark.slow
def test_a_head_that_learns_climbs_for_all_its_agents(
    state: Any, config: Config, tiny_config: Callable[..., Config]
) -> None:
    """Its step is the sum of those that agents with heads of their own would take."""
    rate = 1e3  # gradients are small beside heads, and would be lost in rounding
    learning, apart = (
        dataclasses.replace(one, race=dataclasses.replace(one.race, head_learning_rate=rate))
        for one in (config, tiny_facmac(tiny_config))
    )
    repeated = with_heads(start(apart), jnp.repeat(state.heads, N, axis=1))
    batch = laid_out(random_batch(), junk_seed=1)
    one = stepper(learning, race, fixed=False)(state, batch).after.heads - state.heads
    other = stepper(apart, race, fixed=False)(repeated, batch).after.heads - repeated.heads
    assert one.shape == (P, 1, H + 1, A)
    moved = np.flatnonzero(np.abs(one).max(axis=(1, 2, 3)))
    assert len(moved) == 1
    summed = jnp.sum(other, axis=1, keepdims=True)
    np.testing.assert_allclose(one, summed, rtol=1e-2, atol=1e-3 * np.abs(summed).max())


def test_gradient_steps_are_those_of_teams_whose_agents_have_equal_heads(
    state: Any, config: Config, tiny_config: Callable[..., Config]
) -> None:
    apart = tiny_facmac(tiny_config)
    repeated = with_heads(start(apart), jnp.repeat(state.heads, N, axis=1))
    batch = laid_out(random_batch(), junk_seed=1)
    one = stepper(config, race, fixed=False)(state, batch)
    other = stepper(apart, race, fixed=False)(repeated, batch)
    assert min(map(abs, one.losses.values())) > 0
    for name, loss in one.losses.items():
        np.testing.assert_allclose(loss, other.losses[name], rtol=1e-5)
    for part in ("policies", "critics"):
        both = zip(getattr(one.after, part), getattr(other.after, part), strict=True)
        for mine, theirs in both:
            gradients = map(jax.tree.leaves, map(gradient_of, (mine, theirs)))
            for a, b in zip(*gradients, strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5 * np.abs(b).max())


def evolved(state: Any, config: Config, seed: int = 0) -> Any:
    shape, hyper = shape_of(config), hyper_of(config)
    fitness = jnp.array([2.0, 9.0, 3.0, 1.0])  # all others enter the tournament: team 2 wins it
    return evolving(race)(state, fitness, jax.random.key(seed), SPEC, shape, hyper)


def test_offspring_take_actions_of_both_parents_and_the_marl_head_enters(
    state: Any, config: Config
) -> None:
    race_config = dataclasses.replace(config.race, mutation_probability=0.0)
    still = dataclasses.replace(config, race=race_config)
    before = np.asarray(state.heads)
    mixtures = set()
    for seed in range(4):
        after = evolved(state, still, seed)
        assert after.heads.shape == before.shape
        np.testing.assert_array_equal(after.heads[1:3], before[1:3])
        for child in np.asarray(after.heads)[[0, 3], 0]:
            of_elite, of_parent = ((child == before[team, 0]).all(axis=0) for team in (1, 2))
            assert (of_elite | of_parent).all()
            assert of_elite.any()
            assert of_parent.any()
            mixtures.add(of_elite.tobytes())
        assert after.population.record.now.share.shape == (P, 1)
    assert len(mixtures) > 2
    entered = inject_team(
        after.population, race.entrant(after, shape_of(still)), jax.random.key(1), hyper_of(still)
    )
    np.testing.assert_array_equal(entered.teams.heads[3], after.policies.head.params)
    np.testing.assert_array_equal(entered.teams.heads[:3], after.heads[:3])


@pytest.mark.parametrize("evolution", ["ga", "cem", "es"])
def test_every_evolution_moves_one_head_a_team(
    state: Any, tiny_config: Callable[..., Config], evolution: str
) -> None:
    config = tiny_facmac(
        tiny_config, team_heads="shared", crossover="parameter", evolution=evolution
    )
    before = start(config)
    after = evolved(before, config)
    assert after.heads.shape == before.heads.shape
    assert jnp.isfinite(after.heads).all()
    assert (after.heads != before.heads).any()


def configured(**race: Any) -> Config:
    return resolve(Config("tiny", race=RaceConfig(**race)), discrete=True)


def test_agents_that_share_a_head_have_none_to_exchange() -> None:
    assert configured(team_heads="shared").race.crossover == "parameter"
    assert configured().race.crossover == "agent"
    with pytest.raises(ConfigError, match=r"race.crossover is agent, but it must be parameter"):
        configured(team_heads="shared", crossover="agent")


@pytest.mark.parametrize("equal", [True, False])
def test_a_champion_of_another_run_enters_if_its_agents_do_alike(
    state: Any, config: Config, equal: bool
) -> None:
    ((encoder, tested),) = race.tested(state, SPEC)
    heads = {**tested, "champion": tested["champion"].at[0].add(float(not equal))}
    encoders = dict.fromkeys(heads, encoder)
    if not equal:
        with pytest.raises(ConfigError, match="heads of their own, and here all share one"):
            made_to_fit(encoders, heads, config, Path("other"), config, SPEC)
        return
    found = made_to_fit(encoders, heads, config, Path("other"), config, SPEC)
    assert found.team is not None
    np.testing.assert_array_equal(found.team.heads, state.population.champion.heads)

"""RACE over whole episodes: padding, unequal lengths, dead agents, targets and injection."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_race_update import gradient_of
from tiny_episodes import (
    LENGTHS,
    PACKED,
    SPEC,
    TARGET_EVERY,
    A,
    H,
    N,
    Step,
    T,
    laid_out,
    random_batch,
    start,
    stepper,
    tiny_facmac,
)

from race.algorithms import race
from race.algorithms.population import inject_team
from race.config.hyper import hyper_of
from race.config.settings import Config
from race.config.shape import shape_of
from race.replay.buffer import Layout, Replay, slots_of

PLAIN = ("critic", "pevfa", "value", "policy", "vfm")
"""Losses that are means of what each step of a minibatch gives for itself."""


@pytest.fixture(scope="module", params=["steps", "episodes"])
def config(request: Any, tiny_config: Callable[..., Config]) -> Config:
    """Critics are not moved, so that policies see the same ones whatever critics learned."""
    config = tiny_facmac(tiny_config, mine_negatives=request.param)
    facmac = dataclasses.replace(config.facmac, critic_learning_rate=0.0)
    return dataclasses.replace(config, facmac=facmac)


@pytest.fixture(scope="module")
def before(config: Config) -> Any:
    return start(config)


@pytest.fixture(scope="module")
def step(config: Config) -> Callable[..., Step]:
    return stepper(config, race, fixed=True)


@pytest.fixture(scope="module")
def plain(step: Callable[..., Step], before: Any) -> Step:
    """A step on a minibatch whose empty slots hold zeros, as the buffer lays them out."""
    return step(before, laid_out(random_batch(), None))


def gradients(got: Step) -> dict[str, Any]:
    both = {**got.after.policies._asdict(), **got.after.critics._asdict()}
    return {name: gradient_of(trained) for name, trained in both.items()}


def assert_close(got: Any, expected: Any) -> None:
    leaves = list(zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True))
    scale = max(np.abs(e).max() for _, e in leaves)
    assert scale > 1e-4
    for g, e in leaves:
        np.testing.assert_allclose(g, e, rtol=1e-4, atol=1e-6 * scale)


def assert_same_step(got: Step, expected: Step) -> None:
    """The same losses and gradients; targets are in the critics' losses."""
    assert_close(got.losses, expected.losses)
    for name, gradient in gradients(got).items():
        assert_close(gradient, gradients(expected)[name])


def test_what_stands_where_no_step_was_made_changes_nothing(
    step: Callable[..., Step], before: Any, plain: Step
) -> None:
    assert_same_step(step(before, laid_out(random_batch(), junk_seed=7)), plain)


def test_where_episodes_lie_changes_nothing(
    step: Callable[..., Step], before: Any, plain: Step
) -> None:
    """A row for each, in another order, with one row empty."""
    apart = laid_out(random_batch(), 7, ((1,), (3,), (), (0,), (2,)), size=T + 2)
    assert_same_step(step(before, apart), plain)


def test_a_minibatch_is_its_episodes_weighted_by_their_steps(
    step: Callable[..., Step], before: Any, plain: Step
) -> None:
    batch = random_batch()
    singles = [step(before, laid_out(batch, 7, ((e,),), size=T + 1)) for e in range(len(LENGTHS))]
    shares = np.array(LENGTHS) / sum(LENGTHS)

    def weighted(*values: Any) -> Any:
        return sum(share * v for share, v in zip(shares, values, strict=True))

    for name in PLAIN:
        together = weighted(*(one.losses[name] for one in singles))
        np.testing.assert_allclose(plain.losses[name], together, rtol=1e-4)
    apart = [gradients(one) for one in singles]
    for name in ("critic", "pevfa", "head"):
        together = jax.tree.map(weighted, *(g[name] for g in apart))
        assert_close(gradients(plain)[name], together)
    # The lengths matter: weighted alike, episodes give another loss.
    alike = np.mean([one.losses["critic"] for one in singles])
    assert not np.isclose(alike, plain.losses["critic"], rtol=1e-2)


def test_what_a_dead_agent_remembers_matters_to_nothing(
    step: Callable[..., Step], before: Any
) -> None:
    """An agent that is dead from the beginning: it sees zeros and can do nothing but a no-op."""
    episodes = random_batch()
    episodes.obs[:, :, 1] = 0.0
    episodes.avail_actions[:, :, 1] = np.arange(A) == 0
    episodes.action[:, :, 1] = 0
    batch = laid_out(episodes, None)
    got = step(before, batch)
    of_agents = gradients(got)["encoder"].agent
    assert (of_agents[1] == 0).all()
    assert (of_agents[[0, 2]] != 0).any(axis=1).all()

    def other_memory(encoder: Any) -> Any:
        return dataclasses.replace(encoder, agent=encoder.agent.at[1].add(1.0))

    policies, target = before.policies, before.target
    encoder = policies.encoder._replace(params=other_memory(policies.encoder.params))
    moved = before._replace(
        policies=policies._replace(encoder=encoder),
        target=target._replace(encoder=other_memory(target.encoder)),
    )
    assert_same_step(step(moved, batch), got)


def test_targets_are_copied_after_every_so_many_steps(
    step: Callable[..., Step], before: Any
) -> None:
    batch = laid_out(random_batch(), None)
    for number in range(5):
        after = step(before, batch, number).after
        online = (*after.policies[:2], *after.critics[:2])
        due = (number + 1) % TARGET_EVERY == 0
        expected = tuple(trained.params for trained in online) if due else tuple(before.target)
        for t, x in zip(*map(jax.tree.leaves, (tuple(after.target), expected)), strict=True):
            np.testing.assert_array_equal(t, x)


def test_all_teams_act_with_a_head_for_every_agent(before: Any, config: Config) -> None:
    teams = race.teams(before, SPEC, shape_of(config))
    encoder, heads = teams.encoder, teams.heads
    population = config.race.population_size
    assert heads.shape == (population + 1, N, H + 1, A)
    assert encoder is before.policies.encoder.params
    assert jnp.array_equal(heads[:-1], before.heads)
    for agent in range(N):
        assert jnp.array_equal(heads[-1, agent], before.policies.head.params[0])


def test_injection_gives_every_agent_of_the_worst_team_the_marl_head(
    before: Any, config: Config
) -> None:
    roles = before.population._replace(worst=jnp.int32(2), elite=jnp.int32(0))
    state = before._replace(population=roles)
    entrant = race.entrant(state, shape_of(config))
    entered = inject_team(roles, entrant, jax.random.key(0), hyper_of(config))
    after = state._replace(population=entered)
    assert int(after.population.injected) == 2
    for agent in range(N):
        assert jnp.array_equal(after.heads[2, agent], before.policies.head.params[0])
    kept = jnp.array([0, 1, 3])
    assert jnp.array_equal(after.heads[kept], before.heads[kept])


def test_evolution_moves_every_agents_every_action(
    before: Any, config: Config, compiled: Callable[..., Any]
) -> None:
    """No column of a head is padding, and biases stay those of the elite or the parent."""
    everything: dict[str, Any] = {
        "mutation_fraction": 1.0,
        "mutation_probability": 1.0,
        "agent_mutation_probability": 1.0,
    }
    config = dataclasses.replace(config, race=dataclasses.replace(config.race, **everything))
    fitness = jnp.array([0.0, 3.0, 1.0, 2.0])
    after = compiled(race, "evolve", SPEC, config)(before, fitness, jax.random.key(0))
    assert after.heads.shape == before.heads.shape
    assert jnp.array_equal(after.heads[1], before.heads[1])
    assert (int(after.population.elite), int(after.population.worst)) == (1, 0)
    others = jnp.array([0, 2, 3])
    assert (after.heads[others, :, :-1] != before.heads[others, :, :-1]).all()
    # The tournament is among all: the parent is team 3.
    parents = np.asarray(before.heads[jnp.array([1, 3]), :, -1])
    for team in (0, 2):
        for agent in range(N):
            bias = np.asarray(after.heads[team, agent, -1])
            assert any(np.array_equal(bias, p) for p in parents[:, agent])


def test_the_buffer_lays_minibatches_out_as_these_tests_do() -> None:
    batch, expected = random_batch(), laid_out(random_batch(), None)
    place, time = np.zeros((10, 2), np.int32), np.full((10, 2), -1, np.int32)
    for row, episodes in enumerate(PACKED):
        times = np.concatenate([np.arange(LENGTHS[e] + 1) for e in episodes])
        time[: len(times), row] = times
        place[: len(times), row] = np.repeat(episodes, [LENGTHS[e] + 1 for e in episodes])
    replay = Replay(jax.tree.map(jnp.asarray, batch), jnp.int32(len(LENGTHS)))
    got = slots_of(replay, Layout(jnp.asarray(place), jnp.asarray(time)))
    for name, column in expected.slots._asdict().items():
        there = np.asarray(expected.slots.real)
        assert getattr(got, name).dtype == column.dtype
        assert np.array_equal(np.asarray(getattr(got, name))[there], np.asarray(column)[there])
    assert np.array_equal(got.real, expected.slots.real)
    assert not np.asarray(got.acted | got.first)[~there].any()

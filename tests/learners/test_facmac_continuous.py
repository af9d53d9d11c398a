"""FACMAC's factored critic on continuous actions, against the same in float64."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from float64_factored import q_tot, q_tot_team

from race.config.settings import Config
from race.config.shape import shape_of
from race.learners import facmac_continuous as facmac
from race.networks.dense import embed_policy, head_vectors
from race.networks.factored import embedding_shifts, mix, utility_values
from race.types import EnvSpec

B = 6


def float64(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


def enlarged(network: Any) -> Any:
    """The network with larger weights, so that every non-linearity matters."""
    return jax.tree.map(lambda leaf: 2.0 * leaf, network)


@pytest.fixture(scope="module")
def config(tiny_config: Callable[..., Config]) -> Config:
    return tiny_config("race", "facmac")


@pytest.fixture(scope="module")
def critic(tiny_spec: EnvSpec, config: Config) -> Any:
    return enlarged(facmac.init_critic(jax.random.key(0), tiny_spec, shape_of(config)))


@pytest.fixture(scope="module")
def pevfa(tiny_spec: EnvSpec, config: Config) -> Any:
    return enlarged(facmac.init_pevfa(jax.random.key(1), tiny_spec, shape_of(config)))


@pytest.fixture(scope="module")
def head(tiny_spec: EnvSpec, config: Config) -> Any:
    return facmac.init_heads(jax.random.key(2), tiny_spec, shape_of(config))


@pytest.fixture(scope="module")
def inputs() -> tuple[jax.Array, jax.Array]:
    state_key, action_key = jax.random.split(jax.random.key(3))
    return (
        2.0 * jax.random.normal(state_key, (B, 4)),
        jax.random.uniform(action_key, (B, 3), minval=-1.0),
    )


def test_the_critic_mixes_the_agents_utilities(
    tiny_spec: EnvSpec, critic: Any, inputs: tuple[jax.Array, jax.Array]
) -> None:
    q = facmac.q_marl(critic, *inputs, tiny_spec)
    both = zip(*map(float64, inputs), strict=True)
    expected = [q_tot(float64(critic), tiny_spec, s, u) for s, u in both]
    assert q.shape == (1, B)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(q[0], expected, rtol=1e-4, atol=1e-5)


def test_the_pevfa_has_the_policy_embedding_as_further_inputs(
    tiny_spec: EnvSpec, pevfa: Any, head: Any, inputs: tuple[jax.Array, jax.Array]
) -> None:
    q = facmac.q_team(pevfa, *inputs, head, tiny_spec)
    e = float64(embed_policy(pevfa.embedding, head_vectors(head, tiny_spec)))
    both = list(zip(*map(float64, inputs), strict=True))
    expected = [q_tot_team(float64(pevfa), tiny_spec, s, u, e) for s, u in both]
    assert q.shape == (1, B)
    np.testing.assert_allclose(q[0], expected, rtol=1e-4, atol=1e-5)
    # Without it the values are others: both shifts count.
    blind = [q_tot(float64(pevfa.critic), tiny_spec, s, u) for s, u in both]
    assert not np.allclose(blind, expected, rtol=1e-3)


def test_utilities_may_take_the_embedding_of_their_agents_own_head(
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
    pevfa: Any,
    head: Any,
    inputs: tuple[jax.Array, jax.Array],
) -> None:
    """Agent 0 has one action, agent 1 two; padding has no part in either embedding."""
    shape = shape_of(tiny_config("race", "facmac", race={"utility_embedding": "agent"}))
    own = enlarged(facmac.init_pevfa(jax.random.key(1), tiny_spec, shape))
    assert own.of_agents
    assert not pevfa.of_agents
    spoiled = head.at[0, :, 1].set(9.0)
    q = facmac.q_team(own, *inputs, spoiled, tiny_spec)
    columns = ([head[0, :, 0]], [head[1, :, 0], head[1, :, 1]])
    each = [float64(embed_policy(pevfa.embedding, jnp.stack(of))) for of in columns]
    e = float64(embed_policy(pevfa.embedding, head_vectors(head, tiny_spec)))
    both = list(zip(*map(float64, inputs), strict=True))
    expected = [q_tot_team(float64(pevfa), tiny_spec, s, u, e, each) for s, u in both]
    np.testing.assert_allclose(q[0], expected, rtol=1e-4, atol=1e-5)
    of_team = facmac.q_team(pevfa, *inputs, head, tiny_spec)
    assert not np.allclose(of_team[0], expected, rtol=1e-3)


@pytest.mark.parametrize("part", ["utility_weight", "mixer_weight"])
def test_the_embedding_goes_into_utilities_and_into_hypernetworks(
    tiny_spec: EnvSpec, pevfa: Any, head: Any, inputs: tuple[jax.Array, jax.Array], part: str
) -> None:
    fields = {
        name: getattr(pevfa, name)
        for name in ("critic", "embedding", "utility_weight", "mixer_weight")
    }
    without = type(pevfa)(**{**fields, part: jnp.zeros_like(fields[part])})
    q = facmac.q_team(pevfa, *inputs, head, tiny_spec)
    assert not np.allclose(facmac.q_team(without, *inputs, head, tiny_spec), q, rtol=1e-3)


def test_the_pevfa_tells_teams_apart_but_not_their_padding(
    tiny_spec: EnvSpec, pevfa: Any, head: Any, inputs: tuple[jax.Array, jax.Array]
) -> None:
    q = facmac.q_team(pevfa, *inputs, head, tiny_spec)
    spoiled = head.at[0, :, 1].set(9.0)
    assert jnp.array_equal(facmac.q_team(pevfa, *inputs, spoiled, tiny_spec), q)
    for place in [(0, 0, 0), (0, 4, 0), (1, 0, 1), (1, 4, 0)]:
        other = facmac.q_team(pevfa, *inputs, head.at[place].add(10.0), tiny_spec)
        assert not np.allclose(other, q, rtol=1e-4)


@pytest.mark.parametrize("of_team", [False, True])
@pytest.mark.parametrize("agent", [0, 1])
def test_q_tot_rises_with_every_utility(
    tiny_spec: EnvSpec, pevfa: Any, head: Any, of_team: bool, agent: int
) -> None:
    n = 200
    state_key, value_key, rise_key = jax.random.split(jax.random.key(4), 3)
    state = 3.0 * jax.random.normal(state_key, (n, 4))
    utilities = 5.0 * jax.random.normal(value_key, (n, 2))
    rise = jax.random.uniform(rise_key, (n,), minval=0.01, maxval=3.0)
    vectors, owner = head_vectors(head, tiny_spec), np.array([1, 0, 1])
    shift = embedding_shifts(pevfa, vectors, owner)[1] if of_team else None
    before = mix(pevfa.critic.mixer, state, utilities, shift)
    after = mix(pevfa.critic.mixer, state, utilities.at[:, agent].add(rise), shift)
    assert (after >= before).all()
    assert (after > before).mean() > 0.9
    # The state, on the other hand, moves the value either way.
    moved = mix(pevfa.critic.mixer, state + 1.0, utilities, shift)
    assert 0.1 < (moved > before).mean() < 0.9


def test_an_agents_utility_is_of_what_it_sees_and_does(
    tiny_spec: EnvSpec, critic: Any, inputs: tuple[jax.Array, jax.Array]
) -> None:
    """Without its own action's part of the mixture, nothing an agent does counts."""
    state, action = inputs

    def values(state: jax.Array, action: jax.Array) -> np.ndarray:
        return np.asarray(facmac.q_marl(critic, state, action, tiny_spec)[0])

    q = values(state, action)
    for entry in range(3):
        assert not np.allclose(values(state, action.at[:, entry].add(-0.5)), q, rtol=1e-4)
    # Agent 1 owns entries 2 and 0, agent 0 entry 1: a mixer deaf to an agent is deaf to its own.
    mixer = critic.mixer
    size = mixer.bias_out.weight.shape[0]
    for agent, entries in enumerate(tiny_spec.action_index):
        columns = slice(agent * size, (agent + 1) * size)
        weights_in = type(mixer.weights_in)(
            mixer.weights_in.weight.at[:, columns].set(0.0),
            mixer.weights_in.bias.at[columns].set(0.0),
        )
        deaf_mixer = type(mixer)(mixer.first, weights_in, mixer.weights_out, mixer.bias_out)
        deaf = type(critic)(critic.utilities, deaf_mixer)
        base = facmac.q_marl(deaf, state, action, tiny_spec)
        for entry in range(3):
            other = facmac.q_marl(deaf, state, action.at[:, entry].add(-0.5), tiny_spec)
            assert np.array_equal(base, other) == (entry in entries)


def test_padding_changes_nothing(
    tiny_spec: EnvSpec, critic: Any, inputs: tuple[jax.Array, jax.Array]
) -> None:
    # Agent 1 has no third observation entry, agent 0 no second action entry.
    first = critic.utilities.first
    weight = first.weight.at[1, 2].set(1e3).at[0, 4].set(1e3)
    spoiled = dataclasses.replace(critic.utilities, first=type(first)(weight, first.bias))
    q = facmac.q_marl(critic, *inputs, tiny_spec)
    assert jnp.array_equal(
        facmac.q_marl(type(critic)(spoiled, critic.mixer), *inputs, tiny_spec), q
    )


def test_initial_ranges_and_no_two_agents_alike(tiny_config: Callable[..., Config]) -> None:
    spec = EnvSpec(
        "wide", 100, (tuple(range(100)), (0, 1, 2, 3)), ((0,), (1, 2)), (-1.0,) * 3, (1.0,) * 3, 5
    )
    config = tiny_config(
        "race", "facmac", {"hidden_sizes": (300, 200)}, {"policy_embedding_size": 40}
    )
    fresh = facmac.init_critic(jax.random.key(0), spec, shape_of(config))
    extended = facmac.init_pevfa(jax.random.key(1), spec, shape_of(config))
    for further, critic in ((0, fresh), (40, extended.critic)):
        first = critic.utilities.first
        # The range follows from an agent's own entries, not from the padded ones.
        for agent, (obs, action) in enumerate(((100, 1), (4, 2))):
            bound = 1 / np.sqrt(obs + action + further)
            rows = np.concatenate([first.weight[agent, :obs], first.weight[agent, 100:][:action]])
            assert 0.97 * bound < np.abs(rows).max() <= bound
            assert np.abs(first.bias[agent]).max() <= bound
        assert not np.isclose(first.weight[0], first.weight[1]).any(axis=1).all()
        bound = 1 / np.sqrt(100 + further)
        assert 0.97 * bound < np.abs(critic.mixer.first.weight).max() <= bound
    assert extended.utility_weight.shape == (2, 40, 300)
    assert extended.mixer_weight.shape == (40, extended.critic.mixer.first.weight.shape[1])


def test_utilities_shift_is_a_bias(critic: Any) -> None:
    net = critic.utilities
    inputs = jax.random.normal(jax.random.key(5), (2, B, 5))
    shift = jax.random.normal(jax.random.key(6), (2, 5))
    first = type(net.first)(net.first.weight, net.first.bias + shift)
    shifted = dataclasses.replace(net, first=first)
    np.testing.assert_allclose(
        utility_values(net, inputs, shift), utility_values(shifted, inputs), rtol=1e-5, atol=1e-6
    )

"""Encoders, heads, policy embedding and MINE against explicit loops in float64."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from float64_factored import normal

from race.networks.dense import (
    act,
    act_teams,
    embed_policy,
    encode,
    head_vectors,
    init_encoder,
    init_head,
    init_mine,
    init_policy_embedding,
    mine_scores,
    normalise,
)
from race.types import EnvSpec

B, H = 3, 4


def leaky(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 0.01 * x)


def float64(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


@pytest.fixture(scope="module", params=[True, False], ids=["normalised", "plain"])
def encoder(request: Any, tiny_spec: EnvSpec) -> Any:
    return init_encoder(jax.random.key(0), tiny_spec, (5, H), request.param)


@pytest.fixture(scope="module")
def head(tiny_spec: EnvSpec) -> Any:
    return init_head(jax.random.key(1), tiny_spec, H)


@pytest.fixture(scope="module")
def state() -> jax.Array:
    return jax.random.normal(jax.random.key(2), (B, 4))


def test_normalised_layers_have_mean_0_and_variance_1_whatever_their_scale() -> None:
    x = jax.random.normal(jax.random.key(3), (2, B, 50)) * jnp.array([1e-1, 1e3])[:, None, None]
    for shifted in (x, x + 7.0):
        y = np.asarray(jax.jit(normalise)(shifted), np.float64)
        np.testing.assert_allclose(y.mean(axis=-1), 0.0, atol=1e-3)
        np.testing.assert_allclose(y.var(axis=-1), 1.0, rtol=2e-3)


def test_normalisation_of_equal_entries_is_finite_and_so_is_its_gradient() -> None:
    value, slope = jax.value_and_grad(lambda x: jnp.sum(jnp.square(normalise(x))))(jnp.ones(5))
    assert value == 0
    assert jnp.isfinite(slope).all()


def test_encoders_see_their_own_observation(
    tiny_spec: EnvSpec, encoder: Any, state: jax.Array
) -> None:
    z = encode(encoder, tiny_spec, state)
    weights, s = float64(encoder), float64(state)
    for agent, entries in enumerate(tiny_spec.obs_index):
        for b in range(B):
            obs = s[b, list(entries)]
            w = weights.hidden.weight[agent][: len(obs)]
            x = np.tanh(normal(weights, obs @ w + weights.hidden.bias[agent]))
            x = x @ weights.out.weight[agent] + weights.out.bias[agent]
            x = np.tanh(normal(weights, x))
            np.testing.assert_allclose(z[agent, b], x, rtol=1e-5, atol=1e-6)


def test_actions_are_joined_in_the_environments_order(
    tiny_spec: EnvSpec, head: Any, state: jax.Array, encoder: Any
) -> None:
    z = encode(encoder, tiny_spec, state)
    action = act(z, head, tiny_spec)
    w, z64 = float64(head), float64(z)
    for b in range(B):
        for agent, entries in enumerate(tiny_spec.action_index):
            for place, entry in enumerate(entries):
                expected = np.tanh(z64[agent, b] @ w[agent, :-1, place] + w[agent, -1, place])
                np.testing.assert_allclose(action[b, entry], expected, rtol=1e-5, atol=1e-6)


def test_teams_act_as_each_alone(tiny_spec: EnvSpec) -> None:
    heads = jnp.stack([init_head(key, tiny_spec, H) for key in jax.random.split(jax.random.key(3))])
    z = jax.random.normal(jax.random.key(4), (2, 2, H))  # [N, T, H]
    together = act_teams(z, heads, tiny_spec)
    for team in range(2):
        alone = act(z[:, team : team + 1], heads[team], tiny_spec)[0]
        np.testing.assert_allclose(together[team], alone, rtol=1e-5, atol=1e-6)


def test_padding_changes_nothing(
    tiny_spec: EnvSpec, encoder: Any, head: Any, state: jax.Array
) -> None:
    # Agent 1 has no third observation entry, agent 0 no second action entry.
    junk = encoder.hidden.weight.at[1, 2].set(1e3)
    hidden = type(encoder.hidden)(junk, encoder.hidden.bias)
    spoiled = dataclasses.replace(encoder, hidden=hidden)
    z = encode(encoder, tiny_spec, state)
    assert jnp.array_equal(encode(spoiled, tiny_spec, state), z)
    spoiled_head = head.at[0, :, 1].set(1e3)
    assert jnp.array_equal(act(z, spoiled_head, tiny_spec), act(z, head, tiny_spec))
    assert jnp.array_equal(head_vectors(spoiled_head, tiny_spec), head_vectors(head, tiny_spec))
    # And what is not padding does count.
    assert not jnp.array_equal(
        act(z, head.at[0, 0, 0].add(1.0), tiny_spec), act(z, head, tiny_spec)
    )


def test_fresh_heads_are_zero_in_padding_only(tiny_spec: EnvSpec, head: Any) -> None:
    assert head.shape == (2, H + 1, 2)
    assert (head[0, :, 1] == 0).all()
    assert (head[0, :, 0] != 0).all()
    assert (head[1] != 0).all()


def test_initial_ranges_and_no_two_agents_alike() -> None:
    spec = EnvSpec(
        "wide", 100, (tuple(range(100)), (0, 1, 2, 3)), ((0,), (1,)), (-1.0,) * 2, (1.0,) * 2, 5
    )
    fresh = init_encoder(jax.random.key(0), spec, (300, 200), False)
    # The range follows from an agent's own observation entries, not from the padded ones.
    for agent, fan_in in enumerate((100, 4)):
        rows = np.asarray(fresh.hidden.weight[agent, :fan_in])
        bound = 1 / np.sqrt(fan_in)
        assert 0.97 * bound < np.abs(rows).max() <= bound
        np.testing.assert_allclose(rows.std(), bound / np.sqrt(3), rtol=0.05)
        assert np.abs(fresh.hidden.bias[agent]).max() <= bound
    assert 0.97 / np.sqrt(300) < np.abs(fresh.out.weight).max() <= 1 / np.sqrt(300)
    assert not np.isclose(fresh.out.weight[0], fresh.out.weight[1]).any(axis=1).all()
    team = init_head(jax.random.key(0), spec, 200)
    assert 0.97 / np.sqrt(200) < np.abs(team).max() <= 1 / np.sqrt(200)


def test_head_vectors_are_the_columns_of_each_action(tiny_spec: EnvSpec, head: Any) -> None:
    vectors = head_vectors(head, tiny_spec)
    for agent, entries in enumerate(tiny_spec.action_index):
        for place, entry in enumerate(entries):
            assert jnp.array_equal(vectors[entry], head[agent, :, place])


def test_policy_embedding_averages_over_actions(tiny_spec: EnvSpec, head: Any) -> None:
    embedding = init_policy_embedding(jax.random.key(5), H + 1, 6)
    vectors = head_vectors(head, tiny_spec)
    rows = []
    for vector in float64(vectors):
        first, second, out = float64(embedding).layers
        x = leaky(leaky(vector @ first.weight + first.bias) @ second.weight + second.bias)
        rows.append(x @ out.weight + out.bias)
    e = embed_policy(embedding, vectors)
    np.testing.assert_allclose(e, np.mean(rows, axis=0), rtol=1e-5, atol=1e-6)
    # A mean: the order of actions and their multiplicity do not count, each action does.
    np.testing.assert_allclose(embed_policy(embedding, vectors[::-1]), e, atol=1e-6)
    np.testing.assert_allclose(
        embed_policy(embedding, jnp.concatenate([vectors, vectors])), e, atol=1e-6
    )
    assert not np.allclose(embed_policy(embedding, vectors.at[2, 0].add(1.0)), e)


@pytest.mark.parametrize("layers", [1, 2])
def test_mine_scores_every_pair(tiny_spec: EnvSpec, state: jax.Array, layers: int) -> None:
    mine = init_mine(jax.random.key(6), tiny_spec, H, 6, layers, tiny_spec.n_agents)
    z = jax.random.normal(jax.random.key(7), (2, B, H))
    scores = mine_scores(mine, state, z)
    w, s, z64 = float64(mine), float64(state), float64(z)
    for agent in range(2):
        for t in range(B):
            x = leaky(s[t] @ w.state_hidden.weight[agent] + w.state_hidden.bias[agent])
            x = leaky(x @ w.state_out.weight[agent] + w.state_out.bias[agent])
            for k in range(B):
                y = z64[agent, k] @ w.embedding.weight[agent] + w.embedding.bias[agent]
                if layers == 2:
                    out = w.embedding_out
                    y = leaky(y) @ out.weight[agent] + out.bias[agent]
                np.testing.assert_allclose(scores[agent, t, k], x @ y, rtol=1e-4, atol=1e-6)


def test_a_second_layer_in_mine_leaves_the_others_as_they_are(tiny_spec: EnvSpec) -> None:
    """And without one there is no leaf more in a checkpoint."""
    one, two = (
        init_mine(jax.random.key(6), tiny_spec, H, 6, layers, tiny_spec.n_agents)
        for layers in (1, 2)
    )
    assert one.embedding_out is None
    assert two.embedding_out.weight.shape == (tiny_spec.n_agents, 6, 6)
    without = dataclasses.replace(two, embedding_out=None)
    assert jax.tree.structure(without) == jax.tree.structure(one)
    for a, b in zip(*map(jax.tree.leaves, (without, one)), strict=True):
        assert jnp.array_equal(a, b)
    weights = [two.state_out.weight[0], *two.embedding_out.weight]
    for i, a in enumerate(weights):  # no layer is a copy of another
        assert not any(np.isclose(a, b).any(axis=1).all() for b in weights[:i])

"""Critics against explicit loops in float64."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from float64_factored import normal

from race.networks.critics import (
    first_critic,
    first_pevfa,
    init_critic,
    init_pevfa,
    init_state_value,
    pevfa_values,
    q_values,
    state_values,
)
from race.networks.dense import embed_policy, head_vectors, init_head
from race.types import EnvSpec

B, H, E = 3, 4, 3


def leaky(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 0.01 * x)


def float64(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


def relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0.0)


def mlp(
    x: np.ndarray,
    layers: list[tuple[np.ndarray, np.ndarray]],
    activation: Callable[[np.ndarray], np.ndarray] = leaky,
    network: Any = None,
) -> float:
    for place, (weight, bias) in enumerate(layers):
        x = x @ weight + bias
        if place < len(layers) - 1:
            x = activation(x if network is None else normal(network, x))
    (value,) = x
    return float(value)


@pytest.fixture(scope="module")
def inputs() -> tuple[jax.Array, jax.Array]:
    state_key, action_key = jax.random.split(jax.random.key(0))
    return jax.random.normal(state_key, (B, 4)), jax.random.normal(action_key, (B, 3))


@pytest.mark.parametrize("layer_norm", [True, False], ids=["normalised", "plain"])
@pytest.mark.parametrize("count", [1, 2])
def test_each_critic_of_the_ensemble(
    tiny_spec: EnvSpec, inputs: tuple[jax.Array, jax.Array], count: int, layer_norm: bool
) -> None:
    critic = init_critic(jax.random.key(1), tiny_spec, (5, H), count, layer_norm)
    q = q_values(critic, *inputs)
    assert q.shape == (count, B)
    w = float64(critic)
    for k in range(count):
        layers = [(x.weight[k], x.bias[k]) for x in (w.first, w.hidden, w.out)]
        for b in range(B):
            su = np.concatenate([float64(inputs[0][b]), float64(inputs[1][b])])
            expected = mlp(su, layers, network=critic)
            np.testing.assert_allclose(q[k, b], expected, rtol=1e-5, atol=1e-6)
    assert jnp.array_equal(q_values(first_critic(critic), *inputs), q[:1])
    if count == 2:
        assert not np.allclose(q[0], q[1])


@pytest.mark.parametrize("layer_norm", [True, False], ids=["normalised", "plain"])
def test_pevfa_is_a_critic_of_state_action_and_embedding(
    tiny_spec: EnvSpec, inputs: tuple[jax.Array, jax.Array], layer_norm: bool
) -> None:
    pevfa = init_pevfa(jax.random.key(2), tiny_spec, (5, H), 2, layer_norm, E)
    head = init_head(jax.random.key(3), tiny_spec, H)
    q = pevfa_values(pevfa, tiny_spec, *inputs, head)
    w = float64(pevfa)
    e = float64(embed_policy(pevfa.embedding, head_vectors(head, tiny_spec)))
    for k in range(2):
        # The embedding's rows of the first layer, below those of state and action.
        first = np.concatenate([w.critic.first.weight[k], w.embedding_weight[k]])
        layers = [
            (first, w.critic.first.bias[k]),
            *((x.weight[k], x.bias[k]) for x in (w.critic.hidden, w.critic.out)),
        ]
        for b in range(B):
            sue = np.concatenate([float64(inputs[0][b]), float64(inputs[1][b]), e])
            expected = mlp(sue, layers, network=pevfa.critic)
            np.testing.assert_allclose(q[k, b], expected, rtol=1e-5, atol=1e-6)
    assert jnp.array_equal(pevfa_values(first_pevfa(pevfa), tiny_spec, *inputs, head), q[:1])


def test_pevfa_tells_teams_apart_but_not_their_padding(
    tiny_spec: EnvSpec, inputs: tuple[jax.Array, jax.Array]
) -> None:
    pevfa = init_pevfa(jax.random.key(2), tiny_spec, (5, H), 2, False, E)
    head = init_head(jax.random.key(3), tiny_spec, H)
    q = pevfa_values(pevfa, tiny_spec, *inputs, head)
    assert jnp.array_equal(pevfa_values(pevfa, tiny_spec, *inputs, head.at[0, :, 1].set(9.0)), q)
    # Weights and biases of every agent count.
    for place in [(0, 0, 0), (0, H, 0), (1, 0, 1), (1, H, 0)]:
        other = pevfa_values(pevfa, tiny_spec, *inputs, head.at[place].add(1.0))
        assert not np.allclose(other, q)


def test_first_layers_range_counts_the_embedding(tiny_spec: EnvSpec) -> None:
    pevfa = init_pevfa(jax.random.key(4), tiny_spec, (200, H), 2, False, 93)
    bound = 1 / np.sqrt(4 + 3 + 93)
    for weight in (pevfa.critic.first.weight, pevfa.embedding_weight):
        assert 0.97 * bound < np.abs(weight).max() <= bound


@pytest.mark.parametrize("sizes", [(5, H), (6,)])
@pytest.mark.parametrize("activation", [leaky, relu], ids=["leaky", "relu"])
def test_state_values(
    inputs: tuple[jax.Array, jax.Array],
    sizes: tuple[int, ...],
    activation: Callable[[np.ndarray], np.ndarray],
) -> None:
    network = init_state_value(jax.random.key(5), 4, sizes)
    assert len(network.layers) == len(sizes) + 1
    layers = [(x.weight, x.bias) for x in float64(network).layers]
    expected = [mlp(float64(inputs[0][b]), layers, activation) for b in range(B)]
    other = [mlp(float64(inputs[0][b]), layers, relu) for b in range(B)]
    if activation is leaky:
        # Leaky is what state values are without a word.
        v = state_values(network, inputs[0])
        assert not np.allclose(expected, other, rtol=1e-4)
    else:
        v = state_values(network, inputs[0], jax.nn.relu)
    np.testing.assert_allclose(v, expected, rtol=1e-5, atol=1e-6)

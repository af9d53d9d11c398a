"""The recurrent encoder against float64 step by step; the GRU's own backward pass."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from float64_episodes import float64, gru_moment, sigmoid

from race.networks import recurrent
from race.networks.gru import Gates, gru, gru_step
from race.networks.recurrent import (
    GruEncoder,
    embed_step,
    gate_inputs,
    init_gru_encoder,
    no_memory,
)

L, B, N, OBS, A, H = 5, 2, 3, 4, 6, 5
ROWS = 3


@pytest.fixture(scope="module", params=[True, False], ids=["normalised", "plain"])
def encoder(request: Any) -> GruEncoder:
    """With larger weights than fresh ones, so that gates open and close."""
    fresh = init_gru_encoder(jax.random.key(0), OBS, A, N, H, request.param)
    larger: GruEncoder = jax.tree.map(lambda x: 3.0 * x, fresh)
    return larger


@pytest.fixture(scope="module")
def seen() -> tuple[jax.Array, jax.Array]:
    """Observations [L, B, N, O] and the actions before them, -1 at first."""
    obs_key, action_key = jax.random.split(jax.random.key(1))
    obs = jax.random.normal(obs_key, (L, B, N, OBS))
    last = jax.random.randint(action_key, (L, B, N), 0, A)
    return obs, last.at[0].set(-1)


def embed_episodes(encoder: GruEncoder, obs: jax.Array, last: jax.Array) -> jax.Array:
    """Each row is one episode."""
    first = jnp.zeros(obs.shape[:2], bool).at[0].set(True)
    return recurrent.embed_episodes(encoder, obs, last, first)


def step_by_step(encoder: Any, obs: Any, last: Any) -> np.ndarray:
    """The second version: [L, B, N, H] in float64."""
    weights, obs, last = float64(encoder), np.asarray(obs, np.float64), np.asarray(last)
    episodes = []
    for b in range(obs.shape[1]):
        h, moments = np.zeros((obs.shape[2], H)), []
        for t in range(obs.shape[0]):
            h = gru_moment(weights, h, obs[t, b], last[t, b])
            moments.append(h)
        episodes.append(moments)
    return np.swapaxes(np.array(episodes), 0, 1)


def assert_close(got: Any, expected: Any) -> None:
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


# --- embeddings ---------------------------------------------------------------------------------


def test_whole_episodes_are_embedded_as_in_float64(
    encoder: GruEncoder, seen: tuple[jax.Array, jax.Array]
) -> None:
    z = embed_episodes(encoder, *seen)
    expected = step_by_step(encoder, *seen)
    assert z.shape == (L, B, N, H)
    assert_close(z, expected)
    # The weights are such that the test means something: no gate is always open or shut.
    assert 0.2 < np.abs(expected).mean() < 0.9


def test_moment_by_moment_is_the_same(
    encoder: GruEncoder, seen: tuple[jax.Array, jax.Array]
) -> None:
    carry = no_memory(encoder, B, N)
    assert carry.shape == (B, N, H)
    assert (carry == 0).all()
    whole = embed_episodes(encoder, *seen)
    for t, (obs, last) in enumerate(zip(*seen, strict=True)):
        carry = embed_step(encoder, carry, obs, last)
        np.testing.assert_allclose(carry, whole[t], rtol=1e-5, atol=1e-6)


def test_a_step_is_that_of_pytorchs_documentation() -> None:
    """``torch.nn.GRUCell``: rows r, z, n of ``W_ih`` [3 H, H] and ``W_hh``, two biases::

    r = sigmoid(W_ir x + b_ir + W_hr h + b_hr)
    z = sigmoid(W_iz x + b_iz + W_hz h + b_hz)
    n = tanh(W_in x + b_in + r * (W_hn h + b_hn))
    h' = (1 - z) * n + z * h
    """
    rng = np.random.default_rng(0)
    w_ih, w_hh = rng.normal(size=(2, 3 * H, H))
    b_ih, b_hh = rng.normal(size=(2, 3 * H))
    x, h = rng.normal(size=(2, H))
    i_r, i_z, i_n = np.split(w_ih @ x + b_ih, 3)
    h_r, h_z, h_n = np.split(w_hh @ h + b_hh, 3)
    r, z = sigmoid(i_r + h_r), sigmoid(i_z + h_z)
    n = np.tanh(i_n + r * h_n)
    expected = (1 - z) * n + z * h

    def gates(parts: Any) -> Gates:
        return Gates(*(jnp.asarray(part, jnp.float32) for part in parts))

    weight = gates(part.T for part in np.split(w_hh, 3))
    inputs = gates((i_r[None], i_z[None], i_n[None]))
    got = gru_step(weight, gates(np.split(b_hh, 3)), jnp.asarray(h[None], jnp.float32), inputs)
    assert_close(got[0], expected)


def test_agents_have_memories_of_their_own_and_differ_by_number(
    encoder: GruEncoder, seen: tuple[jax.Array, jax.Array]
) -> None:
    obs, last = seen
    usual = embed_episodes(encoder, obs, last)
    moved = embed_episodes(encoder, obs.at[1, 0, 2].add(1.0), last)
    changed = (moved != usual).any(axis=-1)
    expected = np.zeros((L, B, N), bool)
    expected[1:, 0, 2] = True
    assert np.array_equal(changed, expected)
    # Agents who see and do the same are told apart by their number alone.
    alike = jnp.broadcast_to(obs[:, :, :1], obs.shape), jnp.broadcast_to(last[:, :, :1], last.shape)
    z = embed_episodes(encoder, *alike)
    assert (jnp.abs(z[:, :, 0] - z[:, :, 1]).max(axis=-1) > 1e-3).all()
    nameless = dataclasses.replace(encoder, agent=jnp.zeros_like(encoder.agent))
    z = embed_episodes(nameless, *alike)
    assert jnp.array_equal(z[:, :, 0], z[:, :, 1])
    assert jnp.array_equal(z[:, :, 0], z[:, :, 2])
    # Agents who change places change embeddings, and nothing else.
    order = jnp.array([2, 0, 1])
    turned = dataclasses.replace(encoder, agent=encoder.agent[order])
    z = embed_episodes(turned, obs[:, :, order], last[:, :, order])
    np.testing.assert_allclose(z, usual[:, :, order], rtol=1e-5, atol=1e-6)


def test_each_last_action_adds_its_row_and_none_adds_nothing(encoder: GruEncoder) -> None:
    """Where the first layer passes everything on, inputs of gates are linear in its rows."""
    linear = dataclasses.replace(encoder, agent=jnp.full((N, H), 100.0), layer_norm=False)
    obs = jnp.zeros((N, OBS))

    def inputs(last: int) -> np.ndarray:
        gates = gate_inputs(linear, obs, jnp.full((N,), last, jnp.int32))
        return np.concatenate(gates, axis=-1)

    without = inputs(-1)
    into = float64(encoder.into)
    x = float64(encoder.obs.bias) + 100.0
    np.testing.assert_allclose(without, np.tile(x @ into.weight + into.bias, (N, 1)), rtol=1e-4)
    for action in range(A):
        row = float64(encoder.last_action[action]) @ into.weight
        np.testing.assert_allclose(inputs(action) - without, np.tile(row, (N, 1)), atol=2e-3)


@pytest.mark.parametrize("end", [1, 3])
def test_what_comes_later_changes_nothing_before(
    encoder: GruEncoder, seen: tuple[jax.Array, jax.Array], end: int
) -> None:
    obs, last = seen
    usual = embed_episodes(encoder, obs, last)
    junk = embed_episodes(encoder, obs.at[end:].set(jnp.nan), last.at[end:].set(0))
    assert jnp.array_equal(junk[:end], usual[:end])
    assert jnp.isnan(junk[end:]).all()
    longer = embed_episodes(
        encoder, jnp.concatenate([obs, 9.0 * obs]), jnp.concatenate([last, last])
    )
    np.testing.assert_allclose(longer[:L], usual, rtol=1e-6)


def test_episodes_that_lie_end_to_end_do_not_remember_each_other(
    encoder: GruEncoder, seen: tuple[jax.Array, jax.Array]
) -> None:
    """Both episodes in one row, the second begun anew, are as they are side by side."""
    obs, last = (jnp.concatenate([x[:, :1], x[:, 1:]]) for x in seen)
    first = jnp.zeros((2 * L, 1), bool).at[jnp.array([0, L])].set(True)
    z = recurrent.embed_episodes(encoder, obs, last, first)
    apart = embed_episodes(encoder, *seen)
    np.testing.assert_allclose(z[:L, 0], apart[:, 0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(z[L:, 0], apart[:, 1], rtol=1e-5, atol=1e-6)


def test_initial_ranges() -> None:
    """All inputs of the first layer count: what is seen, the last action, and the number."""
    fresh = init_gru_encoder(jax.random.key(2), 20, 9, 7, 64, False)
    for weights, inputs in (
        (fresh.obs.weight, 36),
        (fresh.obs.bias, 36),
        (fresh.last_action, 36),
        (fresh.agent, 36),
        (fresh.into.weight, 64),
        (fresh.recurrent.weight, 64),
        (fresh.recurrent.bias, 64),
    ):
        bound = 1 / np.sqrt(inputs)
        assert 0.9 * bound < np.abs(weights).max() <= bound
    assert fresh.into.weight.shape == fresh.recurrent.weight.shape == (64, 192)


# --- the backward pass --------------------------------------------------------------------------


KEEP = jnp.ones((L, ROWS)).at[0].set(0.0).at[2, 1].set(0.0).at[3, 2].set(0.0).at[4, 2].set(0.0)
"""Row 0 is one sequence; the others are cut into two and three."""


def scanned(weight: Gates, bias: Gates, inputs: Gates) -> jax.Array:
    """The same recurrence, differentiated automatically."""

    def step(carry: jax.Array, now: tuple[Gates, jax.Array]) -> tuple[jax.Array, jax.Array]:
        begun = jnp.where(now[1][:, None] > 0, carry, 0.0)
        after = gru_step(weight, bias, begun, now[0])
        return after, after

    return jax.lax.scan(step, jnp.zeros((ROWS, H)), (inputs, KEEP))[1]


def packed(weight: Gates, bias: Gates, inputs: Gates) -> jax.Array:
    """The package's own, with the same beginnings."""
    return gru(weight, bias, inputs, KEEP)


@pytest.fixture(scope="module")
def arguments() -> tuple[Gates, Gates, Gates]:
    keys = iter(jax.random.split(jax.random.key(3), 9))

    def gates(*shape: int) -> Gates:
        return Gates(*(jax.random.normal(next(keys), shape) for _ in range(3)))

    return gates(H, H), gates(H), gates(L, ROWS, H)


@pytest.mark.parametrize("moment", [None, 0, 2, L - 1])
def test_gradients_of_all_inputs_are_those_of_a_plain_scan(
    arguments: tuple[Gates, Gates, Gates], moment: int | None
) -> None:
    """Of a random sum of all states, and of those of one moment alone."""
    states, pull = jax.vjp(packed, *arguments)
    expected_states, expected_pull = jax.vjp(scanned, *arguments)
    np.testing.assert_allclose(states, expected_states, rtol=1e-5, atol=1e-6)
    cotangent = jax.random.normal(jax.random.key(4), states.shape)
    if moment is not None:
        cotangent = jnp.where((jnp.arange(L) == moment)[:, None, None], cotangent, 0.0)
    got, expected = pull(cotangent), expected_pull(cotangent)
    for g, e in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert np.abs(e).max() > 1e-3 or moment == 0
        np.testing.assert_allclose(g, e, rtol=2e-4, atol=2e-6)
    if moment is not None:
        for part in got[2]:
            assert (part[moment + 1 :] == 0).all()
            assert (part[moment] != 0).all()
            # Nothing flows back beyond the beginning of a sequence.
            begun = np.cumsum(np.asarray(KEEP) == 0, axis=0)
            others = begun[: moment + 1] != begun[moment]
            assert (np.asarray(part[: moment + 1])[others] == 0).all()


def test_gradients_are_finite_differences(arguments: tuple[Gates, Gates, Gates]) -> None:
    """Along random directions, of states worked out in float64."""
    weight, bias, inputs = float64(arguments)
    mix = np.random.default_rng(1).normal(size=(L, ROWS, H))

    def total(weight: Gates, bias: Gates, inputs: Gates) -> float:
        h, states = np.zeros((ROWS, H)), []
        for t in range(L):
            h = np.where(np.asarray(KEEP)[t, :, None] > 0, h, 0.0)
            own = [h @ w + b for w, b in zip(weight, bias, strict=True)]
            r, u = sigmoid(inputs.reset[t] + own[0]), sigmoid(inputs.update[t] + own[1])
            h = (1 - u) * np.tanh(inputs.candidate[t] + r * own[2]) + u * h
            states.append(h)
        return float((mix * np.stack(states)).sum())

    def objective(*args: Gates) -> jax.Array:
        return jnp.sum(jnp.asarray(mix, jnp.float32) * packed(*args))

    got = float64(jax.grad(objective, argnums=(0, 1, 2))(*arguments))
    for which, name in ((w, n) for w in range(3) for n in Gates._fields):
        args = [weight, bias, inputs]
        leaf = getattr(args[which], name)
        direction = np.random.default_rng(which).normal(size=leaf.shape)

        def moved(
            by: float, args: Any = args, which: int = which, name: str = name, d: Any = direction
        ) -> float:
            at = list(args)
            at[which] = at[which]._replace(**{name: getattr(at[which], name) + by * d})
            return total(*at)

        slope = (moved(1e-5) - moved(-1e-5)) / 2e-5
        expected = float((getattr(got[which], name) * direction).sum())
        assert abs(slope) > 1e-2
        np.testing.assert_allclose(expected, slope, rtol=1e-4, atol=1e-4)

"""FACMAC's functions on whole episodes: time and masks, heads, values, signals, targets."""

import dataclasses
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from float64_episodes import (
    One,
    best_actions,
    embeddings,
    episodes_of,
    float64,
    lambda_targets,
    q_tot,
    scores_of,
    signals,
    signals_across,
    v_zeta,
)
from tiny_episodes import (
    GROUP,
    LENGTHS,
    SPEC,
    A,
    E,
    H,
    Laid,
    N,
    S,
    groups_of,
    laid_out,
    random_batch,
    tiny_facmac,
)

from race.algorithms.base import Teams
from race.config.hyper import hyper_of
from race.config.settings import Config
from race.config.shape import Shape, shape_of
from race.learners import facmac
from race.learners.facmac import Moments, logits
from race.networks.factored import embedding_shifts, mix
from race.rollouts.choosing import blank, choose
from race.types import Episode, Observation

SIZE, ROWS = 10, 2
B = (SIZE - 1) * ROWS
KEY = jax.random.key(4)


@pytest.fixture(scope="module", params=[True, False], ids=["normalised", "plain"])
def config(request: Any, tiny_config: Callable[..., Config]) -> Config:
    return tiny_facmac(tiny_config, layer_norm=request.param)


class Networks:
    """Fresh networks, with larger weights so that every non-linearity matters."""

    def __init__(self, config: Config) -> None:
        shape = shape_of(config)

        def fresh(init: Callable[..., Any], seed: int, shape: Shape = shape) -> Any:
            network = jax.jit(partial(init, spec=SPEC, shape=shape))(jax.random.key(seed))
            return jax.tree.map(lambda x: 2.0 * x, network)

        self.encoder = fresh(facmac.init_encoder, 0)
        self.head = fresh(facmac.init_head, 1)
        self.heads = fresh(facmac.init_heads, 2)
        self.critic = fresh(facmac.init_critic, 3)
        self.pevfa = fresh(facmac.init_pevfa, 4)
        self.value = fresh(facmac.init_value, 5)
        self.mine = fresh(facmac.init_mine, 6)
        deeper = dataclasses.replace(shape, mine_embedding_layers=2)
        self.deeper_mine = fresh(facmac.init_mine, 6, deeper)


@pytest.fixture(scope="module")
def nets(config: Config) -> Networks:
    return Networks(config)


@pytest.fixture(scope="module")
def laid() -> Laid:
    """The minibatch as the learner gets it, with junk where no step was made."""
    return laid_out(random_batch(), junk_seed=2)


@pytest.fixture(scope="module")
def batch() -> Episode:
    return random_batch()


@pytest.fixture(scope="module")
def now(laid: Laid) -> Any:
    return facmac.now(laid.slots, SPEC)


@pytest.fixture(scope="module")
def later(laid: Laid) -> Moments:
    moments: Moments = facmac.later(laid.slots, SPEC)
    return moments


def moments_of(laid: Laid, column: Any) -> list[np.ndarray]:
    """A column ``[L, R, ...]`` by episode, with the moment after the last step."""
    values, found = np.asarray(column), []
    for e, length in enumerate(LENGTHS):
        slot, row = laid.where[e, 0]
        found.append(values[slot : slot + length + 1, row])
    return found


# --- time and masks -----------------------------------------------------------------------------


def test_now_is_the_steps_time_first(batch: Episode, laid: Laid, now: Any) -> None:
    moments, action, mask = now
    assert action.shape == (B, N, A)
    assert moments.obs.dtype == moments.state.dtype == jnp.float32
    for (e, t), place in laid.where.items():
        assert np.array_equal(moments.obs[place], batch.obs[e, t].astype(np.float32))
        assert np.array_equal(moments.state[place], batch.state[e, t].astype(np.float32))
        assert np.array_equal(moments.avail_actions[place], batch.avail_actions[e, t])
        before = batch.action[e, t - 1] if t else np.full(N, -1)
        assert np.array_equal(moments.last_action[place], before)
        assert np.array_equal(action[laid.sample_of[e, t]], np.eye(A)[batch.action[e, t]])
        assert moments.first[place] == (t == 0)
    steps = sorted(laid.sample_of.values())
    assert np.flatnonzero(mask).tolist() == steps
    assert np.array_equal(moments.real.reshape(-1), mask)
    assert mask.sum() == sum(LENGTHS)


def test_later_has_the_moment_after_the_last_step_too(
    batch: Episode, laid: Laid, now: Any, later: Moments
) -> None:
    for column, short in zip(later[:5], now.moments[:5], strict=True):
        assert column.shape == (SIZE, *short.shape[1:])
        assert jnp.array_equal(column[:-1], short)
    for e, (state, last) in enumerate(
        zip(moments_of(laid, later.state), moments_of(laid, later.last_action), strict=True)
    ):
        assert np.array_equal(state, batch.state[e, : LENGTHS[e] + 1].astype(np.float32))
        assert np.array_equal(last[1:], batch.action[e, : LENGTHS[e]])
    assert later.real.sum() == sum(LENGTHS) + E
    assert all((real == 1).all() for real in moments_of(laid, later.real))


def test_targets_of_a_step_use_the_value_of_the_moment_after_it(
    batch: Episode, laid: Laid, config: Config
) -> None:
    values = np.random.default_rng(0).normal(size=laid.slots.real.shape)
    flat = jnp.asarray(values.reshape(-1), jnp.float32)
    got = laid.steps(facmac.td_target(laid.slots, flat, hyper_of(config)))
    hyper = config.facmac
    for one, v, y in zip(episodes_of(batch), moments_of(laid, values), got, strict=True):
        expected = lambda_targets(one, v, hyper.discount, hyper.td_lambda)
        np.testing.assert_allclose(y, expected, rtol=1e-5)


# --- heads --------------------------------------------------------------------------------------


def test_embeddings_and_logits_of_episodes(
    batch: Episode, laid: Laid, later: Moments, nets: Networks
) -> None:
    z = facmac.encode(nets.encoder, later, SPEC)
    assert nets.head.shape == (1, H + 1, A)
    assert nets.heads.shape == (N, H + 1, A)
    for e, one in enumerate(episodes_of(batch)):
        expected = embeddings(float64(nets.encoder), one)
        np.testing.assert_allclose(moments_of(laid, z)[e], expected, rtol=1e-4, atol=1e-5)
        for head in (nets.head, nets.heads):
            np.testing.assert_allclose(
                moments_of(laid, logits(z, head))[e],
                scores_of(expected, float64(head)),
                rtol=1e-3,
                atol=1e-5,
            )


@pytest.mark.parametrize("agent", range(N))
@pytest.mark.parametrize("how", ["act", "target_action", "choose"])
def test_an_agent_acts_through_its_own_head(
    nets: Networks, now: Any, config: Config, agent: int, how: str
) -> None:
    """A head that strongly favours an action concerns its agent and nobody else."""
    moments = now.moments._replace(avail_actions=jnp.ones((SIZE - 1, ROWS, N, A), bool))
    z = facmac.encode(nets.encoder, moments, SPEC)

    def actions(heads: Any) -> np.ndarray:
        if how == "act":
            return np.asarray(facmac.act(z, heads, moments, KEY, SPEC)).argmax(-1)
        if how == "target_action":
            chosen = facmac.target_action(z, heads, moments, KEY, SPEC, hyper_of(config))
            return np.asarray(chosen).argmax(-1)
        teams = Teams(nets.encoder, jnp.stack([nets.heads, heads]))
        columns = (moments.obs, moments.state, moments.avail_actions)
        seen = Observation(*(jnp.stack([column[0, 0]] * 2) for column in columns))
        return np.asarray(choose(teams, blank(teams), seen, np.int32(0), None)[1][1:])

    usual = actions(nets.heads)
    wanted = int((usual[0, agent] + 1) % A)
    moved = actions(nets.heads.at[agent, -1, wanted].add(1e3))
    others = np.arange(N) != agent
    assert (moved[:, agent] == wanted).all()
    assert usual[0, agent] != wanted
    assert np.array_equal(moved[:, others], usual[:, others])


def test_target_actions_are_the_best_available(
    batch: Episode, laid: Laid, later: Moments, nets: Networks, config: Config
) -> None:
    z = facmac.encode(nets.encoder, later, SPEC)
    for head in (nets.head, nets.heads):
        got = facmac.target_action(z, head, later, KEY, SPEC, hyper_of(config))
        again = facmac.target_action(z, head, later, jax.random.key(9), SPEC, hyper_of(config))
        assert jnp.array_equal(got, again)
        for e, one in enumerate(episodes_of(batch)):
            expected = best_actions(float64(nets.encoder), float64(head), one)
            assert np.array_equal(moments_of(laid, got.reshape(SIZE, ROWS, N, A))[e], expected)


def test_rollouts_choose_as_the_learner_does(batch: Episode, nets: Networks) -> None:
    """Two teams, moment by moment, over the histories of two episodes."""
    teams = Teams(nets.encoder, jnp.stack([nets.heads, nets.heads[::-1]]))
    histories = [episodes_of(batch)[e] for e in (0, 3)]
    memory, played = blank(teams), []
    for t in range(min(one.length for one in histories)):
        columns = ([getattr(one, name)[t] for one in histories] for name in One._fields[:3])
        obs, state, available = (np.stack(column) for column in columns)
        seen = Observation(
            jnp.asarray(obs, jnp.float32), jnp.asarray(state, jnp.float32), jnp.asarray(available)
        )
        memory, action = choose(teams, memory, seen, np.int32(t), None)
        played.append(action)
        for z, one in zip(memory.carry, histories, strict=True):
            expected = embeddings(float64(nets.encoder), one)[t]
            np.testing.assert_allclose(z, expected, rtol=1e-4, atol=1e-5)
        done = np.stack([one.action[t] for one in histories])
        memory = memory._replace(last_action=jnp.asarray(done, jnp.int32))
    for team, one in enumerate(histories):
        expected = best_actions(float64(nets.encoder), float64(teams.heads[team]), one)
        got = np.stack([action[team] for action in played])
        assert np.array_equal(got, expected.argmax(axis=-1)[: len(played)])


def test_no_gradient_comes_from_agents_without_a_choice(nets: Networks, now: Any) -> None:
    z = facmac.encode(nets.encoder, now.moments, SPEC)
    score = jax.random.normal(KEY, (B, N, A))

    def total(z: Any, heads: Any) -> Any:
        return jnp.sum(score * facmac.act(z, heads, now.moments, KEY, SPEC))

    by_moment, _ = jax.grad(total, argnums=(0, 1))(z, nets.heads)
    choice = np.asarray(now.moments.avail_actions.sum(axis=-1) > 1)
    assert (np.asarray(by_moment)[~choice] == 0).all()
    assert (np.asarray(by_moment)[choice] != 0).any(axis=-1).all()
    # An agent that never has a choice leaves its head alone.
    dead = now.moments._replace(
        avail_actions=now.moments.avail_actions.at[:, :, 1].set(jnp.arange(A) == 0)
    )
    gradient = jax.grad(lambda heads: jnp.sum(score * facmac.act(z, heads, dead, KEY, SPEC)))(
        nets.heads
    )
    assert (gradient[1] == 0).all()
    assert (gradient[jnp.array([0, 2])] != 0).any()


# --- values -------------------------------------------------------------------------------------


def test_values_of_both_critics(batch: Episode, laid: Laid, now: Any, nets: Networks) -> None:
    moments, action, _ = now
    q_marl = facmac.q_marl(nets.critic, moments, action, SPEC)
    q_team = facmac.q_team(nets.pevfa, moments, action, nets.heads, SPEC)
    assert q_marl.shape == q_team.shape == (1, B)
    pevfa = float64(nets.pevfa)
    for e, one in enumerate(episodes_of(batch)):
        seen = (one.obs[:-1], one.state[:-1], one.taken)
        for got, expected in (
            (q_marl, q_tot(float64(nets.critic), *seen)),
            (q_team, q_tot(pevfa.critic, *seen, pevfa, float64(nets.heads))),
        ):
            np.testing.assert_allclose(laid.steps(got[0])[e], expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("part", ["utility_weight", "mixer_weight"])
@pytest.mark.parametrize("agent", range(N))
def test_the_pevfa_hears_of_every_agents_head_on_both_ways(
    now: Any, nets: Networks, part: str, agent: int
) -> None:
    deaf = dataclasses.replace(nets.pevfa, **{part: jnp.zeros_like(getattr(nets.pevfa, part))})
    value = jax.jit(partial(facmac.q_team, deaf, now.moments, now.action, spec=SPEC))
    usual = value(nets.heads)
    for place in ((0, 0), (H, A - 1)):
        other = value(nets.heads.at[(agent, *place)].add(20.0))
        assert np.abs(other - usual).max() > 1e-4
    # With both ways closed there is no way left.
    closed = dataclasses.replace(
        deaf, **{n: jnp.zeros_like(getattr(deaf, n)) for n in ("utility_weight", "mixer_weight")}
    )
    values = [
        facmac.q_team(closed, now.moments, now.action, h, SPEC)
        for h in (nets.heads, 2.0 * nets.heads)
    ]
    assert jnp.array_equal(values[0], values[1])


def test_utilities_may_hear_of_their_own_agents_head_alone(
    batch: Episode, laid: Laid, now: Any, nets: Networks, config: Config
) -> None:
    race = dataclasses.replace(config.race, utility_embedding="agent")
    made = facmac.init_pevfa(KEY, SPEC, shape_of(dataclasses.replace(config, race=race)))
    assert made.of_agents
    assert not nets.pevfa.of_agents
    pevfa = dataclasses.replace(nets.pevfa, of_agents=True)
    value = jax.jit(partial(facmac.q_team, pevfa, now.moments, now.action, spec=SPEC))
    got = laid.steps(value(nets.heads)[0])
    for e, one in enumerate(episodes_of(batch)):
        seen = (one.obs[:-1], one.state[:-1], one.taken)
        critic = float64(pevfa.critic)
        expected = q_tot(critic, *seen, float64(pevfa), float64(nets.heads))
        np.testing.assert_allclose(got[e], expected, rtol=1e-4, atol=1e-4)
    # Where the mixer hears of no head, swapped heads are heard of, and the order matters.
    deaf = dataclasses.replace(pevfa, mixer_weight=jnp.zeros_like(pevfa.mixer_weight))
    for asked, hears in ((deaf, True), (dataclasses.replace(deaf, of_agents=False), False)):
        both = [
            facmac.q_team(asked, now.moments, now.action, heads, SPEC)
            for heads in (nets.heads, nets.heads[::-1])
        ]
        assert (np.abs(both[0] - both[1]).max() > 1e-3) == hears


@pytest.mark.parametrize("of_team", [False, True])
@pytest.mark.parametrize("agent", range(N))
def test_q_total_never_falls_with_a_utility(nets: Networks, of_team: bool, agent: int) -> None:
    keys = jax.random.split(jax.random.key(8), 3)
    state = 3.0 * jax.random.normal(keys[0], (200, S))
    utilities = 5.0 * jax.random.normal(keys[1], (200, N))
    rise = jax.random.uniform(keys[2], (200,), minval=0.01, maxval=3.0)
    vectors = jnp.swapaxes(nets.heads, 1, 2).reshape(-1, H + 1)
    shift = (
        embedding_shifts(nets.pevfa, vectors, np.repeat(np.arange(N), A))[1] if of_team else None
    )
    mixer = nets.pevfa.critic.mixer
    before = mix(mixer, state, utilities, shift)
    after = mix(mixer, state, utilities.at[:, agent].add(rise), shift)
    assert (after >= before).all()
    assert (after > before).mean() > 0.9


def test_the_state_value_net_has_one_layer_of_relu(
    batch: Episode, laid: Laid, now: Any, nets: Networks, config: Config
) -> None:
    hidden, out = nets.value.layers
    assert hidden.weight.shape == (S, 32)
    assert out.weight.shape == (32, 1)
    got = laid.steps(facmac.state_values(nets.value, now.moments))
    for e, one in enumerate(episodes_of(batch)):
        expected = v_zeta(float64(nets.value), one.state[:-1])
        np.testing.assert_allclose(got[e], expected, rtol=1e-4, atol=1e-5)


# --- mutual information -------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_signals_of_the_steps_as_dealt(
    monkeypatch: pytest.MonkeyPatch,
    batch: Episode,
    laid: Laid,
    now: Any,
    nets: Networks,
    config: Config,
    seed: int | None,
) -> None:
    # 18 samples in groups of 4: two places of the last group are no samples at all.
    deal = np.arange(B) if seed is None else np.random.default_rng(seed).permutation(B)
    module = sys.modules["race.learners.signals"]
    monkeypatch.setattr(module, "GROUP", GROUP)
    monkeypatch.setattr(module, "deal_out", lambda key, moment, real: jnp.asarray(deal))
    z = facmac.encode(nets.encoder, now.moments, SPEC)
    mine = nets.mine if seed != 1 else nets.deeper_mine
    got = facmac.mutual_information(mine, now.moments, z, KEY, shape_of(config))
    assert got.shape == (1, B)
    groups = groups_of(laid, deal)
    expected = signals(float64(mine), float64(nets.encoder), episodes_of(batch), groups)
    for signal, of_episode in zip(laid.steps(got[0]), expected, strict=True):
        np.testing.assert_allclose(signal, of_episode, rtol=1e-4, atol=1e-5)
    # What is no step has no signal, nor has a step at which all agents are dead.
    assert expected[2][2] == 0
    assert (np.asarray(got[0])[np.asarray(now.mask) == 0] == 0).all()


@pytest.mark.parametrize("most", [E, E + 3])
def test_signals_against_other_episodes_at_the_same_time(
    batch: Episode, laid: Laid, now: Any, nets: Networks, config: Config, most: int
) -> None:
    shape = dataclasses.replace(shape_of(config), mine_negatives="episodes", batch_size=most)
    z = facmac.encode(nets.encoder, now.moments, SPEC)
    mine = nets.mine if most == E else nets.deeper_mine
    got = facmac.mutual_information(mine, now.moments, z, KEY, shape)
    assert got.shape == (1, B)
    expected = signals_across(float64(mine), float64(nets.encoder), episodes_of(batch))
    for signal, of_episode in zip(laid.steps(got[0]), expected, strict=True):
        np.testing.assert_allclose(signal, of_episode, rtol=1e-4, atol=1e-5)
    assert (np.asarray(got[0])[np.asarray(now.mask) == 0] == 0).all()
    # Nobody is left at the last step of the longest episode to compare it with.
    assert [int((signal == 0).sum()) for signal in expected] == [1, 0, 1, 0]


def test_places_of_each_time(laid: Laid, now: Any) -> None:
    places = sys.modules["race.learners.signals"].of_each_time(
        now.moments.first, now.moments.real > 0, E
    )
    assert places.shape == (SIZE - 1, E)
    assert int(facmac.episodes(now.moments)) == E
    order = sorted(range(E), key=lambda e: laid.where[e, 0][::-1])  # row by row
    for t, row in enumerate(np.asarray(places)):
        assert row.tolist() == [laid.sample_of.get((e, t), B) for e in order]


def test_chance_depends_on_the_moments_and_not_on_where_they_lie() -> None:
    """Noise and order of the same moments in two minibatches of unequal layouts."""
    module, pairs = (sys.modules[f"race.learners.{name}"] for name in ("facmac", "signals"))
    one = jnp.array([[3, 0], [7, 0], [9, 4]])
    two = jnp.array([[4, 9, 7, 3]])
    noise = [module.gumbel_noise(KEY, moment, (2, 3)) for moment in (one, two)]
    assert noise[0].shape == (3, 2, 2, 3)
    for place, other in (((0, 0), (0, 3)), ((1, 0), (0, 2)), ((2, 0), (0, 1)), ((2, 1), (0, 0))):
        assert jnp.array_equal(noise[0][place], noise[1][other])
    real = [jnp.array([[True, False], [True, False], [True, True]]), jnp.ones((1, 4), bool)]
    orders = [
        moment.reshape(-1)[pairs.deal_out(KEY, moment.reshape(-1), there.reshape(-1))]
        for moment, there in zip((one, two), real, strict=True)
    ]
    assert orders[0][:4].tolist() == orders[1].tolist()
    assert sorted(orders[1].tolist()) == [3, 4, 7, 9]


def test_moments_are_dealt_with_independently() -> None:
    module, pairs = (sys.modules[f"race.learners.{name}"] for name in ("facmac", "signals"))
    moment = jnp.arange(400).reshape(50, 8)
    actions = module.gumbel_noise(KEY, moment, (5, A)).argmax(axis=-1)
    for axis in range(3):
        same = np.asarray(actions == jnp.roll(actions, 1, axis=axis)).mean()
        assert abs(same - 1 / A) < 5 * np.sqrt(1 / A * (1 - 1 / A) / actions.size)
    first = [
        int(pairs.deal_out(key, jnp.arange(6), jnp.arange(6) < 4)[0])
        for key in jax.random.split(KEY, 400)
    ]
    counts = np.bincount(first, minlength=6)
    assert counts[4:].sum() == 0
    assert (np.abs(counts[:4] - 100) < 5 * np.sqrt(400 / 4 * 3 / 4)).all()


def test_the_deal_is_drawn_anew_with_every_key(
    monkeypatch: pytest.MonkeyPatch, now: Any, nets: Networks, config: Config
) -> None:
    monkeypatch.setattr(sys.modules["race.learners.signals"], "GROUP", GROUP)
    z = facmac.encode(nets.encoder, now.moments, SPEC)
    keys = jax.random.split(KEY, 2)
    one, two = (
        facmac.mutual_information(nets.mine, now.moments, z, key, shape_of(config)) for key in keys
    )
    assert not np.allclose(one, two)

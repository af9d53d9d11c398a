"""Choices that change a program: one PeVFA, one encoder for all agents, drawn teams, starts."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from frequencies import KEYS, assert_frequency
from test_race_update import (
    B,
    Frozen,
    assert_gradients_equal,
    float64,
    gradient_of,
    leaky,
    normal,
    numeric_gradient,
    params,
    pevfa_loss,
    pi,
    q_theta,
    separate,
    sp,
    vfm_loss,
)

from race.algorithms import marl, race
from race.algorithms.race_update import draw_teams
from race.config.hyper import hyper_of
from race.config.settings import Config
from race.config.shape import Shape, shape_of
from race.networks import dense
from race.networks.critics import Pevfa
from race.types import EnvSpec


def start(config: Config, spec: EnvSpec) -> tuple[Any, Shape]:
    shape = shape_of(config)
    return race.init(jax.random.key(11), spec, shape, hyper_of(config)), shape


def assert_slopes_equal(loss: Callable[[Any], float], at: Any, gradient: Any) -> None:
    """The gradient is that of the loss along random directions: cheaper than along every axis."""
    rng = np.random.default_rng(0)
    leaves, structure = jax.tree.flatten(at)
    for _ in range(6):
        along = [rng.normal(size=leaf.shape) for leaf in leaves]
        moved = (
            jax.tree.unflatten(
                structure, [x + step * d for x, d in zip(leaves, along, strict=True)]
            )
            for step in (1e-6, -1e-6)
        )
        slope = (loss(next(moved)) - loss(next(moved))) / 2e-6
        got = sum(
            float(np.sum(g * d)) for g, d in zip(jax.tree.leaves(gradient), along, strict=True)
        )
        assert abs(slope) > 1e-3
        np.testing.assert_allclose(got, slope, rtol=2e-3, atol=1e-3)


# --- one PeVFA --------------------------------------------------------------------------------


def test_one_pevfa_learns_and_is_climbed_for_all_teams(
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
    batch_of: Callable[..., Any],
    compiled: Callable[..., Any],
) -> None:
    config = tiny_config("race", "matd3", race={"one_pevfa": True})
    fresh, _ = start(config, tiny_spec)
    before, batch = separate(fresh), batch_of(tiny_spec, B)
    assert before.critics.critic is None
    assert before.target.critic is None
    after, losses, policy_losses = compiled(race, "update", tiny_spec, config)(
        before, batch, jnp.int32(1), jax.random.key(5)
    )
    still = np.zeros((B, 3))
    f = Frozen(
        tiny_spec, float64(batch), float64(before.target), np.zeros(()), 2, 0.99, (still, still)
    )
    target, pevfa = f.target, float64(before.critics.pevfa.params)
    policies = params(before.policies)

    def y_of(acting: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Targets at the actions of one team's heads, of which the PeVFA sees ``seen``."""
        found = []
        for b, s in enumerate(f.batch.next_state):
            u = pi(target.encoder, acting, tiny_spec, s)
            alive = f.discount if f.batch.terminated[b] == 0 else 0.0
            value = min(q_theta(target.pevfa, k, tiny_spec, s, u, seen) for k in range(2))
            found.append(f.batch.reward[b] + alive * value)
        return np.array(found)

    y_marl = y_of(target.head, target.head)
    of_marl, f_marl = y_marl, f._replace(team=policies.head)
    np.testing.assert_allclose(losses["critic"], pevfa_loss(pevfa, f_marl, of_marl), rtol=1e-4)
    (team,) = (
        head
        for head in float64(before.heads)
        if np.isclose(
            pevfa_loss(pevfa, f._replace(team=head), y_of(head, head)),
            float(losses["pevfa"]),
            rtol=1e-4,
        )
    )
    y_team, f_team = y_of(team, team), f._replace(team=team)
    assert_slopes_equal(
        lambda p: pevfa_loss(p, f_marl, of_marl) + pevfa_loss(p, f_team, y_team),
        pevfa,
        gradient_of(after.critics.pevfa),
    )
    # The MARL team climbs it by its actions, not by what the embedding makes of its weights.
    moved = float64(after.critics.pevfa.params)

    def policy_loss(head: np.ndarray) -> float:
        values = [
            q_theta(moved, 0, tiny_spec, s, pi(policies.encoder, head, tiny_spec, s), policies.head)
            for s in f.batch.state
        ]
        return -float(np.mean(values))

    np.testing.assert_allclose(policy_losses["policy"], policy_loss(policies.head), rtol=1e-4)
    assert_gradients_equal(
        gradient_of(after.policies.head), numeric_gradient(policy_loss, policies.head)
    )


# --- what the PeVFA learns from, and how it sees teams ----------------------------------------


def of_critic(pevfa: Pevfa, k: int) -> Pevfa:
    """With the policy embedding that one of its critics has for itself."""
    own = jax.tree.map(lambda leaf: leaf[k], pevfa.embedding)
    found: Pevfa = eqx.tree_at(lambda pevfa: pevfa.embedding, pevfa, own)
    return found


def test_pevfa_of_online_encoders_with_an_embedding_for_each_critic(
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
    batch_of: Callable[..., Any],
    compiled: Callable[..., Any],
) -> None:
    """Smoothing would throw every target action to a bound, if there were any."""
    config = tiny_config(
        "race",
        "matd3",
        race={"pevfa_target": "online", "policy_embedding": "each"},
        learner={"smoothing_noise": 1e3},
    )
    fresh, _ = start(config, tiny_spec)
    before, batch = separate(fresh), batch_of(tiny_spec, B)
    after, losses, policy_losses = compiled(race, "update", tiny_spec, config)(
        before, batch, jnp.int32(1), jax.random.key(5)
    )
    pevfa, target = float64(before.critics.pevfa.params), float64(before.target.pevfa)
    online, samples = params(before.policies).encoder, float64(batch)
    first, second = pevfa.embedding.layers[0].weight
    assert not np.allclose(first, second)

    def y_of(team: np.ndarray) -> list[float]:
        found = []
        for b, s in enumerate(samples.next_state):
            u = pi(online, team, tiny_spec, s)
            value = min(q_theta(of_critic(target, k), k, tiny_spec, s, u, team) for k in range(2))
            found.append(samples.reward[b] + (1 - samples.terminated[b]) * 0.99 * value)
        return found

    def loss(pevfa: Pevfa, team: np.ndarray, y: list[float]) -> float:
        return sum(
            (y[b] - q_theta(of_critic(pevfa, k), k, tiny_spec, s, samples.action[b], team)) ** 2 / B
            for b, s in enumerate(samples.state)
            for k in range(2)
        )

    seen = float(losses["pevfa"])
    (team,) = (
        head for head in float64(before.heads) if np.isclose(loss(pevfa, head, y_of(head)), seen)
    )
    y = y_of(team)
    assert_slopes_equal(lambda p: loss(p, team, y), pevfa, gradient_of(after.critics.pevfa))
    # What the encoders climb is the first critic, with its own embedding.
    moved = params(after.critics)
    still = np.zeros((B, 3))
    f = Frozen(tiny_spec, samples, float64(before.target), team, 2, 0.99, (still, still))
    head, climbed = params(before.policies).head, of_critic(moved.pevfa, 0)
    expected = vfm_loss(online, head, moved.critic, climbed, f)
    np.testing.assert_allclose(policy_losses["vfm"], expected, rtol=1e-4)


def test_one_policy_embedding_for_both_critics(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config]
) -> None:
    """By default."""
    state, _ = start(tiny_config("race", "matd3"), tiny_spec)
    assert state.target.pevfa.embedding.layers[0].weight.ndim == 2


def test_what_teams_are_worth_where_they_are(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config]
) -> None:
    """The smaller of the PeVFA's two values of each team of the population."""
    config = tiny_config("race", "matd3")
    fresh, shape = start(config, tiny_spec)
    state = separate(fresh)
    size = config.race.population_size
    states = np.random.default_rng(0).normal(size=(size, tiny_spec.state_size))
    found = jax.jit(lambda at: race.expected(state, at, tiny_spec, shape))(
        jnp.asarray(states, jnp.float32)
    )
    encoder = params(state.policies).encoder
    heads = float64(state.heads)
    pevfa = float64(state.critics.pevfa.params)
    expected = []
    for at, head in zip(states, heads, strict=True):
        u = pi(encoder, head, tiny_spec, at)
        expected.append(min(q_theta(pevfa, k, tiny_spec, at, u, head) for k in range(2)))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert np.std(expected) > 1e-3


# --- one encoder for all agents ---------------------------------------------------------------


@pytest.fixture(scope="module")
def shared(tiny_config: Callable[..., Config]) -> Config:
    return tiny_config("race", "matd3", learner={"shared_agents": True})


def test_one_encoder_is_told_the_agents_number(tiny_spec: EnvSpec, shared: Config) -> None:
    state, _ = start(shared, tiny_spec)
    encoder = float64(state.policies.encoder.params)
    assert encoder.hidden.weight.shape[0] == encoder.out.weight.shape[0] == 1
    states = np.random.default_rng(0).normal(size=(4, tiny_spec.state_size)).astype(np.float32)
    z = dense.encode(state.policies.encoder.params, tiny_spec, jnp.asarray(states))
    for agent, entries in enumerate(tiny_spec.obs_index):
        for b, s in enumerate(states):
            obs = np.zeros(tiny_spec.obs_size)
            obs[: len(entries)] = s[list(entries)]
            x = obs @ encoder.hidden.weight[0] + encoder.hidden.bias[0] + encoder.agent[agent]
            x = np.tanh(normal(encoder, x)) @ encoder.out.weight[0] + encoder.out.bias[0]
            np.testing.assert_allclose(z[agent, b], np.tanh(normal(encoder, x)), rtol=1e-4)


def test_one_encoder_has_one_mine_which_hears_all_agents(
    tiny_spec: EnvSpec, shared: Config, batch_of: Callable[..., Any]
) -> None:
    from race.learners import matd3

    state, _ = start(shared, tiny_spec)
    mine = state.policies.mine.params
    batch = batch_of(tiny_spec, B)
    z = dense.encode(state.policies.encoder.params, tiny_spec, batch.state)
    found = matd3.mutual_information(mine, batch.state, z, jax.random.key(0), shape_of(shared))
    net, states = float64(mine), float64(batch.state)
    expected = []
    for agent in np.asarray(z, np.float64):
        x = leaky(states @ net.state_hidden.weight[0] + net.state_hidden.bias[0])
        x = leaky(x @ net.state_out.weight[0] + net.state_out.bias[0])
        scores = x @ (agent @ net.embedding.weight[0] + net.embedding.bias[0]).T
        others = [np.mean([sp(row[k]) for k in range(B) if k != t]) for t, row in enumerate(scores)]
        expected.append([-sp(-scores[t, t]) - others[t] for t in range(B)])
    assert found.shape == (1, B)
    np.testing.assert_allclose(found[0], np.mean(expected, axis=0), rtol=1e-4)


def test_one_encoder_learns_from_all_agents(
    tiny_spec: EnvSpec, shared: Config, batch_of: Callable[..., Any], compiled: Callable[..., Any]
) -> None:
    """Its gradient is the sum of those of encoders that begin as its copies."""
    state, _ = start(shared, tiny_spec)
    batch, n = batch_of(tiny_spec, B), tiny_spec.n_agents
    encoder = state.policies.encoder.params

    def value(encoder: Any) -> Any:
        z = dense.encode(encoder, tiny_spec, batch.state)
        action = dense.act(z, state.policies.head.params, tiny_spec)
        return jnp.sum(jnp.sin(3.0 * action))

    def each(layer: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.repeat(leaf, n, axis=0), layer)

    hidden = each(encoder.hidden)
    hidden = dense.Dense(hidden.weight, hidden.bias + encoder.agent)
    copies = dense.Encoder(hidden, each(encoder.out), encoder.layer_norm)
    np.testing.assert_allclose(value(encoder), value(copies), rtol=1e-5)
    got, apart = jax.jit(jax.grad(value))(encoder), jax.jit(jax.grad(value))(copies)
    for one, many in ((got.hidden, apart.hidden), (got.out, apart.out)):
        for a, b in zip(*map(jax.tree.leaves, (one, many)), strict=True):
            np.testing.assert_allclose(a[0], jnp.sum(b, axis=0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(got.agent, apart.hidden.bias, rtol=1e-4, atol=1e-6)


# --- which teams are drawn --------------------------------------------------------------------


@pytest.mark.parametrize("marl_among_teams", [False, True])
@pytest.mark.parametrize("team_draw", ["once", "each"])
def test_teams_of_a_gradient_step(
    tiny_config: Callable[..., Config],
    team_draw: str,
    marl_among_teams: bool,
) -> None:
    choice = {"team_draw": team_draw, "marl_among_teams": marl_among_teams}
    shape = shape_of(tiny_config("race", "matd3", race=choice))
    heads = jnp.arange(5.0)[:, None, None, None] * jnp.ones((5, 2, 5, 2))
    marl_head = jnp.full((2, 5, 2), 5.0)
    draw = jax.jit(jax.vmap(lambda key: draw_teams(heads, marl_head, key, shape)))
    drawn = draw(KEYS)
    first, second = (np.asarray(team.heads)[:, 0, 0, 0] for team in drawn)
    for team, found in zip(drawn, (first, second), strict=True):
        np.testing.assert_array_equal(team.place, found)
    n = 5 + marl_among_teams
    for found in (first, second):
        for team in range(n):
            assert_frequency((found == team).sum(), 1 / n, len(KEYS))
        assert found.max() < n
    if team_draw == "once":
        np.testing.assert_array_equal(first, second)
    else:
        assert_frequency((first == second).sum(), 1 / n, len(KEYS))


# --- numbers of the start and of the encoder's step -------------------------------------------


@pytest.mark.parametrize("base", ["matd3", "facmac"])
def test_last_layers_begin_smaller(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config], base: str
) -> None:
    one, _ = start(tiny_config("race", base), tiny_spec)
    tenth, _ = start(tiny_config("race", base, learner={"last_layer_scale": 0.1}), tiny_spec)
    scaled = ("head", ".out.")
    found = set()
    flat = (jax.tree_util.tree_flatten_with_path(s)[0] for s in (one, tenth))
    for (path, a), (_, b) in zip(*flat, strict=True):
        name = jax.tree_util.keystr(path)
        if "optimizer" in name:
            continue
        if np.array_equal(a, b):
            continue
        np.testing.assert_allclose(b, 0.1 * np.asarray(a), rtol=1e-5)
        found.add(name)
        assert any(part in name for part in scaled), name
    # Networks and targets; weights and biases of critic and PeVFA, and the MARL team's heads.
    assert len(found) == 2 * 5
    alone = [
        marl.init(jax.random.key(0), tiny_spec, shape_of(config), hyper_of(config))
        for config in (
            tiny_config("marl", base, learner={"last_layer_scale": scale}) for scale in (1.0, 0.5)
        )
    ]
    for of in (lambda state: state.head.params, lambda state: state.target.head):
        np.testing.assert_allclose(of(alone[1]), 0.5 * np.asarray(of(alone[0])))


def test_the_encoder_has_a_step_size_of_its_own(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config]
) -> None:
    config = tiny_config(learner={"actor_learning_rate": 3e-3})
    assert hyper_of(config).encoder_learning_rate == np.float32(3e-3)
    config = tiny_config(learner={"actor_learning_rate": 3e-3, "encoder_learning_rate": 1e-4})
    assert hyper_of(config).encoder_learning_rate == np.float32(1e-4)
    assert hyper_of(config).actor_learning_rate == np.float32(3e-3)

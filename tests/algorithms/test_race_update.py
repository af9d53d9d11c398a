"""One gradient step of RACE against the paper's losses in float64.

The losses are written a second time here, from the text of the paper and sample by sample, with
agents' own observations (no padding) and the concatenation [s, u, e] spelled out. Gradients are
their central finite differences. The package's own gradients are read off Adam's first moment
after its first step, which is a tenth of the gradient.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from float64_factored import normal, q_tot, q_tot_team
from tiny_episodes import with_heads

from race.algorithms import marl, race
from race.algorithms.marl import MarlState
from race.algorithms.marl import Targets as MarlTargets
from race.config.hyper import hyper_of
from race.config.settings import Config
from race.config.shape import shape_of
from race.networks.factored import FactoredCritic, FactoredPevfa
from race.types import EnvSpec

B = 3


# --- the paper, in float64 --------------------------------------------------------------------


def leaky(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 0.01 * x)


def sp(x: float) -> float:
    return float(np.logaddexp(0.0, x))


def z_of(encoder: Any, spec: EnvSpec, s: np.ndarray, agent: int) -> np.ndarray:
    obs = s[list(spec.obs_index[agent])]
    x = obs @ encoder.hidden.weight[agent][: len(obs)] + encoder.hidden.bias[agent]
    x = np.tanh(normal(encoder, x)) @ encoder.out.weight[agent] + encoder.out.bias[agent]
    return np.tanh(normal(encoder, x))


def pi(encoder: Any, head: np.ndarray, spec: EnvSpec, s: np.ndarray) -> np.ndarray:
    u = np.full(spec.joint_action_size, np.nan)
    for agent, entries in enumerate(spec.action_index):
        z = z_of(encoder, spec, s, agent)
        for place, entry in enumerate(entries):
            u[entry] = np.tanh(z @ head[agent, :-1, place] + head[agent, -1, place])
    return u


def q_psi(critic: Any, k: int, spec: EnvSpec, s: np.ndarray, u: np.ndarray) -> float:
    if isinstance(critic, FactoredCritic):
        assert k == 0
        return q_tot(critic, spec, s, u)
    x = np.concatenate([s, u]) @ critic.first.weight[k] + critic.first.bias[k]
    return rest_of_critic(critic, k, x)


def rest_of_critic(critic: Any, k: int, x: np.ndarray) -> float:
    """What follows the first layer's sum."""
    x = leaky(normal(critic, x)) @ critic.hidden.weight[k] + critic.hidden.bias[k]
    x = leaky(normal(critic, x))
    return float((x @ critic.out.weight[k] + critic.out.bias[k])[0])


def embedding(pevfa: Any, spec: EnvSpec, head: np.ndarray) -> np.ndarray:
    rows = []
    for agent, entries in enumerate(spec.action_index):
        for place in range(len(entries)):
            first, second, out = pevfa.embedding.layers
            x = leaky(head[agent, :, place] @ first.weight + first.bias)
            x = leaky(x @ second.weight + second.bias)
            rows.append(x @ out.weight + out.bias)
    return np.mean(rows, axis=0)


def q_theta(
    pevfa: Any, k: int, spec: EnvSpec, s: np.ndarray, u: np.ndarray, head: np.ndarray
) -> float:
    if isinstance(pevfa, FactoredPevfa):
        assert k == 0
        return q_tot_team(pevfa, spec, s, u, embedding(pevfa, spec, head))
    critic = pevfa.critic
    first = np.concatenate([critic.first.weight[k], pevfa.embedding_weight[k]])
    x = np.concatenate([s, u, embedding(pevfa, spec, head)])
    return rest_of_critic(critic, k, x @ first + critic.first.bias[k])


def v_zeta(value: Any, s: np.ndarray) -> float:
    first, second, out = value.layers
    x = leaky(leaky(s @ first.weight + first.bias) @ second.weight + second.bias)
    return float((x @ out.weight + out.bias)[0])


def t_omega(mine: Any, agent: int, s: np.ndarray, z: np.ndarray) -> float:
    x = leaky(s @ mine.state_hidden.weight[agent] + mine.state_hidden.bias[agent])
    x = leaky(x @ mine.state_out.weight[agent] + mine.state_out.bias[agent])
    y = z @ mine.embedding.weight[agent] + mine.embedding.bias[agent]
    if mine.embedding_out is not None:
        y = leaky(y) @ mine.embedding_out.weight[agent] + mine.embedding_out.bias[agent]
    return float(x @ y)


def signals(encoder: Any, mine: Any, spec: EnvSpec, batch: Any, agent: int) -> list[float]:
    """I_t below Eq. (3)."""
    z = [z_of(encoder, spec, s, agent) for s in batch.state]
    result = []
    for t, s in enumerate(batch.state):
        others = [sp(t_omega(mine, agent, s, z[k])) for k in range(len(z)) if k != t]
        result.append(-sp(-t_omega(mine, agent, s, z[t])) - float(np.mean(others)))
    return result


class Frozen(NamedTuple):
    """Everything the losses hold fixed, in float64."""

    spec: EnvSpec
    batch: Any
    target: Any
    team: np.ndarray
    n_critics: int
    discount: float
    noise: tuple[np.ndarray, np.ndarray]  # smoothing of marl's and the team's actions, [B, U]


def targets_of(f: Frozen) -> tuple[np.ndarray, np.ndarray]:
    """The two targets of Eq. (1)."""
    y_marl, y_team = [], []
    for b, s in enumerate(f.batch.next_state):
        u_marl = np.clip(pi(f.target.encoder, f.target.head, f.spec, s) + f.noise[0][b], -1, 1)
        u_team = np.clip(pi(f.target.encoder, f.team, f.spec, s) + f.noise[1][b], -1, 1)
        ks = range(f.n_critics)
        next_marl = min(q_psi(f.target.critic, k, f.spec, s, u_marl) for k in ks)
        next_team = min(q_theta(f.target.pevfa, k, f.spec, s, u_team, f.team) for k in ks)
        alive = f.discount if f.batch.terminated[b] == 0 else 0.0
        y_marl.append(f.batch.reward[b] + alive * next_marl)
        y_team.append(f.batch.reward[b] + alive * next_team)
    return np.array(y_marl), np.array(y_team)


def critic_loss(critic: Any, f: Frozen, y: np.ndarray) -> float:
    s, u = f.batch.state, f.batch.action
    return sum(
        float(np.mean([(y[b] - q_psi(critic, k, f.spec, s[b], u[b])) ** 2 for b in range(len(y))]))
        for k in range(f.n_critics)
    )


def pevfa_loss(pevfa: Any, f: Frozen, y: np.ndarray) -> float:
    s, u = f.batch.state, f.batch.action
    return sum(
        float(
            np.mean(
                [(y[b] - q_theta(pevfa, k, f.spec, s[b], u[b], f.team)) ** 2 for b in range(len(y))]
            )
        )
        for k in range(f.n_critics)
    )


def value_loss(value: Any, f: Frozen, best: np.ndarray) -> float:
    return float(
        np.mean([(v_zeta(value, s) - y) ** 2 for s, y in zip(f.batch.state, best, strict=True)])
    )


def vfm_loss(encoder: Any, head: np.ndarray, critic: Any, pevfa: Any, f: Frozen) -> float:
    """Eq. (2)."""
    total = 0.0
    for s in f.batch.state:
        total += q_psi(critic, 0, f.spec, s, pi(encoder, head, f.spec, s))
        total += q_theta(pevfa, 0, f.spec, s, pi(encoder, f.team, f.spec, s), f.team)
    return -total / len(f.batch.state)


def vmm_loss(encoder: Any, mine: Any, values: np.ndarray, f: Frozen, agent: int) -> float:
    """Eq. (5)."""
    weights = (values - values.min()) / (values.max() - values.min())
    signal = signals(encoder, mine, f.spec, f.batch, agent)
    return -float(np.mean([w * i for w, i in zip(weights, signal, strict=True)]))


def marl_loss(encoder: Any, head: np.ndarray, critic: Any, f: Frozen) -> float:
    """Eq. (7)."""
    s_all = f.batch.state
    return -float(
        np.mean([q_psi(critic, 0, f.spec, s, pi(encoder, head, f.spec, s)) for s in s_all])
    )


def numeric_gradient(loss: Callable[[Any], float], params: Any, step: float = 1e-6) -> Any:
    params = jax.tree.map(np.copy, params)

    def of_leaf(leaf: np.ndarray) -> np.ndarray:
        gradient = np.zeros_like(leaf)
        for place in np.ndindex(*leaf.shape):
            kept = leaf[place]
            leaf[place] = kept + step
            above = loss(params)
            leaf[place] = kept - step
            below = loss(params)
            leaf[place] = kept
            gradient[place] = (above - below) / (2 * step)
        return gradient

    return jax.tree.map(of_leaf, params)


# --- one step of the package ------------------------------------------------------------------


def float64(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


def params(trained: Any) -> Any:
    return float64(type(trained)(*(t.params for t in trained)))


def gradient_of(trainable: Any) -> Any:
    """The gradient of a trainable's first step, off Adam's first moment 0.1 g."""
    (moments,) = [
        part
        for part in jax.tree.leaves(
            trainable.optimizer, is_leaf=lambda x: isinstance(x, optax.ScaleByAdamState)
        )
        if isinstance(part, optax.ScaleByAdamState)
    ]
    return jax.tree.map(lambda m: 10.0 * np.asarray(m, np.float64), moments.mu)


def assert_gradients_equal(got: Any, expected: Any) -> None:
    leaves = list(zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True))
    scale = max(np.abs(e).max() for _, e in leaves)
    assert scale > 1e-4  # a comparison of zeros proves nothing
    for g, e in leaves:
        np.testing.assert_allclose(g, e, rtol=2e-3, atol=2e-5 * scale)


class Step(NamedTuple):
    before: Any
    after: Any
    critic_losses: dict[str, float]
    policy_losses: dict[str, float]
    frozen: Frozen
    config: Config


def separate(state: Any) -> Any:
    """Targets and population heads away from the online networks, so that mix-ups show."""
    keys = iter(jax.random.split(jax.random.key(99), 200))
    moved = jax.tree.map(
        lambda leaf: leaf + 0.3 * jax.random.normal(next(keys), leaf.shape), state.target
    )
    return with_heads(state._replace(target=moved), 2.0 * state.heads)


def drawn_team(before: Any, pevfa_loss_seen: float, f: Frozen) -> np.ndarray:
    """The one team of the population that explains the PeVFA's loss."""
    heads = float64(before.heads)
    pevfa = float64(before.critics.pevfa.params)
    fitting = []
    for head in heads:
        g = f._replace(team=head)
        if np.isclose(pevfa_loss(pevfa, g, targets_of(g)[1]), pevfa_loss_seen, rtol=1e-4):
            fitting.append(head)
    (team,) = fitting
    return team


@pytest.fixture(
    scope="module",
    params=[
        *((base, True, 0.0) for base in ("matd3", "maddpg", "facmac")),
        ("matd3", False, 0.5),  # with a second layer for embeddings in MINE
        pytest.param(("facmac", True, 0.5), marks=pytest.mark.slow),
    ],
    ids=lambda param: "-".join(
        [param[0], "normalised" if param[1] else "plain", *["heads-learn"] * (param[2] > 0)]
    ),
)
def stepped(
    request: Any,
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
    batch_of: Callable[..., Any],
    compiled: Callable[..., Any],
) -> Step:
    base, layer_norm, rate = request.param
    config = tiny_config(
        "race",
        base,
        learner={"layer_norm": layer_norm},
        race={"head_learning_rate": rate, "mine_embedding_layers": 1 if layer_norm else 2},
    )
    before = separate(race.init(jax.random.key(11), tiny_spec, shape_of(config), hyper_of(config)))
    batch = batch_of(tiny_spec, B)
    after, critic_losses, policy_losses = compiled(race, "update", tiny_spec, config)(
        before, batch, jnp.int32(1), jax.random.key(5)
    )
    zero = np.zeros((B, tiny_spec.joint_action_size))
    frozen = Frozen(
        tiny_spec,
        float64(batch),
        float64(before.target),
        np.zeros(()),
        2 if base == "matd3" else 1,
        config.learner.discount,
        (zero, zero),
    )
    team = drawn_team(before, float(critic_losses["pevfa"]), frozen)
    return Step(
        before,
        after,
        {name: float(x) for name, x in critic_losses.items()},
        {name: float(x) for name, x in policy_losses.items()},
        frozen._replace(team=team),
        config,
    )


def test_critics_descend_equation_1(stepped: Step) -> None:
    f = stepped.frozen
    y_marl, y_team = targets_of(f)
    assert (np.sort(f.batch.terminated) == [0, 0, 1]).all()
    critics = params(stepped.before.critics)
    np.testing.assert_allclose(
        stepped.critic_losses["critic"], critic_loss(critics.critic, f, y_marl), rtol=1e-4
    )
    assert_gradients_equal(
        gradient_of(stepped.after.critics.critic),
        numeric_gradient(lambda c: critic_loss(c, f, y_marl), critics.critic),
    )
    np.testing.assert_allclose(
        stepped.critic_losses["pevfa"], pevfa_loss(critics.pevfa, f, y_team), rtol=1e-4
    )
    assert_gradients_equal(
        gradient_of(stepped.after.critics.pevfa),
        numeric_gradient(lambda p: pevfa_loss(p, f, y_team), critics.pevfa),
    )


def test_state_value_descends_equation_4(stepped: Step) -> None:
    f = stepped.frozen
    y_marl, y_team = targets_of(f)
    best = np.maximum(y_marl, y_team)
    value = params(stepped.before.critics).value
    np.testing.assert_allclose(
        stepped.critic_losses["value"], value_loss(value, f, best), rtol=1e-4
    )
    assert_gradients_equal(
        gradient_of(stepped.after.critics.value),
        numeric_gradient(lambda v: value_loss(v, f, best), value),
    )


def test_encoders_descend_equation_6(stepped: Step) -> None:
    f, n = stepped.frozen, stepped.frozen.spec.n_agents
    policies, critics = params(stepped.before.policies), params(stepped.after.critics)
    # V(s) is that which Eq. (4) computed, before its own step.
    values = np.array([v_zeta(params(stepped.before.critics).value, s) for s in f.batch.state])
    beta = stepped.config.race.vmm_weight
    assert beta is not None

    def loss_of(agent: int) -> Callable[[Any], float]:
        def loss(encoder: Any) -> float:
            vfm = vfm_loss(encoder, policies.head, critics.critic, critics.pevfa, f)
            return vfm + beta * vmm_loss(encoder, policies.mine, values, f, agent)

        return loss

    vfm = vfm_loss(policies.encoder, policies.head, critics.critic, critics.pevfa, f)
    vmm = [vmm_loss(policies.encoder, policies.mine, values, f, i) for i in range(n)]
    np.testing.assert_allclose(stepped.policy_losses["vfm"], vfm, rtol=1e-4)
    np.testing.assert_allclose(stepped.policy_losses["vmm"], np.mean(vmm), rtol=1e-4)
    got = gradient_of(stepped.after.policies.encoder)
    for agent in range(n):
        # Each phi_i on its own loss, all else fixed.
        expected = numeric_gradient(loss_of(agent), policies.encoder)
        own = (jax.tree.map(lambda x, i=agent: x[i], tree) for tree in (got, expected))
        assert_gradients_equal(*own)


def test_marl_team_descends_equation_7_alone(stepped: Step) -> None:
    f = stepped.frozen
    policies, critics = params(stepped.before.policies), params(stepped.after.critics)

    def loss(head: np.ndarray) -> float:
        return marl_loss(policies.encoder, head, critics.critic, f)

    np.testing.assert_allclose(stepped.policy_losses["policy"], loss(policies.head), rtol=1e-4)
    assert_gradients_equal(
        gradient_of(stepped.after.policies.head), numeric_gradient(loss, policies.head)
    )


def test_mine_climbs_the_plain_bound_of_equation_3(stepped: Step) -> None:
    f, n = stepped.frozen, stepped.frozen.spec.n_agents
    policies = params(stepped.before.policies)

    def loss(mine: Any) -> float:
        bounds = [np.mean(signals(policies.encoder, mine, f.spec, f.batch, i)) for i in range(n)]
        return -float(np.sum(bounds))

    np.testing.assert_allclose(stepped.policy_losses["mine"], loss(policies.mine) / n, rtol=1e-4)
    assert_gradients_equal(
        gradient_of(stepped.after.policies.mine), numeric_gradient(loss, policies.mine)
    )


def test_population_and_bookkeeping_are_left_alone(stepped: Step) -> None:
    """But for the heads of the team of Eq. (2), where they climb its second term."""
    rate, f, before = stepped.config.race.head_learning_rate, stepped.frozen, stepped.before
    new, old = np.asarray(stepped.after.heads), np.asarray(before.heads)
    (place,) = (p for p, head in enumerate(float64(old)) if np.array_equal(head, f.team))
    encoder, pevfa = params(before.policies).encoder, params(stepped.after.critics).pevfa

    def value(head: np.ndarray) -> float:
        """Through its actions; the PeVFA goes on seeing the team that was drawn."""
        actions = [pi(encoder, head, f.spec, s) for s in f.batch.state]
        pairs = zip(f.batch.state, actions, strict=True)
        return float(np.mean([q_theta(pevfa, 0, f.spec, s, u, f.team) for s, u in pairs]))

    if rate:
        uphill = numeric_gradient(value, f.team)
        assert_gradients_equal((new[place] - f.team) / rate, uphill)
        assert np.array_equal(new[place] != old[place], uphill != 0)
    kept = np.arange(len(old)) != place if rate else slice(None)
    np.testing.assert_array_equal(new[kept], old[kept])
    both = with_heads(stepped.after, old).population, before.population
    for after, was in zip(*map(jax.tree.leaves, both), strict=True):
        assert jnp.array_equal(after, was)


def test_every_network_steps_along_its_gradient(stepped: Step) -> None:
    """Adam's first step is the learning rate against the gradient's sign."""
    hyper = stepped.config.learner
    rates = (hyper.actor_learning_rate,) * 2 + (hyper.critic_learning_rate,) * 4
    trained = zip(
        (*stepped.before.policies[:2], stepped.before.policies[2], *stepped.before.critics),
        (*stepped.after.policies[:2], stepped.after.policies[2], *stepped.after.critics),
        rates,
        strict=True,
    )
    for before, after, rate in trained:
        for old, new, g in zip(
            *map(jax.tree.leaves, (before.params, after.params, gradient_of(after))), strict=True
        ):
            large = np.abs(g) > 1e-4
            expected = np.asarray(old)[large] - rate * np.sign(g[large])
            np.testing.assert_allclose(np.asarray(new)[large], expected, atol=1e-6)


def test_targets_move_by_their_rate_towards_the_new_networks(stepped: Step) -> None:
    tau = stepped.config.learner.target_update_rate
    policies, critics = stepped.after.policies, stepped.after.critics
    online = (policies.encoder, policies.head, critics.critic, critics.pevfa)
    for old, new, trained in zip(stepped.before.target, stepped.after.target, online, strict=True):
        for o, n, p in zip(*map(jax.tree.leaves, (old, new, trained.params)), strict=True):
            np.testing.assert_allclose(n, (1 - tau) * o + tau * p, rtol=1e-5, atol=1e-7)


def test_teams_are_drawn_uniformly(
    stepped: Step, batch_of: Callable[..., Any], compiled: Callable[..., Any]
) -> None:
    spec, config = stepped.frozen.spec, stepped.config
    update = compiled(race, "update", spec, config)
    batch, n = batch_of(spec, B), config.race.population_size
    losses = [
        float(update(stepped.before, batch, jnp.int32(0), key)[1]["pevfa"])
        for key in jax.random.split(jax.random.key(8), 300)
    ]
    _, counts = np.unique(np.round(losses, 5), return_counts=True)
    assert len(counts) == n
    assert (np.abs(counts - 300 / n) < 5 * np.sqrt(300 / n)).all()


# --- the learner alone ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stepped_alone(
    stepped: Step,
    tiny_config: Callable[..., Config],
    batch_of: Callable[..., Any],
    compiled: Callable[..., Any],
) -> Any:
    """One step of the learner without a population, from the same networks and minibatch."""
    spec, b = stepped.frozen.spec, stepped.before
    plain = {"layer_norm": stepped.config.learner.layer_norm}
    config = tiny_config("marl", stepped.config.base, learner=plain)
    state = MarlState(
        b.policies.encoder,
        b.policies.head,
        b.critics.critic,
        MarlTargets(b.target.encoder, b.target.head, b.target.critic),
    )
    update = compiled(marl, "update", spec, config)
    return update(state, batch_of(spec, B), jnp.int32(1), jax.random.key(0))


def assert_trees_close(one: Any, two: Any) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)


def test_the_critic_and_the_marl_heads_learn_as_without_a_population(
    stepped: Step, stepped_alone: Any
) -> None:
    alone, critic_losses, policy_losses = stepped_alone
    after = stepped.after
    assert_trees_close(alone.critic, after.critics.critic)
    assert_trees_close(alone.head, after.policies.head)
    assert_trees_close(alone.target.critic, after.target.critic)
    assert_trees_close(alone.target.head, after.target.head)
    np.testing.assert_allclose(critic_losses["critic"], stepped.critic_losses["critic"], rtol=1e-5)
    np.testing.assert_allclose(policy_losses["policy"], stepped.policy_losses["policy"], rtol=1e-5)


def test_without_a_population_encoders_learn_from_the_marl_critic_alone(
    stepped: Step, stepped_alone: Any
) -> None:
    f = stepped.frozen
    policies, critics = params(stepped.before.policies), params(stepped.after.critics)
    assert_gradients_equal(
        gradient_of(stepped_alone[0].encoder),
        numeric_gradient(
            lambda e: marl_loss(e, policies.head, critics.critic, f), policies.encoder
        ),
    )


# --- target policy smoothing ------------------------------------------------------------------


def test_targets_of_both_critics_are_smoothed(
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
    batch_of: Callable[..., Any],
    compiled: Callable[..., Any],
) -> None:
    """Noise so strong that it is always clipped: each entry moves by +-0.5, then into [-1, 1].

    The losses seen must be those of one of the 8 noises per sample, whatever key drew it.
    """
    config = tiny_config(learner={"smoothing_noise": 1e3, "smoothing_clip": 0.5})
    before = separate(race.init(jax.random.key(11), tiny_spec, shape_of(config), hyper_of(config)))
    batch = batch_of(tiny_spec, 2)
    _, losses, _ = compiled(race, "update", tiny_spec, config)(
        before, batch, jnp.int32(0), jax.random.key(2)
    )
    noises = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))  # [8, U]
    critics = params(before.critics)
    still = np.zeros((2, 3))
    f = Frozen(
        tiny_spec, float64(batch), float64(before.target), np.zeros(()), 2, 0.99, (still, still)
    )

    def explanations(team: np.ndarray, which: int) -> list[float]:
        per_sample = []
        for noise in noises:
            both = np.stack([noise, noise])
            per_sample.append(targets_of(f._replace(team=team, noise=(both, both)))[which])
        found = []
        for first, second in itertools.product(range(8), repeat=2):
            y = np.array([per_sample[first][0], per_sample[second][1]])
            g = f._replace(team=team)
            if which == 0:
                found.append(critic_loss(critics.critic, g, y))
            else:
                found.append(pevfa_loss(critics.pevfa, g, y))
        return found

    heads = float64(before.heads)
    marl = explanations(heads[0], 0)
    assert np.isclose(marl, float(losses["critic"]), rtol=1e-5).any()
    fitting = [
        np.isclose(explanations(head, 1), float(losses["pevfa"]), rtol=1e-5).any() for head in heads
    ]
    assert sum(fitting) == 1
    # Unsmoothed targets explain neither.
    y = [targets_of(f._replace(team=head)) for head in heads]
    assert not np.isclose(critic_loss(critics.critic, f, y[0][0]), float(losses["critic"]))

"""What the learners of continuous actions add to the networks: ensembles, smoothing, pessimism."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config, LearnerConfig
from race.config.shape import shape_of
from race.learners import LEARNERS, facmac, learner_of
from race.learners.base import Learner
from race.learners.matd3 import smooth
from race.types import EnvSpec, Transition

KEY = jax.random.key(9)


@pytest.mark.parametrize(("base", "count"), [("matd3", 2), ("maddpg", 1), ("facmac", 1)])
def test_number_of_critics(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config], base: str, count: int
) -> None:
    learner, config = LEARNERS[base], tiny_config("race", base)
    state, action = jnp.ones((3, 4)), jnp.zeros((3, 3))
    critic = learner.init_critic(jax.random.key(0), tiny_spec, shape_of(config))
    pevfa = learner.init_pevfa(jax.random.key(1), tiny_spec, shape_of(config))
    head = learner.init_head(jax.random.key(2), tiny_spec, shape_of(config))
    encoder = learner.init_encoder(jax.random.key(3), tiny_spec, shape_of(config))
    q_marl = learner.q_marl(critic, state, action, tiny_spec)
    q_team = learner.q_team(pevfa, state, action, head, tiny_spec)
    assert q_marl.shape == q_team.shape == (count, 3)
    # Policies maximise the first critic alone.
    first = learner.q_marl(learner.first_critic(critic), state, action, tiny_spec)
    assert jnp.array_equal(first, q_marl[:1])
    first = learner.q_team(learner.first_pevfa(pevfa), state, action, head, tiny_spec)
    assert jnp.array_equal(first, q_team[:1])
    z = learner.encode(encoder, state, tiny_spec)
    assert learner.act(z, head, state, KEY, tiny_spec).shape == (3, 3)


@pytest.mark.parametrize("base", LEARNERS)
def test_heads_of_both_kinds_of_teams_are_one_per_agent(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config], base: str
) -> None:
    learner, config = LEARNERS[base], tiny_config("race", base)
    for init in (learner.init_head, learner.init_heads):
        assert init(KEY, tiny_spec, shape_of(config)).shape == (2, 5, 2)


@pytest.mark.parametrize("base", LEARNERS)
def test_targets_use_the_smallest_value(base: str) -> None:
    values = jnp.array([[1.0, 5.0, -2.0], [3.0, 4.0, -2.0]])
    assert LEARNERS[base].pessimistic(values).tolist() == [1.0, 4.0, -2.0]
    assert LEARNERS[base].pessimistic(values[:1]).tolist() == [1.0, 5.0, -2.0]


@pytest.mark.parametrize("base", LEARNERS)
def test_a_minibatch_is_its_transitions(
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
    batch_of: Callable[..., Transition],
    base: str,
) -> None:
    learner, config, batch = LEARNERS[base], tiny_config("race", base), batch_of(tiny_spec, 3)
    state, action, mask = learner.now(batch, tiny_spec)
    assert mask is None  # all are real
    assert jnp.array_equal(state, batch.state)
    assert jnp.array_equal(action, batch.action)
    assert jnp.array_equal(learner.later(batch, tiny_spec), batch.next_state)
    # The second sample terminated.
    y = learner.td_target(batch, jnp.array([10.0, 20.0, 30.0]), hyper_of(config))
    np.testing.assert_allclose(y, batch.reward + jnp.array([9.9, 0.0, 29.7]), rtol=1e-6)


@pytest.mark.parametrize(("base", "delay"), [("matd3", 2), ("maddpg", 1), ("facmac", 1)])
def test_policies_are_due_after_every_delay(
    tiny_config: Callable[..., Config], base: str, delay: int
) -> None:
    learner, config = LEARNERS[base], tiny_config("race", base)
    due = [bool(learner.policy_due(jnp.int32(step), shape_of(config))) for step in range(6)]
    assert due == [(step + 1) % delay == 0 for step in range(6)]


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("base", LEARNERS)
def test_a_configuration_names_its_learner(base: str, discrete: bool) -> None:
    if discrete and base != "facmac":
        pytest.skip("there is one learner of discrete actions")
    config = resolve(Config(task="t", base=base), discrete=discrete)  # type: ignore[arg-type]
    expected = facmac if discrete else LEARNERS[base]
    assert learner_of(shape_of(config)) is expected
    alone = resolve(Config(task="t", algo=base), discrete=discrete)  # type: ignore[arg-type]
    assert learner_of(shape_of(alone)) is expected


def smoothed(action: Any, **settings: float) -> np.ndarray:
    config = resolve(Config(task="t", learner=LearnerConfig(**settings)))  # type: ignore[arg-type]
    return np.asarray(smooth(action, jax.random.key(4), hyper_of(config)))


def test_smoothing_is_clipped_gaussian_noise() -> None:
    noise = smoothed(jnp.zeros((20_000, 1)), smoothing_noise=0.2, smoothing_clip=0.5)
    assert np.abs(noise).max() <= 0.5
    # Beyond 2.5 standard deviations lies 1.24 % of a Gaussian, all of it on the clip.
    np.testing.assert_allclose((np.abs(noise) == 0.5).mean(), 0.0124, atol=0.004)
    np.testing.assert_allclose(noise.std(), 0.2, rtol=0.03)
    assert abs(noise.mean()) < 5 * 0.2 / np.sqrt(20_000)


def test_smoothing_respects_the_actions_bounds() -> None:
    edges = jnp.array([[-1.0, 1.0]] * 200)
    noisy = smoothed(edges, smoothing_noise=0.2, smoothing_clip=0.5)
    assert noisy.min() == -1.0
    assert noisy.max() == 1.0
    assert noisy[:, 0].max() > -1.0


def test_smoothing_draws_each_entry_for_itself() -> None:
    noise = smoothed(jnp.zeros((50, 3)), smoothing_noise=0.1)
    assert len(np.unique(noise)) == 150


def actions(
    learner: Learner, spec: EnvSpec, config: Config, key: jax.Array
) -> tuple[np.ndarray, np.ndarray]:
    """A team's actions in 50 states, and those at which a target is evaluated."""
    encoder = learner.init_encoder(jax.random.key(1), spec, shape_of(config))
    head = learner.init_head(jax.random.key(2), spec, shape_of(config))
    state = jax.random.normal(jax.random.key(3), (50, spec.state_size))
    z = learner.encode(encoder, state, spec)
    plain = learner.act(z, head, state, key, spec)
    return np.asarray(plain), np.asarray(
        learner.target_action(z, head, state, key, spec, hyper_of(config))
    )


def test_matd3s_targets_are_at_smoothed_actions_of_the_policies(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config]
) -> None:
    config = tiny_config("race", "matd3", {"smoothing_noise": 0.2, "smoothing_clip": 0.3})
    plain, noisy = actions(LEARNERS["matd3"], tiny_spec, config, KEY)
    assert (np.abs(noisy - plain) < 0.3 + 1e-6).all()
    assert (noisy != plain).mean() > 0.99
    assert np.abs(noisy - plain).std() > 0.05
    again, other = (
        actions(LEARNERS["matd3"], tiny_spec, config, key)[1] for key in (KEY, jax.random.key(1))
    )
    assert np.array_equal(again, noisy)
    assert not np.array_equal(other, noisy)


@pytest.mark.parametrize("base", ["maddpg", "facmac"])
def test_maddpg_and_facmac_are_neither_smoothed_nor_delayed(tiny_spec: EnvSpec, base: str) -> None:
    config = resolve(Config(task="t", algo=base))  # type: ignore[arg-type]
    plain, target = actions(LEARNERS[base], tiny_spec, config, KEY)
    assert np.array_equal(plain, target)
    assert config.learner.policy_delay == shape_of(config).policy_delay == 1

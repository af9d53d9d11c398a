"""What MATD3 and MADDPG add to the networks: ensembles, smoothing, pessimism."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.config import Config, LearnerConfig
from race.learners import LEARNERS, matd3
from race.presets import resolve
from race.types import EnvSpec


@pytest.mark.parametrize(("base", "count"), [("matd3", 2), ("maddpg", 1)])
def test_number_of_critics(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config], base: str, count: int
) -> None:
    learner, hyper = LEARNERS[base], tiny_config("race", base).learner
    state, action = jnp.ones((3, 4)), jnp.zeros((3, 3))
    critic = learner.init_critic(jax.random.key(0), tiny_spec, hyper)
    pevfa = learner.init_pevfa(jax.random.key(1), tiny_spec, hyper, 3)
    head = learner.init_head(jax.random.key(2), tiny_spec, hyper)
    encoder = learner.init_encoder(jax.random.key(3), tiny_spec, hyper)
    q_marl = learner.q_marl(critic, state, action)
    q_team = learner.q_team(pevfa, tiny_spec, state, action, head)
    assert q_marl.shape == q_team.shape == (count, 3)
    # Policies maximise the first critic alone.
    first = learner.q_marl(learner.first_critic(critic), state, action)
    assert jnp.array_equal(first, q_marl[:1])
    first = learner.q_team(learner.first_pevfa(pevfa), tiny_spec, state, action, head)
    assert jnp.array_equal(first, q_team[:1])
    assert learner.act(learner.encode(encoder, tiny_spec, state), head, tiny_spec).shape == (3, 3)


@pytest.mark.parametrize("base", LEARNERS)
def test_targets_use_the_smallest_value(base: str) -> None:
    values = jnp.array([[1.0, 5.0, -2.0], [3.0, 4.0, -2.0]])
    assert LEARNERS[base].pessimistic(values).tolist() == [1.0, 4.0, -2.0]
    assert LEARNERS[base].pessimistic(values[:1]).tolist() == [1.0, 5.0, -2.0]


def smoothed(action: Any, **settings: float) -> np.ndarray:
    config = LearnerConfig(**settings)  # type: ignore[arg-type]
    return np.asarray(matd3.smooth(action, jax.random.key(4), config))


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


def test_maddpg_is_neither_smoothed_nor_delayed() -> None:
    hyper = resolve(Config(task="t", algo="maddpg")).learner
    action = jnp.full((3, 2), 0.3)
    smooth = LEARNERS["maddpg"].smooth(action, jax.random.key(0), hyper)
    assert jnp.array_equal(smooth, action)
    assert hyper.policy_delay == 1

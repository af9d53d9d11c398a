"""What is learned from is scaled, and what is told is not."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from race.config.checks import check_env
from race.config.presets import resolve
from race.config.settings import Config, EnvConfig, LearnerConfig
from race.envs import make_continuous_task
from race.errors import ConfigError
from race.rollouts.transitions import TransitionRollouts, scaled
from race.types import Transition


@pytest.mark.parametrize("scale", [1.0, 0.5, 40.0])
def test_random_steps_are_scaled(scale: float) -> None:
    learner = LearnerConfig(random_steps=24, hidden_sizes=(4, 4), batch_size=2)
    config = Config(
        task="probe/time-limit",
        algo="matd3",
        env_steps=100,
        learner=learner,
        env=EnvConfig(reward_scale=scale),
    )
    config = resolve(config, discrete=False)
    task = make_continuous_task(config.task)
    with TransitionRollouts(config, task) as rollouts:
        found = rollouts.warm_up(
            config, rollouts.empty_replay(config), lambda steps: None, lambda: False
        )
    assert found is not None
    replay: Any = found[0]
    assert found[1] == int(replay.inserted) == 24
    np.testing.assert_array_equal(replay.data.reward[:24], np.float32(scale))


def test_rewards_alone_are_scaled() -> None:
    steps = Transition(*(np.arange(3, dtype=np.float32) for _ in Transition._fields))
    assert scaled(steps, 1.0) is steps
    found = scaled(steps, 0.5)
    assert found.reward.tolist() == [0, 0.5, 1]
    assert found.reward.dtype == np.float32
    assert all(getattr(found, n) is getattr(steps, n) for n in steps._fields if n != "reward")


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), 1e9])
def test_scales_that_cannot_be(scale: float) -> None:
    with pytest.raises(ConfigError, match=r"--env\.reward-scale is"):
        check_env(dataclasses.replace(EnvConfig(), reward_scale=scale))

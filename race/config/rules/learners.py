"""What the values of the gradient learners' settings must be."""

from typing import Any

import numpy as np

from race.config.rules import MOST_TRANSITIONS, Rule
from race.config.settings import Config, FacmacConfig, LearnerConfig


def rules(config: Config) -> list[Rule]:
    """Of a resolved configuration."""
    n_episodes = config.n_teams * (config.discrete and config.has_marl)
    return [
        *_of_transitions(config.learner),
        *_start_rules("learner", config.learner),
        *_start_rules("facmac", config.facmac),
        *_of_episodes(config.facmac, n_episodes),
    ]


def _of_transitions(learner: LearnerConfig) -> list[Rule]:
    return [
        (min(learner.hidden_sizes) >= 1, "learner.hidden-sizes", learner.hidden_sizes, "positive"),
        (learner.batch_size >= 2, "learner.batch-size", learner.batch_size, "at least 2"),
        (
            learner.replay_capacity <= MOST_TRANSITIONS,
            "learner.replay-capacity",
            learner.replay_capacity,
            f"at most {MOST_TRANSITIONS}",
        ),
        (
            learner.batch_size <= learner.replay_capacity,
            "learner.batch-size",
            learner.batch_size,
            f"no larger than the replay buffer (learner.replay-capacity {learner.replay_capacity})",
        ),
        (
            max(learner.random_steps, 1) <= learner.replay_capacity,
            "learner.random-steps",
            learner.random_steps,
            f"no larger than the replay buffer (learner.replay-capacity {learner.replay_capacity})",
        ),
        (learner.random_steps >= 0, "learner.random-steps", learner.random_steps, "0 or more"),
        (
            learner.actor_learning_rate > 0,
            "learner.actor-learning-rate",
            learner.actor_learning_rate,
            "above 0",
        ),
        (
            learner.critic_learning_rate > 0,
            "learner.critic-learning-rate",
            learner.critic_learning_rate,
            "above 0",
        ),
        (learner.gradient_clip > 0, "learner.gradient-clip", learner.gradient_clip, "above 0"),
        (0 <= learner.discount < 1, "learner.discount", learner.discount, "in [0, 1)"),
        (
            0 < learner.target_update_rate <= 1,
            "learner.target-update-rate",
            learner.target_update_rate,
            "in (0, 1]",
        ),
        (learner.policy_delay >= 1, "learner.policy-delay", learner.policy_delay, "at least 1"),
        (
            learner.exploration_noise >= 0,
            "learner.exploration-noise",
            learner.exploration_noise,
            "0 or more",
        ),
        (
            learner.smoothing_noise >= 0,
            "learner.smoothing-noise",
            learner.smoothing_noise,
            "0 or more",
        ),
        (
            learner.smoothing_clip >= 0,
            "learner.smoothing-clip",
            learner.smoothing_clip,
            "0 or more",
        ),
        (
            0 < learner.gradient_steps_per_env_step <= 100,
            "learner.gradient-steps-per-env-step",
            learner.gradient_steps_per_env_step,
            "in (0, 100]",
        ),
    ]


def _start_rules(group: str, settings: LearnerConfig | FacmacConfig) -> list[Rule]:
    rate, scale = settings.encoder_learning_rate, settings.last_layer_scale
    return [
        (rate is None or rate > 0, f"{group}.encoder-learning-rate", rate, "above 0"),
        (scale > 0, f"{group}.last-layer-scale", scale, "above 0"),
    ]


def _of_episodes(facmac: FacmacConfig, n_teams: int) -> list[Rule]:
    sizes: dict[str, Any] = {
        "mixer-size": facmac.mixer_size,
        "hypernet-size": facmac.hypernet_size,
        "hidden-size": facmac.hidden_size,
        "utility-sizes": facmac.utility_sizes,
        "value-size": facmac.value_size,
        "target-update-every": facmac.target_update_every,
        "epsilon-steps": facmac.epsilon_steps,
    }
    positive = {
        "actor-learning-rate": facmac.actor_learning_rate,
        "critic-learning-rate": facmac.critic_learning_rate,
        "gradient-clip": facmac.gradient_clip,
    }
    shares = {
        "td-lambda": facmac.td_lambda,
        "epsilon-start": facmac.epsilon_start,
        "epsilon-finish": facmac.epsilon_finish,
    }
    rules: list[Rule] = [
        (np.min(size) >= 1, name, size, "at least 1") for name, size in sizes.items()
    ]
    rules += [(rate > 0, name, rate, "above 0") for name, rate in positive.items()]
    rules += [(0 <= share <= 1, name, share, "in [0, 1]") for name, share in shares.items()]
    rules += [
        (facmac.batch_size >= 2, "batch-size", facmac.batch_size, "at least 2"),
        (
            max(facmac.batch_size, n_teams) <= facmac.replay_capacity,
            "replay-capacity",
            facmac.replay_capacity,
            f"at least a minibatch (facmac.batch-size {facmac.batch_size}) and an episode of each "
            f"team ({n_teams})",
        ),
        (
            facmac.replay_capacity <= MOST_TRANSITIONS,
            "replay-capacity",
            facmac.replay_capacity,
            f"at most {MOST_TRANSITIONS}",
        ),
        (0 <= facmac.discount < 1, "discount", facmac.discount, "in [0, 1)"),
        (
            0 < facmac.gradient_steps_per_episode <= 100,
            "gradient-steps-per-episode",
            facmac.gradient_steps_per_episode,
            "in (0, 100]",
        ),
    ]
    return [(bool(holds), f"facmac.{name}", value, must) for holds, name, value, must in rules]

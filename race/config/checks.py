"""What values of a configuration can work."""

import json
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from race.config import numbers
from race.config.settings import (
    EVOLUTIONS,
    Config,
    EnvConfig,
    FacmacConfig,
    LearnerConfig,
    RaceConfig,
)
from race.errors import ConfigError

LARGEST_LAYER = 16_384
"""Units of a layer, samples of a batch, teams: more is a slip of the hand."""
MOST_TRANSITIONS = 2**30
"""Transitions in a replay buffer, which counts them with 32 bits."""
MOST_KEPT = 1000
"""Best teams of a run."""
MOST_JUDGED = 1000
"""Generations whose returns are kept of a team."""
MOST_OBSERVED = 2**20
"""Entries of what an agent observes: networks are dense."""
MOST_JOINTS = 1000
"""Joints between an agent and what it observes: no robot has as many."""


Rule = tuple[bool, str, Any, str]
"""Whether it holds, the setting, its value, and what it must be."""


def check(config: Config) -> None:
    """Checks every value of a configuration whose presets are filled in.

    Raises:
        ConfigError: naming the first setting that cannot work, and what would.
    """
    learner, race, facmac = config.learner, config.race, config.facmac
    fewest = 3 + race.elite_copy + config.has_marl
    assert race.vmm_weight is not None
    assert config.evaluation.every is not None
    assert config.evaluation.episodes is not None
    if config.discrete and config.base != "facmac":
        raise ConfigError(
            f"{config.method} does not work on {config.task}: its actions are discrete, which "
            "facmac alone learns to choose. Use --algo facmac, or --algo race with --base facmac."
        )
    rules: list[Rule] = [
        (1 <= config.env_steps < 2**31, "env-steps", config.env_steps, "from 1 to 2147483647"),
        (
            config.discrete or not config.has_marl or config.env_steps > learner.random_steps,
            "env-steps",
            config.env_steps,
            f"more than the random steps before training (learner.random-steps "
            f"{learner.random_steps})",
        ),
        (0 <= config.seed < 2**31, "seed", config.seed, "from 0 to 2147483647"),
        (min(learner.hidden_sizes) >= 1, "learner.hidden-sizes", learner.hidden_sizes, "positive"),
        (learner.batch_size >= 2, "learner.batch-size", learner.batch_size, "at least 2"),
        (
            learner.replay_capacity <= MOST_TRANSITIONS,
            "learner.replay-capacity",
            learner.replay_capacity,
            f"at most {MOST_TRANSITIONS}",
        ),
        *(
            (size <= LARGEST_LAYER, f"{name}", size, f"at most {LARGEST_LAYER}")
            for name, size in (
                ("learner.hidden-sizes", max(learner.hidden_sizes)),
                ("learner.batch-size", learner.batch_size),
                ("facmac.mixer-size", facmac.mixer_size),
                ("facmac.hypernet-size", facmac.hypernet_size),
                ("facmac.hidden-size", facmac.hidden_size),
                ("facmac.utility-sizes", max(facmac.utility_sizes)),
                ("facmac.value-size", facmac.value_size),
                ("facmac.batch-size", facmac.batch_size),
                ("race.policy-embedding-size", race.policy_embedding_size),
                ("race.mine-size", race.mine_size),
                ("race.population-size", race.population_size),
                ("evaluation.episodes", config.evaluation.episodes),
            )
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
        *_start_rules("learner", learner),
        *_start_rules("facmac", facmac),
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
        (
            1 <= race.marl_episodes <= LARGEST_LAYER,
            "race.marl-episodes",
            race.marl_episodes,
            f"from 1 to {LARGEST_LAYER}",
        ),
        *_facmac_rules(facmac, config.n_teams * (config.discrete and config.has_marl)),
        (
            race.evolution in EVOLUTIONS or ":" in race.evolution,
            "race.evolution",
            race.evolution,
            f"{', '.join(EVOLUTIONS)}, or package.module:function for your own",
        ),
        (race.population_size >= 3, "race.population-size", race.population_size, "at least 3"),
        (
            race.evolution != "ga" or race.population_size >= fewest,
            "race.population-size",
            race.population_size,
            f"at least {fewest}: an elite, a second parent, "
            f"{'a copy of the elite, ' * race.elite_copy}a team for their offspring"
            f"{' and one for the injected MARL team' * config.has_marl} ({fewest - 1} do with "
            f"--race.no-elite-copy; for no population use --algo {config.base})",
        ),
        (
            not (config.whole_teams and learner.shared_agents),
            "learner.shared-agents",
            learner.shared_agents,
            "False where whole teams evolve: each of their agents has an encoder of its own",
        ),
        (
            0 <= race.surrogate_probability <= 1,
            "race.surrogate-probability",
            race.surrogate_probability,
            "from 0 to 1",
        ),
        *_fitness_rules(race),
        (race.surrogate_steps >= 1, "race.surrogate-steps", race.surrogate_steps, "at least 1"),
        (race.evolution_from >= 0, "race.evolution-from", race.evolution_from, "0 or more"),
        (
            race.own_share is None or 0 <= race.own_share <= 1,
            "race.own-share",
            race.own_share,
            "from 0 to 1, or None for what the replay buffer holds",
        ),
        (
            not config.one_head or race.evolution != "ga" or race.crossover != "agent",
            "race.crossover",
            race.crossover,
            "parameter or layer with --race.team-heads shared: a team's only head can be exchanged "
            "for another's, which makes a copy, but not in part",
        ),
        *_population_rules(race),
        (
            config.whole_teams or race.vfm_marl_weight + race.vfm_team_weight + race.vmm_weight > 0,
            "race.vmm-weight",
            race.vmm_weight,
            "above 0 where the weights of both terms of Eq. (2) are 0, since encoders would learn "
            "from nothing",
        ),
        *_env_rules(config.env),
        (config.evaluation.every >= 1, "evaluation.every", config.evaluation.every, "at least 1"),
        (
            config.evaluation.episodes >= 1,
            "evaluation.episodes",
            config.evaluation.episodes,
            "at least 1",
        ),
        (
            config.checkpoint.minutes >= 0,
            "checkpoint.minutes",
            config.checkpoint.minutes,
            "0 or more",
        ),
        (config.checkpoint.keep >= 1, "checkpoint.keep", config.checkpoint.keep, "at least 1"),
        (
            0 <= config.checkpoint.keep_best <= MOST_KEPT,
            "checkpoint.keep-best",
            config.checkpoint.keep_best,
            f"from 0 to {MOST_KEPT}",
        ),
        *numbers.rules(config),
    ]
    _refuse(rules)


def _refuse(rules: Iterable[Rule]) -> None:
    for holds, name, value, must in rules:
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"--{name} is {value}, but it must be a finite number.")
        if not holds:
            raise ConfigError(f"--{name} is {value}, but it must be {must}.")


def check_env(env: EnvConfig) -> None:
    """Checks the settings of environments, before any is made.

    Raises:
        ConfigError: naming the first setting that cannot work, and what would.
    """
    _refuse(_env_rules(env))


def _env_rules(env: EnvConfig) -> list[Rule]:
    return [
        (
            0 <= env.agent_obsk <= MOST_JOINTS,
            "env.agent-obsk",
            env.agent_obsk,
            f"0 to {MOST_JOINTS}",
        ),
        (0 <= env.retries <= 1000, "env.retries", env.retries, "0 to 1000"),
        (
            0 < env.reward_scale <= 1e6,
            "env.reward-scale",
            env.reward_scale,
            "above 0, at most 1000000",
        ),
        (
            env.step_seconds is None or 0 < env.step_seconds <= 1e6,
            "env.step-seconds",
            env.step_seconds,
            "above 0, at most 1000000, or None for no limit",
        ),
        (
            env.step_seconds is None or env.processes is not False,
            "env.step-seconds",
            env.step_seconds,
            "left out with --env.processes False: only a process of its own can be ended",
        ),
        (
            _is_object(env.kwargs),
            "env.kwargs",
            env.kwargs,
            """a JSON object, such as '{"N": 4}' with the shell's quotes around it""",
        ),
        (
            env.python is None or env.python.strip() != "",
            "env.python",
            "empty",
            "the path of a Python interpreter, or left out for this one",
        ),
        (
            all(part.strip() for part in env.agents.split(",")),
            "env.agents",
            env.agents or "empty",
            "patterns of agents' names, such as 'adversary_*' or 'agent_0,agent_1'",
        ),
        (
            env.others == "random" or env.others.count(":") == 1,
            "env.others",
            env.others or "empty",
            "random, or package.module:function",
        ),
        (
            env.episode_limit is None or 1 <= env.episode_limit <= MOST_TRANSITIONS,
            "env.episode-limit",
            env.episode_limit,
            "at least 1, or None for the environment's own",
        ),
        (
            1 <= env.largest_observation <= MOST_OBSERVED,
            "env.largest-observation",
            env.largest_observation,
            f"1 to {MOST_OBSERVED}",
        ),
    ]


def _is_object(text: str) -> bool:
    try:
        return isinstance(json.loads(text), dict)
    except (ValueError, RecursionError):
        return False


def _start_rules(group: str, settings: LearnerConfig | FacmacConfig) -> list[Rule]:
    rate, scale = settings.encoder_learning_rate, settings.last_layer_scale
    return [
        (rate is None or rate > 0, f"{group}.encoder-learning-rate", rate, "above 0"),
        (scale > 0, f"{group}.last-layer-scale", scale, "above 0"),
    ]


def _fitness_rules(race: RaceConfig) -> list[Rule]:
    episodes, generations = race.fitness_episodes, race.fitness_generations
    exact = race.surrogate_probability == 0
    return [
        (
            episodes >= 1 and episodes * race.population_size <= LARGEST_LAYER,
            "race.fitness-episodes",
            episodes,
            f"at least 1, and at most {LARGEST_LAYER} over all teams of the population",
        ),
        (
            episodes == 1 or exact,
            "race.fitness-episodes",
            episodes,
            "1 with --race.surrogate-probability above 0, which judges teams by one beginning each",
        ),
        (
            1 <= generations <= MOST_JUDGED,
            "race.fitness-generations",
            generations,
            f"from 1 to {MOST_JUDGED}",
        ),
        (
            generations == 1 or exact,
            "race.fitness-generations",
            generations,
            "1 with --race.surrogate-probability above 0: estimates of some generations and "
            "returns of others have no meaning together",
        ),
        (
            generations == 1 or race.head_learning_rate == 0,
            "race.fitness-generations",
            generations,
            "1 with --race.head-learning-rate above 0: teams that learn do not stay what they were",
        ),
    ]


def _population_rules(race: RaceConfig) -> list[Rule]:
    shares = (
        *("mutation_fraction", "mutation_probability", "agent_mutation_probability"),
        *("crossover_probability", "injection_probability", "value_awareness"),
        *("strong_share", "reset_share", "cem_elite_share", "cem_noise_decay"),
    )
    not_negative = (
        *("vmm_weight", "vfm_marl_weight", "vfm_team_weight", "head_learning_rate"),
        *("strong_strength", "mild_strength", "cem_noise_start", "cem_noise_end"),
    )
    above_0 = ("es_noise", "es_learning_rate")
    positive = ("tournament_size", "policy_embedding_size", "mine_size")
    value = race.__getattribute__
    rules: list[Rule] = [(0 <= value(name) <= 1, name, value(name), "in [0, 1]") for name in shares]
    rules += [(value(name) >= 0, name, value(name), "0 or more") for name in not_negative]
    rules += [(value(name) > 0, name, value(name), "above 0") for name in above_0]
    rules += [(value(name) >= 1, name, value(name), "at least 1") for name in positive]
    largest, total = race.largest_weight, race.strong_share + race.reset_share
    rules += [
        (total <= 1, "reset_share", race.reset_share, "at most 1 together with the strong share"),
        (largest is None or largest > 0, "largest_weight", largest, "above 0, or None"),
    ]
    return [(holds, f"race.{name.replace('_', '-')}", x, must) for holds, name, x, must in rules]


def _facmac_rules(facmac: FacmacConfig, n_teams: int) -> list[Rule]:
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

"""What the values of environments' settings must be."""

import json

from race.config.rules import MOST_TRANSITIONS, Rule
from race.config.settings import EnvConfig

MOST_OBSERVED = 2**20
"""Entries of what an agent observes: networks are dense."""
MOST_JOINTS = 1000
"""Joints between an agent and what it observes: no robot has as many."""


def rules(env: EnvConfig) -> list[Rule]:
    """Of any environment."""
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

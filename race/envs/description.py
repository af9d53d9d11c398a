"""A task as metadata.json records it, and whether it is still the one that was recorded."""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from race.errors import TaskError
from race.types import AnyTask, DiscreteTask


def describe(task: AnyTask) -> dict[str, Any]:
    """Who sees what and moves what."""
    if isinstance(task, DiscreteTask):
        return dataclasses.asdict(task.spec) | dict(task.facts)
    spec = task.spec
    return {
        "task": spec.task,
        "agents": spec.n_agents,
        "obs_sizes": spec.obs_sizes,
        "action_sizes": spec.action_sizes,
        "state_size": spec.state_size,
        "episode_limit": spec.episode_limit,
        "obs_index": spec.obs_index,
        "action_index": spec.action_index,
    } | dict(task.facts)


def refuse_changed(recorded: Mapping[str, Any], task: AnyTask) -> None:
    """Refuses a task that is not what a run began with: its networks would mean something else.

    Args:
        recorded: what `describe` said then, read back from JSON; what is missing is not compared.
        task: the task of now.

    Raises:
        TaskError: naming what differs.
    """
    now = json.loads(json.dumps(describe(task)))
    for name, value in now.items():
        if name in recorded and recorded[name] != value:
            raise TaskError(
                f"The task {task.spec.task} is not what it was when the run began: its {name} was "
                f"{recorded[name]} and is {value} now. Use the task, and the versions in "
                "metadata.json, that the run began with, or begin a new run."
            )

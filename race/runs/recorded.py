"""A run as readers of results see it, and which runs are the same experiment."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

from race.config.effects import NETWORKS
from race.config.saved import flat
from race.config.settings import Config


class Recorded(NamedTuple):
    """What is known of a run without its checkpoints."""

    name: str
    """Where it lies, or lay when it was archived."""
    config: Config
    rows: list[dict[str, Any]]
    metadata: dict[str, Any]
    place: Path | None = None
    """The run's directory, where it still is; None of a run from an archive."""

    @property
    def algorithm_version(self) -> int:
        """`race.ALGORITHM_VERSION` of the version that began it."""
        told = self.metadata.get("algorithm_version", 1)
        return told if type(told) is int else 1

    @property
    def experiment(self) -> str:
        """Equal for runs that are the same experiment with other seeds or lengths."""
        return experiment_key(self.config, self.algorithm_version)


def settings(config: Config) -> dict[str, Any]:
    """What makes two runs the same experiment: everything but seed, length and bookkeeping.

    Groups of settings that the method has no use for have no say.
    """
    kept = dataclasses.asdict(config)
    # Ablations are names for settings that are there anyway.
    for name in ("seed", "env_steps", "checkpoint", "ablation"):
        del kept[name]
    if kept["init_from"] is None:
        del kept["init_from"]
    for name in ("processes", "retries", "step_seconds"):
        del kept["env"][name]
    if not config.has_population:
        del kept["race"]
    if config.discrete:
        del kept["learner"]
    elif config.base != "facmac":
        del kept["facmac"]
    if not config.has_marl:
        for group, used in NETWORKS.items():
            if group in kept:
                kept[group] = {name: kept[group][name] for name in used}
    return flat(kept)


def experiment_key(config: Config, algorithm_version: int) -> str:
    """A digest of task, method, settings and version of the algorithm, as 12 hex digits."""
    text = json.dumps([settings(config), algorithm_version], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]

"""Runs of a plan that are there already, wherever they are kept."""

from collections.abc import Mapping, Sequence

from race import ALGORITHM_VERSION
from race.config.settings import Config
from race.runs.recorded import Recorded, experiment_key


def known_of(runs: Mapping[str, Config], kept: Sequence[Recorded]) -> dict[str, Recorded]:
    """Those runs of a plan that are among others, by their names in the plan.

    The same run is the same experiment by this version of the algorithm, with the same seed and
    length, that went to its end.

    Args:
        runs: the plan.
        kept: runs from directories or archives; of two that are the same, the first counts.
    """
    complete: dict[tuple[str, int, int], Recorded] = {}
    for run in kept:
        steps = run.config.env_steps
        if max((row.get("env_steps", 0) for row in run.rows), default=0) >= steps:
            complete.setdefault((run.experiment, run.config.seed, steps), run)
    known: dict[str, Recorded] = {}
    for name, config in runs.items():
        key = experiment_key(config, ALGORITHM_VERSION)
        found = complete.get((key, config.seed, config.env_steps))
        if found is not None:
            known[name] = found
    return known

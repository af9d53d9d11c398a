"""The rows of ``metrics.jsonl``."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from race.algorithms import Algorithm
from race.algorithms.base import Losses
from race.algorithms.lineage import OPERATORS, rows
from race.config.settings import Config
from race.rollouts.base import Score
from race.training.run_state import Progress


def generation_row(
    config: Config, algorithm: Algorithm, learned: Any, losses: Losses, progress: Progress
) -> dict[str, Any]:
    """What a generation did: fitness, fate of injected teams, lineage, mean losses, speed.

    Returns are those of training: the MARL team explores in them. Rates are those of the whole
    run so far; they are None before the first injected team has met its fate, or the first child
    of an operator has played. ``teams`` tells of each team of the population where it came from.
    """
    steps = progress.gradient_steps - progress.gradient_steps_before
    delay = config.policy_delay
    policy_steps = progress.gradient_steps // delay - progress.gradient_steps_before // delay
    row: dict[str, Any] = {"kind": "generation", **_counters(progress)}
    if progress.marl_return is not None:
        row["marl/return"] = progress.marl_return
    if progress.fitness:
        if config.race.surrogate_probability:
            row["population/surrogate"] = progress.estimated
        row["population/fitness_max"] = max(progress.fitness)
        row["population/fitness_mean"] = sum(progress.fitness) / len(progress.fitness)
        row["population/fitness_min"] = min(progress.fitness)
    population = algorithm.population(learned)
    if population is not None:
        if config.has_marl:
            fates = np.asarray(population.injection_counts).tolist()
            for name, count in zip(("elite", "parent", "discarded"), fates, strict=True):
                row[f"injection/{name}_rate"] = count / sum(fates) if sum(fates) else None
        record = population.record
        counts = (np.asarray(column).tolist() for column in (record.children, record.better))
        # Estimates do not compare with returns of the generation before.
        alike = config.race.surrogate_probability == 0
        for name, children, better in zip(OPERATORS, *counts, strict=True):
            rate = better / children if children and alike else None
            row[f"operators/{name}_better_rate"] = rate
        if progress.fitness:
            row["teams"] = rows(record.played, progress.fitness)
            for team, returns in zip(row["teams"], progress.returns, strict=False):
                team["returns"] = list(returns)
    for name, total in losses.items():
        count = policy_steps if name in algorithm.policy_losses else steps
        row[f"loss/{name}"] = float(total) / count if count else None
    env_steps = progress.env_steps - progress.env_steps_before
    seconds = max(progress.generation_seconds, 1e-9)
    row["time/env_steps_per_second"] = env_steps / seconds
    row["time/rollout_fraction"] = progress.rollout_seconds / seconds
    return row


def evaluation_row(progress: Progress, scores: Mapping[str, Score]) -> dict[str, Any]:
    """Test results of the MARL team, the champion, the selected of the two, and the best.

    Selected is the one with the better training return: no test result has a say in it. Best is
    the one with the better test result, of wins where there are any to be had, which is what the
    paper's figures show; being the larger of two noisy numbers it is biased upwards.
    """
    row: dict[str, Any] = {"kind": "evaluation", **_counters(progress)}
    best = max(scores.values(), key=lambda score: (score.win_rate or 0.0, score.mean))
    named = {**scores, "selected": scores[progress.selected], "best": best}
    for name, score in named.items():
        row[f"eval/{name}/return_mean"] = score.mean
        row[f"eval/{name}/return_std"] = score.std
        row[f"eval/{name}/length_mean"] = float(score.lengths.mean())
        if score.win_rate is not None:
            row[f"eval/{name}/win_rate"] = score.win_rate
    return row


def lost_row(progress: Progress) -> dict[str, Any]:
    """The first row of new metrics, where those before were lost."""
    said = "The rows before this one were lost; the run went on without them."
    return {"kind": "note", **_counters(progress), "note": said}


def _counters(progress: Progress) -> dict[str, Any]:
    names = ("generation", "env_steps", "gradient_steps", "wall_seconds")
    counters = {name: getattr(progress, name) for name in names}
    repeated = {"env/repeated_episodes": progress.repeated} if progress.repeated else {}
    return counters | repeated

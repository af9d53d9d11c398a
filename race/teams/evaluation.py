"""Test episodes of a trained team, outside training."""

import contextlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from race.errors import ConfigError
from race.rollouts import rollouts_of
from race.rollouts.base import Score, Trial
from race.teams.trained import Trained

MOST_EPISODES = 1_000_000
BATCH = 32
"""Episodes played at the same time."""


@dataclass(frozen=True)
class Evaluation:
    """What a team came to in test episodes."""

    task: str
    method: str
    env_steps: int
    """Steps that the run had made."""
    team: str
    """What was asked for."""
    played: str
    """``marl`` or ``champion``."""
    seed: int
    score: Score

    @property
    def mean(self) -> float:
        """Mean return."""
        return self.score.mean

    @property
    def std(self) -> float:
        """Standard deviation of the returns over episodes."""
        return self.score.std

    @property
    def win_rate(self) -> float | None:
        """Share of the episodes that were won; None where a task cannot be won."""
        return self.score.win_rate

    def to_json(self) -> dict[str, Any]:
        """All of it as plain JSON values."""
        score = self.score
        return {
            "task": self.task,
            "method": self.method,
            "env_steps": self.env_steps,
            "team": self.team,
            "played": self.played,
            "seed": self.seed,
            "episodes": len(score.returns),
            **({} if score.win_rate is None else {"win_rate": score.win_rate}),
            "return_mean": score.mean,
            "return_std": score.std,
            "return_min": float(score.returns.min()),
            "return_max": float(score.returns.max()),
            "length_mean": float(score.lengths.mean()),
            "returns": score.returns.tolist(),
        }


def check_asked(episodes: int, seed: int) -> None:
    """Refuses numbers of episodes and seeds that cannot be.

    Raises:
        ConfigError: naming which.
    """
    if not 1 <= episodes <= MOST_EPISODES:
        raise ConfigError(
            f"--episodes is {episodes}, but it must be at least 1 and at most {MOST_EPISODES}."
        )
    if not 0 <= seed < 2**63:
        raise ConfigError(f"--seed is {seed}, but it must be from 0 to {2**63 - 1}.")


def evaluate(
    trained: Trained,
    team: str = "selected",
    episodes: int = 10,
    seed: int = 0,
    advance: Callable[[int], None] = lambda episodes: None,
) -> Evaluation:
    """Plays test episodes, without exploration. The same seed plays the same episodes.

    Args:
        trained: the teams of a run.
        team: ``marl``, ``champion`` or ``selected``.
        episodes: how many to play.
        seed: of the episodes.
        advance: told whenever some have been played.

    Raises:
        ConfigError: if the run has no such team, or for numbers that cannot be.
        TaskError: if an environment fails.
    """
    check_asked(episodes, seed)
    name = trained.resolve(team)
    seeds = np.random.SeedSequence(seed).generate_state(episodes).astype(np.int64)
    parts: list[Score] = []
    with (
        contextlib.redirect_stdout(sys.stderr),  # what environments print is no result
        rollouts_of(trained.config, trained.task, proven=True) as rollouts,
    ):
        for start in range(0, episodes, BATCH):
            batch = seeds[start : start + BATCH]
            heads = {name: trained.heads[name]}
            trial = Trial(trained.encoders[name], heads, batch, trained.scaling)
            parts.append(rollouts.test([trial])[0][name])
            advance(len(batch))
    wins = [part.won for part in parts if part.won is not None]
    score = Score(
        np.concatenate([part.returns for part in parts]),
        np.concatenate([part.lengths for part in parts]),
        np.concatenate(wins) if wins else None,
    )
    config = trained.config
    steps = trained.progress.env_steps
    return Evaluation(config.task, config.method, steps, team, name, seed, score)

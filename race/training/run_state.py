"""The state of a run: everything that changes, and the numbers its programs take."""

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

from race.algorithms import Algorithm
from race.algorithms.base import Losses
from race.config.hyper import Hyper, hyper_of
from race.config.settings import Config
from race.config.shape import shape_of
from race.errors import CheckpointError, DivergenceError, RunDirectoryError
from race.method.normalisation import Observed, Scaling, nothing_observed, scaling_of
from race.networks.optimization import copy
from race.programs import empty_losses, start
from race.randomness import Purpose, root_key
from race.replay.buffer import Replay
from race.types import Spec


@dataclass(frozen=True)
class Progress:
    """How far a run is, as plain numbers (JSON holds it exactly)."""

    env_steps: int = 0
    """Steps of all teams, the random ones included."""
    random_steps: int = 0
    """Steps of the warm-up."""
    gradient_steps: int = 0
    episodes: int = 0
    """Episodes of all teams, without those of the warm-up."""
    stored: int = 0
    """Those of them that went into the replay buffer, or would if anything were learned."""
    generation: int = 0
    """Generations begun."""
    learning: bool = False
    """Whether the current generation has been rolled out, as far as it has, and its gradient steps
    are under way."""
    played: tuple[float, ...] = ()
    """Where teams take turns, training returns of those that have played in the current generation,
    until all have."""
    gradient_steps_before: int = 0
    """Gradient steps before the current generation."""
    env_steps_before: int = 0
    """Environment steps before the current generation."""
    fitness: tuple[float, ...] = ()
    """Training returns of the population in the newest generation, or what it was judged by in
    place of them; empty without one."""
    returns: tuple[tuple[float, ...], ...] = ()
    """The returns whose means these are, of each team's episodes, the oldest first; empty where
    settings ask for one episode of one generation."""
    marl_return: float | None = 0.0
    """Training return of the MARL team in the newest generation, the mean of its episodes; None
    where there is no such team."""
    estimated: bool = False
    """Whether the population of the newest generation was judged by beginnings of episodes."""
    evaluated_at: int = 0
    """``env_steps`` of the newest evaluation."""
    wall_seconds: float = 0.0
    """Wall time of the run so far, without the time it was interrupted."""
    generation_seconds: float = 0.0
    """Wall time of the current generation so far."""
    rollout_seconds: float = 0.0
    """Part of it that went into rollouts and their bookkeeping."""
    repeated: int = 0
    """Episodes that were begun anew because an environment failed."""
    metrics_offset: int = 0
    """Bytes of ``metrics.jsonl`` when the checkpoint was written."""

    @property
    def selected(self) -> str:
        """Of the MARL team and the champion, the one with the better training return.

        A champion of which no whole episode is known is not selected. Where fitness is the mean of
        several returns, it is what counts.
        """
        if self.marl_return is None:
            return "champion"
        if self.estimated or not self.fitness:
            return "marl"
        return "champion" if max(self.fitness) > self.marl_return else "marl"

    @property
    def times(self) -> dict[str, float]:
        """What a `race.training.clock.Clock` goes on from."""
        return {
            "wall_seconds": self.wall_seconds,
            "generation_seconds": self.generation_seconds,
            "rollout_seconds": self.rollout_seconds,
        }

    def but(self, **changes: Any) -> "Progress":
        """The same with some values changed."""
        return dataclasses.replace(self, **changes)


def test_due(config: Config, progress: Progress) -> bool:
    """Whether a test is what comes next, after a generation."""
    every = config.evaluation.every
    assert every is not None
    if progress.learning or progress.generation == 0:
        return False
    passed = progress.env_steps // every > progress.evaluated_at // every
    last = progress.env_steps >= config.env_steps
    return passed or (last and progress.evaluated_at < progress.env_steps)


def is_over(config: Config, progress: Progress) -> bool:
    """Whether the budget is used up, the last generation complete and its teams tested."""
    made = progress.env_steps >= config.env_steps and not progress.learning
    return made and not test_due(config, progress)


class RunState(NamedTuple):
    """All of a run that changes."""

    algorithm: Any
    losses: Losses  # sums over the gradient steps of the current generation
    replay: Replay
    progress: Progress
    hyper: Hyper
    observed: Observed | None = None  # where observations are normalised

    @property
    def scaling(self) -> Scaling | None:
        """How networks are shown what environments show; None: as it is."""
        return None if self.observed is None else scaling_of(self.observed)


Outcome = RunState | DivergenceError | RunDirectoryError | CheckpointError
"""What became of a run in a piece of a generation: its state, or what ended it."""


def statics(config: Config, spec: Spec, algorithm: Algorithm) -> dict[str, Any]:
    """The static arguments of the compiled programs."""
    return {"algorithm": algorithm, "spec": spec, "shape": shape_of(config)}


def fresh(config: Config, spec: Spec, algorithm: Algorithm, replay: Replay) -> RunState:
    """The state before the first step, with an empty buffer."""
    key = root_key(config.seed, Purpose.INIT)
    return RunState(
        algorithm=copy(start(key, hyper=hyper_of(config), **statics(config, spec, algorithm))),
        losses=empty_losses(algorithm),
        replay=replay,
        progress=Progress(),
        hyper=hyper_of(config),
        observed=nothing_observed(spec) if config.env.normalise else None,
    )

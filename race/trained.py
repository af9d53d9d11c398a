"""Trained teams, read back from a run directory, ready to act."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from race import checkpoints, run_directory
from race.algorithms import algorithm_of
from race.algorithms.base import Teams, tested_teams
from race.config import Config, TeamName
from race.envs import make_task
from race.errors import ConfigError, RunDirectoryError
from race.programs import act
from race.run_directory import RunDirectory
from race.run_state import Progress, learned_of, progress_of
from race.types import AnyTask, Task


class Trained(NamedTuple):
    """The teams of a run's newest checkpoint."""

    config: Config
    task: AnyTask
    progress: Progress
    encoder: Any
    heads: dict[str, Float[Array, "N H1 A"]]  # "marl" and, with a population, "champion"

    def resolve(self, team: TeamName) -> str:
        """``marl`` or ``champion``: what ``selected`` stands for by the training returns.

        Raises:
            ConfigError: if the run has no such team.
        """
        name = self.progress.selected if team == "selected" else team
        if name not in self.heads:
            raise ConfigError(
                f"A run of {self.config.method} has no population and so no champion; ask for "
                "--team marl or --team selected, which are the same there."
            )
        return name

    def policy(self, team: TeamName) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
        """The team as a function from a state [S] to a joint action [U] in [-1, 1].

        For tasks with continuous actions.
        """
        assert isinstance(self.task, Task), "recurrent teams need more than the state"
        teams = Teams(self.encoder, self.heads[self.resolve(team)][None])
        spec, base = self.task.spec, str(self.config.base)

        def choose(state: NDArray[np.float32]) -> NDArray[np.float32]:
            return np.asarray(act(teams, state[None], spec=spec, base=base))[0]

        return choose


def load_trained(path: Path) -> Trained:
    """The teams in the newest checkpoint of the run in ``path``.

    Raises:
        RunDirectoryError: if ``path`` holds no run, or one without a checkpoint.
        CheckpointError: if the checkpoint is damaged.
    """
    config = run_directory.open_run(path)
    newest = checkpoints.newest(RunDirectory(path).checkpoints)
    if newest is None:
        raise RunDirectoryError(
            f"The run in {path} has no checkpoint yet. Wait for its first one, or go on with it: "
            f"race resume {path}"
        )
    saved = checkpoints.load(newest, tables=False)
    task, algorithm = make_task(config.task, config.env), algorithm_of(config)
    state = learned_of(saved, config, task.spec, algorithm)["algorithm"]
    encoder, heads = tested_teams(algorithm, state, task.spec, config.has_population)
    return Trained(config, task, progress_of(saved), encoder, heads)

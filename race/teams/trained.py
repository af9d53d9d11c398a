"""Trained teams, read back from a run directory, ready to act."""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, final, get_args

import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike, NDArray

from race.algorithms import algorithm_of
from race.algorithms.base import Teams
from race.config.settings import Config, TeamName
from race.envs import contract, make_task
from race.envs.description import refuse_changed
from race.errors import ConfigError, HandedOverError, RunDirectoryError, command
from race.method.normalisation import Observed, Scaling, scaling_of
from race.programs import act
from race.rollouts.choosing import blank, choose
from race.runs import checkpoints, team_files
from race.runs import directory as run_directory
from race.runs.checkpoints import Checkpoint
from race.runs.directory import RunDirectory
from race.training.keeping import kept_teams
from race.training.run_state import Progress
from race.training.saving import check_owner, looked_at, observed_of, one_of, progress_of
from race.types import AnyTask, DiscreteSpec, DiscreteTask, Observation, Task

_choose = jax.jit(choose)


class Trained(NamedTuple):
    """The teams of one of a run's checkpoints, or one that it kept."""

    path: Path
    """The run's directory."""
    identity: str | None
    """Of the run."""
    config: Config
    task: AnyTask
    progress: Progress
    encoders: dict[str, Any]  # by team, which may share them
    heads: dict[str, Float[Array, "N H1 A"]]  # "marl" and "champion", as far as there are such
    kept: str | None = None
    """The name of the one team of the best that this is; None of a checkpoint."""
    observed: Observed | None = None
    """What the run's teams had seen by then, where observations are normalised."""

    @property
    def scaling(self) -> Scaling | None:
        """How the teams' networks are shown what environments show; None: as it is."""
        return None if self.observed is None else scaling_of(self.observed)

    def acting(self, name: str) -> Teams:
        """A team, ``marl`` or ``champion``, as programs take it."""
        return Teams(self.encoders[name], self.heads[name][None], scaling=self.scaling)

    def resolve(self, team: str) -> str:
        """``marl`` or ``champion``: what ``selected`` stands for by the training returns.

        Raises:
            ConfigError: if the run has no such team.
        """
        if team not in get_args(TeamName):
            raise ConfigError(
                f"There is no team {team!r}: a run's teams are {', '.join(get_args(TeamName))}."
            )
        name = self.progress.selected if team == "selected" else team
        if name not in self.heads:
            (only,) = self.heads
            if team == "selected":
                return only
            if self.kept is not None:
                raise ConfigError(
                    f"{self.kept} is the {only} team alone; leave the team out, or name a "
                    "checkpoint, which holds all."
                )
            lacks = "population and so no champion" if only == "marl" else "MARL team"
            raise ConfigError(
                f"A run of {self.config.method} has no {lacks}; ask for --team {only} or --team "
                "selected, which are the same there."
            )
        return name

    def policy(self, team: str) -> Callable[[ArrayLike], NDArray[np.float32]]:
        """The team as a function from a state [S] to a joint action [U] in [-1, 1].

        The function raises `HandedOverError` for what an environment of the task may not show:
        another shape, or an entry that is not finite.

        Raises:
            ConfigError: if the run has no such team, or its task has discrete actions.
        """
        if not isinstance(self.task, Task):
            raise ConfigError(
                f"{self.config.task} has discrete actions, and its teams remember: they are "
                "played by recurrent_policy."
            )
        name = self.resolve(team)
        teams = self.acting(name)
        spec, base = self.task.spec, str(self.config.base)

        def joint_action(state: ArrayLike) -> NDArray[np.float32]:
            with _told(spec.task):
                seen = contract.state(spec, state)
            return np.asarray(act(teams, seen[None], spec=spec, base=base))[0]

        return joint_action

    def recurrent_policy(self, team: str) -> "RecurrentPolicy":
        """The team as it plays tasks with discrete actions.

        Raises:
            ConfigError: if the run has no such team, or its task has continuous actions.
        """
        if not isinstance(self.task, DiscreteTask):
            raise ConfigError(f"{self.config.task} has continuous actions: call policy instead.")
        name = self.resolve(team)
        return RecurrentPolicy(self.acting(name), self.task.spec)


@final
class RecurrentPolicy:
    """A team that chooses discrete actions and remembers what it saw. It does not explore.

    Call `reset` before every further episode.
    """

    def __init__(self, teams: Teams, spec: DiscreteSpec) -> None:
        self._teams, self._spec = teams, spec
        self.reset()

    def reset(self) -> None:
        """Forgets the episode."""
        self._memory = blank(self._teams)

    def __call__(self, obs: ArrayLike, avail_actions: ArrayLike) -> NDArray[np.int32]:
        """The next actions of all agents [N], out of those available.

        Args:
            obs: what each agent observes now, [N, O].
            avail_actions: which actions each can take, [N, A], at least one.

        Raises:
            HandedOverError: for what an environment of the task may not show: another shape, an
                entry that is not finite, a mask of something else than 0 and 1, no action.
        """
        # Teams choose by what agents observe; the state is for the learner alone.
        state = np.zeros(self._spec.state_size, np.float32)
        shown = {"obs": obs, "state": state, "avail_actions": avail_actions}
        with _told(self._spec.task):
            moment = contract.moment(self._spec, shown)
        seen = Observation(*(column[None] for column in moment))
        self._memory, action = _choose(self._teams, self._memory, seen, np.int32(0), None)
        return np.asarray(action)[0]


@contextlib.contextmanager
def _told(task: str) -> Iterator[None]:
    try:
        yield
    except HandedOverError as error:
        raise HandedOverError(
            f"The team was shown what no environment of {task} may show: {error}."
        ) from error


def load_trained(path: str | os.PathLike[str], checkpoint: str | None = None) -> Trained:
    """The teams of the run in ``path``.

    Args:
        path: the run's directory.
        checkpoint: the name of one of its checkpoints, such as ``step-000000012000``; of a team
            in ``best``, such as ``step-000000012000-champion``; or ``best``, the best of these.
            None: the newest checkpoint.

    Raises:
        RunDirectoryError: if ``path`` holds no run, or no such checkpoint.
        CheckpointError: if the checkpoint is damaged.
    """
    path = Path(path)
    config = run_directory.open_run(path)
    place = _place(path, checkpoint)
    identity = run_directory.identity_of(path)
    saved = _team_of(place) if place.is_file() else checkpoints.load(place, tables=False)
    check_owner(saved, identity)
    task, algorithm = make_task(config.task, config.env), algorithm_of(config)
    refuse_changed(run_directory.recorded_task(path), task)
    progress, observed = progress_of(saved), observed_of(saved, config, task.spec)
    if place.is_file():
        name, kept = str(saved.info["team"]), place.name.removesuffix(team_files.SUFFIX)
        encoder, head = one_of(saved, name, config, task.spec, algorithm)
        teams = ({name: encoder}, {name: head})
        return Trained(path, identity, config, task, progress, *teams, kept, observed)
    groups = algorithm.tested(looked_at(saved, config, task.spec, algorithm), task.spec)
    encoders = {name: group.encoder for group in groups for name in group.heads}
    heads = {name: head for group in groups for name, head in group.heads.items()}
    return Trained(path, identity, config, task, progress, encoders, heads, None, observed)


def names_of_checkpoints(path: Path) -> list[str]:
    """What `load_trained` finds in a run's directory by name, oldest first, then the best teams."""
    found = checkpoints.list_checkpoints(RunDirectory(path).checkpoints)
    return [place.name for place in found] + [kept.name for kept in kept_teams(path)]


def _place(path: Path, checkpoint: str | None) -> Path:
    run = RunDirectory(path)
    if checkpoint is None:
        newest = checkpoints.newest(run.checkpoints)
        if newest is None:
            raise RunDirectoryError(
                f"The run in {path} has no checkpoint yet. Wait for its first one, or go on with "
                "it: " + command("race", "resume", path)
            )
        return newest
    best = kept_teams(path)
    if checkpoint == "best" and best:
        return best[0].path
    if checkpoint == "best":
        raise RunDirectoryError(
            f"The run in {path} has kept no best teams: it keeps them if it is trained with "
            "--checkpoint.keep-best 3."
        )
    names = names_of_checkpoints(path)
    if checkpoint not in names:
        there = f"there are {', '.join(names)}" if names else "there is none yet"
        raise RunDirectoryError(
            f"The run in {path} has no checkpoint {checkpoint!r}; {there}. --checkpoint.keep says "
            "how many a run keeps."
        )
    of_best = {kept.name: kept.path for kept in best}
    return of_best.get(checkpoint, run.checkpoints / checkpoint)


def _team_of(file: Path) -> Checkpoint:
    arrays, info = team_files.read(file)
    return Checkpoint(file, arrays, info, {})

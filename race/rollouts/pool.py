"""Environments of one task, here or in processes, replaced where they fail."""

import functools
import os
import time
from collections.abc import Callable, Mapping
from typing import Any, Final, final

import numpy as np

from race.closing import Closing
from race.compilation import cores
from race.envs.checked import CheckedEnv
from race.envs.contract import Seen, Step
from race.envs.worker import EnvProcess, Request
from race.errors import EnvFailedError, TaskError, say
from race.types import AnyTask, Task

_TIMED_STEPS: Final = 50

# What processes cost a tick, measured with environments without physics on two cores: 0.22 ms for
# one environment, 0.32 for 2, 0.38 for 4, 0.65 for 8 (pipes and waking up), against 0.03 to 0.04 ms
# in this process.
_TICK_OVERHEAD: Final = 160e-6
_ENV_OVERHEAD: Final = 60e-6
_MOST_PROCESSES: Final = 16
"""Environments beyond so many, or the number of cores, share processes."""


@final
class EnvPool(Closing):
    """Environments of one task, one for each of some teams; they are made when they are needed.

    In this process they are stepped one after the other; with processes, each environment has one
    of its own, or some share one where there are many. What they give is the same, to the bit. Use
    it in a ``with`` statement, or call `close`.

    Worker processes start afresh and import what they need. A script that uses them needs the
    usual ``if __name__ == "__main__":``.

    An environment that fails (an error, a dead process, no answer in time) after the task has
    shown that it works is no end of a run: `reset` and `step` give the error instead of an answer,
    and the next reset of that team makes a fresh environment.

    Attributes:
        task: the task.
        spec: its sizes.
        size: most environments at once.
        retries: how often an episode is begun anew before its failure is raised.
        proven: whether an episode of the task has been played to its end.
        repeated: episodes begun anew so far.
    """

    def __init__(
        self,
        task: AnyTask,
        size: int,
        processes: bool | None = None,
        *,
        usual: int | None = None,
        retries: int = 0,
        step_seconds: float | None = None,
        proven: bool = False,
    ) -> None:
        """Makes nothing yet.

        Args:
            task: the task.
            size: most environments at once.
            processes: whether each runs in a process of its own. None: if steps have a time limit;
                else where it pays, by a quick timing of the physics and the number of cores.
            usual: how many environments work at most times; None: all.
            retries: how often an episode is begun anew.
            step_seconds: longest time of a step, in processes.
            proven: whether an episode of the task has been played to its end, in an earlier part
                of the run.
        """
        if size < 1:
            raise ValueError(f"A pool needs at least one environment, not {size}.")
        self.task, self.size = task, size
        self.spec: Any = task.spec
        self.retries, self.proven, self.repeated = retries, proven, 0
        self._asked, self._usual = processes, usual or size
        self._step_seconds = step_seconds
        self._here: dict[int, CheckedEnv] = {}
        self._workers: dict[int, EnvProcess] = {}
        self._together = -(-size // max(_MOST_PROCESSES, _cores()))  # of a process

    @functools.cached_property
    def processes(self) -> bool:
        """Whether the environments run in processes."""
        if self._asked is not None:
            return self._asked
        pays = isinstance(self.task, Task) and _processes_pay(self.task, self._usual)
        return self._step_seconds is not None or pays

    def reset(self, seeds: Mapping[int, int]) -> dict[int, Seen | EnvFailedError]:
        """Begins an episode for each of some teams.

        Args:
            seeds: by the teams' numbers, below `size`.

        Returns:
            What each sees, or the error.

        Raises:
            EnvFailedError: if an environment fails whose episode is not to be repeated.
            HandedOverError: if what it shows breaks the contract.
        """
        if seeds and not 0 <= min(seeds) <= max(seeds) < self.size:
            raise ValueError(
                f"This pool has {self.size} environments, but {len(seeds)} were asked."
            )
        found = self._make(seeds)
        here = {team: seed for team, seed in seeds.items() if team not in found}
        self._ask("reset", here)
        for team, seed in here.items():
            try:
                worker = self._workers.get(team)
                found[team] = worker.answer(team) if worker else self._here[team].reset(seed)
            except EnvFailedError as error:
                found[team] = self._noted(team, error)
        return found

    def step(self, actions: Mapping[int, Any]) -> dict[int, Step | EnvFailedError]:
        """A step of each of some teams.

        Args:
            actions: by the teams' numbers, as `CheckedEnv.step` takes them.

        Returns:
            What each brought, or the error.

        Raises:
            EnvFailedError: if an environment fails whose episode is not to be repeated.
            HandedOverError: if what it answers breaks the contract.
        """
        self._ask("step", actions)
        found: dict[int, Step | EnvFailedError] = {}
        for team, action in actions.items():
            try:
                worker = self._workers.get(team)
                found[team] = worker.answer(team) if worker else self._here[team].step(action)
            except EnvFailedError as error:
                found[team] = self._noted(team, error)
        return found

    def begin_again(self, failures: Mapping[int, EnvFailedError], attempt: int) -> None:
        """Agrees to a further attempt at some episodes, and says so the first time.

        Args:
            failures: how they failed.
            attempt: the number of the attempt to come, from 1.

        Raises:
            EnvFailedError: the failure, if there have been as many attempts as allowed.
        """
        for error in failures.values():
            if attempt > self.retries:
                often = f"{self.retries} time{'s' * (self.retries != 1)}"
                raise EnvFailedError(
                    f"{error} The episode was begun anew {often} (--env.retries), to no avail."
                ) from error
            if self.repeated == 0:
                say(f"{error} The episode is repeated in a fresh environment, as all that fail so.")
            self.repeated += 1

    def close(self) -> None:
        """Closes all environments and ends their processes; says what fails then."""
        failures: list[TaskError] = []
        open_ones: list[CheckedEnv | EnvProcess] = [*self._here.values()]
        open_ones += dict.fromkeys(self._workers.values())
        self._here.clear()
        self._workers.clear()
        while open_ones:
            failures += _close(open_ones.pop().close)
        if failures:
            more = f" So did {len(failures) - 1} more." if len(failures) > 1 else ""
            say(f"{failures[0]}{more} What was done before is not affected.")

    def _make(self, teams: Mapping[int, int]) -> dict[int, Seen | EnvFailedError]:
        """Makes the missing environments of some teams; returns the errors."""
        found: dict[int, Seen | EnvFailedError] = {}
        for team in [team for team, worker in self._workers.items() if worker.ended]:
            del self._workers[team]
        missing = [t for t in teams if t not in self._here and t not in self._workers]
        if self.processes:
            for team in missing:
                self._workers[team] = self._process_for(team)
            self._ask("make", dict.fromkeys(missing))
        for team in missing:
            try:
                if self.processes:
                    self._workers[team].answer(team)
                else:
                    self._here[team] = CheckedEnv(self.task, team)
            except EnvFailedError as error:
                found[team] = self._noted(team, error)
        return found

    def _process_for(self, team: int) -> EnvProcess:
        """The process of a team's neighbours, or a new one."""
        first = team - team % self._together
        beside = (self._workers.get(first + i) for i in range(self._together))
        there = [worker for worker in beside if worker is not None]
        return there[0] if there else EnvProcess(self.task, self._step_seconds)

    def _ask(self, what: Request, values: Mapping[int, Any]) -> None:
        """One message to each process."""
        parts: dict[EnvProcess, dict[int, Any]] = {}
        for team, value in values.items():
            if team in self._workers:
                parts.setdefault(self._workers[team], {})[team] = value
        for worker, part in parts.items():
            worker.ask(what, part)

    def _noted(self, team: int, error: EnvFailedError) -> EnvFailedError:
        """Puts the environment of a failure away."""
        if not self.proven or self.retries == 0:
            raise error
        worker, env = self._workers.pop(team, None), self._here.pop(team, None)
        if env is not None:
            _close(env.close)
        elif worker is not None and worker not in self._workers.values():
            _close(worker.close)
        return error


def _close(close: Callable[[], None]) -> list[TaskError]:
    # An environment that cannot be closed must not hide what went wrong before, nor keep others
    # open, nor spoil a run that is complete.
    try:
        close()
    except TaskError as error:
        return [error]
    return []


def _cores() -> int:
    return len(cores()) or os.cpu_count() or 1


def _processes_pay(task: Task, size: int) -> bool:
    """Whether a tick takes clearly less time in processes (by a quarter or more).

    With a core for each environment and one for the policies, or several environments to each of
    many cores: with two cores, four
    HumanoidStandups (0.4 ms a step) took 1.8 ms a tick in processes and 1.6 ms without. With
    enough cores, six environments pay from about 0.15 ms a step: Ant and the humanoids, but not
    HalfCheetah or Hopper.
    """
    workers = min(size, _cores() - 1)
    if size < 2 or workers < 2 or (workers < size <= _MOST_PROCESSES):
        return False
    step = _seconds_per_step(task)
    longest = -(-size // workers) * step
    return _TICK_OVERHEAD + size * _ENV_OVERHEAD + longest < 0.75 * size * step


def _seconds_per_step(task: Task) -> float:
    middle = (np.array(task.spec.action_low) + np.array(task.spec.action_high)) / 2
    action = middle.astype(np.float32)
    env = CheckedEnv(task)
    seconds = []
    try:
        env.reset(0)
        for _ in range(_TIMED_STEPS):
            begin = time.perf_counter()
            step = env.step(action)
            seconds.append(time.perf_counter() - begin)
            if step.terminated or step.truncated:
                env.reset(0)
    finally:
        _close(env.close)
    return float(np.median(seconds))

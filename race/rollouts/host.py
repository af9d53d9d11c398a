"""Episodes on the host: one environment per team, one batched call of the policies per tick."""

import functools
import multiprocessing
import os
import signal
import time
import warnings
from collections.abc import Callable
from types import TracebackType
from typing import Any, Final, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from race.errors import DivergenceError, TaskError, described
from race.types import EnvSpec, Rollout, Task, Transition

Act = Callable[[NDArray[np.float32], int], Any]
"""``act(states [T, S], tick) -> actions [T, U]`` between -1 and 1, as a NumPy or JAX array."""

_FIRST_ROWS: Final = 65536  # memory that is never written costs nothing
_TIMED_STEPS: Final = 50

# What gymnasium.vector.AsyncVectorEnv costs a tick, measured with environments without physics
# on two cores: 0.22 ms for one environment, 0.32 for 2, 0.38 for 4, 0.65 for 8 (pipes and waking
# up), against 0.03 to 0.04 ms in this process.
_TICK_OVERHEAD: Final = 160e-6
_ENV_OVERHEAD: Final = 60e-6


@final
class EnvPool:
    """Environments of one task, one for each of `size` teams.

    In this process they are stepped one after the other; with processes, each environment has
    one of its own. Rollouts are the same, to the bit. Use it in a ``with`` statement, or call
    `close`.

    Worker processes start afresh and import what they need, because a process in which JAX runs
    threads must not be forked. A script that uses them needs the usual
    ``if __name__ == "__main__":``.

    Attributes:
        spec: the task's factorisation.
        size: number of environments.
        processes: whether they run in processes.
    """

    def __init__(self, task: Task, size: int, processes: bool | None = None) -> None:
        """Makes the environments.

        Args:
            task: the task.
            size: number of environments.
            processes: whether each runs in a process of its own. None: where it pays, by a quick
                timing of the physics and the number of cores.
        """
        if size < 1:
            raise ValueError(f"A pool needs at least one environment, not {size}.")
        self.spec: EnvSpec = task.spec
        self.size = size
        self._envs: list[gymnasium.Env[Any, Any]] = []
        self._workers: gymnasium.vector.AsyncVectorEnv | None = None
        if processes is None:
            processes = _processes_pay(task, size)
        self.processes = processes
        if processes:
            make = functools.partial(_make_in_worker, task.make)
            # Results of an episode that has ended are ignored, so that it does no harm that its
            # environment begins another one.
            self._workers = gymnasium.vector.AsyncVectorEnv(
                [make] * size,
                copy=False,
                context="forkserver",
                autoreset_mode=gymnasium.vector.AutoresetMode.NEXT_STEP,
            )
        else:
            self._envs = [task.make(None) for _ in range(size)]

    def reset(self, seeds: NDArray[np.int64]) -> NDArray[np.float32]:
        """Begins an episode in each of the first T environments; [T] -> states [T, S]."""
        teams = len(seeds)
        if not 1 <= teams <= self.size:
            raise ValueError(f"This pool has {self.size} environments, but {teams} seeds came.")
        states = np.empty((teams, self.spec.state_size), np.float32)
        team = None
        try:
            if self._workers is not None:
                all_seeds = [*seeds.tolist(), *[0] * (self.size - teams)]
                states[:] = self._workers.reset(seed=all_seeds)[0][:teams]
            for team, env in enumerate(self._envs[:teams]):
                states[team] = env.reset(seed=int(seeds[team]))[0]
        except Exception as error:
            raise self._failed(error, "reset", team) from error
        return states

    def step(
        self,
        alive: NDArray[np.intp],
        actions: NDArray[np.float32],
        next_states: NDArray[np.float32],
        rewards: NDArray[np.float64],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
    ) -> None:
        """Steps the environments of the teams `alive` (L of them), and writes what they answer.

        Args:
            alive: teams whose episode goes on, [L].
            actions: joint actions of all teams in the environment's units, [T, U].
            next_states: to be written, [L, S].
            rewards: to be written, [L].
            terminated: to be written, [L].
            truncated: to be written, [L].
        """
        team: int | None = None
        try:
            if self._workers is not None:
                everyone = np.empty((self.size, actions.shape[1]), np.float32)
                everyone[:] = (np.array(self.spec.action_low) + self.spec.action_high) / 2
                everyone[alive] = actions[alive]
                states, *outcome, _ = self._workers.step(everyone)
                next_states[:] = states[alive]
                for target, values in zip((rewards, terminated, truncated), outcome, strict=True):
                    target[:] = values[alive]
                return
            for row, team in enumerate(alive.tolist()):
                state, reward, ended, cut, _ = self._envs[team].step(actions[team])
                next_states[row] = state
                rewards[row], terminated[row], truncated[row] = reward, ended, cut
        except Exception as error:
            raise self._failed(error, "step", team) from error

    def close(self) -> None:
        """Closes the environments and ends their processes, also in the middle of a step."""
        envs, self._envs = self._envs, []
        for env in envs:
            env.close()
        workers, self._workers = self._workers, None
        if workers is not None:
            with warnings.catch_warnings():
                # After Ctrl-C a step is still pending, which is why everything ends here.
                warnings.filterwarnings("ignore", message=".*Calling `close` while waiting.*")
                workers.close(terminate=True)

    def _failed(self, error: Exception, what: str, team: int | None) -> TaskError:
        which = f" (environment {team})" if team is not None else ""
        return TaskError(
            f"The environment of {self.spec.task} failed in its {what}{which}: "
            f"{described(error)}. Its states must have "
            f"{self.spec.state_size} entries, its rewards be numbers."
        )

    def __enter__(self) -> "EnvPool":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def collect(
    pool: EnvPool, act: Act, seeds: NDArray[np.int64], max_ticks: int | None = None
) -> Rollout:
    """One episode per team, all teams in step with each other.

    Args:
        pool: at least T environments.
        act: called once a tick with the states of all teams [T, S] and the tick (0, 1, ...);
            returns their joint actions [T, U] between -1 and 1, which are clipped to it. Rows of
            teams whose episode has ended are ignored; their states stay as they were at the end.
        seeds: for each team, the seed of its environment's reset, [T].
        max_ticks: steps after which running episodes are cut (not terminated), if that is before
            the task's own limit.

    Returns:
        Transitions in order of tick, then team; actions as `act` gave them, clipped. Rewards and
        states are as the environment gave them, be they finite or not.

    Raises:
        DivergenceError: if a running team's action is not finite.
        TaskError: if an environment fails.
    """
    spec = pool.spec
    teams = len(seeds)
    low = np.array(spec.action_low, np.float32)
    high = np.array(spec.action_high, np.float32)
    episode_return = np.zeros(teams, np.float64)
    episode_length = np.zeros(teams, np.int64)
    longest = spec.episode_limit if max_ticks is None else min(max_ticks, spec.episode_limit)
    rows = _rows(min(teams * max(longest, 1), _FIRST_ROWS), spec)
    count = tick = 0
    states = pool.reset(seeds)
    alive = np.arange(teams)
    limit = spec.episode_limit if max_ticks is None else min(max_ticks, spec.episode_limit)
    while alive.size and tick < limit:
        actions = np.asarray(act(states, tick), np.float32)
        if actions.shape != (teams, spec.joint_action_size):
            raise ValueError(
                f"The policy of {spec.task} returned actions of shape {actions.shape} instead of "
                f"{(teams, spec.joint_action_size)}."
            )
        if not np.isfinite(actions[alive]).all():
            raise DivergenceError(
                f"A policy of {spec.task} produced an action that is not a finite number, at step "
                f"{tick} of an episode: its networks have diverged. Lower the learning rates "
                "(--learner.actor-learning-rate, --learner.critic-learning-rate) or go back to an "
                "earlier checkpoint."
            )
        actions = np.clip(actions, -1, 1)
        while count + alive.size > len(rows.reward):
            rows = _doubled(rows)
        here = slice(count, count + alive.size)
        next_states = np.empty((alive.size, spec.state_size), np.float32)
        rewards = np.empty(alive.size, np.float64)
        terminated, truncated = np.empty((2, alive.size), np.bool_)
        pool.step(alive, in_units(actions, low, high), next_states, rewards, terminated, truncated)
        rows.state[here] = states[alive]
        rows.action[here] = actions[alive]
        rows.reward[here] = rewards
        rows.terminated[here] = terminated
        rows.next_state[here] = next_states
        episode_return[alive] += rewards
        episode_length[alive] += 1
        # A fresh array, because `act` may still hold the old one: JAX does not always copy.
        states = states.copy()
        states[alive] = next_states
        count += alive.size
        alive = alive[~(terminated | truncated)]
        tick += 1
    return Rollout(Transition(*(array[:count] for array in rows)), episode_return, episode_length)


def in_units(
    actions: NDArray[np.float32], low: NDArray[np.float32], high: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Actions between -1 and 1 to the environment's units, in float32; [..., U] -> [..., U].

    A range around 0 is scaled by one exact product, so that a policy means the same as in the
    environment's own units.
    """
    shifted = np.clip(low + (actions + 1) / 2 * (high - low), low, high)
    return np.where(low == -high, actions * high, shifted)


def _rows(count: int, spec: EnvSpec) -> Transition:
    return Transition(
        state=np.empty((count, spec.state_size), np.float32),
        action=np.empty((count, spec.joint_action_size), np.float32),
        reward=np.empty(count, np.float32),
        terminated=np.empty(count, np.float32),
        next_state=np.empty((count, spec.state_size), np.float32),
    )


def _doubled(rows: Transition) -> Transition:
    def doubled(array: Any) -> NDArray[np.float32]:
        larger = np.empty((2 * len(array), *array.shape[1:]), np.float32)
        larger[: len(array)] = array
        return larger

    return Transition(*map(doubled, rows))


def _make_in_worker(
    make: Callable[[str | None], gymnasium.Env[Any, Any]],
) -> gymnasium.Env[Any, Any]:
    # AsyncVectorEnv also makes one environment in the main process, to ask for its spaces.
    if multiprocessing.parent_process() is not None:
        # Ctrl-C reaches every process of a terminal; the main one ends its workers in order.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return _WithoutInfo(make(None))


@final
class _WithoutInfo(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Drops the info, whose way through the pipe costs more than the state's."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        return self.env.reset(**options)[0], {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        state, reward, terminated, truncated, _ = self.env.step(action)
        return state, reward, terminated, truncated, {}


def _processes_pay(task: Task, size: int) -> bool:
    """Whether a tick takes clearly less time in processes (by a quarter or more).

    Only with a core for each environment and one for the policies: with two cores, four
    HumanoidStandups (0.4 ms a step) took 1.8 ms a tick in processes and 1.6 ms without. With
    enough cores, six environments pay from about 0.15 ms a step: Ant and the humanoids, but not
    HalfCheetah or Hopper.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if size < 2 or (cores or 1) <= size:
        return False
    step = _seconds_per_step(task)
    return _TICK_OVERHEAD + size * _ENV_OVERHEAD + step < 0.75 * size * step


def _seconds_per_step(task: Task) -> float:
    action = (np.array(task.spec.action_low) + np.array(task.spec.action_high)) / 2
    action = action.astype(np.float32)
    env = task.make(None)
    seconds = []
    env.reset(seed=0)
    for _ in range(_TIMED_STEPS):
        begin = time.perf_counter()
        _, _, terminated, truncated, _ = env.step(action)
        seconds.append(time.perf_counter() - begin)
        if terminated or truncated:
            env.reset(seed=0)
    env.close()
    return float(np.median(seconds))

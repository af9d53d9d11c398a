"""Episodes on the host: one environment per team, one batched call of the policies per tick."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from race.envs.contract import Step, in_units
from race.errors import DivergenceError, EnvFailedError
from race.randomness import seed_again
from race.rollouts.pool import EnvPool
from race.types import EnvSpec, Rollout, Transition

Act = Callable[[NDArray[np.float32], int], Any]
"""``act(states [T, S], tick) -> actions [T, U]`` between -1 and 1, as a NumPy or JAX array."""

_FIRST_ROWS: Final = 65536  # memory that is never written costs nothing


def collect(
    pool: EnvPool,
    act: Act,
    seeds: NDArray[np.int64],
    max_ticks: int | NDArray[np.int64] | None = None,
) -> Rollout:
    """One episode per team, all teams in step with each other.

    An episode whose environment fails is played anew in a fresh one after the others, if the pool
    allows it, with a seed that depends on its own and the number of the attempt; what was played
    of it before is forgotten.

    Args:
        pool: at least T environments of a task with continuous actions.
        act: called once a tick with the states of all teams [T, S] and the tick (0, 1, ...);
            returns their joint actions [T, U] between -1 and 1, which are clipped to it. Rows of
            teams whose episode has ended are ignored; their states stay as they were at the end.
        seeds: for each team, the seed of its environment's reset, [T].
        max_ticks: steps after which running episodes are cut (not terminated), if that is before
            the task's own limit; of all teams, or of each [T].

    Returns:
        Transitions in order of attempt, tick, then team; actions as `act` gave them, clipped.

    Raises:
        DivergenceError: if a running team's action is not finite.
        HandedOverError: if what an environment hands over breaks the contract.
        EnvFailedError: if an environment fails.
    """
    spec: EnvSpec = pool.spec
    cut = spec.episode_limit if max_ticks is None else max_ticks
    limits = np.broadcast_to(np.minimum(cut, spec.episode_limit), len(seeds))
    found = _Found(len(seeds), int(limits.max(initial=0)), spec)
    waiting = {team: int(seed) for team, seed in enumerate(seeds.tolist())}
    attempt = 0
    while waiting:
        failures = _play(pool, act, waiting, limits, found)
        attempt += 1
        pool.begin_again(failures, attempt)
        found.repeated[list(failures)] += 1
        waiting = {team: seed_again(int(seeds[team]), attempt) for team in failures}
    pool.proven = True
    return found.rollout()


def _play(
    pool: EnvPool, act: Act, seeds: dict[int, int], limits: NDArray[np.int64], found: "_Found"
) -> dict[int, EnvFailedError]:
    """An episode of each of some teams; returns those that failed."""
    spec = pool.spec
    low, high = np.array(spec.action_low, np.float32), np.array(spec.action_high, np.float32)
    failures: dict[int, EnvFailedError] = {}
    states = found.states.copy()
    for team, seen in pool.reset(seeds).items():
        if isinstance(seen, EnvFailedError):
            failures[team] = seen
        else:
            states[team] = seen
    alive = np.array([t for t in sorted(set(seeds) - set(failures)) if limits[t] > 0], np.intp)
    for tick in range(limits.max(initial=0)):
        if not alive.size:
            break
        actions = _chosen(act, states, tick, alive, spec)
        units = in_units(actions, low, high)
        steps = pool.step({team: units[team] for team in alive.tolist()})
        # A fresh array, because `act` may still hold the old one: JAX does not always copy.
        states, before = states.copy(), states
        running = []
        for team, step in steps.items():
            if isinstance(step, EnvFailedError):
                failures[team] = step
                found.forget(team)
                continue
            states[team] = step.seen
            found.add(team, before[team], actions[team], step)
            if not (step.terminated or step.truncated or tick + 1 == limits[team]):
                running.append(team)
        alive = np.array(running, np.intp)
    found.states = states
    return failures


def _chosen(
    act: Act, states: NDArray[np.float32], tick: int, alive: NDArray[np.intp], spec: EnvSpec
) -> NDArray[np.float32]:
    actions = np.asarray(act(states, tick), np.float32)
    if actions.shape != (len(states), spec.joint_action_size):
        raise ValueError(
            f"The policy of {spec.task} returned actions of shape {actions.shape} instead of "
            f"{(len(states), spec.joint_action_size)}."
        )
    if not np.isfinite(actions[alive]).all():
        raise DivergenceError(
            f"A policy of {spec.task} produced an action that is not a finite number, at step "
            f"{tick} of an episode: its networks have diverged. Lower the learning rates "
            "(--learner.actor-learning-rate, --learner.critic-learning-rate) or go back to an "
            "earlier checkpoint."
        )
    return np.clip(actions, -1, 1)


class _Found:
    """What the episodes brought so far, in rows that grow."""

    def __init__(self, teams: int, longest: int, spec: EnvSpec) -> None:
        self.states = np.zeros((teams, spec.state_size), np.float32)
        self._rows = _rows(min(teams * max(longest, 1), _FIRST_ROWS), spec)
        self._team = np.zeros(len(self._rows.reward), np.int64)  # -1 where forgotten
        self._count = 0
        self._return = np.zeros(teams, np.float64)
        self._length = np.zeros(teams, np.int64)
        self.repeated = np.zeros(teams, np.int64)

    def add(
        self, team: int, before: NDArray[np.float32], action: NDArray[np.float32], step: Step
    ) -> None:
        """A step of a team."""
        if self._count == len(self._team):
            self._rows = Transition(*map(_doubled, self._rows))
            self._team = _doubled(self._team)
        here = self._count
        self._rows.state[here], self._rows.action[here] = before, action
        self._rows.reward[here], self._rows.terminated[here] = step.reward, step.terminated
        self._rows.next_state[here] = step.seen
        self._team[here] = team
        self._return[team] += step.reward
        self._length[team] += 1
        self._count += 1

    def forget(self, team: int) -> None:
        """The steps of a team's failed episode."""
        self._team[: self._count][self._team[: self._count] == team] = -1
        self._return[team] = self._length[team] = 0

    def rollout(self) -> Rollout:
        """All that was not forgotten."""
        kept = self._team[: self._count] >= 0
        whole = slice(self._count) if kept.all() else np.flatnonzero(kept)
        rows = Transition(*(column[whole] for column in self._rows))
        team = self._team[: self._count][whole]
        return Rollout(rows, self._return, self._length, team, self.repeated)


def _rows(count: int, spec: EnvSpec) -> Transition:
    return Transition(
        state=np.empty((count, spec.state_size), np.float32),
        action=np.empty((count, spec.joint_action_size), np.float32),
        reward=np.empty(count, np.float32),
        terminated=np.empty(count, np.float32),
        next_state=np.empty((count, spec.state_size), np.float32),
    )


def _doubled(array: Any) -> Any:
    larger = np.empty((2 * len(array), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger

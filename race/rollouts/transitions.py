"""Rollouts of tasks with continuous actions: transitions from environments on the host."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from race import programs
from race.algorithms.base import Teams
from race.closing import Closing
from race.config.settings import Config
from race.errors import DivergenceError
from race.method.normalisation import Observed, observed_more, running_of
from race.programs import cohort
from race.randomness import Purpose, host_seeds
from race.replay.buffer import Replay, init_replay
from race.rollouts.base import Generation, Play, Score, Steps, Trial, WarmUp, keepers
from race.rollouts.beginnings import beginnings
from race.rollouts.host import collect
from race.rollouts.pool import EnvPool
from race.types import EnvSpec, Rollout, Task, Transition

TESTS_AT_ONCE = 32
"""Most environments that tests keep open; more episodes are played in several rounds."""


def empty_transition(spec: EnvSpec) -> Transition:
    """A transition of zeros, as it is stored."""
    number = np.zeros((), np.float32)
    return Transition(
        state=np.zeros(spec.state_size, np.float32),
        action=np.zeros(spec.joint_action_size, np.float32),
        reward=number,
        terminated=number,
        next_state=np.zeros(spec.state_size, np.float32),
    )


@final
class TransitionRollouts(Closing):
    """A `race.rollouts.base.Rollouts`. Environments are made when they are needed first."""

    def __init__(
        self,
        config: Config,
        task: Task,
        proven: bool = False,
        runs: int = 1,
        together: bool = False,
    ) -> None:
        """Nothing is made yet.

        Args:
            config: the configuration of a run.
            task: the task.
            proven: whether a run has played an episode before.
            runs: how many there are, alike but for their numbers.
            together: whether the teams of all choose in one program.
        """
        self._config, self._task = config, task
        self._runs, self._together = runs, together and runs > 1
        self._usual = runs * (1 if config.in_turns else config.n_teams)
        self._pool = EnvPool(
            task,
            max(self._usual, TESTS_AT_ONCE),
            config.env.processes,
            usual=self._usual,
            retries=config.env.retries,
            step_seconds=config.env.step_seconds,
            proven=proven,
        )

    @property
    def repeated(self) -> int:
        """Episodes that were begun anew since the environments failed, in this process."""
        return self._pool.repeated

    def empty_replay(self, config: Config) -> Replay:
        """A short run does not pay for a long one's memory."""
        learner, teams = config.learner, config.n_teams
        longest = learner.random_steps + config.env_steps
        longest += teams * self._task.spec.episode_limit
        capacity = min(learner.replay_capacity, max(longest, programs.INSERT_ROWS))
        capacity *= config.has_marl
        return init_replay(empty_transition(self._task.spec), capacity, config.tells_own)

    def warm_up(
        self, config: Config, replay: Replay, report: Steps, interrupted: Callable[[], bool]
    ) -> WarmUp | None:
        """Uniform actions, exactly as many steps as asked for; none where nothing learns."""
        spec = self._task.spec
        collected, index = 0, 0
        observed: Observed | None = None
        while config.has_marl and collected < config.learner.random_steps:
            if interrupted():
                return None
            report(collected)
            missing = config.learner.random_steps - collected
            playing = min(config.n_teams, missing)
            seeds = host_seeds(config.seed, Purpose.WARM_UP, index, playing + 1)
            generator = np.random.default_rng(int(seeds[-1]))
            shape = (playing, spec.joint_action_size)

            def choose(
                _: NDArray[np.float32],
                tick: int,
                generator: np.random.Generator = generator,
                shape: tuple[int, int] = shape,
            ) -> NDArray[np.float32]:
                return generator.uniform(-1, 1, shape).astype(np.float32)

            rollout = collect(self._pool, choose, seeds[:-1], max_ticks=missing // playing)
            replay = store(replay, scaled(rollout.transitions, config.env.reward_scale))
            now = seen_by(rollout, config)
            observed = now if observed is None or now is None else observed_more(observed, now)
            collected += len(rollout.transitions.reward)
            index += 1
        return WarmUp(replay, collected, observed)

    def play(self, plays: Sequence[Play]) -> list[tuple[Replay, Generation] | DivergenceError]:
        """All tick together. MARL teams' actions are noisy; populations explore by diversity."""
        results: list[tuple[Replay, Generation] | DivergenceError] = []
        # Nothing is stored before all have played: a buffer is used up as it is written.
        for play, played in zip(plays, self._played(plays), strict=True):
            if isinstance(played, DivergenceError):
                results.append(played)
                continue
            replay, kept = play.replay, keepers(played.episode_return, play)
            if replay.capacity:
                replay = _with_steps(replay, played, kept, play)
            steps, repeated = len(played.transitions.reward), int(played.repeated.sum())
            stored = int(kept.sum())
            observed = seen_by(played, play.config)
            begun = None
            if play.beginnings is not None:
                discount = play.config.learner.discount
                begun = beginnings(played, play.n_population, play.beginnings, discount)
            made = Generation(played.episode_return, steps, repeated, stored, observed, begun)
            results.append((replay, made))
        return results

    def _played(self, plays: Sequence[Play]) -> list[Rollout | DivergenceError]:
        """What each run brings; if one diverges, the others do as if it had not been there."""
        try:
            return list(self._play(plays))
        except DivergenceError as error:
            if len(plays) == 1:
                return [error]
            return [found for play in plays for found in self._played([play])]

    def _play(self, plays: Sequence[Play]) -> list[Rollout]:
        spec = self._task.spec
        seeds = [
            host_seeds(p.config.seed, Purpose.ROLLOUT, p.number, p.teams.count + 1) for p in plays
        ]
        acting = self._acting([play.teams for play in plays])
        noises: list[np.random.Generator] = []
        attempt = 0

        def choose(states: NDArray[np.float32], tick: int) -> NDArray[np.float32]:
            nonlocal attempt, noises
            if tick == 0:
                # Anew with every attempt, for how long others played is not a run's own affair.
                own = [(int(part[-1]), attempt) if attempt else int(part[-1]) for part in seeds]
                noises, attempt = [np.random.default_rng(seed) for seed in own], attempt + 1
            actions = acting(states)
            for play, teams, noise in zip(plays, acting.parts, noises, strict=True):
                exploring = slice(teams.stop - play.n_marl, teams.stop)
                scale = np.float32(play.config.learner.exploration_noise)
                shape = (play.n_marl, spec.joint_action_size)
                actions[exploring] += scale * noise.standard_normal(shape, np.float32)
            return actions

        longest = np.concatenate([_longest(play, spec.episode_limit) for play in plays])
        rollout = collect(self._pool, choose, np.concatenate([p[:-1] for p in seeds]), longest)
        return [rollout.of(teams) for teams in acting.parts]

    def test(self, trials: Sequence[Trial]) -> list[dict[str, Score]]:
        """At most `TESTS_AT_ONCE` episodes at once; in one program as many as play a generation."""
        if not self._together and len(trials) > 1:
            return [self.test([trial])[0] for trial in trials]
        most = max(TESTS_AT_ONCE, self._usual) if self._together else TESTS_AT_ONCE
        rounds = -(-sum(len(t.seeds) * len(t.heads) for t in trials) // most)
        pieces = [np.array_split(trial.seeds, rounds) for trial in trials]
        found: list[dict[str, list[Score]]] = [{name: [] for name in t.heads} for t in trials]
        for turn in range(rounds):
            seeds = [np.tile(of[turn], len(t.heads)) for t, of in zip(trials, pieces, strict=True)]
            acting = self._acting(
                [trial.teams(len(of[turn])) for trial, of in zip(trials, pieces, strict=True)]
            )
            rollout = collect(self._pool, lambda seen, _: acting(seen), np.concatenate(seeds))  # noqa: B023
            for scores, teams in zip(found, acting.parts, strict=True):
                part, n = rollout.of(teams), len(teams) // len(scores)
                for i, kept in enumerate(scores.values()):
                    own = slice(i * n, (i + 1) * n)
                    kept.append(Score(part.episode_return[own], part.episode_length[own]))
        return [{name: _joined(parts) for name, parts in scores.items()} for scores in found]

    def _acting(self, teams: list[Teams]) -> "_Acting":
        runs = self._runs if self._together else 1
        return _Acting(teams, self._task.spec, str(self._config.base), runs)

    def close(self) -> None:
        """Closes the environments and ends their processes."""
        self._pool.close()


@final
class _Acting:
    """The joint actions of the teams of some runs, run after run, with one call a tick or one each.

    Attributes:
        parts: for each run, the places of its teams.
    """

    def __init__(self, runs: list[Teams], spec: EnvSpec, base: str, at_once: int) -> None:
        """``at_once``: runs of one program; more are there than act, once some are over."""
        ends = np.cumsum([0, *[teams.count for teams in runs]]).tolist()
        self.parts = [range(first, end) for first, end in itertools.pairwise(ends)]
        self._runs, self._spec, self._base = runs, spec, base
        self._stacked = None
        if at_once > 1 and len({teams.count for teams in runs}) == 1:
            self._missing = max(at_once - len(runs), 0)
            self._stacked = cohort.stack((*runs, *[runs[-1]] * self._missing))

    def __call__(self, states: NDArray[np.float32]) -> NDArray[np.float32]:
        """States [all teams, S] to actions [all teams, U], an array of its own."""
        how: Any = {"spec": self._spec, "base": self._base}
        if self._stacked is not None:
            apart = states.reshape(len(self._runs), -1, states.shape[1])
            padded = np.pad(apart, ((0, self._missing), (0, 0), (0, 0)))
            actions = np.asarray(cohort.act(self._stacked, padded, **how))[: len(self._runs)]
            return actions.reshape(len(states), -1).copy()
        each = [
            np.asarray(programs.act(teams, states[part.start : part.stop], **how))
            for teams, part in zip(self._runs, self.parts, strict=True)
        ]
        return np.concatenate(each)


def _longest(play: Play, limit: int) -> NDArray[np.int64]:
    """Of each team, how many steps it plays at most."""
    steps = np.full(play.teams.count, limit)
    if play.beginnings is not None:
        steps[: play.n_population] = play.beginnings
    return steps


def _joined(parts: list[Score]) -> Score:
    return Score(
        np.concatenate([part.returns for part in parts]),
        np.concatenate([part.lengths for part in parts]),
    )


def seen_by(rollout: Rollout, config: Config) -> Observed | None:
    """The states in which teams chose an action, where they are normalised."""
    if not config.env.normalise:
        return None
    return Observed(None, running_of(rollout.transitions.state))


def scaled(transitions: Transition, scale: float) -> Transition:
    """Steps as they are learned from: what they were paid is multiplied."""
    if scale == 1:
        return transitions
    return transitions._replace(reward=transitions.reward * np.float32(scale))


def _with_steps(replay: Replay, played: Rollout, kept: NDArray[np.bool_], play: Play) -> Replay:
    """The buffer with the steps of those teams whose experience is kept."""
    rows: Any = slice(None)
    if not kept.all():
        rows = np.flatnonzero(kept[played.team])
    steps = Transition(*(column[rows] for column in played.transitions))
    own = played.team[rows] >= play.n_population
    return store(replay, scaled(steps, play.config.env.reward_scale), own)


def store(replay: Replay, transitions: Transition, own: NDArray[np.bool_] | None = None) -> Replay:
    """Appends transitions of any number, in pieces of one size.

    ``own``: which the MARL team made, [steps]; None: none of them.
    """
    size = min(programs.INSERT_ROWS, replay.capacity)
    if replay.own is None:
        own = None
    elif own is None:  # said, for one program to serve all
        own = np.zeros(len(transitions.reward), bool)
    for first in range(0, len(transitions.reward), size):
        piece = Transition(*(column[first : first + size] for column in transitions))
        count = len(piece.reward)
        padded = Transition(
            *(np.pad(c, [(0, size - count), *[(0, 0)] * (c.ndim - 1)]) for c in piece)
        )
        of_marl = None if own is None else np.pad(own[first : first + size], (0, size - count))
        replay = programs.store(replay, padded, np.int32(count), of_marl)
    return replay

"""Rollouts of tasks with discrete actions: whole episodes, on the device where that can be."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from race import programs
from race.algorithms.base import Teams
from race.closing import Closing
from race.config.settings import Config
from race.errors import DivergenceError
from race.method.exploration import epsilon
from race.randomness import Purpose, host_seeds, root_key
from race.replay.buffer import Replay, init_replay
from race.rollouts import device
from race.rollouts.base import (
    Generation,
    Play,
    Score,
    Steps,
    Trial,
    WarmUp,
    check_returns,
    keepers,
)
from race.rollouts.choosing import Exploration
from race.rollouts.episodes import Part, Played, empty_episode, seen_in
from race.rollouts.host_episodes import HostEnvs
from race.rollouts.pool import EnvPool
from race.types import DiscreteTask, Episode

TESTS_AT_ONCE = 32
"""Test episodes of a team in one program; a program serves one number of them only."""
TESTS_AT_ONCE_ON_HOST = 4
"""There they are played one after the other anyway, and a game may be large."""


@final
class EpisodeRollouts(Closing):
    """A `race.rollouts.base.Rollouts`: on the device if the task can be played there."""

    def __init__(
        self,
        config: Config,
        task: DiscreteTask,
        on_device: bool = True,
        proven: bool = False,
        runs: int = 1,
    ) -> None:
        """Nothing is made yet.

        Args:
            config: the configuration of a run.
            task: the task.
            on_device: whether to play on the device if the task can be played there.
            proven: whether a run has played an episode before.
            runs: how many go on in one program, on the device.
        """
        self._config, self._spec, self._runs = config, task.spec, runs
        self._env = task.device() if on_device and task.device is not None else None
        asked = config.env.processes
        in_processes = task.waits if asked is None else asked
        pool = EnvPool(
            task,
            max(config.n_teams, 2 * TESTS_AT_ONCE_ON_HOST),  # of two teams
            in_processes or config.env.step_seconds is not None,
            retries=config.env.retries,
            step_seconds=config.env.step_seconds,
            proven=proven or task.waits,  # it has been tried: what dies is the game
        )
        self._host = HostEnvs(pool)
        self._most = TESTS_AT_ONCE if self._env is not None else TESTS_AT_ONCE_ON_HOST
        self._tests = 0  # at once, so far

    @property
    def repeated(self) -> int:
        """Episodes that were begun anew since the environments failed, in this process."""
        return self._host.pool.repeated

    def empty_replay(self, config: Config) -> Replay:
        """A short run does not pay for a long one's memory: an episode has at least one step."""
        facmac = config.facmac
        most = max(config.env_steps + config.n_teams, facmac.batch_size)
        item = empty_episode(self._spec, str(facmac.replay_precision))
        capacity = min(facmac.replay_capacity, most) * config.has_marl
        return init_replay(item, capacity, config.tells_own)

    def warm_up(
        self, config: Config, replay: Replay, report: Steps, interrupted: Callable[[], bool]
    ) -> WarmUp | None:
        """There is none: exploration begins with many random actions."""
        return WarmUp(replay, 0)

    def play(self, plays: Sequence[Play]) -> list[tuple[Replay, Generation] | DivergenceError]:
        """MARL teams choose at random now and then; populations by their policies, if at all."""
        parts = [Part(play.teams, _seeds(play), _exploration(play)) for play in plays]
        before, found = self.repeated, list(self._episodes(parts))
        results: list[tuple[Replay, Generation] | DivergenceError] = []
        for play, (played, now) in zip(plays, found, strict=True):
            try:
                self._check_finite(played, f"generation {play.generation + 1}")
            except DivergenceError as error:
                results.append(error)
                continue
            replay = play.replay
            returns = np.asarray(played.episode_return, np.float64)
            kept = keepers(returns, play)
            if replay.capacity:
                replay = _with_episodes(replay, played.episodes, kept, play)
            steps = int(np.sum(played.episodes.length))
            observed = seen_in(played.episodes) if play.config.env.normalise else None
            made = Generation(returns, steps, now - before, int(kept.sum()), observed)
            results.append((replay, made))
            before = now
        return results

    def test(self, trials: Sequence[Trial]) -> list[dict[str, Score]]:
        """At most `TESTS_AT_ONCE` episodes of each team at once."""
        longest = max(len(trial.seeds) for trial in trials)
        size = self._tests = max(self._tests, min(longest, self._most))
        everyone = [trial.teams(size) for trial in trials]
        found: list[list[Any]] = [[] for _ in trials]
        for first in range(0, longest, size):
            parts = [
                Part(teams, np.tile(_small(np.resize(t.seeds[first:], size)), len(t.heads)), None)
                for t, teams in zip(trials, everyone, strict=True)
            ]
            for trial, kept, (played, _) in zip(trials, found, self._episodes(parts), strict=True):
                results = (played.episode_return, played.episodes.length, played.won)
                shape, real = (len(trial.heads), size), len(trial.seeds[first : first + size])
                kept.append([np.asarray(r).reshape(shape)[:, :real] for r in results])
        return [self._scores(trial, kept) for trial, kept in zip(trials, found, strict=True)]

    def _scores(self, trial: Trial, parts: list[Any]) -> dict[str, Score]:
        returns, lengths, won = (
            np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True)
        )
        return {
            name: Score(
                returns[i].astype(np.float64),
                lengths[i].astype(np.int64),
                won[i] if self._spec.has_wins else None,
            )
            for i, name in enumerate(trial.heads)
        }

    def episode(self, team: Teams, seed: int) -> NDArray[np.int32]:
        """The actions of one episode of a single team without exploration, [steps, N]."""
        part = Part(team, _small(np.array([seed])), None)
        ((played, _),) = self._episodes([part])
        steps = int(played.episodes.length[0])
        return np.asarray(played.episodes.action[0, :steps]).astype(np.int32)

    def close(self) -> None:
        """Closes the environments on the host."""
        self._host.close()

    def _episodes(self, parts: Sequence[Part]) -> Iterator[tuple[Played, int]]:
        """The episodes of each run, and how many have been begun anew by then."""
        precision = str(self._config.facmac.replay_precision)
        if self._env is None:
            for part in parts:
                yield self._host.play(*part, precision), self.repeated
            return
        alike = len({part.teams.count for part in parts}) == 1
        if self._runs > 1 and alike:
            # The program stays the same when some are over.
            padded = [*parts, *[parts[-1]] * (self._runs - len(parts))]
            for played in device.play(self._env, padded, self._spec, precision)[: len(parts)]:
                yield played, self.repeated
            return
        for part in parts:
            yield device.play(self._env, [part], self._spec, precision)[0], self.repeated

    def _check_finite(self, played: Played, where: str) -> None:
        check_returns(played.episode_return, where)
        shown = {"an observation": played.episodes.obs, "a state": played.episodes.state}
        if programs.all_finite(shown):
            return
        for name, column in shown.items():
            values = np.asarray(column)
            strange = np.argwhere(~np.isfinite(values))
            if len(strange) == 0:
                continue
            team, step = strange[0][:2]
            entry = values[tuple(strange[0])]
            advice = "That is no number. Look at the task."
            if not np.isnan(entry):
                advice = (
                    "The replay buffer keeps numbers up to 65504 with --facmac.replay-precision "
                    "float16, larger ones with float32; better scale what the task shows to "
                    "about 1."
                )
            raise DivergenceError(
                f"The environment of team {team} gave {name} in {where}, after {step} steps, "
                f"with the entry {entry}. {advice}"
            )


def _small(seeds: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Seeds below 2**31, which is what environments take."""
    return (seeds % 2**31).astype(np.uint32)


def _seeds(play: Play) -> NDArray[np.uint32]:
    seed, count = play.config.seed, play.teams.count
    return _small(host_seeds(seed, Purpose.ROLLOUT, play.number, count))


def _with_episodes(
    replay: Replay, episodes: Episode, kept: NDArray[np.bool_], play: Play
) -> Replay:
    """The buffer with the episodes of those teams whose experience is kept."""
    scale, teams = play.config.env.reward_scale, np.arange(play.teams.count)
    if scale != 1:  # returns stay in the task's own units
        episodes = episodes._replace(reward=episodes.reward * np.float32(scale))
    if not kept.all():  # the first ones are written
        teams = np.argsort(~kept, kind="stable")
        episodes = jax.tree.map(lambda column: column[teams], episodes)
    own = None if replay.own is None else teams >= play.n_population
    return programs.store(replay, episodes, np.int32(kept.sum()), own)


def _exploration(play: Play) -> Exploration | None:
    sampled = play.config.race.population_actions == "sampled"
    if not (play.n_marl or sampled):
        return None
    facmac, teams = play.config.facmac, play.teams.count
    share = epsilon(
        play.env_steps, facmac.epsilon_start, facmac.epsilon_finish, facmac.epsilon_steps
    )
    marl = jnp.arange(teams) >= play.n_population
    return Exploration(
        jnp.ones(teams, bool) if sampled else marl,
        jnp.where(marl, jnp.float32(share), jnp.float32(0)),
        jax.random.fold_in(root_key(play.config.seed, Purpose.ROLLOUT), play.number),
    )

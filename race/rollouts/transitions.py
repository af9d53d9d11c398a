"""Rollouts of tasks with continuous actions: transitions from environments on the host."""

from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from race import programs
from race.algorithms.base import Teams
from race.config.settings import Config
from race.randomness import Purpose, host_seeds
from race.replay.buffer import Replay, init_replay
from race.rollouts.base import Generation, Score, Steps
from race.rollouts.host import collect
from race.rollouts.pool import EnvPool
from race.types import EnvSpec, Task, Transition

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
class TransitionRollouts:
    """A `race.rollouts.base.Rollouts`. Environments are made when they are needed first."""

    def __init__(self, config: Config, task: Task, proven: bool = False) -> None:
        self._config, self._task = config, task
        self._pool = EnvPool(
            task,
            max(config.n_teams, TESTS_AT_ONCE),
            config.env.processes,
            usual=config.n_teams,
            retries=config.env.retries,
            step_seconds=config.env.step_seconds,
            proven=proven,
        )

    @property
    def repeated(self) -> int:
        """Episodes that were begun anew since the environments failed, in this process."""
        return self._pool.repeated

    def empty_replay(self) -> Replay:
        """A short run does not pay for a long one's memory."""
        learner, teams = self._config.learner, self._config.n_teams
        longest = learner.random_steps + self._config.env_steps
        longest += teams * self._task.spec.episode_limit
        capacity = min(learner.replay_capacity, max(longest, programs.INSERT_ROWS))
        capacity *= self._config.has_marl
        return init_replay(empty_transition(self._task.spec), capacity)

    def warm_up(
        self, replay: Replay, report: Steps, interrupted: Callable[[], bool]
    ) -> tuple[Replay, int] | None:
        """Uniform actions, exactly as many steps as asked for; none where nothing learns."""
        config, spec = self._config, self._task.spec
        collected, index = 0, 0
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
            replay = store(replay, rollout.transitions)
            collected += len(rollout.transitions.reward)
            index += 1
        return replay, collected

    def play(
        self, teams: Teams, n_marl: int, generation: int, env_steps: int, replay: Replay
    ) -> tuple[Replay, Generation]:
        """The MARL team's actions are noisy; the population explores by its diversity."""
        config, spec = self._config, self._task.spec
        seeds = host_seeds(config.seed, Purpose.ROLLOUT, generation, teams.count + 1)
        noise = np.random.default_rng(int(seeds[-1]))
        scale = np.float32(config.learner.exploration_noise)
        shape, first = (n_marl, spec.joint_action_size), teams.count - n_marl

        def choose(states: NDArray[np.float32], _: int) -> NDArray[np.float32]:
            actions = np.array(programs.act(teams, states, spec=spec, base=str(config.base)))
            actions[first:] += scale * noise.standard_normal(shape, np.float32)
            return actions

        rollout = collect(self._pool, choose, seeds[:-1])
        if replay.capacity:
            replay = store(replay, rollout.transitions)
        return replay, Generation(rollout.episode_return, len(rollout.transitions.reward))

    def test(
        self,
        encoder: Any,
        heads: Mapping[str, Float[Array, "N H1 A"]],
        seeds: NDArray[np.int64],
    ) -> dict[str, Score]:
        """At most `TESTS_AT_ONCE` episodes at once."""
        spec, base = self._task.spec, str(self._config.base)
        rounds = -(-len(seeds) * len(heads) // TESTS_AT_ONCE)
        parts: dict[str, list[tuple[NDArray[Any], NDArray[Any]]]] = {name: [] for name in heads}
        for piece in np.array_split(seeds, rounds):
            n = len(piece)
            teams = Teams(encoder, jnp.repeat(jnp.stack(list(heads.values())), n, axis=0))

            def choose(
                states: NDArray[np.float32], _: int, teams: Teams = teams
            ) -> NDArray[np.float32]:
                return np.asarray(programs.act(teams, states, spec=spec, base=base))

            rollout = collect(self._pool, choose, np.tile(piece, len(heads)))
            for i, name in enumerate(heads):
                part = slice(i * n, (i + 1) * n)
                parts[name].append((rollout.episode_return[part], rollout.episode_length[part]))
        return {
            name: Score(*(np.concatenate(columns) for columns in zip(*found, strict=True)))
            for name, found in parts.items()
        }

    def close(self) -> None:
        """Closes the environments and ends their processes."""
        self._pool.close()

    def __enter__(self) -> "TransitionRollouts":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def store(replay: Replay, transitions: Transition) -> Replay:
    """Appends transitions of any number, in pieces of one size."""
    size = min(programs.INSERT_ROWS, replay.capacity)
    for first in range(0, len(transitions.reward), size):
        piece = Transition(*(column[first : first + size] for column in transitions))
        count = len(piece.reward)
        padded = Transition(
            *(np.pad(c, [(0, size - count), *[(0, 0)] * (c.ndim - 1)]) for c in piece)
        )
        replay = programs.store(replay, padded, np.int32(count))
    return replay

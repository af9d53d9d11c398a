"""Rollouts of tasks with continuous actions: transitions from environments on the host."""

import contextlib
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
from race.errors import DivergenceError
from race.randomness import Purpose, host_seeds
from race.replay.buffer import Replay, init_replay
from race.rollouts.base import Generation, Score, Steps, check_returns
from race.rollouts.host import EnvPool, collect
from race.types import EnvSpec, Rollout, Task, Transition


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

    def __init__(self, config: Config, task: Task) -> None:
        self._config, self._task = config, task
        self._pools: dict[int, EnvPool] = {}
        self._open = contextlib.ExitStack()

    def empty_replay(self) -> Replay:
        """A short run does not pay for a long one's memory."""
        learner, teams = self._config.learner, self._config.n_teams
        longest = learner.random_steps + self._config.env_steps
        longest += teams * self._task.spec.episode_limit
        capacity = min(learner.replay_capacity, max(longest, programs.INSERT_ROWS))
        return init_replay(empty_transition(self._task.spec), capacity)

    def warm_up(
        self, replay: Replay, report: Steps, interrupted: Callable[[], bool]
    ) -> tuple[Replay, int] | None:
        """Uniform actions, exactly as many steps as asked for."""
        config, spec = self._config, self._task.spec
        collected, index = 0, 0
        while collected < config.learner.random_steps:
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

            pool = self._pool(config.n_teams)
            rollout = collect(pool, choose, seeds[:-1], max_ticks=missing // playing)
            _check_finite(rollout, "the random episodes")
            replay = store(replay, rollout.transitions)
            collected += len(rollout.transitions.reward)
            index += 1
        return replay, collected

    def play(
        self, teams: Teams, generation: int, env_steps: int, replay: Replay
    ) -> tuple[Replay, Generation]:
        """The MARL team's actions are noisy; the population explores by its diversity."""
        config, spec = self._config, self._task.spec
        seeds = host_seeds(config.seed, Purpose.ROLLOUT, generation, config.n_teams + 1)
        noise = np.random.default_rng(int(seeds[-1]))
        shape, scale = spec.joint_action_size, np.float32(config.learner.exploration_noise)

        def choose(states: NDArray[np.float32], _: int) -> NDArray[np.float32]:
            actions = np.array(programs.act(teams, states, spec=spec, base=str(config.base)))
            actions[-1] += scale * noise.standard_normal(shape, np.float32)
            return actions

        rollout = collect(self._pool(config.n_teams), choose, seeds[:-1])
        _check_finite(rollout, f"generation {generation + 1}")
        replay = store(replay, rollout.transitions)
        return replay, Generation(rollout.episode_return, len(rollout.transitions.reward))

    def test(
        self,
        encoder: Any,
        heads: Mapping[str, Float[Array, "N H1 A"]],
        seeds: NDArray[np.int64],
    ) -> dict[str, Score]:
        """All episodes at once."""
        n = len(seeds)
        teams = Teams(encoder, jnp.repeat(jnp.stack(list(heads.values())), n, axis=0))
        spec, base = self._task.spec, str(self._config.base)

        def choose(states: NDArray[np.float32], _: int) -> NDArray[np.float32]:
            return np.asarray(programs.act(teams, states, spec=spec, base=base))

        rollout = collect(self._pool(n * len(heads)), choose, np.tile(seeds, len(heads)))
        parts = [slice(i * n, (i + 1) * n) for i in range(len(heads))]
        return {
            name: Score(rollout.episode_return[part], rollout.episode_length[part])
            for name, part in zip(heads, parts, strict=True)
        }

    def close(self) -> None:
        """Closes the environments and ends their processes."""
        self._pools.clear()
        self._open.close()

    def __enter__(self) -> "TransitionRollouts":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _pool(self, size: int) -> EnvPool:
        if size not in self._pools:
            pool = EnvPool(self._task, size, self._config.env.processes)
            self._pools[size] = self._open.enter_context(pool)
        return self._pools[size]


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


def _check_finite(rollout: Rollout, where: str) -> None:
    if not np.isfinite(rollout.transitions.next_state).all():
        raise DivergenceError(
            f"The environment gave a state that is not a finite number in {where}. A buffer that "
            "holds it teaches nothing, so the run stops here. Look at the task's observation."
        )
    check_returns(rollout.episode_return, where)

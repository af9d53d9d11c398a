"""One generation of training: the paper's Algorithm 1, and the random steps before the first.

Everything that changes is one `RunState`; each function maps it to the next.
"""

import math
import time

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from race import programs
from race.algorithms.base import tested_teams
from race.clock import Clock
from race.errors import DivergenceError
from race.evaluation import evaluate
from race.records import evaluation_row, generation_row
from race.replay import Replay
from race.rollouts.host import collect
from race.run import Run, save
from race.run_state import Purpose, RunState, host_seeds, n_teams, root_key
from race.types import Rollout, Transition

CHUNK = 100
"""Gradient steps between two looks at the clock, the progress bar and Ctrl-C."""


def warm_up(run: Run, state: RunState) -> RunState:
    """Random episodes before the first generation, exactly as many steps as asked for.

    If it is interrupted, the state stays as it was.

    Raises:
        DivergenceError: if the environment gives a reward or a state that is not finite.
    """
    config, spec = run.config, run.task.spec
    teams, collected, index = n_teams(config), 0, 0
    replay = state.replay
    while collected < config.learner.random_steps:
        if run.interrupts.requested:
            return state
        run.report("random steps", state.progress.but(env_steps=collected), {})
        missing = config.learner.random_steps - collected
        playing = min(teams, missing)
        seeds = host_seeds(config, Purpose.WARM_UP, index, playing + 1)
        generator = np.random.default_rng(int(seeds[-1]))
        shape = (playing, spec.joint_action_size)

        def choose(
            _: NDArray[np.float32],
            tick: int,
            generator: np.random.Generator = generator,
            shape: tuple[int, int] = shape,
        ) -> NDArray[np.float32]:
            return generator.uniform(-1, 1, shape).astype(np.float32)

        rollout = collect(run.pool, choose, seeds[:-1], max_ticks=missing // playing)
        _check_finite(rollout, "the random episodes")
        replay = store(replay, rollout.transitions)
        collected += len(rollout.transitions.reward)
        index += 1
    progress = state.progress.but(env_steps=collected, random_steps=collected)
    return state._replace(replay=replay, progress=progress)


def generation(run: Run, state: RunState, clock: Clock) -> RunState:
    """One pass of Algorithm 1, or the rest of one that a checkpoint broke off.

    Comments name the lines of Algorithm 1. An interrupt leaves the gradient steps half done.
    """
    if not state.progress.learning:
        clock.begin()
        state, rollout = roll_out(run, state)  # 3-6
        state = evolve(run, state, rollout)  # 9
        state = clock.rolled_out(state)
    while _owed(run, state) > 0:
        if run.interrupts.requested:
            return state
        state = learn(run, state)  # 8, 10, 13
        if clock.checkpoint_due():
            state = save(run, clock.stamp(state))
    algorithm = run.algorithm.inject(state.algorithm)  # 11
    state = state._replace(algorithm=algorithm, progress=state.progress.but(learning=False))
    state = clock.stamp(state)
    row = generation_row(run.config, run.algorithm, state)
    run.metrics.write(row)
    run.report("generation", state.progress, row)
    state = state._replace(losses=programs.empty_losses(run.algorithm))
    every, progress = run.config.evaluation.every, state.progress
    if (
        progress.env_steps // every > progress.evaluated_at // every
        or progress.env_steps >= run.config.env_steps
    ):
        state = test(run, state)
        state = clock.stamp(state)
    return state


def roll_out(run: Run, state: RunState) -> tuple[RunState, Rollout]:
    """Lines 3 to 6: every team plays one episode; all steps go to the replay buffer.

    Raises:
        DivergenceError: if a fitness or an action is not a finite number.
    """
    config, progress = run.config, state.progress
    run.report("rollouts", progress, {})
    teams = run.algorithm.teams(state.algorithm)
    seeds = host_seeds(config, Purpose.ROLLOUT, progress.generation, n_teams(config) + 1)
    noise = np.random.default_rng(int(seeds[-1]))
    shape, scale = run.task.spec.joint_action_size, np.float32(config.learner.exploration_noise)

    def choose(states: NDArray[np.float32], _: int) -> NDArray[np.float32]:
        actions = np.array(programs.act(teams, states, spec=run.task.spec, base=config.base))
        # The last team, the MARL team, explores; the population explores by its diversity.
        actions[-1] += scale * noise.standard_normal(shape, np.float32)
        return actions

    rollout = collect(run.pool, choose, seeds[:-1])
    _check_finite(rollout, f"generation {progress.generation + 1}")
    returns = rollout.episode_return.tolist()
    progress = progress.but(
        env_steps_before=progress.env_steps,
        env_steps=progress.env_steps + len(rollout.transitions.reward),
        gradient_steps_before=progress.gradient_steps,
        generation=progress.generation + 1,
        fitness=tuple(returns[:-1]),
        marl_return=returns[-1],
        learning=True,
    )
    replay = store(state.replay, rollout.transitions)
    return state._replace(replay=replay, progress=progress), rollout


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


def evolve(run: Run, state: RunState, rollout: Rollout) -> RunState:
    """Line 9: the population evolves by the fitness just measured."""
    if not run.config.has_population:
        return state
    fitness = jnp.asarray(rollout.episode_return[:-1], jnp.float32)
    key = jax.random.fold_in(root_key(run.config, Purpose.EVOLUTION), state.progress.generation)
    algorithm = programs.evolve(state.algorithm, fitness, key, **run.statics)
    return state._replace(algorithm=algorithm)


def learn(run: Run, state: RunState) -> RunState:
    """Lines 8, 10 and 13: some of the gradient steps that the generation owes.

    Raises:
        DivergenceError: if a loss is not a finite number.
    """
    progress = state.progress
    count = min(CHUNK, _owed(run, state))
    algorithm, losses = programs.learn(
        state.algorithm,
        state.losses,
        state.replay,
        root_key(run.config, Purpose.LEARNING),
        np.int32(progress.gradient_steps),
        np.int32(count),
        **run.statics,
    )
    for name, value in losses.items():
        if not math.isfinite(float(value)):
            raise DivergenceError(
                f"The {name} loss is no longer a finite number, between gradient steps "
                f"{progress.gradient_steps} and {progress.gradient_steps + count} of generation "
                f"{progress.generation}. Start a new run with smaller learning rates "
                "(--learner.actor-learning-rate, --learner.critic-learning-rate)."
            )
    if progress.gradient_steps == 0:
        run.report(
            "learning", progress, {"time/first_gradient_steps": time.perf_counter() - run.began}
        )
    progress = progress.but(gradient_steps=progress.gradient_steps + count)
    run.report("learning", progress, {})
    return state._replace(algorithm=algorithm, losses=losses, progress=progress)


def _owed(run: Run, state: RunState) -> int:
    progress = state.progress
    learned_from = progress.env_steps - progress.random_steps
    due = math.floor(learned_from * run.config.learner.gradient_steps_per_env_step)
    return due - progress.gradient_steps


def test(run: Run, state: RunState) -> RunState:
    """Plays the test episodes and writes their row."""
    config, progress = run.config, state.progress
    run.report("evaluation", progress, {})
    encoder, played = tested_teams(run.algorithm, state.algorithm, config.has_population)
    seeds = host_seeds(config, Purpose.EVALUATION, progress.generation, config.evaluation.episodes)
    scores = evaluate(run.test_pool, encoder, played, seeds, run.task.spec, config.base)
    row = evaluation_row(progress, scores)
    progress = progress.but(evaluated_at=progress.env_steps)
    run.metrics.write(row)
    run.report("evaluation", progress, row)
    return state._replace(progress=progress)


def _check_finite(rollout: Rollout, where: str) -> None:
    if not np.isfinite(rollout.transitions.next_state).all():
        raise DivergenceError(
            f"The environment gave a state that is not a finite number in {where}. A buffer that "
            "holds it teaches nothing, so the run stops here. Look at the task's observation."
        )
    for team, value in enumerate(rollout.episode_return.tolist()):
        if not math.isfinite(value):
            raise DivergenceError(
                f"The return of team {team} in {where} is {value}: the environment gave a reward "
                "that is not a finite number. A fitness like that never wins, and a buffer that "
                "holds it teaches nothing, so the run stops here. Look at the task's reward."
            )

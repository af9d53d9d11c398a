"""One generation of training: the paper's Algorithm 1, and the random steps before the first.

Everything that changes is one `RunState`; each function maps it to the next.
"""

import math
import time

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from race import programs
from race.config.settings import Config
from race.errors import DivergenceError
from race.randomness import Purpose, host_seeds, root_key
from race.replay.buffer import Layout
from race.replay.packing import layouts
from race.rollouts.base import Score
from race.training.records import evaluation_row, generation_row
from race.training.run import Run, counted, stamped
from race.training.run_state import Progress, RunState

CHUNK = 100
"""Gradient steps between two looks at the clock, the progress bar and Ctrl-C."""
EPISODES_CHUNK = 12
"""The same where each is made on whole episodes and takes far longer."""


def warm_up(run: Run, state: RunState) -> RunState:
    """Random episodes before the first generation, where the learner wants any.

    If it is interrupted, the state stays as it was.

    Raises:
        TaskError: if an environment fails, or hands over what it may not.
    """

    def report(steps: int) -> None:
        run.report("random steps", state.progress.but(env_steps=steps), {})

    warm = run.rollouts.warm_up(state.replay, report, lambda: run.interrupts.requested)
    if warm is None:
        return state
    replay, steps = warm
    progress = counted(run, state.progress.but(env_steps=steps, random_steps=steps))
    return state._replace(replay=replay, progress=progress)


def advance(run: Run, state: RunState) -> RunState:
    """The next piece of a generation: its beginning, some of its gradient steps, or its end.

    Between any two pieces a run can be saved and resumed. Comments name the lines of Algorithm 1.
    """
    if not state.progress.learning:
        run.clock.begin_generation()
        state = roll_out(run, state)  # 3-6
        state = evolve(run, state)  # 9
        jax.block_until_ready(state.replay)
        run.clock.rolled_out()
        return state
    if owed(run.config, state.progress) > 0:
        return learn(run, state)  # 8, 10, 13
    state = inject(run, state)  # 11
    return test(run, state) if _test_due(run, state) else state


def inject(run: Run, state: RunState) -> RunState:
    """Line 11: the MARL team enters the population; the generation is over and has its row."""
    key = jax.random.fold_in(
        root_key(run.config.seed, Purpose.INJECTION), state.progress.generation
    )
    algorithm = state.algorithm
    if state.progress.fitness and run.config.has_marl:
        statics = {name: run.statics[name] for name in ("algorithm", "shape")}
        algorithm = programs.inject(algorithm, key, hyper=state.hyper, **statics)
    progress = stamped(run, state.progress.but(learning=False))
    row = generation_row(run.config, run.algorithm, algorithm, state.losses, progress)
    run.metrics.write(row)
    run.report("generation", progress, row)
    losses = programs.empty_losses(run.algorithm)
    return state._replace(algorithm=algorithm, losses=losses, progress=progress)


def _test_due(run: Run, state: RunState) -> bool:
    every, progress = run.config.evaluation.every, state.progress
    assert every is not None
    passed = progress.env_steps // every > progress.evaluated_at // every
    return passed or progress.env_steps >= run.config.env_steps


def roll_out(run: Run, state: RunState) -> RunState:
    """Lines 3 to 6: every team plays one episode; all steps go to the replay buffer.

    Raises:
        DivergenceError: if a fitness or an action is not a finite number.
        TaskError: if an environment fails, or hands over what it may not.
    """
    progress, config = state.progress, run.config
    run.report("rollouts", progress, {})
    teams = run.algorithm.teams(state.algorithm, run.task.spec, run.statics["shape"])
    n_marl = config.n_marl_teams
    if progress.env_steps - progress.random_steps < config.race.evolution_from and n_marl:
        teams = teams.at(slice(teams.count - 1, None))  # of a population nobody plays yet
    if n_marl:
        teams = teams.last_again(n_marl)
    replay, played = run.rollouts.play(
        teams, n_marl, progress.generation, progress.env_steps, state.replay
    )
    returns = played.episode_return.tolist()
    fitness, of_marl = returns[: teams.count - n_marl], returns[teams.count - n_marl :]
    progress = progress.but(
        env_steps_before=progress.env_steps,
        env_steps=progress.env_steps + played.env_steps,
        episodes=progress.episodes + len(returns),
        gradient_steps_before=progress.gradient_steps,
        generation=progress.generation + 1,
        fitness=tuple(fitness),
        marl_return=sum(of_marl) / len(of_marl) if of_marl else None,
        learning=True,
    )
    return state._replace(replay=replay, progress=counted(run, progress))


def evolve(run: Run, state: RunState) -> RunState:
    """Line 9: the population evolves by the fitness just measured."""
    if not state.progress.fitness:
        return state
    fitness = jnp.asarray(state.progress.fitness, jnp.float32)
    key = jax.random.fold_in(
        root_key(run.config.seed, Purpose.EVOLUTION), state.progress.generation
    )
    algorithm = programs.evolve(state.algorithm, fitness, key, hyper=state.hyper, **run.statics)
    return state._replace(algorithm=algorithm)


def learn(run: Run, state: RunState) -> RunState:
    """Lines 8, 10 and 13: some of the gradient steps that the generation owes.

    Raises:
        DivergenceError: if a loss is not a finite number.
    """
    progress = state.progress
    key, first = root_key(run.config.seed, Purpose.LEARNING), np.int32(progress.gradient_steps)
    if run.config.discrete:
        # Where a generation's steps are parted depends on nothing but their number, so that a
        # resumed run parts them alike.
        count, laid = _minibatches(run, state, key)
    else:
        count, laid = min(CHUNK, owed(run.config, state.progress)), None
    algorithm, losses = programs.learn(
        state.algorithm,
        state.losses,
        state.replay,
        key,
        first,
        np.int32(count),
        hyper=state.hyper,
        **run.statics,
        layouts=laid,
    )
    for name, value in losses.items():
        if not math.isfinite(float(value)):
            raise DivergenceError(
                f"The {name} loss is no longer a finite number, between gradient steps "
                f"{progress.gradient_steps} and {progress.gradient_steps + count} of generation "
                f"{progress.generation}. Start a new run with smaller learning rates "
                "(--learner.actor-learning-rate, --learner.critic-learning-rate, or of --facmac)."
            )
    if progress.gradient_steps == 0:
        run.report(
            "learning", progress, {"time/first_gradient_steps": time.perf_counter() - run.began}
        )
    progress = progress.but(gradient_steps=progress.gradient_steps + count)
    run.report("learning", progress, {})
    return state._replace(algorithm=algorithm, losses=losses, progress=progress)


def _minibatches(run: Run, state: RunState, key: PRNGKeyArray) -> tuple[int, Layout]:
    """The next gradient steps on episodes: how many, and how their minibatches are laid out."""
    config = run.config
    room = max(EPISODES_CHUNK, config.n_teams)
    count = min(room, owed(run.config, state.progress))
    first, shape = np.int32(state.progress.gradient_steps), run.statics["shape"]
    drawn = programs.draw(state.replay, key, first, np.int32(count), room=room, shape=shape)
    places, lengths = (np.asarray(column)[:count] for column in drawn)
    return count, layouts(places, lengths, run.task.spec.episode_limit, room)


def owed(config: Config, progress: Progress) -> int:
    """Gradient steps that are due."""
    if not config.has_marl:
        return 0
    if config.discrete:
        # From the first full minibatch on.
        learned_from = max(progress.episodes - config.facmac.batch_size + 1, 0)
        due = math.floor(learned_from * config.facmac.gradient_steps_per_episode)
    else:
        random = 0 if config.learner.random_steps_owed else progress.random_steps
        learned_from = progress.env_steps - random
        due = math.floor(learned_from * config.learner.gradient_steps_per_env_step)
    return due - progress.gradient_steps


def test(run: Run, state: RunState) -> RunState:
    """Plays the test episodes and writes their row."""
    config, progress = run.config, state.progress
    run.report("evaluation", progress, {})
    spec, episodes = run.task.spec, config.evaluation.episodes
    assert episodes is not None
    seeds = host_seeds(config.seed, Purpose.EVALUATION, progress.generation, episodes)
    scores: dict[str, Score] = {}
    for encoder, heads in run.algorithm.tested(state.algorithm, spec):
        scores |= run.rollouts.test(encoder, heads, seeds)
    progress = counted(run, stamped(run, progress.but(evaluated_at=progress.env_steps)))
    row = evaluation_row(progress, scores)
    run.metrics.write(row)
    run.report("evaluation", progress, row)
    return state._replace(progress=progress)

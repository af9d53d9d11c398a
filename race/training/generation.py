"""One generation of training: the paper's Algorithm 1, and the random steps before the first.

Everything that changes of a run is one `RunState`; each function maps it to the next. What takes
long is done for several runs at once: `race.training.cohort` decides for which.
"""

import dataclasses
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from race import programs
from race.algorithms.base import Tested
from race.config.settings import Config
from race.errors import CheckpointError, DivergenceError, RunDirectoryError
from race.method.normalisation import Observed, observed_more
from race.randomness import Purpose, host_seeds, root_key
from race.rollouts.base import Generation, Play, Trial
from race.rollouts.beginnings import Beginnings
from race.training.fitness import Returns, averages, known_returns, means
from race.training.keeping import keep_best
from race.training.records import evaluation_row, generation_row
from race.training.run import Run, stamped
from race.training.run_state import Outcome, Progress, RunState


def warm_up(run: Run, state: RunState) -> RunState:
    """Random episodes before the first generation, where the learner wants any.

    If it is interrupted, the state stays as it was.

    Raises:
        TaskError: if an environment fails, or hands over what it may not.
    """

    def report(steps: int) -> None:
        run.report("random steps", state.progress.but(env_steps=steps), {})

    before = run.rollouts.repeated
    warm = run.rollouts.warm_up(run.config, state.replay, report, lambda: run.interrupts.requested)
    if warm is None:
        return state
    steps = warm.env_steps
    repeated = state.progress.repeated + run.rollouts.repeated - before
    progress = state.progress.but(env_steps=steps, random_steps=steps, repeated=repeated)
    state = state._replace(replay=warm.replay, progress=progress)
    return _observed(state, warm.observed)


def to_play(run: Run, state: RunState) -> Play:
    """Lines 3 to 6: the teams of a generation, each as often as it plays an episode.

    Where they take turns, the next of them.
    """
    progress, config = state.progress, run.config
    turn = len(progress.played)
    generation = progress.generation - (turn > 0)  # counted from 0, and this one has begun
    run.report("rollouts", progress, {})
    teams = run.algorithm.teams(state.algorithm, run.task.spec, run.statics["shape"])
    n_marl = config.n_marl_teams
    if _marl_alone(config, progress):
        teams = teams.at(slice(teams.count - 1, None))  # of a population nobody plays yet
    teams = teams.again(config.race.fitness_episodes, n_marl)
    teams = dataclasses.replace(teams, scaling=state.scaling)
    if config.in_turns:
        n_marl = int(turn >= teams.count - n_marl)
        teams = teams.at(slice(turn, turn + 1))
    judged_early = teams.count > n_marl and _surrogate_due(config, progress)
    steps = config.race.surrogate_steps if judged_early else None
    turns = config.n_teams if config.in_turns else 1
    env_steps, replay = progress.env_steps, state.replay
    return Play(config, teams, n_marl, generation, env_steps, replay, steps, turn, turns)


def _marl_alone(config: Config, progress: Progress) -> bool:
    """Whether the MARL team plays alone in the generation that is next, or under way."""
    begun_at = progress.env_steps_before if progress.played else progress.env_steps
    return config.has_marl and begun_at - progress.random_steps < config.race.evolution_from


def _surrogate_due(config: Config, progress: Progress) -> bool:
    """Whether beginnings of episodes are to judge the population: by chance, once it can be."""
    share = config.race.surrogate_probability
    if share == 0 or progress.gradient_steps == 0:
        return False
    seeds = host_seeds(config.seed, Purpose.SURROGATE, progress.generation, 1)
    return bool(np.random.default_rng(int(seeds[0])).random() < share)


def noted(run: Run, state: RunState, played: Generation) -> RunState:
    """The state with the results of the episodes; the gradient steps that they owe are next."""
    config, before = run.config, state.progress
    now = played.episode_return.tolist()
    progress = before.but(
        env_steps=before.env_steps + played.env_steps,
        episodes=before.episodes + len(now),
        stored=before.stored + played.stored,
        learning=True,
        repeated=before.repeated + played.repeated,
    )
    if not before.played:
        progress = progress.but(
            env_steps_before=before.env_steps,
            gradient_steps_before=before.gradient_steps,
            generation=before.generation + 1,
        )
    returns, n_marl = (*before.played, *now), config.n_marl_teams
    if len(returns) < (n_marl if _marl_alone(config, before) else config.n_teams):
        progress = progress.but(played=returns)
    else:
        fitness, of_marl = returns[: len(returns) - n_marl], returns[len(returns) - n_marl :]
        averaged: Returns = ()
        if played.beginnings is not None:
            fitness = _judged(run, state, played.beginnings)
        elif fitness and averages(config):
            averaged = _averaged(run, state, fitness)
            fitness = means(averaged)
        progress = progress.but(
            played=(),
            fitness=fitness,
            returns=averaged,
            marl_return=sum(of_marl) / len(of_marl) if of_marl else None,
            estimated=played.beginnings is not None,
        )
    return _observed(state._replace(progress=progress), played.observed)


def _averaged(run: Run, state: RunState, returns: Sequence[float]) -> Returns:
    """The returns by which the teams are judged that have played and not yet evolved.

    Args:
        run: the run.
        state: its state.
        returns: of this generation, all teams and then all again.
    """
    population = run.algorithm.population(state.algorithm)
    assert population is not None
    now, before = (np.asarray(of.id) for of in (population.record.now, population.record.played))
    return known_returns(
        np.reshape(returns, (-1, len(now))).T.tolist(),
        now.tolist(),
        before.tolist(),
        state.progress.returns,
        run.config.race.fitness_generations,
    )


def _judged(run: Run, state: RunState, begun: Beginnings) -> tuple[float, ...]:
    """Discounted returns of the population; the PeVFA guesses what lies behind a beginning.

    In the task's own units, whatever rewards are multiplied by for learning.
    """
    values = programs.expected(state.algorithm, begun.state, **run.statics, scaling=state.scaling)
    ahead = np.asarray(values, np.float64) / run.config.env.reward_scale
    return tuple((begun.rewards + begun.weight * ahead).tolist())


def _observed(state: RunState, now: Observed | None) -> RunState:
    """The state with what its teams have just seen.

    Statistics change here alone, so that all teams that play at once are shown things alike, and
    the gradient steps that follow all see the buffer alike. Tests do not count.
    """
    if state.observed is None or now is None:
        return state
    return state._replace(observed=observed_more(state.observed, now))


def evolve(run: Run, state: RunState) -> RunState:
    """Line 9: the population evolves by the fitness just measured, once all have played."""
    if state.progress.played or not state.progress.fitness:
        return state
    fitness = jnp.asarray(state.progress.fitness, jnp.float32)
    key = jax.random.fold_in(
        root_key(run.config.seed, Purpose.EVOLUTION), state.progress.generation
    )
    algorithm = programs.evolve(state.algorithm, fitness, key, hyper=state.hyper, **run.statics)
    return state._replace(algorithm=algorithm)


def owed(config: Config, progress: Progress) -> int:
    """Gradient steps that are due, in whole policy periods.

    Periods keep several runs at the same moment of theirs. What is left over is due later.
    """
    if not config.has_marl:
        return 0
    if config.discrete:
        # From the first full minibatch on.
        batch_size = config.facmac.batch_size
        learned_from = progress.episodes - batch_size + 1 if progress.stored >= batch_size else 0
        due = math.floor(learned_from * config.facmac.gradient_steps_per_episode)
    else:
        random = 0 if config.learner.random_steps_owed else progress.random_steps
        learned_from = progress.env_steps - random
        due = math.floor(learned_from * config.learner.gradient_steps_per_env_step)
    missing = due - progress.gradient_steps
    return missing - missing % config.policy_delay


def checked(state: RunState, before: Progress) -> RunState | DivergenceError:
    """The state after some gradient steps, if its losses are finite numbers."""
    for name, value in state.losses.items():
        if not math.isfinite(float(value)):
            return DivergenceError(
                f"The {name} loss is no longer a finite number, between gradient steps "
                f"{before.gradient_steps} and {state.progress.gradient_steps} of generation "
                f"{before.generation}. Start a new run with smaller learning rates "
                "(--learner.actor-learning-rate, --learner.critic-learning-rate, or of --facmac)."
            )
    return state


def inject(run: Run, state: RunState) -> Outcome:
    """Line 11: the MARL team enters the population; the generation is over and has its row.

    Returns:
        The state, or why the row could not be written.
    """
    key = jax.random.fold_in(
        root_key(run.config.seed, Purpose.INJECTION), state.progress.generation
    )
    algorithm = state.algorithm
    if state.progress.fitness and run.config.has_marl:
        statics = {name: run.statics[name] for name in ("algorithm", "shape")}
        algorithm = programs.inject(algorithm, key, hyper=state.hyper, **statics)
    progress = stamped(run, state.progress.but(learning=False))
    row = generation_row(run.config, run.algorithm, algorithm, state.losses, progress)
    try:
        run.metrics.write(row)
    except RunDirectoryError as error:
        return error
    run.report("generation", progress, row)
    losses = programs.empty_losses(run.algorithm)
    return state._replace(algorithm=algorithm, losses=losses, progress=progress)


def test(runs: Sequence[Run], states: Sequence[RunState]) -> list[Outcome]:
    """Plays the test episodes of some runs, writes their rows and keeps the best teams.

    Returns:
        Of each the state, or why its directory could not be written.
    """
    groups: list[list[Trial]] = []
    teams: list[tuple[Tested, ...]] = []
    for run, state in zip(runs, states, strict=True):
        run.report("evaluation", state.progress, {})
        episodes = run.config.evaluation.episodes
        assert episodes is not None
        seeds = host_seeds(run.config.seed, Purpose.EVALUATION, state.progress.generation, episodes)
        tested = run.algorithm.tested(state.algorithm, run.task.spec)
        teams.append(tested)
        groups.append([Trial(encoder, heads, seeds, state.scaling) for encoder, heads in tested])
    rollouts = runs[0].rollouts
    before = rollouts.repeated
    scores = [
        dict(item for part in of_run for item in part.items())
        for of_run in zip(*(rollouts.test(t) for t in zip(*groups, strict=True)), strict=True)
    ]
    # Of several runs failures are not told apart: each that took part counts all.
    repeated = rollouts.repeated - before
    after: list[Outcome] = []
    for run, state, tested, found in zip(runs, states, teams, scores, strict=True):
        progress = state.progress
        progress = stamped(
            run,
            progress.but(evaluated_at=progress.env_steps, repeated=progress.repeated + repeated),
        )
        row = evaluation_row(progress, found)
        try:
            run.metrics.write(row)
            keep_best(run, tested, found, progress, state.observed)
        except (RunDirectoryError, CheckpointError) as error:
            after.append(error)
            continue
        run.report("evaluation", progress, row)
        after.append(state._replace(progress=progress))
    return after

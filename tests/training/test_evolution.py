"""What evolution finds, alone and beside a learner, on probes whose answer is known."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom
from whole_runs import rows, run

from race import programs
from race.algorithms import ea
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import (
    CheckpointConfig,
    Config,
    EvaluationConfig,
    FacmacConfig,
    LearnerConfig,
    RaceConfig,
)
from race.config.shape import shape_of
from race.envs import make_task
from race.envs.discrete_probe.rules import CLIMB_PAYOFFS
from race.envs.probe import COORDINATION_BEST, TargetEnv
from race.networks.dense import act, encode
from race.types import Task


def alone(task: str, **race: Any) -> Config:
    """EA with small networks."""
    return resolve(
        Config(
            task,
            algo="ea",
            env_steps=1000,
            learner=LearnerConfig(hidden_sizes=(8, 8)),
            race=RaceConfig(**race),
            evaluation=EvaluationConfig(every=1000, episodes=20),
            checkpoint=CheckpointConfig(minutes=60.0),
        )
    )


def test_ea_finds_the_better_optimum_of_two(tmp_path: Path) -> None:
    """Within 1,000 steps, and so far from the worse one that luck has no part in it."""
    run(tmp_path, alone("probe/coordination", population_size=20))
    found = rows(tmp_path, "evaluation")[-1]["eval/champion/return_mean"]
    assert found > COORDINATION_BEST[1] - 0.02


def test_ea_learns_what_agents_of_unequal_size_see() -> None:
    """Fitness is the mean over 64 states: that of one, as a run measures it, is mostly chance."""
    task = make_task("probe/target", alone("probe/target").env)
    assert isinstance(task, Task)
    spec, config = task.spec, alone("probe/target", population_size=20)
    shape, hyper = shape_of(config), hyper_of(config)
    statics = {"algorithm": ea, "spec": spec, "shape": shape}
    state = programs.start(jax.random.key(1), hyper=hyper, **statics)

    @jax.jit
    def error(state: Any, states: Any, best: Any) -> Any:
        def of_team(encoder: Any, heads: Any) -> Any:
            action = act(encode(encoder, spec, states), heads, spec)
            return jnp.mean(jnp.sum(jnp.square(action - best), axis=1))

        teams = ea.teams(state, spec, shape)
        return jax.vmap(of_team)(teams.encoder, teams.heads)

    rng = np.random.default_rng(0)
    states, others = (rng.uniform(-1, 1, (64, 4)).astype(np.float32) for _ in range(2))
    seen, unseen = ((s, TargetEnv.optimal_action(s)) for s in (states, others))
    for generation in range(200):
        fitness = -error(state, *seen)
        key = jax.random.key(generation)
        state = programs.evolve(state, fitness, key, hyper=hyper, **statics)
    champion = int(state.population.elite)
    constant = np.square(unseen[1] - unseen[1].mean(axis=0)).sum(axis=1).mean()
    assert float(error(state, *unseen)[champion]) < 0.1 * constant


SEEDS = range(1, 21)


@pytest.mark.slow
def test_race_climbs_above_chance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """How many of 20 seeds end at the better joint action, which one in nine choices hits."""
    sizes: dict[str, Any] = {"mixer_size": 8, "hypernet_size": 8, "hidden_size": 16}
    sizes |= {"utility_sizes": (16, 16), "value_size": 8}
    learning = {"epsilon_steps": 1000, "target_update_every": 50, "replay_capacity": 2000}
    counts = {}
    for algo in ("facmac", "merl", "race"):
        counts[algo] = 0
        for seed in SEEDS:
            config = Config(
                "probe/climb",
                algo=algo,  # type: ignore[arg-type]
                seed=seed,
                env_steps=2000,
                facmac=FacmacConfig(
                    **sizes, **learning, batch_size=16, gradient_steps_per_episode=0.2
                ),
                race=RaceConfig(policy_embedding_size=3, mine_size=5, population_size=9)
                if algo == "race"
                else RaceConfig(population_size=9),
                evaluation=EvaluationConfig(every=2000, episodes=4),
                checkpoint=CheckpointConfig(minutes=60.0),
            )
            path = tmp_path / f"{algo}{seed}"
            run(path, resolve(config, discrete=True))
            last = rows(path, "evaluation")[-1]["eval/selected/return_mean"]
            counts[algo] += last == CLIMB_PAYOFFS[0][0]
        with capsys.disabled():
            print(f"\nprobe/climb, better optimum in 20 seeds: {algo} {counts[algo]}")
    assert counts["race"] > binom.ppf(0.99, len(SEEDS), 1 / 9)

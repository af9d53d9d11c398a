"""Compiled programs: one for all numbers and seeds; the numbers are arguments, not constants."""

import dataclasses
import hashlib
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evolving import evolving
from whole_runs import run

from race import programs
from race.algorithms import algorithm_of
from race.config.hyper import Hyper, hyper_of
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
from race.randomness import Purpose, root_key
from race.training.run_state import statics
from race.types import EnvSpec

SMALL = {"policy_embedding_size": 3, "mine_size": 5}
OTHER_RACE = {
    "mutation_fraction": 0.25,
    "vmm_weight": 0.3,
    "mutation_probability": 0.5,
    "agent_mutation_probability": 0.9,
    "crossover_probability": 0.7,
    "injection_probability": 0.8,
    "strong_share": 0.1,
    "reset_share": 0.2,
    "strong_strength": 5.0,
    "mild_strength": 0.2,
    "largest_weight": None,
    "vfm_marl_weight": 0.5,
    "vfm_team_weight": 0.0,
    "value_awareness": 0.0,
}


def continuous(algo: str, seed: int = 1, race: Any = None, **learner: Any) -> Config:
    settings = {"hidden_sizes": (6, 5), "batch_size": 4, "random_steps": 20, **learner}
    return resolve(
        Config(
            "probe/target",
            algo=algo,  # type: ignore[arg-type]
            seed=seed,
            env_steps=60,
            learner=LearnerConfig(**settings),
            race=RaceConfig(**SMALL, **(race or {})),
            evaluation=EvaluationConfig(episodes=2),
        )
    )


def discrete(algo: str, seed: int = 1, race: Any = None, **facmac: Any) -> Config:
    sizes = {"hidden_size": 5, "utility_sizes": (4, 4), "mixer_size": 3, "hypernet_size": 3}
    return resolve(
        Config(
            "probe/memory",
            algo=algo,  # type: ignore[arg-type]
            seed=seed,
            env_steps=60,
            facmac=FacmacConfig(**sizes, batch_size=3, replay_capacity=20, **facmac),
            race=RaceConfig(**SMALL, **(race or {})),
            evaluation=EvaluationConfig(episodes=2),
        ),
        discrete=True,
    )


RATES = {"actor_learning_rate": 1e-4, "critic_learning_rate": 2e-4, "gradient_clip": 0.5}
OTHER_LEARNER = {
    **RATES,
    "discount": 0.9,
    "target_update_rate": 0.1,
    "smoothing_noise": 0.4,
    "smoothing_clip": 0.2,
    "exploration_noise": 0.3,
}
OTHER_FACMAC = {**RATES, "discount": 0.9, "td_lambda": 0.3, "epsilon_start": 0.9}


@pytest.mark.parametrize(
    ("make", "algo", "others"),
    [
        (continuous, "race", OTHER_LEARNER),
        (continuous, "matd3", OTHER_LEARNER),
        (discrete, "race", OTHER_FACMAC),
    ],
)
def test_runs_that_differ_in_numbers_and_seed_share_their_programs(
    tmp_path: Path, make: Callable[..., Config], algo: str, others: dict[str, Any]
) -> None:
    programs.TRACES.clear()
    programs.learn.clear_cache()  # of what other tests of this process have compiled
    run(tmp_path / "one", make(algo))
    first = dict(programs.TRACES)
    assert first["learn"] >= 1
    other = make(algo, seed=2, race=OTHER_RACE, **others)
    other = dataclasses.replace(other, checkpoint=CheckpointConfig(minutes=0.0, keep=1))
    run(tmp_path / "two", other)
    assert dict(programs.TRACES) == first


def test_shapes_tell_what_is_compiled_anew() -> None:
    base = shape_of(continuous("race"))
    assert shape_of(continuous("race", seed=3, race=OTHER_RACE, **OTHER_LEARNER)) == base
    assert shape_of(continuous("race", race={"population_size": 6})) != base
    assert shape_of(continuous("race", race={"mutation_draw": "weight"})) != base
    assert shape_of(continuous("race", policy_delay=3)) != base
    assert shape_of(continuous("race", race={"mine_embedding_layers": 2})) != base
    assert shape_of(continuous("race", race={"teams_per_batch": 2})) != base
    assert shape_of(continuous("race", race={"places": "agent"})) != base
    learning = [shape_of(continuous("race", race={"head_learning_rate": x})) for x in (0.1, 0.2)]
    assert learning[0] == learning[1] != base
    assert shape_of(continuous("race", layer_norm=False)) != base
    # What belongs to a population has no say without one.
    alone = shape_of(continuous("matd3"))
    assert shape_of(continuous("matd3", race={"population_size": 9})) == alone


def test_every_setting_is_in_a_shape_or_a_hyper_or_known_to_be_the_hosts() -> None:
    on_host = {
        "exploration_noise",
        "replay_capacity",
        "replay_precision",
        "random_steps",
        "random_steps_owed",
        "marl_episodes",
        "population_actions",
        "evolution_from",
        "replayed",
        "learn_after",
        "fitness_episodes",
        "fitness_generations",
        "surrogate_probability",
        "surrogate_steps",
        "sharing",  # chooses the algorithm
        "gradient_steps_per_env_step",
        "gradient_steps_per_episode",
        "epsilon_start",
        "epsilon_finish",
        "epsilon_steps",
    }
    renamed = {"hidden_size", "utility_sizes", "value_size"}  # parts of tuples of sizes
    compiled = {*Hyper._fields, *(f.name for f in dataclasses.fields(shape_of(continuous("race"))))}
    for group in (LearnerConfig, FacmacConfig, RaceConfig):
        names = {f.name for f in dataclasses.fields(group)}
        assert names - compiled - on_host - renamed == set(), group.__name__
    assert not compiled & on_host


@pytest.mark.parametrize("algo", ["race", "matd3", "maddpg"])
def test_what_a_learner_has_no_use_for_is_not_a_number_and_reaches_nothing(
    algo: str, tiny_spec: EnvSpec, batch_of: Callable[..., Any]
) -> None:
    config = continuous(algo)
    unused = {name for name, x in hyper_of(config)._asdict().items() if np.isnan(x)}
    assert ("smoothing_noise" in unused) == (algo == "maddpg")
    assert ("vmm_weight" in unused) == (algo != "race")
    assert "td_lambda" in unused
    state, update = one_step(config, tiny_spec)
    assert programs.all_finite(update(state, batch_of(tiny_spec, 4), hyper_of(config))[0])


def one_step(config: Config, spec: EnvSpec) -> tuple[Any, Any]:
    """A state, and the compiled gradient step (with policies) whose numbers are an argument."""
    algorithm = algorithm_of(config)
    state = algorithm.init(jax.random.key(3), spec, shape_of(config), hyper_of(config))

    def update(state: Any, batch: Any, hyper: Hyper) -> Any:
        key, shape = jax.random.key(4), shape_of(config)
        return algorithm.update(state, batch, jnp.int32(1), key, spec, shape, hyper)

    return state, jax.jit(update)


@pytest.mark.parametrize(("algo", "base"), [("race", "matd3"), ("matd3", None), ("race", "facmac")])
def test_numbers_as_arguments_give_what_they_give_as_constants(
    algo: str, base: Any, tiny_spec: EnvSpec, batch_of: Callable[..., Any]
) -> None:
    config = continuous(algo, race=OTHER_RACE, **OTHER_LEARNER)
    if base == "facmac":
        config = resolve(dataclasses.replace(config, base=base))
    state, update = one_step(config, tiny_spec)
    batch = batch_of(tiny_spec, 4)
    python = Hyper(*map(float, hyper_of(config)))
    constants = jax.jit(partial(update.__wrapped__, hyper=python))
    given, fixed = update(state, batch, hyper_of(config)), constants(state, batch)
    for a, b in zip(jax.tree.leaves(given), jax.tree.leaves(fixed), strict=True):
        scale = np.abs(np.asarray(b)).max(initial=0.0)
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6 * scale)


def test_evolution_with_numbers_as_arguments_gives_what_it_gives_with_constants(
    tiny_spec: EnvSpec,
) -> None:
    config = continuous("race", race=OTHER_RACE)
    algorithm, shape = algorithm_of(config), shape_of(config)
    state = algorithm.init(jax.random.key(3), tiny_spec, shape, hyper_of(config))
    fitness, key = jnp.arange(5.0), jax.random.key(6)

    def evolve(hyper: Hyper) -> Any:
        return evolving(algorithm)(state, fitness, key, tiny_spec, shape, hyper)

    given = jax.jit(evolve)(hyper_of(config))
    fixed = jax.jit(partial(evolve, Hyper(*map(float, hyper_of(config)))))()
    for a, b in zip(jax.tree.leaves(given), jax.tree.leaves(fixed), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def digest_of_a_step() -> str:
    """A digest of the state after some gradient steps of a run's own program."""
    spec = EnvSpec("tiny", 4, ((2, 0, 3), (1, 3)), ((1,), (2, 0)), (-1.0,) * 3, (1.0,) * 3, 5)
    config = continuous("race", race=OTHER_RACE)
    from race.bench.update import random_replay

    fixed = statics(config, spec, algorithm_of(config))
    key = root_key(config.seed, Purpose.INIT)
    state = programs.start(key, hyper=hyper_of(config), **fixed)
    after, _ = programs.learn(
        jax.tree.map(jnp.copy, state),
        programs.empty_losses(algorithm_of(config)),
        random_replay(spec, 16),
        root_key(config.seed, Purpose.LEARNING),
        np.int32(0),
        np.int32(5),
        hyper=hyper_of(config),
        **fixed,
    )
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(after):
        found.update(np.asarray(leaf).tobytes())
    return found.hexdigest()


def test_a_fresh_process_gives_the_same_to_the_bit() -> None:
    folder = Path(__file__).parent
    code = (
        f"import sys; sys.path[:0] = [{str(folder)!r}, {str(folder.parent)!r}]; "
        "from test_programs import digest_of_a_step; print(digest_of_a_step())"
    )
    fresh = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert fresh.stdout.split()[-1] == digest_of_a_step()

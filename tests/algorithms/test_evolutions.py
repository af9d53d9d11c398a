"""Evolutions other than genetics: distributions of teams, and operators of one's own."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from whole_runs import rows, run

from race.algorithms import lineage
from race.algorithms.evolutions import evolve, start
from race.algorithms.population import inject_team
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config, EvaluationConfig, LearnerConfig, RaceConfig
from race.config.shape import shape_of
from race.errors import ConfigError
from race.types import EnvSpec, Team

Make = Callable[..., "World"]


class World:
    """A population whose fitness is minus the squared distance to a goal."""

    def __init__(self, spec: EnvSpec, config: Config) -> None:
        self.spec, shape, hyper = spec, shape_of(config), hyper_of(config)
        size = (shape.population_size, spec.n_agents, 5, spec.action_size)
        self.mask = jnp.asarray(spec.action_mask, jnp.float32)[:, None]
        heads = 0.3 * jax.random.normal(jax.random.key(0), size) * self.mask[None]
        self.start = jax.tree.map(jnp.asarray, start(Team(None, heads), spec, shape))
        self.goal = self.mask * jax.random.normal(jax.random.key(1), size[1:])
        self.step = jax.jit(
            lambda population, fitness, key: evolve(population, fitness, key, spec, shape, hyper)
        )
        self.inject = jax.jit(lambda p, team: inject_team(p, team, jax.random.key(0), hyper))

    def fitness(self, population: Any) -> jax.Array:
        return -self.distance(population.teams.heads)

    def distance(self, heads: jax.Array) -> jax.Array:
        """Of weights alone: genetics leaves biases as they are."""
        away = heads[..., :-1, :] - jnp.broadcast_to(self.goal[:, :-1], heads[..., :-1, :].shape)
        return jnp.sum(jnp.square(away), axis=(-3, -2, -1))


@pytest.fixture(scope="module")
def make(tiny_spec: EnvSpec, tiny_config: Callable[..., Config]) -> Make:
    def world(evolution: str, **race: Any) -> World:
        config = tiny_config("race", "matd3", race={"evolution": evolution, **race})
        return World(tiny_spec, config)

    return world


@pytest.mark.parametrize(
    ("evolution", "numbers"),
    [
        ("cem", {"cem_noise_decay": 0.9}),
        ("es", {"es_noise": 0.1, "es_learning_rate": 0.05}),
        ("ga", {}),
    ],
)
def test_every_evolution_comes_closer_to_a_goal(
    make: Make, evolution: str, numbers: dict[str, float]
) -> None:
    world = make(evolution, population_size=24, **numbers)
    population = world.start
    first = float(world.fitness(population).max())
    for generation in range(100):
        population = world.step(population, world.fitness(population), jax.random.key(generation))
    heads = population.champion.heads
    assert float(world.distance(heads)) < -first / 8
    padded = np.broadcast_to(np.asarray(world.mask == 0), population.teams.heads.shape[1:])
    assert not np.asarray(population.teams.heads)[:, padded].any()
    assert not np.asarray(heads)[padded].any()


def test_cem_draws_around_its_elites_with_a_floor_that_decays(make: Make) -> None:
    numbers = {"cem_noise_start": 0.2, "cem_noise_end": 0.1, "cem_noise_decay": 0.5}
    world = make("cem", population_size=3000, cem_elite_share=0.001, **numbers)
    before = world.start
    np.testing.assert_allclose(
        before.memory.variance.heads, np.var(np.asarray(before.teams.heads), axis=0), rtol=1e-4
    )
    fitness = world.fitness(before)
    best = np.argsort(-np.asarray(fitness))[:3]
    weights = np.log(4) - np.log(np.arange(1, 4))
    weights /= weights.sum()
    elites = np.asarray(before.teams.heads, float)[best]
    by = weights[:, None, None, None]
    mean = (by * elites).sum(axis=0)
    moved = np.asarray(before.memory.mean.heads, float)
    variance = (by * (elites - moved) ** 2).sum(axis=0) + 0.2
    after = world.step(before, fitness, jax.random.key(0))
    np.testing.assert_allclose(after.memory.mean.heads, mean, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(after.memory.variance.heads, variance, rtol=1e-3)
    real = np.broadcast_to(np.asarray(world.mask == 1), mean.shape)
    drawn = np.asarray(after.teams.heads)
    z = ((drawn - mean) / np.sqrt(variance))[:, real]
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=0.08)
    # The champion is the team that was best, though it lives no longer.
    np.testing.assert_array_equal(after.champion.heads, before.teams.heads[best[0]])
    again = world.step(after, world.fitness(after), jax.random.key(1))
    floor = np.asarray(again.memory.variance.heads)[~real]  # of padding nothing but the floor
    np.testing.assert_allclose(floor, 0.15, rtol=1e-3)


def test_es_steps_along_its_gradient_and_mirrors_its_noise(make: Make) -> None:
    world = make("es", population_size=7, es_noise=0.1, es_learning_rate=0.02)
    before = world.start
    after = world.step(before, world.fitness(before), jax.random.key(0))
    mean, heads = np.asarray(after.memory.params.heads), np.asarray(after.teams.heads)
    real = np.broadcast_to(np.asarray(world.mask == 1), mean.shape)
    middle = (heads[:3] + heads[4:])[:, real] / 2
    np.testing.assert_allclose(middle, np.tile(mean[real], (3, 1)), atol=1e-6)
    assert 0.05 < (heads - mean)[:, real].std() < 0.15
    moved = np.abs(mean - np.asarray(before.memory.params.heads))[real]
    np.testing.assert_allclose(moved, 0.02, rtol=1e-3)  # Adam's first step


@pytest.mark.parametrize("evolution", ["cem", "es"])
def test_the_marl_team_is_a_sample(make: Make, evolution: str) -> None:
    world = make(evolution, population_size=6)
    population = world.step(world.start, world.fitness(world.start), jax.random.key(0))
    assert all(row["origin"] == "sampled" for row in told(population))
    entered = world.inject(population, Team(None, world.goal))
    np.testing.assert_array_equal(entered.teams.heads[5], world.goal)
    assert [row["origin"] for row in told(entered)] == ["sampled"] * 5 + ["injected"]
    after = world.step(entered, world.fitness(entered), jax.random.key(1))
    assert after.injection_counts.tolist() == [1, 0, 0]
    np.testing.assert_array_equal(after.champion.heads, world.goal)
    mean_of = {"cem": lambda m: m.mean, "es": lambda m: m.params}[evolution]
    distance = [
        float(jnp.sum(jnp.square(mean_of(p.memory).heads - world.goal))) for p in (entered, after)
    ]
    assert distance[1] < distance[0]
    worst = jnp.arange(6.0)[::-1]
    assert world.step(entered, worst, jax.random.key(1)).injection_counts.tolist() == [0, 0, 1]
    second = jnp.array([9.0, 1, 2, 3, 4, 8])
    assert world.step(entered, second, jax.random.key(1)).injection_counts.tolist() == [0, 1, 0]


def told(population: Any) -> list[dict[str, Any]]:
    size = population.teams.heads.shape[0]
    return lineage.rows(population.record.now, (0.0,) * size)


# --- operators of one's own -------------------------------------------------------------------

HERE = "test_evolutions"


def averaged(heads: Any, fitness: Any, key: Any) -> Any:
    """The worst team becomes the mean of all, shaken, its padding too; the others live on."""
    noise = jax.random.normal(key, heads.shape[1:])
    return heads.at[jnp.argmin(fitness)].set(jnp.mean(heads, axis=0) + 0.1 * noise)


def too_few(heads: Any, fitness: Any, key: Any) -> Any:
    return heads[:2]


def broken(heads: Any, fitness: Any, key: Any) -> Any:
    raise ValueError("out of ideas")


def test_an_operator_of_ones_own(make: Make) -> None:
    world = make(f"{HERE}:averaged", population_size=5)
    before = world.start
    fitness = jnp.array([2.0, -1.0, 5.0, 0.0, 1.0])
    after = world.step(before, fitness, jax.random.key(0))
    old, new = np.asarray(before.teams.heads), np.asarray(after.teams.heads)
    for team in (0, 2, 3, 4):
        np.testing.assert_array_equal(new[team], old[team])
    assert not np.array_equal(new[1], old[1])
    assert not new[1][np.broadcast_to(np.asarray(world.mask == 0), new[1].shape)].any()
    assert after.record.now.id.tolist() == [0, 5, 2, 3, 4]
    assert [row["origin"] for row in told(after)] == ["kept", "own", "kept", "kept", "kept"]
    np.testing.assert_array_equal(after.champion.heads, old[2])
    assert int(after.worst) == 1


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("too_few", r"returned float32\[2, 2, 5, 2\]; it must .* float32\[5, 2, 5, 2\]"),
        ("broken", "failed: ValueError: out of ideas"),
        ("missing", "has no function missing. Define one that takes heads"),
    ],
)
def test_an_operator_that_cannot_work_is_told_of(make: Make, name: str, why: str) -> None:
    def one_step() -> None:
        world = make(f"{HERE}:{name}", population_size=5)
        world.step(world.start, jnp.arange(5.0), jax.random.key(0))

    with pytest.raises(ConfigError, match=why):
        one_step()


def test_an_evolution_that_is_none_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"ga, cem, es, or package\.module:function"):
        resolve(Config("probe/target", race=RaceConfig(evolution="pso")))


def averaged_teams(teams: Team, fitness: Any, key: Any) -> Team:
    """The same of whole teams."""
    worst = jnp.argmin(fitness)
    return jax.tree.map(lambda leaf: leaf.at[worst].set(jnp.mean(leaf, axis=0)), teams)


def test_whole_runs_evolve_by_it(tmp_path: Path) -> None:
    config = Config(
        "probe/target",
        algo="ea",
        env_steps=15,
        learner=LearnerConfig(hidden_sizes=(6, 5)),
        race=RaceConfig(evolution=f"{HERE}:averaged_teams"),
        evaluation=EvaluationConfig(every=50, episodes=2),
    )
    run(tmp_path, resolve(config))
    found = [[team["origin"] for team in row["teams"]] for row in rows(tmp_path, "generation")]
    assert found[0] == ["initial"] * 5
    assert all(sorted(origins) == ["kept"] * 4 + ["own"] for origins in found[1:])
    assert len(found) == 3


def test_the_example_in_the_documents(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (Path(__file__).parent.parent.parent / "docs/evolution.md").read_text()
    (example,) = re.findall(r"```python\n# (\w+)\.py\n(.*?)```", text, re.DOTALL)
    (tmp_path / f"{example[0]}.py").write_text(example[1])
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    world = make(f"{example[0]}:around_the_best", population_size=5)
    after = world.step(world.start, jnp.array([2.0, -1.0, 5.0, 0.0, 1.0]), jax.random.key(0))
    assert [row["origin"] for row in told(after)] == ["own", "own", "kept", "own", "own"]

"""Several runs in lockstep: each does what it does alone."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_trainer import small as continuous
from test_trainer_discrete import of_unequal_lengths
from test_trainer_discrete import small as discrete
from whole_runs import KilledError, rows, run

from race.config.cohort import Batching
from race.config.settings import CheckpointConfig, Config
from race.errors import (
    CheckpointError,
    ConfigError,
    DivergenceError,
    RaceError,
    RunDirectoryError,
)
from race.runs import checkpoints, team_files
from race.runs import directory as run_directory
from race.runs.metrics import MetricsWriter
from race.training import learning, lockstep
from race.training.cohort import kind_of, together
from race.training.run import Report, silent
from race.training.run_state import Progress
from race.training.trainer import Order, train_cohort

__all__ = ["of_unequal_lengths"]
UNEQUAL = "test_cohort:of_unequal_lengths"
SEEDS = (1, 2, 3)


@pytest.fixture(autouse=True)
def short_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "CHUNK", 7)
    monkeypatch.setattr(learning, "EPISODES_CHUNK", 5)


def configs(kind: str) -> list[Config]:
    """Three seeds that also differ in a number and in their budget."""
    config = (
        discrete(UNEQUAL)
        if kind == "discrete"
        else continuous("probe/target", env_steps=100, algo=kind)
    )
    made = []
    for seed in SEEDS:
        changed = dataclasses.replace(config, seed=seed, env_steps=config.env_steps + 20 * seed)
        if kind != "discrete":
            noise = dataclasses.replace(config.learner, exploration_noise=0.1 * seed)
            changed = dataclasses.replace(changed, learner=noise)
        made.append(changed)
    return made


def train_all(
    path: Path, made: list[Config], batching: Batching, report: Report = silent
) -> list[Progress | RaceError]:
    orders = []
    for config in made:
        place = path / f"seed{config.seed}"
        if not (place / "config.json").exists():
            run_directory.create(place, config)
        orders.append(Order(place, config, report=report))
    return train_cohort(orders, batching=batching)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], list[Any]]:
    """The rows of each run by itself."""
    known: dict[str, list[Any]] = {}

    def of(kind: str) -> list[Any]:
        if kind not in known:
            known[kind] = []
            for config in configs(kind):
                path = tmp_path_factory.mktemp(kind) / "run"
                run(path, config)
                known[kind].append(rows(path))
        return known[kind]

    return of


def assert_near(found: list[dict[str, Any]], expected: list[dict[str, Any]]) -> None:
    """The same rows up to rounding; lineage and shares of small counts are numbers as others."""
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert one.keys() == other.keys()
        for name, value in other.items():
            if isinstance(value, float):
                assert one[name] == pytest.approx(value, rel=2e-2, abs=2e-3), name
            else:
                assert type(one[name]) is type(value), name


def assert_as_alone(path: Path, config: Config, batching: Batching, *, exactly: bool) -> None:
    """Two runs in lockstep write what each writes by itself, to the bit or up to rounding."""
    made = [dataclasses.replace(config, seed=seed) for seed in (1, 2)]
    results = train_all(path / "together", made, batching)
    assert [type(result) for result in results] == [Progress, Progress]
    for one in made:
        run(path / f"{one.seed}", one)
        found = rows(path / "together" / f"seed{one.seed}")
        expected = rows(path / f"{one.seed}")
        if exactly:
            assert found == expected
        else:
            assert_near(found, expected)


KINDS = ["race", pytest.param("discrete", marks=pytest.mark.slow)]


@pytest.mark.parametrize("kind", KINDS)
def test_one_after_the_other_each_run_is_what_it_is_alone(
    tmp_path: Path, alone: Callable[[str], list[Any]], kind: str
) -> None:
    results = train_all(tmp_path, configs(kind), "map")
    for config, result, expected in zip(configs(kind), results, alone(kind), strict=True):
        assert isinstance(result, Progress)
        assert result.env_steps >= config.env_steps
        place = tmp_path / f"seed{config.seed}"
        assert rows(place) == expected
        assert run_directory.is_finished(place)
    first, second, third = (rows(tmp_path / f"seed{seed}") for seed in SEEDS)
    assert first[0] != second[0] != third[0] != first[0]


@pytest.mark.parametrize("kind", KINDS)
def test_in_one_program_each_run_is_what_it_is_alone_up_to_rounding(
    tmp_path: Path, alone: Callable[[str], list[Any]], kind: str
) -> None:
    results = train_all(tmp_path, configs(kind), "vmap")
    assert all(isinstance(result, Progress) for result in results)
    for config, expected in zip(configs(kind), alone(kind), strict=True):
        found = rows(tmp_path / f"seed{config.seed}")
        # Rounding grows as a run goes on; a stranger's key or a stranger's data would show at once.
        assert_near(found[:2], expected[:2])
        assert [row["env_steps"] for row in found] == [row["env_steps"] for row in expected]
        assert [row["gradient_steps"] for row in found] == [
            row["gradient_steps"] for row in expected
        ]


@pytest.mark.parametrize("batching", ["map", "vmap"])
def test_a_run_that_diverges_leaves_the_others_alone(
    tmp_path: Path, alone: Callable[[str], list[Any]], batching: Batching
) -> None:
    made = configs("race")
    broken = dataclasses.replace(made[1].learner, critic_learning_rate=1e30, gradient_clip=1e30)
    made[1] = dataclasses.replace(made[1], learner=broken)
    results = train_all(tmp_path, made, batching)
    assert isinstance(results[1], DivergenceError)
    assert "smaller learning rates" in str(results[1])
    newest = checkpoints.newest(tmp_path / "seed2" / "checkpoints")
    assert newest is not None
    assert str(newest) in str(results[1])
    for place in (0, 2):
        result, found = results[place], rows(tmp_path / f"seed{SEEDS[place]}")
        assert isinstance(result, Progress)
        if batching == "map":
            assert found == alone("race")[place]
        else:
            assert_near(found[:2], alone("race")[place][:2])


@pytest.mark.parametrize("moment", [2, 30, 47])
def test_killed_cohorts_go_on_exactly(
    tmp_path: Path, alone: Callable[[str], list[Any]], moment: int
) -> None:
    """Also when a kill between two saves leaves runs at unequal moments."""
    calls = 0

    def kill(stage: str, progress: Progress, row: dict[str, Any]) -> None:
        nonlocal calls
        calls += 1
        if calls > moment:
            raise KilledError

    with pytest.raises(KilledError):
        train_all(tmp_path, configs("race"), "map", kill)
    train_all(tmp_path, configs("race"), "map")
    for seed, expected in zip(SEEDS, alone("race"), strict=True):
        assert rows(tmp_path / f"seed{seed}") == expected


def test_a_run_of_a_cohort_goes_on_alone_and_the_cohort_without_it(
    tmp_path: Path, alone: Callable[[str], list[Any]]
) -> None:
    made = configs("race")
    calls = 0

    def stop(stage: str, progress: Progress, row: dict[str, Any]) -> None:
        nonlocal calls
        calls += stage == "evaluation"
        if calls > 1:
            raise KilledError

    with pytest.raises(KilledError):
        train_all(tmp_path, made, "vmap", stop)
    run(tmp_path / "seed2", made[1])
    results = train_all(tmp_path, made, "map")
    assert isinstance(results[1], RaceError)
    assert "has finished" in str(results[1])
    for result in (results[0], results[2]):
        assert isinstance(result, Progress)
        assert result.env_steps >= made[0].env_steps


@pytest.mark.parametrize("batching", ["map", "vmap"])
def test_a_run_that_diverges_as_it_ends_stops_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batching: Batching
) -> None:
    """Its networks are found out when it is saved for the last time."""
    made = configs("race")
    sound = lockstep.save

    def save(run: Any, state: Any) -> None:
        if run.config.seed == 1 and state.progress.env_steps >= made[0].env_steps:
            raise DivergenceError("no numbers")
        sound(run, state)

    monkeypatch.setattr(lockstep, "save", save)
    results = train_all(tmp_path, made, batching)
    assert isinstance(results[0], DivergenceError)
    for config, result in zip(made[1:], results[1:], strict=True):
        assert isinstance(result, Progress)
        assert result.env_steps >= config.env_steps
        assert run_directory.is_finished(tmp_path / f"seed{config.seed}")


def test_a_run_whose_rows_cannot_be_written_stops_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = configs("matd3")
    sound = MetricsWriter.write

    def write(self: MetricsWriter, row: Any) -> None:
        if self._path.parent.name == "seed2" and row["kind"] == "evaluation":
            raise RunDirectoryError("the disk is full")
        sound(self, row)

    monkeypatch.setattr(MetricsWriter, "write", write)
    results = train_all(tmp_path, made, "map")
    assert isinstance(results[1], RunDirectoryError)
    assert not run_directory.is_finished(tmp_path / "seed2")
    for config, result in zip((made[0], made[2]), (results[0], results[2]), strict=True):
        assert isinstance(result, Progress)
        assert run_directory.is_finished(tmp_path / f"seed{config.seed}")
    with pytest.raises(RunDirectoryError, match="full"):  # the only run ends with the error
        train_all(tmp_path / "alone", made[1:2], "map")


def test_a_run_whose_best_team_cannot_be_kept_stops_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeping = CheckpointConfig(keep_best=1)
    made = [dataclasses.replace(config, checkpoint=keeping) for config in configs("matd3")[:2]]
    sound = team_files.write

    def write(path: Path, *told: Any) -> None:
        if "seed2" in path.parts:
            raise CheckpointError("the disk is full")
        sound(path, *told)

    monkeypatch.setattr(team_files, "write", write)
    results = train_all(tmp_path, made, "map")
    assert isinstance(results[0], Progress)
    assert run_directory.is_finished(tmp_path / "seed1")
    assert isinstance(results[1], CheckpointError)
    assert not run_directory.is_finished(tmp_path / "seed2")


def test_runs_that_are_not_of_one_kind_are_refused(tmp_path: Path) -> None:
    made = [continuous(), continuous(algo="matd3", seed=2)]
    with pytest.raises(ConfigError, match="numbers and seeds alone"):
        train_all(tmp_path, made, "map")


def test_runs_of_one_kind_differ_in_numbers_alone() -> None:
    config = continuous()
    rate = dataclasses.replace(config.learner, actor_learning_rate=0.1)
    alike = dataclasses.replace(config, seed=9, env_steps=7, learner=rate)
    assert kind_of(alike) == kind_of(config)
    batch = dataclasses.replace(config.learner, batch_size=9)
    for other in (
        dataclasses.replace(config, learner=batch),
        dataclasses.replace(config, task="probe/target"),
        continuous(algo="matd3"),
        dataclasses.replace(config, race=dataclasses.replace(config.race, fitness_episodes=2)),
        dataclasses.replace(
            config, race=dataclasses.replace(config.race, population_actions="sampled")
        ),
        dataclasses.replace(config, env=dataclasses.replace(config.env, retries=7)),
    ):
        assert kind_of(other) != kind_of(config)


def test_one_program_is_for_several_runs_on_an_accelerator() -> None:
    assert not together("auto", 5)
    assert not together("map", 5)
    assert together("vmap", 5)
    assert not together("vmap", 1)


def test_what_is_drawn_for_a_run_depends_on_it_alone() -> None:
    """Its minibatches in one program are those it draws alone."""
    import jax

    from race.config.hyper import hyper_of
    from race.config.shape import shape_of
    from race.programs import cohort
    from race.replay.buffer import Replay, sample
    from race.types import Transition

    shape, hyper = shape_of(continuous()), hyper_of(continuous())
    numbers = jax.numpy.arange(30.0)
    columns = (numbers[:, None], numbers[:, None], numbers, numbers, numbers[:, None])
    replay = Replay(Transition(*columns), jax.numpy.int32(21))
    key = jax.random.key(5)
    found = cohort.minibatches(replay, key, np.int32(4), hyper=hyper, room=3, shape=shape)
    for i in range(3):
        sample_key, _ = jax.random.split(jax.random.fold_in(key, 4 + i))
        expected = sample(replay, shape.batch_size, sample_key)
        np.testing.assert_array_equal(found.reward[i], expected.reward)

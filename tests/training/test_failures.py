"""Runs whose environment fails: nothing is lost, and they go on exactly where they were."""

import dataclasses
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from whole_runs import KilledError, rows, run

from race.config.presets import resolve
from race.config.settings import (
    CheckpointConfig,
    Config,
    EnvConfig,
    EvaluationConfig,
    LearnerConfig,
)
from race.envs import factorised
from race.errors import EnvFailedError, HandedOverError, TaskError
from race.runs import checkpoints
from race.runs import directory as run_directory
from race.training.run_state import Progress
from race.training.trainer import Order, train, train_cohort
from race.types import Task

TASK = "test_failures:task"


class Faulty(gymnasium.Env[Any, Any]):
    """Five steps of a random walk, whose faults the tests choose."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    failing_seeds = 0  # fail at the third step if it divides the seed
    broken_from = 10**9  # number of the episode from which on every one fails
    wrong_from = 10**9  # or shows what is no number
    episodes = failures = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        Faulty.episodes += 1
        self.seed, self.steps = seed, 0
        self.at = self.np_random.uniform(-1, 1, 2)
        return self.at, {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        self.at = self.at + 0.1 * action + 0.01 * self.np_random.normal(size=2)
        fails = self.failing_seeds and self.seed % self.failing_seeds == 0
        if self.steps == 3 and (fails or Faulty.episodes >= self.broken_from):
            Faulty.failures += 1
            raise ConnectionError("the simulator does not answer")
        wrong = np.nan if Faulty.episodes >= self.wrong_from else 0.0
        return self.at + wrong, -float(np.square(self.at).sum()), False, self.steps == 5, {}


def task() -> Task:
    index = ((0,), (1,))
    return factorised(
        lambda mode: Faulty(), obs_index=index, action_index=index, task=TASK, episode_limit=5
    )


@pytest.fixture(autouse=True)
def sound(monkeypatch: pytest.MonkeyPatch) -> None:
    """No faults, unless a test asks for them."""
    for name in ("failing_seeds", "broken_from", "wrong_from", "episodes", "failures"):
        monkeypatch.setattr(Faulty, name, getattr(Faulty, name))
    Faulty.episodes = Faulty.failures = 0


def small(**changes: Any) -> Config:
    config = Config(
        TASK,
        algo="matd3",
        env_steps=120,
        learner=LearnerConfig(hidden_sizes=(6, 5), batch_size=4, random_steps=40),
        env=EnvConfig(retries=2),
        evaluation=EvaluationConfig(every=60, episodes=3),
        checkpoint=CheckpointConfig(minutes=0.0),
    )
    return resolve(dataclasses.replace(config, **changes))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """The rows of a run in which nothing fails."""
    path = tmp_path_factory.mktemp("whole")
    run(path, small())
    return rows(path)


def test_accidents_are_counted_and_resuming_stays_exact(tmp_path: Path) -> None:
    Faulty.failing_seeds = 1
    with pytest.raises(EnvFailedError, match=r"seed .* .environment 0.: ConnectionError"):
        run(tmp_path / "mistake", small())  # the task has never worked yet
    Faulty.failing_seeds, Faulty.failures = 5, 0
    run(tmp_path / "whole", small())
    expected, failed = rows(tmp_path / "whole"), Faulty.failures
    assert 4 < failed == expected[-1]["env/repeated_episodes"]
    counts = [row.get("env/repeated_episodes", 0) for row in expected]
    assert counts == sorted(counts)
    assert counts[0] < counts[-1]
    for moment in (4, 21):
        calls = 0

        def kill(stage: str, progress: Progress, row: dict[str, Any], moment: int = moment) -> None:
            nonlocal calls
            calls += 1
            if calls > moment:
                raise KilledError

        path = tmp_path / str(moment)
        with pytest.raises(KilledError):
            run(path, small(), kill)
        run(path, small())
        assert rows(path) == expected


# 8 episodes at random, then one a generation; the first 3 tests after the fourth generation.
@pytest.mark.parametrize(("fault", "episode"), [("broken", 10), ("broken", 14), ("wrong", 13)])
def test_a_run_is_saved_before_its_environment_ends_it(
    tmp_path: Path, whole: list[dict[str, Any]], fault: str, episode: int
) -> None:
    setattr(Faulty, f"{fault}_from", episode)
    kind = EnvFailedError if fault == "broken" else HandedOverError
    with pytest.raises(TaskError, match=rf"saved at \d+ .*: race resume {tmp_path}$") as raised:
        run(tmp_path, small())
    assert raised.type is kind
    assert ("--env.retries" in str(raised.value)) == (fault == "broken")
    newest = checkpoints.newest(tmp_path / "checkpoints")
    assert newest is not None
    made = checkpoints.load(newest).info["progress"]["env_steps"]
    assert made == 5 * min(episode - 1, 12)
    assert f"saved at {made} environment steps" in str(raised.value)
    Faulty.broken_from = Faulty.wrong_from = 10**9  # it is mended
    run(tmp_path, small())
    assert rows(tmp_path) == whole


def test_populations_and_cohorts_are_saved_too(tmp_path: Path) -> None:
    """In a test after a generation, when the MARL teams have entered the populations."""
    made = [small(algo="race", env_steps=150, seed=seed) for seed in (1, 2)]
    for config in made:
        run_directory.create(tmp_path / f"alone{config.seed}", config)
        train(tmp_path / f"alone{config.seed}", config)
        run_directory.create(tmp_path / f"seed{config.seed}", config)
    orders = [Order(tmp_path / f"seed{config.seed}", config) for config in made]
    Faulty.episodes = 0
    # 16 episodes each at random, cut short, then 6 each a generation, of 30 steps; the first tests
    # are at 70.
    Faulty.broken_from = 2 * 16 + 2 * 6 + 3
    with pytest.raises(EnvFailedError, match=r"The runs were saved at 70, 70 .* race resume"):
        train_cohort(orders, batching="map")
    Faulty.broken_from = 10**9
    train_cohort(orders, batching="map")
    for config in made:
        expected = rows(tmp_path / f"alone{config.seed}")
        assert rows(tmp_path / f"seed{config.seed}") == expected


def test_repeated_episodes_of_a_cohort_are_what_they_are_alone(tmp_path: Path) -> None:
    """Noise too, however long the others played."""
    made = [small(env_steps=100, seed=seed) for seed in (3, 4)]
    for config in made:
        run(tmp_path / f"alone{config.seed}", dataclasses.replace(config, env_steps=60))
        run_directory.create(tmp_path / f"seed{config.seed}", config)
    orders = [Order(tmp_path / f"seed{c.seed}", dataclasses.replace(c, env_steps=60)) for c in made]
    train_cohort(orders, batching="map")
    Faulty.failing_seeds, Faulty.failures = 4, 0
    for config in made:
        run(tmp_path / f"alone{config.seed}", config)
    assert Faulty.failures > 2
    train_cohort([dataclasses.replace(o, config=c) for o, c in zip(orders, made, strict=True)])
    for config in made:
        expected = rows(tmp_path / f"alone{config.seed}")
        assert rows(tmp_path / f"seed{config.seed}") == expected

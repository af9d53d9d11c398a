"""Properties of whole runs: they repeat, resume exactly, stop when something is not finite."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from whole_runs import KilledError, rows, run

from race import programs
from race.config.presets import resolve
from race.config.settings import (
    CheckpointConfig,
    Config,
    EvaluationConfig,
    LearnerConfig,
    RaceConfig,
)
from race.envs import factorised
from race.errors import DivergenceError
from race.runs import checkpoints
from race.training import learning, trainer
from race.training.run_state import Progress
from race.training.trainer import train
from race.types import Task


def small(task: str = "probe/terminates", **changes: Any) -> Config:
    learner = LearnerConfig(hidden_sizes=(12, 8), batch_size=8, random_steps=40)
    config = Config(
        task,
        env_steps=220,
        learner=learner,
        race=RaceConfig(policy_embedding_size=4, mine_size=6),
        evaluation=EvaluationConfig(every=90, episodes=2),
        checkpoint=CheckpointConfig(minutes=0.0, keep=2),
    )
    return resolve(dataclasses.replace(config, **changes))


@pytest.fixture(autouse=True)
def short_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "CHUNK", 7)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, Any]]]:
    """Rows of whole runs, one per algorithm."""
    found = {}
    for algo in ("race", "matd3"):
        path = tmp_path_factory.mktemp(algo) / "run"
        run(path, small(algo=algo))
        found[algo] = rows(path)
    return found


def test_a_run_writes_what_it_promises(tmp_path: Path) -> None:
    config = small()
    progress = run(tmp_path / "run", config)
    assert progress.env_steps >= config.env_steps
    assert progress.gradient_steps == progress.env_steps - progress.random_steps
    assert progress.random_steps == 40
    assert (tmp_path / "run" / "DONE").exists()
    found = rows(tmp_path / "run")
    generations = [row for row in found if row["kind"] == "generation"]
    evaluations = [row for row in found if row["kind"] == "evaluation"]
    assert [row["generation"] for row in generations] == list(range(1, progress.generation + 1))
    # Every episode of this probe has 5 steps; 6 teams act.
    assert np.all(np.diff([40, *(row["env_steps"] for row in generations)]) == 30)
    assert evaluations[-1]["env_steps"] == progress.env_steps
    for row in evaluations:
        for team in ("marl", "champion", "selected"):
            assert row[f"eval/{team}/return_mean"] == pytest.approx(5.0)
            assert row[f"eval/{team}/return_std"] == pytest.approx(0.0)
    for row in generations:
        assert row["population/fitness_max"] == pytest.approx(5.0)
        assert all(np.isfinite(v) for k, v in row.items() if k.startswith("loss/"))
    rates = [generations[-1][f"injection/{f}_rate"] for f in ("elite", "parent", "discarded")]
    assert sum(rates) == pytest.approx(1.0)


@pytest.mark.parametrize("algo", ["race", "matd3"])
def test_same_seed_same_run_other_seed_other_run(
    tmp_path: Path, uninterrupted: dict[str, list[dict[str, Any]]], algo: str
) -> None:
    run(tmp_path / "again", small(algo=algo))
    assert rows(tmp_path / "again") == uninterrupted[algo]
    run(tmp_path / "other", small(algo=algo, seed=2))
    assert rows(tmp_path / "other") != uninterrupted[algo]


@pytest.mark.parametrize("algo", ["race", "matd3"])
@pytest.mark.parametrize("moment", [1, 3, 9, 16, 40])
def test_a_killed_run_resumes_exactly(
    tmp_path: Path, uninterrupted: dict[str, list[dict[str, Any]]], algo: str, moment: int
) -> None:
    calls = 0

    def kill(stage: str, progress: Progress, row: dict[str, Any]) -> None:
        nonlocal calls
        calls += 1
        if calls > moment:
            raise KilledError

    config = small(algo=algo)
    with pytest.raises(KilledError):
        run(tmp_path, config, kill)
    # KilledError a second time, a little later.
    calls = -3
    with pytest.raises(KilledError):
        run(tmp_path, config, kill)
    run(tmp_path, config)
    assert rows(tmp_path) == uninterrupted[algo]


def test_a_run_stopped_early_and_extended_is_the_longer_run(
    tmp_path: Path, uninterrupted: dict[str, list[dict[str, Any]]]
) -> None:
    short = small(env_steps=120)
    run(tmp_path, short)
    extended = dataclasses.replace(short, env_steps=220)
    train(tmp_path, extended, extend=True)
    generations = [row for row in rows(tmp_path) if row["kind"] == "generation"]
    assert generations == [row for row in uninterrupted["race"] if row["kind"] == "generation"]


def test_random_steps_count_and_are_exact(tmp_path: Path) -> None:
    # 6 teams and episodes of 5 steps: 40 is a multiple of neither.
    config = small(env_steps=41)
    progress = run(tmp_path, config)
    assert progress.random_steps == 40
    saved = checkpoints.load(checkpoints.newest(tmp_path / "checkpoints"))
    assert saved.rows["replay"].inserted == progress.env_steps


def test_only_the_marl_team_explores_with_noise(tmp_path: Path) -> None:
    found = []
    for noise in (0.0, 0.5):
        learner = dataclasses.replace(small().learner, exploration_noise=noise)
        path = tmp_path / str(noise)
        run(path, small("probe/chain", learner=learner, env_steps=46))
        found.append(rows(path)[0])
    quiet, noisy = found
    for key in ("population/fitness_max", "population/fitness_mean", "population/fitness_min"):
        assert quiet[key] == noisy[key]
    assert quiet["marl/return"] != noisy["marl/return"]


def test_gradient_steps_follow_the_ratio(tmp_path: Path) -> None:
    learner = dataclasses.replace(small().learner, gradient_steps_per_env_step=0.3)
    progress = run(tmp_path, small(learner=learner))
    assert progress.gradient_steps == int(0.3 * (progress.env_steps - progress.random_steps))


class EndlessEnv(gymnasium.Env[Any, Any]):
    """Never ends an episode."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros(2), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.zeros(2), 1.0, False, False, {}


def test_the_episode_limit_holds_where_the_environment_has_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make_task(name: str, config: Any) -> Task:
        return factorised(
            lambda mode: EndlessEnv(),
            obs_index=((0,), (1,)),
            action_index=((0,), (1,)),
            task=name,
            episode_limit=6,
        )

    monkeypatch.setattr(trainer, "make_task", make_task)
    run(tmp_path, small("endless", algo="matd3", env_steps=52))
    found = rows(tmp_path)
    assert [row["env_steps"] for row in found if row["kind"] == "generation"] == [46, 52]
    assert found[-1]["eval/marl/return_mean"] == 6.0
    saved = checkpoints.load(checkpoints.newest(tmp_path / "checkpoints"))
    assert not saved.rows["replay"].columns["terminated"].any()


def test_each_program_is_compiled_once(tmp_path: Path) -> None:
    programs.TRACES.clear()
    for program in ("start", "store", "act", "_evolve", "learn", "_inject"):
        getattr(programs, program).clear_cache()  # of what other tests have compiled
    learner = LearnerConfig(hidden_sizes=(11, 9), batch_size=8, random_steps=20)
    run(tmp_path, small("probe/target", learner=learner, env_steps=60))
    counts = dict(programs.TRACES)
    assert counts == {
        "start": 1,
        "store": 1,
        "act": 2,  # training, and evaluation with its own number of teams
        "evolve": 1,
        "learn": 1,
        "inject": 1,
    }


def test_a_loss_that_is_not_finite_stops_the_run(tmp_path: Path) -> None:
    learner = dataclasses.replace(small().learner, critic_learning_rate=1e30)
    with pytest.raises(DivergenceError, match=r"loss is no longer .* smaller learn") as caught:
        run(tmp_path, small(algo="matd3", learner=learner))
    newest = checkpoints.newest(tmp_path / "checkpoints")
    assert newest is not None
    assert str(newest) in str(caught.value)
    arrays = checkpoints.load(newest).arrays
    assert all(np.isfinite(a).all() for a in arrays.values() if a.dtype == np.float32)
    assert not (tmp_path / "DONE").exists()


def _command(path: Path, *extra: str) -> list[str]:
    settings = [
        "--env-steps=500",
        "--learner.random-steps=40",
        "--learner.batch-size=8",
        "--learner.hidden-sizes=12 8",
        "--evaluation.every=90",
        "--evaluation.episodes=2",
        "--checkpoint.minutes=0",
    ]
    flags = [part for setting in settings for part in setting.replace("=", " ").split()]
    return [
        sys.executable,
        "-m",
        "race",
        "train",
        "probe/terminates",
        "--run-dir",
        str(path),
        *flags,
    ]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_signals_lose_nothing(tmp_path: Path, number: signal.Signals) -> None:
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    whole = tmp_path / "whole"
    subprocess.run(_command(whole), check=True, env=environment, capture_output=True)
    path = tmp_path / "run"
    process = subprocess.Popen(
        _command(path), env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    rng = np.random.default_rng(int(number))
    wanted = int(rng.integers(2, 9))
    metrics_file = path / "metrics.jsonl"
    while not metrics_file.exists() or metrics_file.read_bytes().count(b"\n") < wanted:
        assert process.poll() is None, process.communicate()
        time.sleep(0.002)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    if number != signal.SIGKILL:
        assert process.returncode == 130, err
        assert "race resume" in out
    resumed = subprocess.run(
        [sys.executable, "-m", "race", "resume", str(path)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "Traceback" not in resumed.stderr
    assert rows(path) == rows(whole)
    assert json.loads((path / "config.json").read_text())["env_steps"] == 500

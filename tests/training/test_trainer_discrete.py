"""Whole runs on tasks with discrete actions: they repeat, resume exactly, and learn."""

import contextlib
import dataclasses
import functools
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from whole_runs import KilledError, rows, run

from race import programs
from race.cli import main
from race.config.presets import resolve
from race.config.settings import (
    CheckpointConfig,
    Config,
    EvaluationConfig,
    FacmacConfig,
    RaceConfig,
)
from race.envs.discrete_probe import PROBES
from race.envs.discrete_probe.host import ProbeHost
from race.envs.discrete_probe.rules import CLIMB_PAYOFFS
from race.envs.pymarl import pymarl_task
from race.replay.buffer import distinct_places
from race.rollouts.discrete import EpisodeRollouts
from race.runs import checkpoints
from race.runs import directory as run_directory
from race.training import learning
from race.training.run import Report
from race.training.run_state import Progress
from race.types import DiscreteTask

TEAMS = 5
ON_HOST = "test_trainer_discrete:lives_on_host"
UNEQUAL = "test_trainer_discrete:of_unequal_lengths"


def lives_on_host() -> DiscreteTask:
    """``probe/lives`` as somebody's own environment with PyMARL's interface."""
    return pymarl_task(functools.partial(ProbeHost, "probe/lives"), ON_HOST)


class Unequal:
    """PyMARL's interface to episodes of 1 to 8 steps in which nothing happens."""

    def get_env_info(self) -> dict[str, int]:
        sizes = ("n_agents", "obs_shape", "state_shape", "n_actions", "episode_limit")
        return dict(zip(sizes, (2, 1, 1, 2, 8), strict=True))

    def seed(self, seed: int) -> None:
        self.chance = np.random.default_rng(seed)

    def reset(self) -> None:
        self.left = int(self.chance.integers(1, 9))

    def get_obs(self) -> Any:
        return np.full((2, 1), float(self.left))

    def get_state(self) -> Any:
        return np.full(1, float(self.left))

    def get_avail_actions(self) -> Any:
        return np.ones((2, 2))

    def step(self, actions: Any) -> tuple[float, bool, dict[str, Any]]:
        self.left -= 1
        return 1.0, self.left == 0, {}

    def close(self) -> None: ...


def of_unequal_lengths() -> DiscreteTask:
    return pymarl_task(Unequal, UNEQUAL)


def small(
    task: str = "probe/lives", facmac: dict[str, Any] | None = None, **changes: Any
) -> Config:
    settings = FacmacConfig(
        mixer_size=3,
        hypernet_size=4,
        hidden_size=6,
        utility_sizes=(5, 4),
        value_size=4,
        batch_size=3,
        target_update_every=7,
        epsilon_steps=60,
        replay_capacity=20,
        gradient_steps_per_episode=2.4,  # more in a generation than are made at once
    )
    config = Config(
        task,
        env_steps=90,
        facmac=dataclasses.replace(settings, **(facmac or {})),
        race=RaceConfig(
            policy_embedding_size=3, mine_size=5, population_size=TEAMS - 1, elite_copy=False
        ),
        evaluation=EvaluationConfig(every=40, episodes=3),
        checkpoint=CheckpointConfig(minutes=0.0, keep=2),
    )
    return resolve(dataclasses.replace(config, **changes), discrete=True)


def final(path: Path) -> Any:
    """All that the newest checkpoint of a run holds, without times."""
    newest = checkpoints.newest(path / "checkpoints")
    assert newest is not None
    saved = checkpoints.load(newest)
    replay = saved.rows["replay"]
    progress = {
        name: value
        for name, value in saved.info["progress"].items()
        if not name.endswith("_seconds") and name != "metrics_offset"
    }
    columns = {name: column[: replay.size] for name, column in replay.columns.items()}
    return saved.arrays, columns, replay.inserted, progress


def assert_same(one: Any, other: Any) -> None:
    for mine, theirs in zip(one[:2], other[:2], strict=True):
        assert set(mine) == set(theirs)
        for name in mine:
            np.testing.assert_array_equal(mine[name], theirs[name], err_msg=name, strict=True)
    assert one[2:] == other[2:]


@pytest.fixture(autouse=True)
def short_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "EPISODES_CHUNK", 2)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Path]:
    """(algorithm, task) -> the directory of a whole run."""

    @functools.cache
    def make(algo: str, task: str) -> Path:
        path = tmp_path_factory.mktemp(algo) / "run"
        run(path, small(task, algo=algo))
        return path

    return make


def end_after(reports: int, how: str) -> Report:
    """Ends a run after so many reports, as a kill or Ctrl-C would."""
    calls = 0

    def report(stage: str, progress: Progress, row: dict[str, Any]) -> None:
        nonlocal calls
        calls += 1
        if calls == reports:
            if how == "kill":
                raise KilledError
            os.kill(os.getpid(), signal.SIGINT)

    return report


@pytest.mark.parametrize(
    ("algo", "task", "how"),
    [
        ("race", "probe/lives", "kill"),
        pytest.param("race", "probe/lives", "interrupt", marks=pytest.mark.slow),
        pytest.param("race", ON_HOST, "kill", marks=pytest.mark.slow),
        pytest.param("facmac", "probe/lives", "kill", marks=pytest.mark.slow),
        ("facmac", ON_HOST, "interrupt"),
    ],
)
def test_a_run_ended_again_and_again_is_the_uninterrupted_run(
    tmp_path: Path, uninterrupted: Callable[[str, str], Path], algo: str, task: str, how: str
) -> None:
    whole, config, ends = uninterrupted(algo, task), small(task, algo=algo), 0
    run_directory.create(tmp_path, config)
    while not (tmp_path / "DONE").exists():
        # At ever other moments, and late enough that a checkpoint has been written in between.
        with contextlib.suppress(KilledError):
            run(tmp_path, config, end_after(8 + 5 * ends % 13, how))
        ends += 1
        assert ends < 40, "no progress between two ends"
    assert ends > 3
    assert rows(tmp_path) == rows(whole)
    assert_same(final(tmp_path), final(whole))


@pytest.mark.parametrize("algo", [pytest.param("race", marks=pytest.mark.slow), "facmac"])
def test_runs_on_host_and_device_are_the_same(
    uninterrupted: Callable[[str, str], Path], algo: str
) -> None:
    on_device, on_host = (uninterrupted(algo, task) for task in ("probe/lives", ON_HOST))
    assert rows(on_host) == rows(on_device)
    assert_same(final(on_host), final(on_device))


def test_another_seed_is_another_run(
    tmp_path: Path, uninterrupted: Callable[[str, str], Path]
) -> None:
    run(tmp_path, small(seed=2, env_steps=40))
    other = rows(tmp_path, "generation")
    assert other != rows(uninterrupted("race", "probe/lives"), "generation")[: len(other)]


@pytest.mark.slow
def test_an_extended_run_is_the_longer_run(tmp_path: Path) -> None:
    """Also where the short run's buffer had no room for what the longer one collects."""
    room = {"replay_capacity": 500}
    run(tmp_path / "long", small(facmac=room, algo="facmac"))
    run(tmp_path / "short", small(facmac=room, algo="facmac", env_steps=45))
    newest = checkpoints.newest(tmp_path / "short" / "checkpoints")
    assert checkpoints.load(newest).rows["replay"].capacity < 90
    main(["resume", str(tmp_path / "short"), "--env-steps", "90"])
    assert rows(tmp_path / "short", "generation") == rows(tmp_path / "long", "generation")
    assert_same(final(tmp_path / "short"), final(tmp_path / "long"))


def test_all_steps_of_all_teams_count(tmp_path: Path) -> None:
    progress = run(tmp_path, small(env_steps=60))
    _, columns, inserted, _ = final(tmp_path)
    assert progress.env_steps == columns["length"].sum()
    assert progress.env_steps >= 60 > progress.env_steps_before
    assert progress.episodes == inserted == TEAMS * progress.generation
    ends = np.cumsum(columns["length"])[TEAMS - 1 :: TEAMS]
    found = rows(tmp_path, "generation")
    assert [row["env_steps"] for row in found] == ends.tolist()
    returns = columns["reward"].sum(axis=1).reshape(-1, TEAMS)
    for row, (*population, marl) in zip(found, returns.tolist(), strict=True):
        assert row["marl/return"] == pytest.approx(marl, rel=1e-6)
        assert row["population/fitness_max"] == pytest.approx(max(population), rel=1e-6)
    assert progress.random_steps == 0


@pytest.mark.parametrize(
    ("algo", "batch", "ratio"),
    [pytest.param("race", 8, 0.3, marks=pytest.mark.slow), ("facmac", 4, 1.0)],
)
def test_gradient_steps_begin_with_the_first_minibatch(
    tmp_path: Path, algo: str, batch: int, ratio: float
) -> None:
    facmac = {"batch_size": batch, "gradient_steps_per_episode": ratio}
    config = small("probe/matching", facmac, algo=algo, env_steps=30 if algo == "race" else 8)
    run(tmp_path, config)
    teams = TEAMS if algo == "race" else 1
    expected = [
        int(max(episodes - batch + 1, 0) * ratio)
        for episodes in range(teams, config.env_steps + 1, teams)
    ]
    found = rows(tmp_path, "generation")
    assert [row["gradient_steps"] for row in found] == expected
    made = np.diff([0, *expected])
    assert made[0] == 0
    for row, steps in zip(found, made, strict=True):
        losses = [value for name, value in row.items() if name.startswith("loss/")]
        assert len(losses) == (7 if algo == "race" else 2)
        assert all((value is None) == (steps == 0) for value in losses)


def test_learning_is_traced_once_per_shape_and_sees_whole_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows_used, first = set(), 0
    real, places_of = programs.learn, jax.jit(distinct_places, static_argnums=1)

    def spy(state: Any, sums: Any, replay: Any, *others: Any, layouts: Any, **statics: Any) -> Any:
        nonlocal first
        key, begin, count = others
        assert begin == first  # no step is left out or made twice
        first += int(count)
        rows_used.add(layouts.place.shape)
        lengths = np.asarray(replay.data.length)
        for step in range(int(count)):
            sample_key, _ = jax.random.split(jax.random.fold_in(key, int(begin) + step))
            drawn = np.asarray(places_of(replay, 3, sample_key))
            assert len(set(drawn.tolist())) == 3
            place, time = layouts.place[step], layouts.time[step]
            for episode in drawn:
                mine = (place == episode) & (time >= 0)
                assert sorted(time[mine].tolist()) == list(range(lengths[episode] + 1))
            assert (time >= 0).sum() == (lengths[drawn] + 1).sum()
        return real(state, sums, replay, *others, layouts=layouts, **statics)

    for program in ("start", "store", "draw", "learn"):
        getattr(programs, program).clear_cache()  # of what other tests have compiled
    monkeypatch.setattr(programs, "learn", spy)
    monkeypatch.setattr(learning, "EPISODES_CHUNK", 1)
    programs.TRACES.clear()
    facmac = {"gradient_steps_per_episode": 1.0}
    progress = run(tmp_path, small(UNEQUAL, facmac, algo="facmac", env_steps=150))
    assert first == progress.gradient_steps > 20
    assert {(1, 9, 2), (1, 9, 3)} <= rows_used <= {(1, 9, rows) for rows in (1, 2, 3)}
    traced = {"start": 1, "store": 1, "draw": 1, "learn": len(rows_used)}
    assert dict(programs.TRACES) == traced


@pytest.mark.slow
@pytest.mark.parametrize(("task", "has_wins"), [("probe/memory", True), ("probe/lives", False)])
@pytest.mark.parametrize("algo", ["race", "facmac"])
def test_win_rates_are_written_where_there_are_wins(
    tmp_path: Path, task: str, has_wins: bool, algo: str
) -> None:
    # Minibatches so large that nothing is learned.
    run(tmp_path, small(task, {"batch_size": 20}, algo=algo, env_steps=15))
    teams = {"marl", "champion", "selected"} if algo == "race" else {"marl", "selected"}
    found = rows(tmp_path, "evaluation")
    assert found
    for row in found:
        quantities = ("return_mean", "return_std", "length_mean", *["win_rate"] * has_wins)
        expected = {f"eval/{team}/{name}" for team in teams for name in quantities}
        assert {name for name in row if name.startswith("eval/")} == expected
        if has_wins:
            assert all(0 <= row[f"eval/{team}/win_rate"] <= 1 for team in teams)
    assert not any("win_rate" in name for row in rows(tmp_path, "generation") for name in row)


@pytest.mark.slow
def test_evaluations_come_every_so_many_steps_of_32_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    defaults = resolve(Config("probe/matching"), discrete=True).evaluation
    assert defaults == EvaluationConfig(every=10_000, episodes=32)
    seeds: list[Any] = []
    real = EpisodeRollouts.test

    def spy(self: EpisodeRollouts, encoder: Any, heads: Any, now: Any) -> Any:
        seeds.append(now.tolist())
        return real(self, encoder, heads, now)

    monkeypatch.setattr(EpisodeRollouts, "test", spy)
    evaluation = resolve(
        Config("probe/matching", evaluation=EvaluationConfig(every=12)), discrete=True
    ).evaluation
    # Generations of five steps, and minibatches so large that nothing is learned.
    facmac = {"batch_size": 100, "replay_capacity": 100}
    run(tmp_path, small("probe/matching", facmac, evaluation=evaluation, env_steps=52))
    found = [row["env_steps"] for row in rows(tmp_path, "evaluation")]
    assert found == [15, 25, 40, 50, 55]
    assert [len(now) for now in seeds] == [32] * 5
    assert len({seed for now in seeds for seed in now}) == 5 * 32


# Learning.


def selected_returns(
    path: Path, task: str, algo: str, env_steps: int, ratio: float = 1.0, **changes: Any
) -> list[float]:
    """Of the selected team's tests; ``ratio`` is that of gradient steps to episodes."""
    settings = {"mixer_size": 8, "hypernet_size": 8, "hidden_size": 16, "batch_size": 16}
    config = small(
        task,
        {
            **settings,
            "utility_sizes": (16, 16),
            "value_size": 8,
            "epsilon_steps": env_steps // 2,
            "target_update_every": 50,
            "replay_capacity": 2000,
            "gradient_steps_per_episode": ratio,
        },
        algo=algo,
        env_steps=env_steps,
        evaluation=EvaluationConfig(every=env_steps // 4, episodes=32),
        checkpoint=CheckpointConfig(minutes=60.0),
        **changes,
    )
    run(path, config)
    return [row["eval/selected/return_mean"] for row in rows(path, "evaluation")]


@pytest.mark.slow
@pytest.mark.parametrize(("algo", "env_steps"), [("facmac", 400), ("race", 600)])
def test_learners_solve_the_matching_of_cues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, algo: str, env_steps: int
) -> None:
    monkeypatch.setattr(learning, "EPISODES_CHUNK", 12)
    found = selected_returns(tmp_path, "probe/matching", algo, env_steps)
    assert found[-1] >= 0.9 * PROBES["probe/matching"].optimal_return
    # Agents that choose any available action are right 0.4 of the time.
    assert found[0] < 0.9


@pytest.mark.slow
def test_race_climbs_to_the_better_optimum(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "EPISODES_CHUNK", 12)
    population = RaceConfig(policy_embedding_size=3, mine_size=5, population_size=9)
    found = selected_returns(
        tmp_path, "probe/climb", "race", 2000, ratio=0.2, race=population, seed=2
    )
    assert found[-1] == CLIMB_PAYOFFS[0][0]
    # It was not there to begin with.
    assert rows(tmp_path, "generation")[0]["population/fitness_max"] <= CLIMB_PAYOFFS[2][2]

"""Laws of whole runs, over algorithms, learners and probes; a handful of them always."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from whole_runs import KilledError, rows, run

from race import programs
from race.algorithms.lineage import ORIGINS
from race.config.presets import resolve
from race.config.settings import (
    CheckpointConfig,
    Config,
    EvaluationConfig,
    FacmacConfig,
    LearnerConfig,
    RaceConfig,
)
from race.envs import discrete_probe, probe
from race.runs import checkpoints
from race.teams.trained import load_trained
from race.training import generation, learning
from race.training.run_state import Progress

POPULATION = 5
CONTINUOUS = [
    (algo, base, task)
    for algo in ("race", "merl", "marl", "no-sharing")
    for base in ("matd3", "maddpg", "facmac")
    for task in probe.PROBES
]
CONTINUOUS += [("ea", "matd3", task) for task in probe.PROBES]
DISCRETE = [
    (algo, "facmac", task)
    for algo in ("race", "merl", "marl", "no-sharing", "ea")
    for task in discrete_probe.PROBES
]
ALWAYS = [("merl", "matd3", "probe/terminates"), ("ea", "facmac", "probe/lives")]
"""The others take minutes together: each compiles gradient steps of its own."""


def small(algo: str, base: str, task: str, **race: Any) -> Config:
    sizes: dict[str, Any] = {"policy_embedding_size": 3, "mine_size": 4}
    config = Config(
        task,
        algo="race" if algo == "no-sharing" else base if algo == "marl" else algo,  # type: ignore[arg-type]
        base=base,  # type: ignore[arg-type]
        env_steps=90,
        learner=LearnerConfig(hidden_sizes=(6, 5), batch_size=4, random_steps=20),
        facmac=FacmacConfig(
            mixer_size=3, hypernet_size=3, hidden_size=4, utility_sizes=(4, 4), batch_size=3
        ),
        race=RaceConfig(**{**sizes, "sharing": algo != "no-sharing", **race}),
        evaluation=EvaluationConfig(every=40, episodes=2),
        checkpoint=CheckpointConfig(minutes=0.0, keep=1),
    )
    return resolve(config, discrete=task in discrete_probe.PROBES)


@pytest.mark.parametrize(
    ("algo", "base", "task"),
    [
        *ALWAYS,
        *(
            pytest.param(*law, marks=pytest.mark.slow)
            for law in CONTINUOUS + DISCRETE
            if law not in ALWAYS
        ),
    ],
)
def test_the_laws_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, algo: str, base: str, task: str
) -> None:
    monkeypatch.setattr(learning, "CHUNK", 7)
    monkeypatch.setattr(learning, "EPISODES_CHUNK", 2)
    config = small(algo, base, task)
    progress = run(tmp_path / "whole", config)
    check_rows(tmp_path / "whole", config, progress)
    check_resumption(tmp_path, config)
    check_teams(tmp_path / "whole", config)


def check_rows(path: Path, config: Config, progress: Progress) -> None:
    generations, tests = rows(path, "generation"), rows(path, "evaluation")
    assert progress.env_steps >= config.env_steps
    assert progress.episodes == config.n_teams * len(generations)
    assert (progress.random_steps > 0) == (config.has_marl and not config.discrete)
    if not config.has_marl:
        assert progress.gradient_steps == 0
    elif not config.discrete:
        assert progress.gradient_steps == progress.env_steps - progress.random_steps
    there = {"marl": config.has_marl, "champion": config.has_population}
    names = [name for name, is_there in there.items() if is_there]
    for row in tests:
        assert {key.split("/")[1] for key in row if key.startswith("eval/")} == {
            *names,
            *("selected", "best"),
        }
    known: dict[int, float | None] = {}
    for row in generations:
        assert ("marl/return" in row) == config.has_marl
        assert ("teams" in row) == config.has_population
        if not config.has_population:
            continue
        teams = row["teams"]
        assert len(teams) == config.race.population_size
        assert max(team["fitness"] for team in teams) == row["population/fitness_max"]
        assert len({team["id"] for team in teams}) == len(teams)
        for team in teams:
            assert team["origin"] in ORIGINS
            for parent in np.ravel(team.get("parents", [])).tolist():
                assert parent in known
        assert [team["origin"] for team in teams].count("elite") == (row["generation"] > 1)
        assert sum(t["origin"] == "injected" for t in teams) == (
            config.has_marl and row["generation"] > 1
        )
        known |= {team["id"]: team["fitness"] for team in teams}


def check_resumption(folder: Path, config: Config) -> None:
    calls = 0

    def kill(stage: str, progress: Progress, row: dict[str, Any]) -> None:
        nonlocal calls
        calls += 1
        if calls in (9, 23):
            raise KilledError

    with contextlib.suppress(KilledError):
        run(folder / "killed", config, kill)
    with contextlib.suppress(KilledError):
        run(folder / "killed", config, kill)
    run(folder / "killed", config)
    assert rows(folder / "killed") == rows(folder / "whole")
    saved = []
    for name in ("killed", "whole"):
        newest = checkpoints.newest(folder / name / "checkpoints")
        assert newest is not None
        saved.append(checkpoints.load(newest))
    for name, array in saved[0].arrays.items():
        np.testing.assert_array_equal(array, saved[1].arrays[name], err_msg=name)
    assert saved[0].rows["replay"].inserted == saved[1].rows["replay"].inserted
    assert (saved[0].rows["replay"].inserted > 0) == config.has_marl


def check_teams(path: Path, config: Config) -> None:
    trained = load_trained(path)
    for name in trained.heads:
        if config.discrete:
            policy = trained.recurrent_policy(name)  # type: ignore[arg-type]
            spec: Any = trained.task.spec
            available = np.ones((spec.n_agents, spec.n_actions))
            action = policy(np.zeros((spec.n_agents, spec.obs_size)), available)
            assert action.shape == (spec.n_agents,)
        else:
            spec = trained.task.spec
            joint = trained.policy(name)(np.zeros(spec.state_size, np.float32))  # type: ignore[arg-type]
            assert joint.shape == (spec.joint_action_size,)


SAMPLED = {"population_actions": "sampled"}
OWN = {"utility_embedding": "agent"}
OF_EPISODES = {"vmm_reduction": "sum", "mine_negatives": "episodes"}
MORE = {"teams_per_batch": 2, "mine_embedding_layers": 2, "places": "agent"}
ONE_HEAD = {"team_heads": "shared"}


@pytest.mark.parametrize(
    ("algo", "task", "race"),
    [
        ("race", "probe/lives", {**SAMPLED, **OWN, **OF_EPISODES, **MORE}),
        pytest.param("race", "probe/lives", ONE_HEAD, marks=pytest.mark.slow),
        pytest.param("race", "probe/terminates", OWN, marks=pytest.mark.slow),
        *(
            pytest.param(algo, "probe/lives", SAMPLED, marks=pytest.mark.slow)
            for algo in ("merl", "ea", "no-sharing")
        ),
    ],
)
def test_the_laws_hold_with_other_choices_over_facmac(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, algo: str, task: str, race: dict[str, Any]
) -> None:
    monkeypatch.setattr(learning, "CHUNK", 7)
    monkeypatch.setattr(learning, "EPISODES_CHUNK", 2)
    config = small(algo, "facmac", task, **race)
    progress = run(tmp_path / "whole", config)
    check_rows(tmp_path / "whole", config, progress)
    check_resumption(tmp_path, config)
    check_teams(tmp_path / "whole", config)


@pytest.mark.parametrize(
    ("algo", "base", "task"),
    [
        ("merl", "facmac", "probe/lives"),
        pytest.param("race", "matd3", "probe/terminates", marks=pytest.mark.slow),
    ],
)
def test_the_marl_team_may_play_more_often_and_alone_at_first(
    tmp_path: Path, algo: str, base: str, task: str
) -> None:
    config = small(algo, base, task, marl_episodes=3, evolution_from=25)
    config = dataclasses.replace(config, env_steps=130)
    progress = run(tmp_path, config)
    generations = rows(tmp_path, "generation")
    alone = [row for row in generations if "teams" not in row]
    together = [row for row in generations if "teams" in row]
    assert generations == alone + together
    assert len(alone) >= 2
    assert len(together) >= 2
    random = progress.random_steps
    assert alone[-2]["env_steps"] - random < 25 <= alone[-1]["env_steps"] - random
    assert progress.episodes == 3 * len(alone) + (POPULATION + 3) * len(together)
    assert all(team["origin"] == "initial" for team in together[0]["teams"])
    assert [team["origin"] for team in together[1]["teams"]].count("injected") == 1
    assert len(progress.fitness) == POPULATION


def test_beginnings_of_episodes_may_judge_the_population(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Episodes of ten steps that pay 1 each, cut after three, at a discount of a half."""
    monkeypatch.setattr(learning, "CHUNK", 7)
    expected: list[np.ndarray] = []
    asked = programs.expected

    def noting(*args: Any, **more: Any) -> np.ndarray:
        expected.append(np.asarray(asked(*args, **more), np.float64))
        return expected[-1]

    config = small("race", "matd3", "probe/time-limit", surrogate_probability=0.5)
    config = dataclasses.replace(
        config,
        env_steps=250,
        learner=dataclasses.replace(config.learner, discount=0.5),
        race=dataclasses.replace(config.race, surrogate_steps=3),
        env=dataclasses.replace(config.env, reward_scale=2.0),
    )
    with monkeypatch.context() as patched:
        patched.setattr(programs, "expected", noting)
        progress = run(tmp_path / "whole", config)
    generations = rows(tmp_path / "whole", "generation")
    assert progress.gradient_steps == progress.env_steps - progress.random_steps
    before, judged = progress.random_steps, iter(expected)
    kinds = [row["population/surrogate"] for row in generations]
    assert not kinds[0]  # there was nothing learned yet
    assert {*kinds} == {False, True}
    for row, surrogate in zip(generations, kinds, strict=True):
        made, before = row["env_steps"] - before, row["env_steps"]
        assert made == (POPULATION * 3 + 10 if surrogate else (POPULATION + 1) * 10)
        assert row["marl/return"] == 10
        fitness = [team["fitness"] for team in row["teams"]]
        if surrogate:
            values = next(judged)
            np.testing.assert_allclose(fitness, 1 + 1 / 2 + 1 / 4 + values / 8 / 2, rtol=1e-6)
        else:
            assert fitness == [10] * POPULATION
        assert row["operators/mutation_better_rate"] is None
    assert next(judged, None) is None
    check_resumption(tmp_path, config)


@pytest.mark.parametrize(
    ("base", "task"),
    [
        pytest.param("matd3", "probe/target", marks=pytest.mark.slow),
        pytest.param("facmac", "probe/lives", marks=pytest.mark.slow),
    ],
)
def test_heads_of_the_population_may_learn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, base: str, task: str
) -> None:
    monkeypatch.setattr(learning, "CHUNK", 7)
    monkeypatch.setattr(learning, "EPISODES_CHUNK", 2)
    config = small("race", base, task, head_learning_rate=0.1)
    progress = run(tmp_path / "whole", config)
    check_rows(tmp_path / "whole", config, progress)
    check_resumption(tmp_path, config)
    check_teams(tmp_path / "whole", config)
    newest = checkpoints.newest(tmp_path / "whole" / "checkpoints")
    assert newest is not None
    arrays = checkpoints.load(newest).arrays
    heads, elite, champion = (
        np.asarray(arrays[f"['algorithm'].population.{name}"])
        for name in ("teams.heads", "elite", "champion.heads")
    )
    # The elite has learned since it was measured, and the champion has not.
    assert not np.array_equal(heads[elite], champion)
    np.testing.assert_allclose(heads[elite], champion, atol=1.0)


def test_an_estimate_selects_nobody() -> None:
    returned = Progress(fitness=(9.0, 11.0), marl_return=10.0)
    assert returned.selected == "champion"
    assert returned.but(estimated=True).selected == "marl"
    assert returned.but(marl_return=12.0).selected == "marl"


@pytest.mark.parametrize(("owed", "steps"), [(False, 32), (True, 52)])
def test_random_steps_may_be_owed_gradient_steps(owed: bool, steps: int) -> None:
    config = small("marl", "matd3", "probe/terminates")
    config = dataclasses.replace(
        config, learner=dataclasses.replace(config.learner, random_steps_owed=owed)
    )
    progress = Progress(env_steps=60, random_steps=20, gradient_steps=7)
    # Whole policy periods.
    assert generation.owed(config, progress) == steps

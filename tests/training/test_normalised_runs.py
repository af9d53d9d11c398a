"""Runs that normalise what is observed: what they keep, and that they go on exactly."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from whole_runs import KilledError, rows, run

from race import programs
from race.algorithms import algorithm_of
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import CheckpointConfig, Config, EvaluationConfig, LearnerConfig
from race.config.shape import shape_of
from race.errors import CheckpointError, ConfigError
from race.method.normalisation import Observed, running_of, scaled, scaling_of
from race.programs import cohort
from race.replay.buffer import Replay
from race.runs import checkpoints
from race.runs import directory as run_directory
from race.runs.directory import RunDirectory
from race.teams.creating import create_run
from race.teams.evaluation import evaluate
from race.teams.initial import initial_teams
from race.teams.team import Team
from race.teams.trained import load_trained
from race.training import learning
from race.training.run_state import Progress
from race.training.saving import looked_at, observed_of
from race.types import EnvSpec, Transition

TASK = "probe/terminates"


def config_of(normalise: bool = True, **changes: Any) -> Config:
    config = Config(
        TASK,
        algo="matd3",
        env_steps=130,
        learner=LearnerConfig(hidden_sizes=(5, 4), batch_size=4, random_steps=40),
        evaluation=EvaluationConfig(every=50, episodes=2),
        checkpoint=CheckpointConfig(minutes=0.0, keep=2, keep_best=1),
    )
    config = dataclasses.replace(config, **changes)
    return resolve(
        dataclasses.replace(config, env=dataclasses.replace(config.env, normalise=normalise))
    )


@pytest.fixture(autouse=True)
def short_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "CHUNK", 4)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("normalised") / "run"
    run(path, config_of())
    return path


def test_statistics_are_of_all_that_teams_acted_on(whole: Path) -> None:
    place = checkpoints.newest(RunDirectory(whole).checkpoints)
    assert place is not None
    saved, trained = checkpoints.load(place), load_trained(whole)
    observed = observed_of(saved, trained.config, trained.task.spec)
    assert observed is not None
    assert observed.obs is None
    # The buffer has room for all steps, and holds them as the environment showed them.
    states = saved.rows["replay"].columns["state"][: saved.rows["replay"].size]
    assert len(states) == int(observed.state.number) == trained.progress.env_steps
    exact = np.asarray(states, np.float64)
    np.testing.assert_allclose(observed.state.mean, exact.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(observed.state.squares / len(states), exact.var(axis=0), atol=1e-12)
    for name in (None, "best"):
        found = load_trained(whole, name).observed
        assert found is not None
        assert {x.dtype for x in found.state} == {np.dtype(np.float64)}
        np.testing.assert_array_equal(found.state.mean.shape, observed.state.mean.shape)
    best = load_trained(whole, "best")
    assert best.observed is not None
    assert best.observed.state.number == best.progress.env_steps  # as they were then


def test_a_run_that_was_killed_goes_on_exactly(whole: Path, tmp_path: Path) -> None:
    calls = 0

    def kill(stage: str, progress: Progress, row: dict[str, Any]) -> None:
        nonlocal calls
        calls += 1
        if calls > 9:
            raise KilledError

    for _ in range(3):
        calls = 0
        with pytest.raises(KilledError):
            run(tmp_path, config_of(), kill)
    run(tmp_path, config_of())
    assert rows(tmp_path) == rows(whole)
    one, other = (load_trained(path).observed for path in (tmp_path, whole))
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_a_loaded_team_is_the_one_that_was_tested(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = load_trained(whole)
    team, scaling = Team(trained, "marl"), trained.scaling
    assert scaling is not None
    states = np.random.default_rng(0).normal(size=(5, trained.task.spec.state_size))
    states = states.astype(np.float32)
    shown = np.asarray(scaled(states, scaling.state))
    plain = Team(trained._replace(observed=None), "marl")
    np.testing.assert_allclose(team.act(state=states), plain.act(state=shown), atol=1e-6)
    assert np.abs(team.act(state=states) - plain.act(state=states)).max() > 1e-3
    # Test episodes are played with it.
    act, scalings = programs.act, []

    def noted(teams: Any, *given: Any, **how: Any) -> Any:
        scalings.append(teams.scaling)
        return act(teams, *given, **how)

    monkeypatch.setattr(programs, "act", noted)
    evaluate(trained, "marl", 2)
    assert len(scalings) == 5
    for found in scalings:
        jax.tree.map(np.testing.assert_array_equal, found, scaling)


def test_a_run_begins_with_what_the_other_has_seen(whole: Path, tmp_path: Path) -> None:
    config = config_of(init_from=str(whole))
    begins = initial_teams(config, load_trained(whole).task)
    create_run(tmp_path / "next", config, {}, begins, ())

    def stop(stage: str, progress: Progress, row: dict[str, Any]) -> None:
        if stage == "rollouts":
            raise KilledError

    with pytest.raises(KilledError):
        run(tmp_path / "next", config, stop)
    before, now = load_trained(whole).observed, load_trained(tmp_path / "next").observed
    assert before is not None
    assert now is not None
    assert now.state.number == before.state.number + 40  # its random steps
    with pytest.raises(ConfigError, match=r"one of the two normalises"):
        initial_teams(config_of(False, init_from=str(whole)), load_trained(whole).task)


def test_statistics_that_are_missing_or_not_meant_are_told(whole: Path, tmp_path: Path) -> None:
    place = checkpoints.newest(RunDirectory(whole).checkpoints)
    assert place is not None
    saved, spec = checkpoints.load(place, tables=False), load_trained(whole).task.spec
    less = {name: x for name, x in saved.arrays.items() if "observed" not in name}
    with pytest.raises(CheckpointError, match="observed"):
        observed_of(dataclasses.replace(saved, arrays=less), config_of(), spec)
    config = config_of(False)
    assert observed_of(saved, config, spec) is None
    with pytest.raises(CheckpointError, match="observed"):
        looked_at(saved, config, spec, algorithm_of(config))
    assert run_directory.open_run(whole).env.normalise


def told(state: Any, batch: Any, *_: Any) -> Any:
    """In the place of a gradient step: what it is shown."""
    means = {name: jnp.mean(x) for name, x in batch._asdict().items()}
    return state, means, {}


@pytest.mark.parametrize("together", [False, True])
def test_gradient_steps_see_the_buffer_normalised(tiny_spec: EnvSpec, together: bool) -> None:
    config = config_of(False)
    names = Transition._fields
    algorithm = algorithm_of(config)._replace(update=told, critic_losses=names, policy_losses=())
    shape, hyper = shape_of(config), hyper_of(config)
    rng = np.random.default_rng(1)
    states, later = (rng.normal(5, 40, (64, 4)).astype(np.float32) for _ in range(2))
    action, rest = rng.uniform(-1, 1, (64, 3)), rng.normal(size=64)
    scaling = scaling_of(Observed(None, running_of(states)))
    key, first, count = jax.random.key(3), np.int32(0), np.int32(4)

    def sums(state: Any, next_state: Any, how: Any) -> Any:
        columns = (state, action, rest, rest > 0, next_state)
        stored = Transition(*(jnp.asarray(c, jnp.float32) for c in columns))
        replay = Replay(stored, jnp.int32(64))
        if together:
            drawn = cohort.minibatches(
                replay, key, first, hyper=hyper, room=4, shape=shape, scaling=how
            )
            return {name: jnp.mean(x) for name, x in drawn._asdict().items()}
        zeros = programs.empty_losses(algorithm)
        statics: Any = {"algorithm": algorithm, "spec": tiny_spec, "shape": shape, "hyper": hyper}
        begun = jnp.zeros(())
        return programs.learn(begun, zeros, replay, key, first, count, **statics, scaling=how)[1]

    found = sums(states, later, scaling)
    expected = sums(*(np.asarray(scaled(x, scaling.state)) for x in (states, later)), None)
    raw = sums(states, later, None)
    for name in names:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-5, atol=1e-6)
        seen = name in ("state", "next_state")
        assert (abs(float(raw[name] - found[name])) > 0.1) == seen

"""What the shell does, from Python."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from whole_runs import rows as rows_of

import race
from race.errors import CheckpointError, ConfigError, RaceError, RunDirectoryError
from race.runs import team_files
from race.teams.trained import load_trained

LEARNER = {
    "hidden_sizes": (6, 5),
    "random_steps": 40,
    "batch_size": 4,
    "gradient_steps_per_env_step": 0.05,
}
SETTINGS: dict[str, Any] = {
    "algo": "matd3",
    "env_steps": 120,
    "learner": LEARNER,
    "evaluation": {"every": 30, "episodes": 2},
    "checkpoint": {"keep_best": 2},
    "progress": False,
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> race.Run:
    return race.train("probe/target", run_dir=tmp_path_factory.mktemp("api") / "run", **SETTINGS)


def test_what_is_slow_to_import_is_imported_when_asked_for() -> None:
    code = (
        "import sys, race; race.__version__; dir(race)\n"
        "print([m for m in ('jax', 'numpy', 'tyro') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert {"train", "load", "evaluate", "render"} <= set(dir(race))
    with pytest.raises(AttributeError, match="nothing"):
        _ = race.nothing  # type: ignore[attr-defined]


def test_the_stub_names_what_there_is() -> None:
    stub = (Path(race.__file__).parent / "__init__.pyi").read_text()
    names = {line.split(" as ")[1] for line in stub.splitlines() if " as " in line}
    assert names == set(race._WHERE)  # type: ignore[attr-defined]
    assert all(getattr(race, name) is not None for name in names)


def test_a_run_is_what_the_shell_makes(run: race.Run) -> None:
    assert run.finished
    assert run.config.learner.hidden_sizes == (6, 5)
    found = run.rows()
    assert [row for row in found if row["kind"] == "evaluation"] == run.rows("evaluation")
    assert len(run.rows("evaluation")) == 4
    assert race.load(str(run.path)).rows() == found
    assert run.checkpoints[1] == "step-000000000120"
    assert "MATD3 on probe/target" in repr(run)


def test_rows_become_a_table_where_pandas_is(
    run: race.Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=tuple))
    assert run.rows("evaluation").to_pandas() == tuple(run.rows("evaluation"))
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ConfigError, match="pip install pandas"):
        run.rows().to_pandas()


def test_a_callback_stops_a_run_that_goes_on_as_if_it_had_not(
    run: race.Run, tmp_path: Path
) -> None:
    seen: list[dict[str, Any]] = []

    def on_row(row: dict[str, Any]) -> bool:
        seen.append(row)
        return row["env_steps"] < 70

    stopped = race.train("probe/target", run_dir=tmp_path / "run", on_row=on_row, **SETTINGS)
    assert not stopped.finished
    assert seen[-1]["env_steps"] == 70
    assert all(row["env_steps"] < 70 for row in seen[:-1])
    assert stopped.resume(progress=False).finished
    assert rows_of(stopped.path) == rows_of(run.path)


def test_an_error_of_a_callback_is_raised_once_the_run_is_saved(tmp_path: Path) -> None:
    def on_row(row: dict[str, Any]) -> None:
        raise LookupError("mine")

    with pytest.raises(LookupError, match="mine"):
        race.train("probe/target", run_dir=tmp_path / "run", on_row=on_row, **SETTINGS)
    assert race.load(tmp_path / "run").checkpoints[-1] == "step-000000000041"


def test_the_best_tested_teams_are_kept(run: race.Run) -> None:
    tests = run.rows("evaluation")
    by_return = sorted(tests, key=lambda row: -row["eval/marl/return_mean"])
    expected = [f"step-{row['env_steps']:012d}-marl" for row in by_return[:2]]
    assert run.checkpoints[2:] == expected
    folder = run.path / "best"
    assert sorted(path.stem for path in folder.iterdir()) == sorted(expected)
    best = run.trained("best")
    assert best.progress.env_steps == by_return[0]["env_steps"]
    assert run.team(checkpoint=expected[1]).trained.progress.env_steps == by_return[1]["env_steps"]
    # Those who were kept play as they did when they were tested; others play differently.
    state = np.linspace(-1, 1, 4, dtype=np.float32)
    actions = [run.team(checkpoint=name).act(state=state) for name in (*expected, None)]
    assert len({tuple(action.tolist()) for action in actions}) == 3
    with pytest.raises(ConfigError, match="is the marl team alone"):
        run.team("champion", checkpoint="best")
    with pytest.raises(RunDirectoryError, match=f"no checkpoint 'x'.*{expected[0]}"):
        run.team(checkpoint="x")


def test_a_kept_team_is_the_one_that_was_tested(run: race.Run, tmp_path: Path) -> None:
    """At the end of a run nothing is learned between its test and its last checkpoint."""
    settings = SETTINGS | {"checkpoint": {"keep_best": 9}}
    with_all = race.train("probe/target", run_dir=tmp_path / "run", **settings)
    state = np.linspace(-1, 1, 4, dtype=np.float32)
    kept = with_all.team(checkpoint="step-000000000120-marl")
    np.testing.assert_array_equal(kept.act(state=state), with_all.team().act(state=state))
    np.testing.assert_array_equal(kept.act(state=state), run.team().act(state=state))
    assert len(with_all.checkpoints) == 2 + 4


def test_damaged_files_of_teams_are_refused(run: race.Run, tmp_path: Path) -> None:
    copied = tmp_path / "run"
    shutil.copytree(run.path, copied)
    name = run.checkpoints[2]
    file = copied / "best" / f"{name}.safetensors"
    whole = file.read_bytes()
    file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(CheckpointError, match="digest"):
        race.load(copied).team(checkpoint=name)
    file.write_bytes(whole[:40])  # it is none any more
    assert name not in race.load(copied).checkpoints
    other = shutil.copytree(run.path, tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    assert config["run"] == run.trained().identity
    file.write_bytes(whole.replace(config["run"].encode(), b"0" * 16))
    assert name not in race.load(copied).checkpoints  # its seal is broken


def test_a_run_begins_with_the_team_of_another(run: race.Run, tmp_path: Path) -> None:
    """With a step size of almost 0 it stays what it was handed."""
    learner = {**LEARNER, "actor_learning_rate": 1e-12}
    settings = {**SETTINGS, "learner": learner, "env_steps": 44, "init_from": str(run.path)}
    second = race.train("probe/target", run_dir=tmp_path / "run", **settings, seed=7)
    state = np.linspace(-1, 1, 4, dtype=np.float32)
    np.testing.assert_allclose(
        second.team().act(state=state), run.team().act(state=state), atol=1e-6
    )
    fresh = race.train(
        "probe/target", run_dir=tmp_path / "fresh", **{**settings, "init_from": None}, seed=7
    )
    assert abs(fresh.team().act(state=state) - run.team().act(state=state)).max() > 0.01
    info = team_files.info_of(second.path / "init.safetensors")
    assert (info["from_run"], info["from_env_steps"]) == (run.trained().identity, 120)
    wide = {**settings, "learner": {**learner, "hidden_sizes": (7, 5)}}
    with pytest.raises(ConfigError, match=r"encoder.hidden.bias is \[2, 6\] there and \[2, 7\]"):
        race.train("probe/target", run_dir=tmp_path / "wide", **wide)
    assert not (tmp_path / "wide").exists()


def test_a_team_is_loaded_from_text_or_path(run: race.Run) -> None:
    team = run.team()
    trained = load_trained(str(run.path))
    state = np.linspace(-1, 1, 4, dtype=np.float32)
    expected = trained.policy("selected")(state)  # this probe's units are -1 to 1
    np.testing.assert_allclose(team.act(state=state), expected, atol=2e-6)
    with pytest.raises(ConfigError, match="marl, champion, selected"):
        run.team("best")
    with pytest.raises(ConfigError, match="no population"):
        run.team("champion")


def test_evaluations_repeat(run: race.Run) -> None:
    first = race.evaluate(run, episodes=3, seed=2)
    again = race.evaluate(run.team("marl"), episodes=3, seed=2)
    np.testing.assert_array_equal(first.score.returns, again.score.returns)
    assert first.mean == pytest.approx(np.mean(first.score.returns))
    assert json.loads(json.dumps(first.to_json()))["episodes"] == 3
    other = race.evaluate(run.path, episodes=3, seed=3)
    assert (other.score.returns != first.score.returns).any()


def test_settings_of_a_run_train_it_again(run: race.Run, tmp_path: Path) -> None:
    again = race.train(
        config=run.path / "config.json", run_dir=tmp_path / "run", env_steps=50, progress=False
    )
    assert again.config == dataclasses.replace(run.config, env_steps=50)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({}, "Name a task"),
        ({"task": "probe/targt"}, "probe/target"),
        ({"task": "probe/target", "lerner": {}}, "Did you mean learner"),
        ({"task": "probe/target", "learner": {"batch": 3}}, "batch_size"),
        ({"task": "probe/target", "seed": "1"}, "seed is '1', but must be a whole number"),
        ({"task": "probe/target", "base": "td3"}, "must be one of 'matd3', .* or None"),
        (
            {"task": "probe/target", "learner": {"hidden_sizes": [8]}},
            r"must be a list of 2: a whole number, a whole number",
        ),
        ({"task": "probe/target", "algo": "matd3", "race": {"population_size": 3}}, "no effect"),
        ({"task": "probe/target", "config": "nothing.toml"}, "cannot be read"),
        ({"task": "probe/target", "log": ("paper",)}, "tensorboard.*not 'paper'"),
    ],
)
def test_mistakes_are_named(keywords: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(RaceError, match=words):
        race.train(run_dir=tmp_path / "run", **keywords)
    assert not (tmp_path / "run").exists()


def test_nothing_is_overwritten(run: race.Run, tmp_path: Path) -> None:
    with pytest.raises(RunDirectoryError, match="already holds a run"):
        race.train("probe/target", run_dir=run.path, **SETTINGS)
    with pytest.raises(RunDirectoryError, match="it has no config"):
        race.load(tmp_path)
    with pytest.raises(RaceError, match="no video"):
        race.render(run, tmp_path / "team.png")

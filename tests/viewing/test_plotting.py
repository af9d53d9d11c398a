"""Learning curves: grouping, the interval, and what cannot be drawn."""

import json
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from race.config import settings as configs
from race.config.presets import resolve
from race.config.settings import Config, LearnerConfig
from race.errors import RaceError, RunDirectoryError
from race.viewing.plotting import Curve, aggregate, plot


def make_run(path: Path, points: list[tuple[int, float]], **settings: Any) -> Path:
    config = resolve(Config(settings.pop("task", "mamujoco/Hopper-3x1"), **settings))
    path.mkdir(parents=True)
    (path / "config.json").write_text(json.dumps(configs.to_json(config)))
    rows: list[dict[str, Any]] = []
    for steps, value in points:
        rows.append(
            {"kind": "generation", "env_steps": steps, "injection/elite_rate": value / 1000}
        )
        row = {"kind": "evaluation", "env_steps": steps, "eval/marl/return_mean": value}
        if config.has_population:
            row["eval/champion/return_mean"] = value + 10
        row["eval/selected/return_mean"] = value + (10 if config.has_population else 0)
        rows.append(row)
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_the_interval_of_three_seeds_by_hand() -> None:
    grid = np.array([0.0, 10.0])
    runs = [Curve(grid, np.array([v, 2 * v])) for v in (1.0, 2.0, 6.0)]
    band = aggregate(runs)
    np.testing.assert_allclose(band.mean, [3.0, 6.0])
    # s = sqrt((4 + 1 + 9) / 2) = sqrt(7); t(0.975, 2) = 4.302653; half = t s / sqrt(3).
    half = 4.302653 * np.sqrt(7.0) / np.sqrt(3.0)
    np.testing.assert_allclose(band.half_width, [half, 2 * half], rtol=1e-6)


def test_runs_evaluated_at_different_steps_meet_on_a_common_grid() -> None:
    first = Curve(np.array([0.0, 10.0, 20.0]), np.array([0.0, 10.0, 20.0]))
    second = Curve(np.array([5.0, 15.0, 40.0]), np.array([5.0, 15.0, 40.0]))
    band = aggregate([first, second])
    assert band.env_steps.tolist() == [5.0, 10.0, 15.0, 20.0]
    np.testing.assert_allclose(band.mean, band.env_steps)
    np.testing.assert_allclose(band.half_width, 0.0, atol=1e-12)


def test_runs_are_grouped_by_task_and_method(tmp_path: Path) -> None:
    for seed, shift in ((1, 0.0), (2, 30.0)):
        make_run(tmp_path / f"race{seed}", [(100, shift), (200, 100 + shift)], seed=seed)
    make_run(tmp_path / "matd3", [(100, 1.0), (200, 2.0)], algo="matd3")
    make_run(tmp_path / "ant", [(100, 7.0), (300, 8.0)], task="mamujoco/Ant-2x4")
    out = tmp_path / "figures" / "curves.png"
    found = {(row.task, row.curve): row for row in plot([tmp_path], out)}
    assert set(found) == {
        ("mamujoco/Hopper-3x1", "RACE(MATD3)"),
        ("mamujoco/Hopper-3x1", "MATD3"),
        ("mamujoco/Ant-2x4", "RACE(MATD3)"),
    }
    race = found["mamujoco/Hopper-3x1", "RACE(MATD3)"]
    assert (race.seeds, race.env_steps) == (2, 200)
    assert race.mean == pytest.approx(125.0)
    assert race.half_width == pytest.approx(12.706205 * np.std([110, 140], ddof=1) / np.sqrt(2))
    assert found["mamujoco/Hopper-3x1", "MATD3"].mean == pytest.approx(2.0)
    image = iio.imread(out)[..., :3]
    red = (image[..., 0] > 180) & (image[..., 1] < 90) & (image[..., 2] < 90)
    assert red.sum() > 100


def test_teams_and_other_quantities(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", [(100, 50.0), (200, 60.0)])
    out = tmp_path / "curves.svg"
    teams = {row.curve: row.mean for row in plot([run], out, team="all")}
    assert teams == {
        "RACE(MATD3), selected team": 70.0,
        "RACE(MATD3), champion": 70.0,
        "RACE(MATD3), MARL team": 60.0,
    }
    (rate,) = plot([run], out, metric="injection/elite_rate")
    assert rate.mean == pytest.approx(0.06)
    # Asked for of several methods, a quantity of populations is drawn for those that have one.
    other = make_run(tmp_path / "other", [(100, 50.0), (200, 60.0)], algo="matd3")
    rows = (other / "metrics.jsonl").read_text().replace("injection/elite_rate", "marl/return")
    (other / "metrics.jsonl").write_text(rows)
    assert len(plot([run, other], out, metric="injection/elite_rate")) == 1
    assert out.read_text().lstrip().startswith("<?xml")


def test_runs_with_other_settings_are_other_curves(tmp_path: Path) -> None:
    small = LearnerConfig(batch_size=32)
    make_run(tmp_path / "a", [(100, 1.0), (200, 2.0)], algo="matd3", env_steps=20_000)
    make_run(tmp_path / "b", [(100, 1.0), (200, 4.0)], algo="matd3", env_steps=30_000, seed=2)
    make_run(tmp_path / "c", [(100, 1.0), (200, 8.0)], algo="matd3", learner=small)
    found = {row.curve: (row.seeds, row.mean) for row in plot([tmp_path], tmp_path / "a.png")}
    assert found == {
        "MATD3 learner.batch_size=128": (2, 3.0),
        "MATD3 learner.batch_size=32": (1, 8.0),
    }


def test_one_seed_does_not_count_twice(tmp_path: Path) -> None:
    make_run(tmp_path / "a", [(100, 1.0)])
    make_run(tmp_path / "b", [(100, 1.0)])
    with pytest.raises(RaceError, match="same seed 1"):
        plot([tmp_path], tmp_path / "a.png")


def test_what_cannot_be_drawn_says_why(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", [(100, 50.0)])
    with pytest.raises(RaceError, match="return_mean"):
        plot([run], tmp_path / "a.png", metric="retrun_mean")
    with pytest.raises(RaceError, match=r"\.png, \.svg, \.pdf"):
        plot([run], tmp_path / "a.bmp")
    with pytest.raises(RunDirectoryError, match="not a directory"):
        plot([tmp_path / "nowhere"], tmp_path / "a.png")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunDirectoryError, match="not the directory of a run"):
        plot([tmp_path / "empty"], tmp_path / "a.png")
    young = make_run(tmp_path / "young", [], seed=2)
    with pytest.raises(RunDirectoryError, match="no rows"):
        plot([young], tmp_path / "a.png")
    row = {"kind": "generation", "env_steps": 5, "marl/return": 1.0}
    (young / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    with pytest.raises(RunDirectoryError, match="not been evaluated"):
        plot([young], tmp_path / "a.png")
    far = make_run(tmp_path / "far", [(500, 1.0), (600, 1.0)], seed=3)
    with pytest.raises(RaceError, match="no range"):
        plot([run, far], tmp_path / "a.png")

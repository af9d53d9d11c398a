"""Learning curves: grouping, the interval, and what cannot be drawn."""

import json
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from matplotlib.figure import Figure

from race.config import saved as configs
from race.config.presets import resolve
from race.config.settings import Config, LearnerConfig, RaceConfig
from race.errors import RaceError, RunDirectoryError
from race.statistics.intervals import mean_interval
from race.viewing import plotting
from race.viewing.curves import Curve, aggregate, ended_early
from race.viewing.plotting import plot


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
            row["eval/best/return_mean"] = value + 10
        row["eval/selected/return_mean"] = value + (10 if config.has_population else 0)
        rows.append(row)
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def curve(x: list[float], values: list[float], seed: int = 1) -> Curve:
    return Curve(np.array(x), np.array(values), x[-1], seed)


def test_runs_evaluated_at_different_steps_meet_on_a_common_grid() -> None:
    first = curve([0.0, 10.0, 20.0], [0.0, 10.0, 20.0])
    second = curve([5.0, 15.0, 20.5], [7.0, 17.0, 22.5])
    band = aggregate([first, second])
    # Where both have been tested, and no ragged ends of one of them.
    assert band.x.tolist() == [5.0, 10.0, 15.0, 20.0]
    np.testing.assert_allclose(band.mean, band.x + 1.0)
    assert band.seeds.tolist() == [2] * 4
    # t(0.975, 1) = 12.7062; s = sqrt(2); half = t.
    np.testing.assert_allclose(band.high - band.mean, 12.7062047, rtol=1e-6)


def test_a_run_that_stopped_early_does_not_cut_the_others() -> None:
    whole = [curve([0.0, 10.0, 20.0], [v] * 3, i) for i, v in enumerate((1.0, 2.0))]
    short = curve([0.0, 10.0], [6.0, 6.0], 7)
    band = aggregate([*whole, short])
    assert band.x.tolist() == [0.0, 10.0, 20.0]
    np.testing.assert_allclose(band.mean, [3.0, 3.0, 1.5])
    assert band.seeds.tolist() == [3, 3, 2]
    assert [run.seed for run in ended_early([*whole, short])] == [7]
    assert ended_early(whole) == []


def test_over_time_a_slow_run_is_no_run_that_ended_late() -> None:
    runs = [
        Curve(np.array([0.0, seconds]), np.array([0.0, 10.0]), 100.0) for seconds in (50.0, 90.0)
    ]
    assert ended_early(runs) == []
    band = aggregate(runs)
    assert (band.x[-1], band.seeds.tolist()) == (50.0, [2, 2])
    assert band.mean[-1] == pytest.approx((10.0 + 10.0 * 50 / 90) / 2)


def test_runs_without_a_common_range_are_each_where_they_are() -> None:
    band = aggregate([curve([0.0, 1.0], [1.0, 1.0]), curve([0.98, 1.02], [0.0, 0.0])])
    assert band.x.tolist() == [0.98, 1.0]
    band = aggregate([curve([100.0], [1.0]), curve([101.0], [0.0])])
    assert band.x.tolist() == [100.0, 101.0]
    assert band.mean.tolist() == [1.0, 0.0]
    assert np.isnan(band.low).all()


def test_the_last_point_is_that_of_all_seeds_though_their_last_tests_differ(tmp_path: Path) -> None:
    for seed in range(1, 6):
        ends = [(100, 10.0 * seed), (1000 + seed, 20.0 * seed)]
        make_run(tmp_path / f"s{seed}", ends, algo="matd3", seed=seed)
    (summary,) = plot([tmp_path], tmp_path / "a.png").summaries
    assert (summary.seeds, summary.x) == (5, 1001.0)
    assert summary.ended_early == ()
    assert summary.low < summary.mean < summary.high


def test_runs_are_grouped_by_task_and_method(tmp_path: Path) -> None:
    for seed, shift in ((1, 0.0), (2, 30.0)):
        make_run(tmp_path / f"race{seed}", [(100, shift), (200, 100 + shift)], seed=seed)
    make_run(tmp_path / "matd3", [(100, 1.0), (200, 2.0)], algo="matd3")
    make_run(tmp_path / "ant", [(100, 7.0), (300, 8.0)], task="mamujoco/Ant-2x4")
    out = tmp_path / "figures" / "curves.png"
    found = {(row.task, row.curve): row for row in plot([tmp_path], out).summaries}
    assert set(found) == {
        ("mamujoco/Hopper-3x1", "RACE(MATD3)"),
        ("mamujoco/Hopper-3x1", "MATD3"),
        ("mamujoco/Ant-2x4", "RACE(MATD3)"),
    }
    race = found["mamujoco/Hopper-3x1", "RACE(MATD3)"]
    assert (race.seeds, race.x) == (2, 200)
    assert race.mean == pytest.approx(125.0)
    expected = mean_interval([110.0, 140.0])
    assert (race.low, race.high) == pytest.approx((expected.low, expected.high))
    assert found["mamujoco/Hopper-3x1", "MATD3"].mean == pytest.approx(2.0)
    image = iio.imread(out)[..., :3]
    red = (image[..., 0] > 180) & (image[..., 1] < 90) & (image[..., 2] < 90)
    assert red.sum() > 100


def test_teams_and_other_quantities(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", [(100, 50.0), (200, 60.0)])
    out = tmp_path / "curves.svg"
    teams = {row.curve: row.mean for row in plot([run], out, team="all").summaries}
    assert teams == {
        "RACE(MATD3), selected team": 70.0,
        "RACE(MATD3), champion": 70.0,
        "RACE(MATD3), MARL team": 60.0,
    }
    (rate,) = plot([run], out, metric="injection/elite_rate").summaries
    assert rate.mean == pytest.approx(0.06)
    # Asked for of several methods, a quantity of populations is drawn for those that have one.
    other = make_run(tmp_path / "other", [(100, 50.0), (200, 60.0)], algo="matd3")
    rows = (other / "metrics.jsonl").read_text().replace("injection/elite_rate", "marl/return")
    (other / "metrics.jsonl").write_text(rows)
    drawn = plot([run, other], out, metric="injection/elite_rate")
    assert len(drawn.summaries) == 1
    assert drawn.without == [str(other)]
    assert out.read_text().lstrip().startswith("<?xml")


def test_runs_with_other_settings_are_other_curves(tmp_path: Path) -> None:
    small = LearnerConfig(batch_size=32)
    make_run(tmp_path / "a", [(100, 1.0), (200, 2.0)], algo="matd3", env_steps=20_000)
    make_run(tmp_path / "b", [(100, 1.0), (200, 4.0)], algo="matd3", env_steps=30_000, seed=2)
    make_run(tmp_path / "c", [(100, 1.0), (200, 8.0)], algo="matd3", learner=small)
    found = {
        row.curve: (row.seeds, row.mean) for row in plot([tmp_path], tmp_path / "a.png").summaries
    }
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
    with pytest.raises(RaceError, match="no rows"):
        plot([young], tmp_path / "a.png")
    row = {"kind": "generation", "env_steps": 5, "marl/return": 1.0}
    (young / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    with pytest.raises(RaceError, match="not been an evaluation"):
        plot([young], tmp_path / "a.png")
    # Beside others it is left out, and said to be.
    drawn = plot([run, young], tmp_path / "a.png")
    assert [summary.seeds for summary in drawn.summaries] == [1]
    assert drawn.without == [str(young)]


def lines_of(monkeypatch: pytest.MonkeyPatch, paths: list[Path], out: Path, **how: Any) -> Any:
    """The axes of the one panel of a figure."""
    panels = []
    frame = plotting.frame

    def spy(axes: Any, *rest: Any) -> None:
        frame(axes, *rest)
        panels.append(axes)

    monkeypatch.setattr(plotting, "frame", spy)
    plot(paths, out, **how)
    return panels[0]


@pytest.mark.parametrize("team", ["marl", "champion", "best"])
def test_bands_are_there_whatever_team_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, team: str
) -> None:
    for seed in range(1, 5):
        points = [(100, 10.0 * seed), (200, 20.0 * seed)]
        for algo in ("race", "matd3", "maddpg"):
            make_run(tmp_path / f"{algo}{seed}", points, algo=algo, seed=seed)
    axes = lines_of(monkeypatch, [tmp_path], tmp_path / "a.png", team=team)
    assert len(axes.collections) == 3
    # All teams of a method together are lines alone.
    assert not lines_of(monkeypatch, [tmp_path], tmp_path / "a.png", team="all").collections


@pytest.mark.parametrize("seeds", [2, 3, 4])
def test_few_seeds_are_shown_themselves_and_many_as_a_band(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seeds: int
) -> None:
    for seed in range(1, seeds + 1):
        make_run(tmp_path / f"s{seed}", [(100, 100.0 * seed), (200, 100.0)], seed=seed)
    axes = lines_of(monkeypatch, [tmp_path], tmp_path / "a.png")
    assert len(axes.collections) == (1 if seeds == 4 else 0)
    thin = [line for line in axes.lines if line.get_linewidth() < 1]
    assert len(thin) == (0 if seeds == 4 else seeds)


def test_axes_follow_the_lines_and_not_the_band(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed, value in enumerate((0.0, 0.0, 0.0, 4000.0), 1):
        make_run(tmp_path / f"s{seed}", [(100, value), (200, value)], algo="matd3", seed=seed)
    low, high = lines_of(monkeypatch, [tmp_path], tmp_path / "a.png").get_ylim()
    assert 900 < low < 1000 < high < 1100  # the mean is 1,000, the interval -2,182 to 4,182


def test_the_band_of_a_share_stays_within_0_and_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed, value in enumerate((0.0, 300.0, 900.0, 1000.0), 1):
        make_run(tmp_path / f"s{seed}", [(100, value), (200, 1000.0)], seed=seed)
    axes = lines_of(monkeypatch, [tmp_path], tmp_path / "a.png", metric="injection/elite_rate")
    heights = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert heights.min() == 0.0
    assert heights.max() == 1.0


def test_wall_time_on_the_axis(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", [(100, 50.0), (200, 60.0)])
    text = (run / "metrics.jsonl").read_text()
    (run / "metrics.jsonl").write_text(
        text.replace('"env_steps": 200', '"env_steps": 200, "wall_seconds": 90.0')
    )
    (summary,) = plot([run], tmp_path / "a.png", axis="wall_time").summaries
    assert summary.x == 1.5


def test_long_names_stay_on_the_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(8):
        race = RaceConfig(
            mutation_fraction=0.1 + seed / 10, vmm_weight=1e-3 * 2**seed, population_size=5 + seed
        )
        make_run(tmp_path / f"{seed}", [(100, 1.0), (200, 2.0)], seed=seed, race=race)
    drawn: list[Figure] = []
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, file, **_: (drawn.append(figure), file.touch())
    )
    plot([tmp_path], tmp_path / "names.png")
    (figure,) = drawn
    figure.canvas.draw()
    (axes,) = figure.axes
    legend = axes.get_legend()
    assert legend is not None
    assert "race.vmm_weight=" in legend.get_texts()[0].get_text()
    box, whole = legend.get_window_extent(), figure.bbox
    assert whole.x0 <= box.x0 < box.x1 <= whole.x1
    assert whole.y0 - 4 <= box.y0  # nothing but the margin below the last line
    assert axes.get_window_extent().height > 2.5 * figure.dpi  # inches


def test_a_dozen_curves_have_colours_of_their_own() -> None:
    names = [f"RACE(MATD3) race.mutation_fraction={k / 10}" for k in range(8)]
    found = plotting.colours_of(["EA", "MATD3", "MERL(MATD3)", "FACMAC", *names])
    assert len(set(found.values())) == 12
    assert (found["EA"], found["MATD3"]) == ("#2ca02c", "#222222")  # the paper's
    assert "#d62728" in {found[name] for name in names}

"""Tables of methods: the numbers by hand, what is unlike is said, every format says the same."""

import csv
import io
import json
import math
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from scipy import stats
from written_runs import experiment, written_run

from race.cli import main
from race.errors import RaceError
from race.runs.results import load
from race.statistics.intervals import mean_estimate
from race.viewing.comparison import Comparison, compare
from race.viewing.curves import aggregate
from race.viewing.grouping import bases_of
from race.viewing.normalising import scales
from race.viewing.profiles import draw_profiles
from race.viewing.scores import Scores, scores_of
from race.viewing.tables import as_json, number, seconds, tables_of, written

RACE, MATD3 = "RACE(MATD3)", "MATD3"
HOPPER, ANT = "mamujoco/Hopper-3x1", "mamujoco/Ant-2x4"
BATTLE = "micro/2s3z"
FINALS = np.array([0.0, 40.0, 80.0, 120.0, 160.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return experiment(tmp_path_factory.mktemp("experiment"))


@pytest.fixture(scope="module")
def scores(folder: Path) -> Scores:
    return scores_of(load([folder]))


@pytest.fixture(scope="module")
def found(scores: Scores) -> Comparison:
    return compare(scores)


def test_scores_of_a_run_by_hand(scores: Scores) -> None:
    (first, *_) = scores.of(HOPPER, MATD3)
    assert (first.seed, first.final) == (1, 1080.0)
    # Trapezoids from 100 to 300 steps: (0 + f / 2) / 2 and (f / 2 + f) / 2, each half the way.
    assert first.area == pytest.approx(1080 / 2)
    assert scores.horizons == {ANT: 300.0, HOPPER: 300.0}
    assert scores.differences == []


def test_numbers_of_a_task(found: Comparison, scores: Scores) -> None:
    row = next(r for r in found.on_tasks if (r.task, r.method) == (HOPPER, RACE))
    assert row.final == mean_estimate(1500 + FINALS)
    assert row.area == mean_estimate((1500 + FINALS) / 2)
    assert row.seeds == (1, 2, 3, 4, 5)
    # 1080 is reached at 300 steps by all, and by none at 200, where they have under 830.
    assert row.time_to.score == 1080.0
    assert row.time_to.env_steps == (300.0, 300.0, 300.0)
    assert row.time_to.seconds == (30.0, 30.0, 30.0)
    # The same as the last point of the figure.
    band = aggregate([run.curve for run in scores.of(HOPPER, RACE)])
    assert (row.final.value, row.final.low) == (band.mean[-1], band.low[-1])


def test_numbers_against_the_base(found: Comparison) -> None:
    assert found.base == MATD3
    pair = next(p for p in found.pairs if p.task == HOPPER)
    welch = stats.ttest_ind(1500 + FINALS, 1000 + FINALS, equal_var=False).confidence_interval()
    assert pair.difference == (500.0, welch.low, welch.high)
    assert (pair.told_apart, pair.seeds_needed) == (True, None)
    (against,) = found.against
    assert against.improvement.value == 1.0
    assert against.gain is not None
    assert against.gain.value == pytest.approx((1580 / 1080 + 2580 / 2080) / 2 - 1)
    assert against.gain_tasks == (ANT, HOPPER)


def test_numbers_over_tasks(found: Comparison) -> None:
    assert found.common == (ANT, HOPPER)
    race = next(r for r in found.overall if r.method == RACE)
    # The scale of both tasks: the worst run is MATD3's, 660 below RACE's best.
    scaled = np.tile((500 + FINALS) / 660, 2)
    assert race.runs == 10
    assert race.iqm.value == pytest.approx(float(stats.trim_mean(scaled, 0.25)))
    assert race.gap.value == pytest.approx(1 - scaled.mean())
    assert race.profile[0].value == 1.0
    assert race.profile[-1].value == 0.0


def test_methods_that_are_not_told_apart_say_how_many_seeds_would(tmp_path: Path) -> None:
    near = compare(scores_of(load([experiment(tmp_path, shift=40.0)])))
    pair = next(p for p in near.pairs if p.task == HOPPER)
    assert pair.told_apart is False
    assert pair.seeds_needed is not None
    assert 20 < pair.seeds_needed < 60  # Cohen's d is 40 / 63
    assert f"no: {pair.seeds_needed} seeds each" in written(near, "text")


def test_another_base_score_and_scale(scores: Scores, tmp_path: Path) -> None:
    other = compare(scores, base=RACE, normalise="base", score=2000.0)
    assert {pair.method for pair in other.pairs} == {MATD3}
    assert next(r for r in other.overall if r.method == MATD3).iqm.value == pytest.approx(
        np.mean([1080 / 1580, 2080 / 2580]), abs=0.02
    )
    hopper = next(r for r in other.on_tasks if (r.task, r.method) == (HOPPER, MATD3))
    assert hopper.time_to.reached == 0
    assert math.isinf(hopper.time_to.seconds[0])
    file = tmp_path / "low_high.toml"
    file.write_text(f'"{HOPPER}" = {{ low = 0, high = 2000 }}\n')
    given = compare(scores, references=file)
    assert given.common == (HOPPER,)
    assert any("says nothing of it" in note for note in given.notes)
    assert next(r for r in given.overall if r.method == MATD3).iqm.value == pytest.approx(0.54)
    with pytest.raises(RaceError, match="no method 'PPO'"):
        compare(scores, base="PPO")
    file.write_text(f'"{HOPPER}" = {{ low = 5, high = 5 }}\n')
    with pytest.raises(RaceError, match="low is not below high"):
        compare(scores, references=file)
    with pytest.raises(RaceError, match="cannot be read"):
        compare(scores, references=tmp_path / "missing.toml")


def test_what_is_unlike_is_said(tmp_path: Path) -> None:
    points = [(100, 1.0), (200, 2.0), (300, 3.0)]
    version = {"algorithm_version": 2, "versions": {"mujoco": "3.2"}}
    written_run(tmp_path / "a1", points, version, seed=1)
    written_run(tmp_path / "a2", points, version, seed=2)
    written_run(tmp_path / "a3", points[:1], version, seed=3)
    newer = {"algorithm_version": 3, "versions": {"mujoco": "3.3"}}
    written_run(tmp_path / "b1", points[:2], newer, seed=1, algo="matd3")
    written_run(tmp_path / "young", [], version, seed=9)
    scores = scores_of(load([tmp_path]))
    said = "\n".join(scores.differences)
    for words in (
        "a3 (seed 3) ended at 100 steps",
        "young has no return_mean yet",
        "unequal seeds (MATD3 1; RACE(MATD3) 1, 2)",
        "unequal numbers of steps (MATD3 200; RACE(MATD3) 300)",
        "unlike algorithm versions (2; 3)",
        "unlike versions of mujoco (3.2; 3.3)",
    ):
        assert words in said, words
    # Compared where the shortest ends, without the run that stopped before.
    assert scores.horizons[HOPPER] == 200.0
    assert [run.final for run in scores.runs] == [2.0, 2.0, 2.0]
    found = compare(scores)
    assert any("One seed has no interval: MATD3" in note for note in found.notes)
    assert "too few seeds to tell" in written(found, "text")
    with pytest.raises(SystemExit):
        main(["compare", str(tmp_path), "--strict"])


def test_win_rates_are_taken_where_there_are_any(tmp_path: Path) -> None:
    for seed in (1, 2):
        written_run(tmp_path / f"{seed}", [(100, 0.5)], None, "win_rate", None, seed=seed)
    found = compare(scores_of(load([tmp_path])))
    (row,) = found.on_tasks
    assert (row.metric, row.final.value) == ("win_rate", 0.5)
    assert (found.base, found.pairs, found.against) == (None, [], [])
    assert scores_of(load([tmp_path]), "return_mean").runs[0].metric == "return_mean"
    with pytest.raises(RaceError, match="compared by their tests"):
        scores_of(load([tmp_path]), "injection/elite_rate")


def test_tasks_without_a_common_method_have_nothing_over_tasks(tmp_path: Path) -> None:
    written_run(tmp_path / "a", [(100, 1.0)])
    written_run(tmp_path / "b", [(100, 1.0)], task="mamujoco/Ant-2x4", algo="matd3")
    found = compare(scores_of(load([tmp_path])))
    assert (found.common, found.overall, found.against) == ((), [], [])
    assert any("Not all methods were tried" in note for note in found.notes)
    assert written(found, "text")


def test_every_format_has_every_number(found: Comparison) -> None:
    plain = json.loads(written(found, "json"))
    assert plain == as_json(found)
    assert plain["on_tasks"][0]["final"]["value"] == found.on_tasks[0].final.value
    rows = list(csv.DictReader(io.StringIO(written(found, "csv"))))
    finals = {(r["task"], r["method"]): r for r in rows if r["quantity"] == "final_return_mean"}
    assert len(finals) == 4
    assert float(finals[HOPPER, RACE]["low"]) == mean_estimate(1500 + FINALS).low
    for form in ("text", "markdown", "latex"):
        text = written(found, form)
        for table in tables_of(found):
            for cell in (cell for line in table.rows for cell in line):
                assert cell.replace("%", "\\%" if form == "latex" else "%") in text, (form, cell)
    markdown = [line for line in written(found, "markdown").splitlines() if line.startswith("|")]
    # A table for each task and one over tasks, of a head, a line and two methods each.
    assert len(markdown) == 3 * 4
    latex = written(found, "latex")
    assert latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == 3
    assert "mamujoco/Hopper-3x1: test return" in latex


def test_numbers_for_people() -> None:
    assert [number(v) for v in (1234.5, 99.95, 0.12345, math.nan)] == ["1,234", "100", "0.123", "-"]
    assert [seconds(v) for v in (59.6, 3700.0, math.inf)] == ["1m00s", "1h01m", "never"]


def test_the_command(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(tmp_path / f"c{suffix}") for suffix in (".md", ".json")]
    figure = ["--profile", str(tmp_path / "profile.png")]
    main(["compare", str(folder), "--strict", "--format", "csv", *figure, "--out", *files])
    assert capsys.readouterr().out.startswith("task,method,base,quantity")
    assert json.loads((tmp_path / "c.json").read_text())["base"] == MATD3
    assert "| RACE(MATD3) | 5 | 1,580" in (tmp_path / "c.md").read_text()
    assert (imread := iio.imread(tmp_path / "profile.png")).std() > 0
    assert imread.shape[0] > 500
    for words, said in (
        ([], "Say which runs"),
        ([str(folder), "--out", "c.xlsx"], "must end with"),
        ([str(folder), "--profile", "c.txt"], "must end with"),
        ([str(folder), "--score", "nan"], "--score is nan"),
        ([str(tmp_path / "nowhere")], "not a directory"),
    ):
        with pytest.raises(SystemExit):
            main(["compare", *words])
        assert said in capsys.readouterr().err


@pytest.fixture(scope="module")
def two_kinds(tmp_path_factory: pytest.TempPathFactory) -> Scores:
    """Robots and battles, as in the paper: RACE is over another learner on each."""
    folder = tmp_path_factory.mktemp("two kinds")
    levels = {"race": 1.2, "merl": 0.9, "matd3": 1.0, "facmac": 0.8, "ea": 0.5}
    for task, most in ((HOPPER, 1000.0), (ANT, 2000.0), (BATTLE, 0.5)):
        learners = ("facmac",) if most < 1 else ("matd3", "facmac")
        for algo in ("race", "merl", "ea", *learners):
            for seed in (1, 3):
                level = most * levels[algo] * (1 + seed / 100)
                level /= levels["facmac"] if most < 1 and algo == "facmac" else 1
                told = {"task": task, "algo": algo, "seed": seed}
                told |= {"base": "facmac"} if most < 1 and algo in ("race", "merl") else {}
                quantity = "win_rate" if most < 1 else "return_mean"
                written_run(folder / f"{task} {algo} {seed}", [(9, level)], None, quantity, **told)
    return scores_of(load([folder]))


@pytest.fixture(scope="module")
def of_both(two_kinds: Scores) -> Comparison:
    return compare(two_kinds)


def test_each_task_has_the_base_that_its_methods_are_built_on(
    two_kinds: Scores, of_both: Comparison
) -> None:
    # FACMAC was tried on more tasks, but RACE and MERL are over MATD3 on robots.
    assert of_both.bases == {ANT: MATD3, HOPPER: MATD3, BATTLE: "FACMAC"}
    assert {(pair.task, pair.method): pair.base for pair in of_both.pairs}[HOPPER, "FACMAC"] == (
        MATD3
    )
    time_to = {(row.task, row.method): row.time_to.score for row in of_both.on_tasks}
    assert time_to[HOPPER, RACE] == pytest.approx(1020)
    assert set(bases_of(two_kinds, "FACMAC").values()) == {"FACMAC"}
    found, _, _ = scales(two_kinds, "base", of_both.bases, None)
    assert [found[task].high for task in (HOPPER, BATTLE)] == pytest.approx([1020, 0.51])


def test_tasks_with_the_same_methods_are_taken_together(
    of_both: Comparison, tmp_path: Path
) -> None:
    found = of_both
    assert (found.common, found.families) == ((), ((ANT, HOPPER), (BATTLE,)))
    runs = {(row.tasks, row.method): row.runs for row in found.overall}
    assert runs[(ANT, HOPPER), RACE] == 4
    assert runs[(BATTLE,), "RACE(FACMAC)"] == 2
    assert len(runs) == 5 + 4
    titles = [table.title for table in tables_of(found)]
    ends = ["Over 2 tasks, final scores", "Over 1 task, final scores"]
    assert titles[3:] == [*ends, "Against the base, final scores"]
    assert "Not all methods were tried on all tasks" in written(found, "text")
    draw_profiles(found, tmp_path / "profile.png")
    picture = iio.imread(tmp_path / "profile.png")
    assert picture.shape[1] > 1.5 * picture.shape[0]  # two panels side by side


def test_the_gain_of_an_algorithm_is_over_the_base_of_each_task(of_both: Comparison) -> None:
    """The paper's 34.4%: RACE over MATD3 on robots and over FACMAC on battles."""
    found = of_both
    rows = {row.method: row for row in found.against}
    assert rows["RACE"].tasks == (ANT, HOPPER, BATTLE)
    assert rows["RACE"].base == "the base"
    assert rows["RACE"].gain is not None
    assert rows["RACE"].gain.value == pytest.approx((0.2 + 0.2 + 0.2) / 3)
    assert rows["MERL"].gain is not None
    assert rows["MERL"].gain.value == pytest.approx(-0.1)
    assert (rows["FACMAC"].base, rows["FACMAC"].tasks) == (MATD3, (ANT, HOPPER))
    assert rows["EA"].tasks == (ANT, HOPPER, BATTLE)  # one method on all of them
    assert MATD3 not in rows
    (line,) = (line for line in tables_of(found)[-1].rows if line[0] == "RACE")
    assert line[1:3] == ["the base", "3 tasks"]
    assert line[-1].startswith("20.0%")
    flat = list(csv.DictReader(io.StringIO(written(found, "csv"))))
    assert {r["task"] for r in flat if r["quantity"] == "optimality_gap"} == {
        f"{ANT}; {HOPPER}",
        BATTLE,
    }


@pytest.mark.parametrize(("seeds", "apart"), [(2, None), (4, True)])
def test_seeds_that_are_all_alike_prove_something_only_if_they_are_many(
    tmp_path: Path, seeds: int, apart: bool | None
) -> None:
    """Win rates of 1 and 0.97 have no spread, so that Welch's interval has no width."""
    for algo, rate in (("race", 1.0), ("facmac", 0.97)):
        for seed in range(seeds):
            told = {"task": BATTLE, "algo": algo, "seed": seed}
            written_run(tmp_path / f"{algo} {seed}", [(9, rate)], None, "win_rate", None, **told)
    found = compare(scores_of(load([tmp_path])))
    (pair,) = found.pairs
    assert (pair.difference.value, pair.told_apart) == (pytest.approx(0.03), apart)
    assert ("too few seeds to tell" if apart is None else "yes") in written(found, "text")

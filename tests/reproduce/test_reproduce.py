"""The paper's figures: which runs they need, which are shared, and what is drawn."""

import time
from pathlib import Path

import imageio.v3 as iio
import pytest
from written_runs import written_run

from race.cli import main
from race.cli.planned import show_plan
from race.config.cohort import CohortConfig
from race.config.presets import TABLES
from race.config.settings import Config
from race.envs import make_task
from race.errors import ConfigError
from race.reproduce import paper
from race.reproduce.figures import FIGURES, variants
from race.reproduce.known import known_of
from race.reproduce.planning import Plan, plan
from race.runs import archive, results
from race.training.asking import settled

ASKED = Config("")
CHEETAH, BATTLE = "mamujoco/HalfCheetah-2x3", "micro/2s3z"


def planned(*figures: str, **more: object) -> Plan:
    return plan(figures, more.pop("seeds", (1,)), ASKED, **more)  # type: ignore[arg-type]


def test_numbers_of_runs() -> None:
    assert len(planned("fig2").runs) == 8 * 5
    assert len(planned("fig3").runs) == 8 * 4
    assert len(planned("fig4").runs) == 16
    assert len(planned("fig5", seeds=(1, 2)).runs) == 4 * 5 * 2
    # Figure 4 shows the runs of RACE in Figures 2 and 3, and needs none of its own.
    assert len(planned("fig2", "fig3", "fig4").runs) == 72


def test_budgets_alpha_and_beta_are_the_papers() -> None:
    runs = planned(*FIGURES).runs.values()
    long = {config.task for config in runs if config.env_steps == 2_000_000}
    assert long == {"micro/2c_vs_64zg", "micro/MMM2", "micro/3s5z"}
    assert {config.env_steps for config in runs} == {1_000_000, 2_000_000}
    for config in planned("fig2", "fig3").runs.values():
        if config.algo == "race":
            tables = TABLES[config.task]
            assert (config.race.mutation_fraction, config.race.vmm_weight) == tables
    alphas = {c.race.mutation_fraction for c in planned("fig7", tasks=(BATTLE,)).runs.values()}
    assert alphas == {0.005, 0.01, 0.05, 0.1}
    betas = {c.race.vmm_weight for c in planned("fig8", tasks=(CHEETAH,)).runs.values()}
    assert betas == {1e-1, 1e-2, 1e-3, 1e-4}


def test_a_run_that_two_figures_show_is_made_once() -> None:
    both = planned("fig2", "fig7", tasks=(CHEETAH,))
    shared = "mamujoco-HalfCheetah-2x3-race-matd3-seed1"
    assert [(p.figure, p.label) for p in both.seen[shared]] == [
        ("fig2", "RACE"), ("fig7", "alpha = 0.7")
    ]  # fmt: skip
    assert len(both.runs) == 5 + 3
    assert "mamujoco-HalfCheetah-2x3-race-matd3-mutation_fraction=0.2-seed1" in both.runs


def test_runs_are_those_of_race_train() -> None:
    runs = planned("fig6", tasks=(CHEETAH, BATTLE)).runs
    for task, base in ((CHEETAH, "matd3"), (BATTLE, "facmac")):
        name = f"{task.replace('/', '-')}-race-{base}-no-mutation-seed1"
        assert runs[name] == settled(Config(task), "paper", ("no-mutation",), make_task(task))


def test_first_seeds_come_first_and_budgets_scale() -> None:
    runs = planned("fig2", seeds=(4, 2), tasks=(CHEETAH,), scale=0.1).runs
    assert [config.seed for config in runs.values()] == [4] * 5 + [2] * 5
    assert {config.env_steps for config in runs.values()} == {100_000}
    demo = planned("fig2", tasks=(CHEETAH,), env_steps=50_000, preset="demo").runs
    assert {config.learner.hidden_sizes for config in demo.values()} == {(160, 120)}
    with pytest.raises(ConfigError, match="--scale"):
        planned("fig2", scale=0.0)
    with pytest.raises(ConfigError, match="no fig9"):
        variants("fig9", False)


def test_a_thousand_runs_are_planned_in_a_second() -> None:
    began = time.process_time()
    assert len(planned(*FIGURES, seeds=tuple(range(8))).runs) > 1000
    assert time.process_time() - began < 5  # with every shape and type checked; 0.5 without


def test_the_papers_numbers() -> None:
    assert paper.points("fig2", CHEETAH, "RACE")[-1] == (1e6, 6000.0)
    assert paper.points("fig3", "micro/3s5z", "FACMAC") == [(2e6, 0.84)]
    assert paper.points("fig2", CHEETAH, "nobody") == paper.points("fig7", CHEETAH, "RACE") == []
    labels = {label: {v.label for v in variants("fig2", False)} for label in ("fig2",)}
    for task in FIGURES["fig2"].tasks:
        assert paper.points("fig2", task, "RACE")
    assert labels["fig2"] == {"RACE", "MERL", "MATD3", "FACMAC", "EA"}


def folder_of(path: Path, made: Plan, leave_out: str) -> None:
    """Runs of a plan with tests at their budgets, but for some."""
    for number, (name, config) in enumerate(made.runs.items()):
        if leave_out not in name:
            told = {"task": config.task, "algo": config.algo, "base": config.base}
            row = {"kind": "generation", "env_steps": 500_000, "wall_seconds": 10.0}
            rates = {"injection/elite_rate": 0.4, "injection/discarded_rate": 0.35}
            written_run(
                *(path / name, [(100_000, 10.0), (500_000, 1000.0 + number)], None),
                generations=[row | rates] if config.algo == "race" else None,
                seed=config.seed,
                **told,
            )


def test_figures_are_drawn_with_gaps_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder_of(tmp_path, planned("fig2", seeds=(1, 2), tasks=(CHEETAH,)), "-ea-")
    words = ["--tasks", CHEETAH, "--seeds", "1-2", "--dir", str(tmp_path)]
    main(["reproduce", "fig2", "fig4", "fig5", *words, "--draw-only"])
    told = capsys.readouterr()
    for figure in ("fig2", "fig4", "fig5"):
        picture = iio.imread(tmp_path / f"{figure}.png")
        assert picture.std() > 5
        assert f"{figure}.png" in told.out
    assert "fig2: 2 runs are not begun" in told.err


def test_known_runs_are_drawn_and_not_trained_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of an archive, too; not those of other settings, seeds or lengths, nor unfinished ones."""
    made = planned("fig2", tasks=(CHEETAH,), env_steps=400_000)
    ends = {"matd3": 500_000, "merl": 300_000, "race": 500_000}
    for name, config in made.runs.items():
        if config.algo in ends:
            run = tmp_path / "kept" / name
            told = {name: getattr(config, name) for name in ("task", "algo", "base", "seed")}
            written_run(run, [(ends[config.algo], 1000.0)], None, env_steps=400_000, **told)
    kept = results.load([tmp_path / "kept"])
    known = known_of(made.runs, kept)
    assert {run.config.algo for run in known.values()} == {"matd3", "race"}
    assert all(made.runs[name].algo == run.config.algo for name, run in known.items())
    for other in (
        planned("fig2", tasks=(CHEETAH,), env_steps=400_001),
        planned("fig2", tasks=(CHEETAH,), env_steps=400_000, seeds=(2,)),
        planned("fig2", tasks=(CHEETAH,), env_steps=400_000, preset="demo"),
        planned("fig2", tasks=("mamujoco/Ant-4x2",), env_steps=400_000),
    ):
        assert not known_of(other.runs, kept)
    packed = tmp_path / f"kept{archive.SUFFIX}"
    archive.write(packed, kept)
    words = ["--tasks", CHEETAH, "--env-steps", "400000", "--seeds", "1", "--known", str(packed)]
    out = tmp_path / "figures"
    main(["reproduce", "fig2", *words, "--dir", str(out), "--dry-run"])
    told = capsys.readouterr()
    assert "2 of 5 runs are known" in told.err
    assert told.out.count(" new\n") == 3
    main(["reproduce", "fig2", *words, "--dir", str(out), "--draw-only"])
    assert iio.imread(out / "fig2.png").std() > 5
    assert [file.name for file in out.iterdir()] == ["fig2.png"]
    assert "3 runs are not begun" in capsys.readouterr().err


def test_a_plan_is_shown_with_the_time_that_is_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    task = "probe/target"
    folder_of(tmp_path, planned("fig2", tasks=(task,)), "-ea-")
    words = ["--tasks", task, "--seeds", "1", "--dir", str(tmp_path)]
    main(["reproduce", "fig2", *words, "--dry-run"])
    told = capsys.readouterr()
    assert told.out.count(" begun\n") == 4
    assert told.out.count(" new\n") == 1
    # Four runs have half a million steps to go, at ten a second: 13.9 hours each.
    assert "55.6 hours of one process" in told.out
    assert "hours of one process" in told.out
    assert "no run has begun yet" in told.out


def test_what_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in (
        ([], "Say which figure"),
        (["fig2", "--draw-only", "--dir", str(tmp_path)], "There is no run of these figures"),
        (["fig2", "--scale", "-1"], "--scale is -1"),
        (["fig2", "--jobs", "0"], "--jobs"),
        (["fig2", "--env-steps", "0", "--dry-run"], "--env-steps is 0"),
        (["fig2", "--seeds", "x"], "seeds"),
        (["fig2", "--tasks", "micro/nowhere", "--dry-run"], "nowhere"),
    ):
        with pytest.raises(SystemExit):
            main(["reproduce", *words])
        assert said in capsys.readouterr().err


def test_runs_that_were_made_with_other_settings_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    task = "probe/target"
    folder_of(tmp_path, planned("fig4", tasks=(task,)), "nothing")
    words = ["--tasks", task, "--seeds", "1", "--dir", str(tmp_path), "--scale", "0.5"]
    main(["reproduce", "fig4", *words, "--dry-run"])
    assert "other settings" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["reproduce", "fig4", *words])
    told = " ".join(capsys.readouterr().err.split())
    assert "holds a run with other settings (env_steps 1000000, asked: 500000)" in told
    assert "another directory with --dir" in told


def test_a_plan_of_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    show_plan(tmp_path, {}, CohortConfig())  # where --known has all runs
    assert capsys.readouterr().out == "Nothing is left to run.\n"

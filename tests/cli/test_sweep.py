"""Many runs from one file."""

from pathlib import Path

import pytest
from commands import fails, race
from whole_runs import rows

from race.cli.fleet import directories_of
from race.runs import directory as run_directory

GRID = """
task = "probe/terminates"
algo = "matd3"
seeds = [1, 2]
env_steps = 90
[learner]
hidden_sizes = [6, 5]
batch_size = 8
random_steps = 40
actor_learning_rate = [1e-3, 3e-4]
[evaluation]
every = 60
episodes = 2
"""


def test_a_sweep_is_shown_run_and_gone_on_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("grid.toml").write_text(GRID)
    race("sweep grid.toml --dry-run")
    shown = capsys.readouterr().out
    name = "probe-terminates-matd3-actor_learning_rate=0.0003-seed2"
    assert name in shown
    assert "4 runs, 360 environment steps" in shown
    assert "Time left: 360 steps of tasks and methods of which no run has begun yet." in shown
    assert not Path("runs").exists()
    race("sweep grid.toml --cohort.batching vmap")
    assert "All 4 runs have finished" in capsys.readouterr().out
    places = directories_of(Path("runs/grid"))
    assert len(places) == 4
    assert all(run_directory.is_finished(place) for place in places)
    found = {place.name: run_directory.open_run(place) for place in places}
    assert found[name].learner.actor_learning_rate == 3e-4
    assert found[name].seed == 2
    first = [rows(place) for place in places]
    assert all(one != other for i, one in enumerate(first) for other in first[:i])
    race("sweep grid.toml")  # there is nothing left to do
    assert [rows(place) for place in places] == first
    race("sweep grid.toml --dry-run")
    assert capsys.readouterr().out.count("finished") >= 4
    # One that went on longer stays; a file that says something else is another sweep.
    Path("grid.toml").write_text(GRID.replace("batch_size = 8", "batch_size = 9"))
    assert "other settings" in fails("sweep grid.toml", capsys)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("task =", "is no TOML"),
        ('task = "nowhere/x"', "no task 'nowhere/x'"),
        ('task = "probe/terminates"\nalgo = "rice"', "algo is 'rice'"),
        (
            'task = "probe/terminates"\nalgo = ["race", "matd3"]\n[race]\npopulation_size = [6, 8]',
            "With algo = matd3, race.population_size = 6: ",
        ),
        ('task = "probe/terminates"\nablation = ["", "no-brain"]', "no-brain"),
    ],
)
def test_bad_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, told: str
) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(text)
    assert told in fails(f"sweep {file} --run-dir {tmp_path / 'runs'}", capsys)
    assert not (tmp_path / "runs").exists()


def test_no_file_and_no_jobs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "cannot be read" in fails(f"sweep {tmp_path / 'none.toml'}", capsys)
    assert "at least 1" in fails(f"sweep {tmp_path / 'none.toml'} --jobs 0", capsys)

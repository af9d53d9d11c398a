"""Several seeds at once: the same runs as one by one, stopped and resumed as a whole."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from commands import fails, race
from whole_runs import rows

from race.cli import fleet, machines
from race.cli.fleet import directories_of
from race.config.seeds import parse_seeds
from race.errors import ConfigError
from race.runs import directory as run_directory

SMALL = (
    "--algo matd3 --env-steps 120 --learner.random-steps 40 --learner.hidden-sizes 12 8 "
    "--learner.batch-size 8 --evaluation.every 60 --evaluation.episodes 2"
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("1-5", [1, 2, 3, 4, 5]), ("1,4,7", [1, 4, 7]), ("1-3, 9", [1, 2, 3, 9]), ("6", [6])],
)
def test_seeds_as_people_write_them(text: str, expected: list[int]) -> None:
    assert parse_seeds(text) == expected


@pytest.mark.parametrize("text", ["", "a", "3-1", "1,,2", "1-", "-2", "1,1", "1-3,2", "1.5"])
def test_what_is_no_list_of_seeds(text: str) -> None:
    with pytest.raises(ConfigError, match="--seeds is"):
        parse_seeds(text)


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("several") / "runs"
    race(f"train probe/terminates --seeds 1,2 --jobs 2 --run-dir {path} {SMALL}")
    return path


def test_each_seed_is_the_run_it_is_alone(both: Path, tmp_path: Path) -> None:
    assert [path.name for path in directories_of(both)] == ["seed1", "seed2"]
    race(f"train probe/terminates --seed 2 --run-dir {tmp_path / 'alone'} {SMALL}")
    assert rows(both / "seed2") == rows(tmp_path / "alone") != rows(both / "seed1")
    assert all(run_directory.is_finished(path) for path in directories_of(both))
    # Which command made it, for whoever wants to make it again.
    command = json.loads((both / "seed1" / "metadata.json").read_text())["command"]
    assert command == sys.argv


@pytest.mark.slow
def test_finished_seeds_are_extended_as_a_whole(
    both: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(shutil.copytree(both, tmp_path / "runs"))
    race(f"resume {path} --env-steps 140 --jobs 1")
    for run in directories_of(path):
        assert rows(run)[-1]["env_steps"] >= 140
        assert run_directory.is_finished(run)
    before = [rows(run) for run in directories_of(path)]
    race(f"resume {path}")  # there is nothing left to do
    assert [rows(run) for run in directories_of(path)] == before
    assert "would not extend" in fails(f"resume {path} --env-steps 130", capsys)


def test_a_new_budget_is_everybodys_before_anybody_goes_on(
    both: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped before the second has its turn, a plain resume still knows of it."""
    path = Path(shutil.copytree(both, tmp_path / "runs"))

    def stop_at_once(self: fleet.Worker, take: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as stopped:
        stopped.setattr(fleet.Worker, "start", stop_at_once)
        with pytest.raises(SystemExit) as ended:
            race(f"resume {path} --env-steps 140 --jobs 1")
    assert ended.value.code == 130
    assert not any(run_directory.is_finished(run) for run in directories_of(path))
    race(f"resume {path} --jobs 2")
    assert all(rows(run)[-1]["env_steps"] >= 140 for run in directories_of(path))
    # One of them longer than the others: asked for less, the others are brought up to it.
    race(f"resume {path / 'seed1'} --env-steps 180")
    race(f"resume {path} --env-steps 160")
    assert [rows(run)[-1]["env_steps"] >= 160 for run in directories_of(path)] == [True, True]


def test_bad_input(both: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train = f"train probe/terminates --run-dir {both} {SMALL}"
    assert "already holds a run" in fails(f"{train} --seeds 2-4", capsys)
    assert not (both / "seed3").exists()
    assert "two ways" in fails(f"{train} --seeds 1-2 --seed 4", capsys)
    assert "no effect without --seeds" in fails(f"{train} --jobs 2", capsys)
    assert "no effect without --seeds" in fails(f"{train} --jobs 0", capsys)
    assert "at least 1" in fails(f"{train} --seeds 1-2 --jobs 0", capsys)
    assert "at least 1" in fails(f"resume {both} --jobs -1 --env-steps 900", capsys)
    assert "which is one run" in fails(f"resume {both / 'seed1'} --jobs 2", capsys)
    assert "not the directory of a run" in fails(f"resume {tmp_path}", capsys)


def test_a_seed_that_fails_is_named_and_the_others_are_trained(
    both: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(shutil.copytree(both, tmp_path / "runs"))
    shutil.rmtree(path / "seed1" / "checkpoints")
    (path / "seed1" / "checkpoints").write_text("a file where a folder should be")
    message = fails(f"resume {path} --env-steps 140 --jobs 2", capsys)
    assert "seed1 failed" in message
    assert "seed1" in message
    assert rows(path / "seed2")[-1]["env_steps"] >= 140


@pytest.mark.slow
def test_an_interrupt_stops_all_and_they_go_on_number_for_number(tmp_path: Path) -> None:
    path = tmp_path / "runs"
    long = SMALL.replace("--env-steps 120", "--env-steps 4000").replace("every 60", "every 500")
    command = f"train probe/terminates --seeds 1,2 --jobs 2 --run-dir {path} {long}"
    process = subprocess.Popen(
        [sys.executable, "-m", "race", *command.split()], stdout=subprocess.PIPE, text=True
    )
    written = [path / f"seed{seed}" / "metrics.jsonl" for seed in (1, 2)]
    deadline = time.monotonic() + 240
    while time.monotonic() < deadline and not all(f.exists() and f.stat().st_size for f in written):
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGINT)
    said, _ = process.communicate(timeout=240)
    assert process.returncode == 130
    assert f"race resume {path}" in " ".join(said.split())
    assert not any(run_directory.is_finished(run) for run in directories_of(path))
    race(f"resume {path} --jobs 2")
    race(f"train probe/terminates --seed 1 --run-dir {tmp_path / 'alone'} {long}")
    assert rows(path / "seed1") == rows(tmp_path / "alone")


class Ended(subprocess.Popen[bytes]):
    """A process that has ended at once."""

    def __init__(self) -> None:
        """Starts none."""

    def poll(self) -> int:
        return 0


@pytest.fixture
def cores(monkeypatch: pytest.MonkeyPatch) -> list[int | None]:
    """The cores on which processes were to be started, in their order."""
    started: list[int | None] = []

    def start(paths: Any, batching: Any, log: Any, core: int | None, device: str | None) -> Ended:
        started.append(core)
        return Ended()

    monkeypatch.setattr(machines, "start_here", start)
    return started


def test_runs_have_a_core_each_where_there_are_enough(
    both: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: list[int | None]
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3, 5})
    path = Path(shutil.copytree(both, tmp_path / "runs"))
    fleet.run_all(path, directories_of(path), jobs=2, env_steps=500)
    assert cores == [3, 5]
    cores.clear()
    fleet.run_all(
        path, directories_of(path), jobs=1, env_steps=600
    )  # alone, a run may use them all
    assert cores == [None, None]


def test_more_jobs_than_cores_share_them(
    both: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: list[int | None]
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3})
    path = Path(shutil.copytree(both, tmp_path / "runs"))
    fleet.run_all(path, directories_of(path), jobs=2, env_steps=500)
    assert cores == [3, 3]

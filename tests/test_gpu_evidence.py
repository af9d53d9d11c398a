"""The script for a machine with a GPU: what it compares, and a minute of it on a processor."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from loaded_scripts import SCRIPTS, loaded

FILES = {"log.txt", "report.json", "bench.json", "evidence.jsonl.gz", "doctor.txt"}


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return loaded("gpu_evidence")


def test_rows_are_compared_by_their_losses_relative_to_their_size(script: ModuleType) -> None:
    one = [{"env_steps": 10}, {"loss/critic": 2.0, "loss/pevfa": None}, {"loss/critic": 4.0}]
    other = [{"env_steps": 11}, {"loss/critic": 2.02, "loss/pevfa": 1.0}, {"loss/critic": 5.0}]
    first, largest = script.differences(one, other)
    assert first == pytest.approx(0.02 / 2.02)
    assert largest == pytest.approx(0.2)
    assert script.differences(one[:1], other[:1]) == (None, None)


def test_times_and_names_of_runs_do_not_tell_rows_apart(script: ModuleType) -> None:
    rows = [
        [{"run": name, "wall_seconds": 1.0, "time/x": 2.0, "loss/critic": 3.0}] for name in "ab"
    ]
    assert script.comparable(rows[0]) == script.comparable(rows[1]) == [{"loss/critic": 3.0}]


def test_what_is_measured_is_known_to_the_bench(script: ModuleType) -> None:
    from race.bench import suite

    for pattern in script.BENCHES:
        assert suite.chosen(suite.subjects(), pattern)


def test_a_mistake_is_told(tmp_path: Path) -> None:
    for wrong in (["--out", str(tmp_path)], ["--out", str(tmp_path), "--minutes", "0"]):
        done = subprocess.run(
            [SCRIPTS / "gpu_evidence.sh", "--python", sys.executable, *wrong],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 2
        assert "--minutes" in done.stderr


@pytest.mark.slow
def test_a_few_minutes_leave_the_files_and_end_in_time(tmp_path: Path) -> None:
    out = tmp_path / "out"
    asked = ("--out", out, "--minutes", "4", "--skip", "bench", "--env-steps", "4000")
    done = subprocess.run(
        [SCRIPTS / "gpu_evidence.sh", "--python", sys.executable, *asked],
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        timeout=300,
        check=False,
    )
    assert done.returncode == 0
    assert {file.name for file in out.iterdir()} <= FILES
    report = json.loads((out / "report.json").read_text())
    assert {"agreement", "resume", "evidence"} <= set(report)

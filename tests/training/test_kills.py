"""SIGKILL at random moments: nothing is lost, and every run goes on exactly."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import pytest
from whole_runs import rows

from race.config.presets import resolve
from race.config.settings import (
    CheckpointConfig,
    Config,
    EvaluationConfig,
    LearnerConfig,
    RaceConfig,
)
from race.runs import directory as run_directory

# Forks a trainer for each directory that it is told: importing takes longer than training. JAX must
# not have computed anything in a process that forks.
TRAINERS = """
import os, sys
from pathlib import Path
import race.compilation, race.training.trainer
from race.runs import directory
for line in sys.stdin:
    path = Path(line.rstrip())
    child = os.fork()
    if child == 0:
        race.compilation.use_cache()
        def report(stage, progress, row):
            os.write(1, (stage + "\\n").encode())
        race.training.trainer.train(path, directory.open_run(path), report=report)
        os.write(1, b"done\\n")
        os._exit(0)
    os.write(1, f"{child}\\n".encode())
    os.waitpid(child, 0)
    os.write(1, b"gone\\n")
"""
STAGES = ("random steps", "rollouts", "learning", "evaluation", "saving")
KILLS = {"race": 30, "matd3": 70}


def config_of(algo: Any) -> Config:
    config = Config(
        "slow_walk:task",
        algo=algo,
        env_steps=330,
        learner=LearnerConfig(hidden_sizes=(12, 8), batch_size=8, random_steps=100),
        race=RaceConfig(policy_embedding_size=4, mine_size=6),
        evaluation=EvaluationConfig(every=60, episodes=3),
        checkpoint=CheckpointConfig(minutes=0.0),
    )
    return resolve(config)


@pytest.fixture
def trainers(tmp_path: Path) -> Iterator["subprocess.Popen[str]"]:
    environment = os.environ | {
        "PYTHONPATH": f"{Path(__file__).parent}:{os.environ.get('PYTHONPATH', '')}",
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }
    with subprocess.Popen(
        [sys.executable, "-c", TRAINERS],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    ) as process:
        yield process
        assert process.stdin is not None
        process.stdin.close()


class Moment(NamedTuple):
    """When to kill: so many seconds after a stage has been told of so many times."""

    stage: str
    times: int
    seconds: float


def trained(
    process: "subprocess.Popen[str]", path: Path, kill_at: Moment | None = None
) -> tuple[str, list[str], float]:
    """Trains in a directory, and kills that at some moment, if it comes to it.

    Returns:
        The stage that it was in (``done``: it came to its end), all stages that it told of, and the
        seconds from the first to the last of them.
    """
    stdin, stdout = process.stdin, process.stdout
    assert stdin is not None
    assert stdout is not None
    stdin.write(f"{path}\n")
    stdin.flush()
    child, due, told, begun = 0, float("inf"), [""], 0.0
    os.set_blocking(stdout.fileno(), False)
    try:
        for line in _lines(stdout):
            if line == "gone":
                break
            if line.isdigit():
                child = int(line)
            elif line:
                begun = begun or time.monotonic()
                told.append(line)
                if kill_at is not None and line == kill_at.stage:
                    kill_at = kill_at._replace(times=kill_at.times - 1)
                    if kill_at.times == 0:
                        due = time.monotonic() + kill_at.seconds
            if time.monotonic() >= due:
                os.kill(child, signal.SIGKILL)
                due = float("inf")
    finally:
        os.set_blocking(stdout.fileno(), True)
    return told[-1], told, time.monotonic() - begun


def _lines(stream: IO[str]) -> Iterator[str]:
    """Lines as they come, and empty ones while none does."""
    rest = ""
    while True:
        try:
            data = os.read(stream.fileno(), 65536).decode()
        except BlockingIOError:
            time.sleep(0.001)
            yield ""
            continue
        assert data, "the trainers have ended"
        *lines, rest = (rest + data).split("\n")
        yield from lines


@pytest.mark.slow
@pytest.mark.parametrize("algo", KILLS)
def test_killed_runs_go_on_exactly(
    tmp_path: Path, trainers: "subprocess.Popen[str]", algo: str
) -> None:
    config = config_of(algo)
    for name in ("compiling", "whole"):
        run_directory.create(tmp_path / name, config)
        stage, told, seconds = trained(trainers, tmp_path / name)
        assert stage == "done"
    expected = rows(tmp_path / "whole")
    assert rows(tmp_path / "compiling") == expected
    chance, usual = np.random.default_rng(2023), Counter(told)
    kills: Counter[str] = Counter()
    runs = 0
    while True:
        path = tmp_path / f"run{runs}"
        if not path.exists():
            if kills.total() >= KILLS[algo]:
                break
            run_directory.create(path, config)
        moment = None
        if kills.total() < KILLS[algo]:
            # Each stage in turn; a run that is past it comes to its end, and the next one meets it.
            aim = STAGES[kills.total() % len(STAGES)]
            times = int(chance.integers(1, max(2, usual[aim] // 2)))
            moment = Moment(aim, times, float(chance.uniform(0, 3 * seconds / len(told))))
        stage, *_ = trained(trainers, path, moment)
        if stage == "done":
            assert (path / "DONE").exists()
            assert rows(path) == expected
            runs += 1
        else:
            kills[stage] += 1
    print(f"{algo}: {kills.total()} kills ({dict(kills)}), {runs} whole runs, {seconds:.1f} s each")
    assert set(kills) >= set(STAGES), kills
    assert runs >= KILLS[algo] // len(STAGES)

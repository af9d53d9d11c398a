"""Runs on a cluster: what is sent, stopped, lost, sent again; and a real one of several nodes."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from commands import fails, race
from whole_runs import rows
from written_runs import written_run

from race.cli import carried, cluster, fleet
from race.cli.cluster import Cluster, Need, check_address
from race.cli.fleet import directories_of
from race.cli.worker import MOST_LOSSES
from race.config.cohort import CohortConfig
from race.errors import ConfigError, RaceError, RunDirectoryError
from race.runs import directory as run_directory

SLEEPS = [sys.executable, "-c", "import time; time.sleep(60)"]
STOPS = (
    "import sys,time,signal; signal.signal(2, lambda *_: sys.exit(130)); print('up', flush=True)"
)


@pytest.mark.parametrize("on", ["ray", "ray://10.0.0.7", "ray://head:10001", "ray://a.b-c:1"])
def test_names_of_clusters(on: str) -> None:
    check_address(on)


@pytest.mark.parametrize(
    "on", ["", "slurm", "ray://", "ray://:1", "ray://a:0", "ray://a:99999", "ray://a:b", "ray:/a"]
)
def test_what_names_no_cluster(on: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match="ray://HOST:PORT"):
        check_address(on)
    if on:
        words = f"train probe/target --run-dir {tmp_path / 'runs'} --on {on}"
        assert "ray://HOST:PORT" in fails(f"{words} --seeds 1-2", capsys)
        assert "no effect without --seeds" in fails(words, capsys)
        assert not (tmp_path / "runs").exists()


def test_without_ray(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    written_run(tmp_path / "runs/seed1", [], task="probe/target")
    told = fails(f"resume {tmp_path / 'runs'} --on ray", capsys)
    assert "pip install 'race-marl[ray]'" in told
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return written_run(tmp_path / "runs/seed1", [], task="probe/target")


def carry(monkeypatch: pytest.MonkeyPatch, run: Path, command: list[str]) -> int:
    monkeypatch.setattr(carried, "command_for", lambda paths, batching: command)
    signs = run.parent / ".signs"
    signs.mkdir(exist_ok=True)
    return carried.carry_out(signs, 1, [run], "map", run, 0)


def test_a_task_ends_as_its_process_does(monkeypatch: pytest.MonkeyPatch, run: Path) -> None:
    said = "import os, sys; print(len(os.sched_getaffinity(0)), os.getcwd()); sys.exit(7)"
    assert carry(monkeypatch, run, [sys.executable, "-c", said]) == 7
    assert (run / "log.txt").read_text() == f"1 {run}\n"
    assert carried.begun(run.parent / ".signs", 1).exists()


def test_a_task_that_is_to_stop_lets_its_process_save(
    monkeypatch: pytest.MonkeyPatch, run: Path
) -> None:
    def wish(process: Any, stop: Path) -> int:
        while "up" not in (run / "log.txt").read_text():
            time.sleep(0.05)
        stop.touch()
        return watched(process, stop)

    watched = carried._watched
    monkeypatch.setattr(carried, "_watched", wish)
    assert carry(monkeypatch, run, [sys.executable, "-c", f"{STOPS}; time.sleep(60)"]) == 130
    assert carry(monkeypatch, run, SLEEPS) == 130  # it does not begin any more


def test_a_machine_that_does_not_see_the_runs(tmp_path: Path) -> None:
    with pytest.raises(RunDirectoryError, match="all of its machines share"):
        carried.carry_out(tmp_path, 1, [tmp_path / "elsewhere"], "map", tmp_path, 0)


def test_a_run_that_another_process_keeps_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, run: Path
) -> None:
    monkeypatch.setattr(carried, "WAIT_FOR_LOCK", 0.0)
    held = f"from race.runs.lock import lock\nwith lock(__import__('pathlib').Path({str(run)!r})):"
    keeper = subprocess.Popen(
        [sys.executable, "-c", f"{held}\n print('held', flush=True); input()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert keeper.stdout is not None
    keeper.stdout.readline()
    with pytest.raises(RunDirectoryError, match="by another process"):
        carry(monkeypatch, run, SLEEPS)
    monkeypatch.setattr(carried, "WAIT_FOR_LOCK", 60.0)
    keeper.communicate(b"\n")
    assert carry(monkeypatch, run, [sys.executable, "-c", ""]) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="needs prctl")
def test_a_process_ends_with_the_one_that_it_is_tied_to(tmp_path: Path) -> None:
    tied = "[sys.executable, '-m', 'race.cli.tied', str(os.getpid()), sys.executable, '-c', "
    parent = subprocess.Popen(
        [
            *(sys.executable, "-c"),
            f"import os, subprocess, sys; print(subprocess.Popen({tied}"
            "'import time; print(0, flush=True); time.sleep(60)'], stdout=2).pid, flush=True); "
            "__import__('time').sleep(60)",
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout is not None
    assert parent.stderr is not None
    child = int(parent.stdout.readline())
    assert parent.stderr.readline() == "0\n"  # it is what it was to become
    parent.kill()
    parent.communicate()
    deadline = time.monotonic() + 20
    with contextlib.suppress(ProcessLookupError):
        while time.monotonic() < deadline and "zombie" not in state_of(child):
            time.sleep(0.05)
    assert time.monotonic() < deadline


def test_a_process_that_is_tied_hears_of_interrupts_again() -> None:
    signals = "signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})"
    said = "import signal; print(signal.getsignal(2).__name__, signal.pthread_sigmask(0, []))"
    words = f"['-m', 'race.cli.tied', str(os.getpid()), sys.executable, '-c', {said!r}]"
    done = subprocess.run(
        [
            *(sys.executable, "-c"),
            f"import os, signal, subprocess, sys; {signals}; signal.signal(2, signal.SIG_IGN); "
            f"subprocess.run([sys.executable, *{words}], check=True)",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "default_int_handler set()\n"


def state_of(process: int) -> str:
    try:
        return Path(f"/proc/{process}/status").read_text()
    except FileNotFoundError:
        raise ProcessLookupError from None


class FakeRay:
    """Answers like the module; what tasks come to is scripted."""

    def __init__(self, nodes: list[dict[str, float]], answers: Sequence[Any]) -> None:
        self.alive, self.answers = nodes, list(answers)
        self.sent: list[tuple[dict[str, Any], tuple[Any, ...]]] = []
        self.cancelled: list[tuple[int, bool]] = []
        self.down = False
        names = "WorkerCrashedError NodeDiedError OutOfMemoryError TaskCancelledError RayTaskError"
        error = type("RayError", (Exception,), {})
        kinds = {name: type(name, (error,), {}) for name in names.split()}
        self.exceptions = SimpleNamespace(RayError=error, **kinds)

    def nodes(self) -> list[dict[str, Any]]:
        return [{"Alive": True, "Resources": node} for node in self.alive]

    def remote(self, function: Any) -> Any:
        assert function is carried.carry_out

        def options(**asked: Any) -> Any:
            def send(*arguments: Any) -> int:
                self.sent.append((asked, arguments))
                return len(self.sent) - 1

            return SimpleNamespace(remote=send)

        return SimpleNamespace(options=options)

    def wait(self, refs: list[int], timeout: float) -> tuple[list[int], list[int]]:
        ended = [ref for ref in refs if ref < len(self.answers) and self.answers[ref] != "going"]
        return ended, [ref for ref in refs if ref not in ended]

    def get(self, ref: int) -> Any:
        answer = self.answers[ref]
        if isinstance(answer, str):
            raise getattr(self.exceptions, answer)("it is gone")
        return answer

    def cancel(self, ref: int, force: bool = False) -> None:
        self.cancelled.append((ref, force))
        self.answers[ref] = "TaskCancelledError"

    def shutdown(self) -> None:
        self.down = True


GIB = 2**30


@pytest.fixture
def sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """(nodes, answers) -> a fake ray, and the runs of two seeds."""

    def make(nodes: list[dict[str, float]], answers: Sequence[Any]) -> tuple[FakeRay, Path]:
        fake = FakeRay(nodes, answers)
        monkeypatch.setattr(cluster, "_connected", lambda on: fake)
        monkeypatch.setattr(fleet, "LOOK_EVERY", 0.0)
        for seed in (1, 2):
            if not (tmp_path / f"runs/seed{seed}").exists():
                run = written_run(tmp_path / f"runs/seed{seed}", [], task="probe/target", seed=seed)
                (run / "log.txt").touch()
        return fake, tmp_path / "runs"

    return make


TWO = [{"CPU": 0.0, "memory": 9 * GIB}, {"CPU": 2.0, "memory": 9.0 * GIB, "GPU": 0.0}]


def go(path: Path, **more: Any) -> None:
    fleet.run_all(path, directories_of(path), on="ray://there", **more)


def test_tasks_state_what_they_need(sent: Any, capsys: pytest.CaptureFixture[str]) -> None:
    fake, path = sent(TWO, [0, 0])
    go(path)
    asked = [options for options, _ in fake.sent]
    assert [o["num_cpus"] for o in asked] == [1, 1]
    assert [o["num_gpus"] for o in asked] == [0, 0]
    assert all(1.5e9 < o["memory"] < 3e9 for o in asked)  # the replay buffer is a part of it
    places = [arguments[2] for _, arguments in fake.sent]
    assert places == [[path.resolve() / "seed1"], [path.resolve() / "seed2"]]
    assert fake.down
    assert not list(path.glob(".cluster-*"))
    assert "All 2 runs have finished" in capsys.readouterr().out


def test_alike_runs_share_the_accelerators_of_a_cluster(sent: Any) -> None:
    fake, path = sent([{"CPU": 8.0, "memory": 9 * GIB, "GPU": 1.0}], [0])
    go(path)
    ((asked, arguments),) = fake.sent
    assert asked["num_gpus"] == 1
    assert [place.name for place in arguments[2]] == ["seed1", "seed2"]
    fake, path = sent([{"CPU": 8.0, "memory": 9 * GIB, "GPU": 1.0}], [0, 0])
    go(path, cohort=CohortConfig(width=1))
    assert len(fake.sent) == 2


def test_what_is_lost_goes_on_and_not_for_ever(
    sent: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    fake, path = sent(TWO, ["NodeDiedError", 0, "OutOfMemoryError", 0])
    go(path)
    assert [a[2][0].name for _, a in fake.sent] == ["seed1", "seed2", "seed1", "seed1"]
    assert capsys.readouterr().out.count("seed1: its machine was lost") == 2
    fake, path = sent(TWO, [0, *["WorkerCrashedError"] * 9])
    with pytest.raises(RunDirectoryError, match=r"seed2 failed(.|\n)*Its process was lost on"):
        go(path)
    assert len(fake.sent) == 1 + MOST_LOSSES + 1


def test_what_else_ray_says_of_a_task_is_told(sent: Any) -> None:
    _, path = sent(TWO, ["RayError", 0])
    with pytest.raises(RunDirectoryError, match=r"seed1 failed.*: it is gone"):
        go(path)


def test_a_second_interrupt_ends_all_at_once(sent: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    fake, path = sent(TWO, ["going", "going"])
    nodes = fake.wait

    def wait(refs: list[int], timeout: float) -> Any:
        if len(fake.sent) == 2 and not fake.cancelled:
            for _, (signs, number, *_rest) in fake.sent:
                carried.begun(signs, number).touch()
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
        return nodes(refs, timeout)

    monkeypatch.setattr(fake, "wait", wait)
    with pytest.raises(SystemExit) as ended:
        go(path)
    assert ended.value.code == 130
    assert sorted(fake.cancelled) == [(0, True), (1, True)]


def test_room_is_what_machines_offer_and_jobs_allow(sent: Any) -> None:
    fake, path = sent([{"CPU": 1.0, "memory": 9 * GIB}] * 2, ["going"] * 3)
    needs = {path / f"seed{k}": Need(memory=4 * GIB) for k in (1, 2)}
    with Cluster("ray://there", path) as made:
        for jobs, most in ((None, 2), (1, 1), (7, 2)):
            made.plan(needs, jobs)
            while made.room():
                made.start([path / "seed1"], "map", path)
            assert len(fake.sent) == most
            fake.answers = [0] * len(fake.sent)
            made.room()
            fake.sent, fake.answers = [], ["going"] * 3
        with pytest.raises(RaceError, match=r"No machine of the cluster offers 1 core and 10.7 GB"):
            made.plan({path / "seed1": Need(memory=10 * GIB)}, None)
        made.start([path / "seed1"], "map", path)
    assert fake.cancelled == [(0, True)]  # nothing is left behind
    assert fake.down


def test_an_interrupt_stops_those_that_run_and_those_that_wait(
    sent: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake, path = sent(TWO, ["going", "going"])
    nodes = fake.wait

    def wait(refs: list[int], timeout: float) -> Any:
        if len(fake.sent) == 2 and not list(path.glob(".cluster-*/stop")):
            signs = fake.sent[0][1][0]
            carried.begun(signs, fake.sent[0][1][1]).touch()  # the first runs, the other waits
            os.kill(os.getpid(), signal.SIGINT)
            assert (signs / carried.STOP).exists()
            fake.answers[0] = 130
        return nodes(refs, timeout)

    monkeypatch.setattr(fake, "wait", wait)
    with pytest.raises(SystemExit) as ended:
        go(path)
    assert ended.value.code == 130
    assert fake.cancelled == [(1, False)]
    assert fake.down


SMALL = (
    "--algo matd3 --env-steps 4000 --learner.random-steps 40 --learner.hidden-sizes 12 8 "
    "--learner.batch-size 8 --evaluation.every 500 --evaluation.episodes 2 "
    "--learner.replay-capacity 5000 --checkpoint.minutes 0.05"
)


def started(words: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "race", *words.split()],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def wait_for_rows(path: Path, training: "subprocess.Popen[str]") -> None:
    written = [path / f"seed{seed}" / "metrics.jsonl" for seed in (1, 2)]
    deadline = time.monotonic() + 300
    while not all(file.exists() and file.stat().st_size for file in written):
        assert time.monotonic() < deadline
        assert training.poll() is None, training.communicate()[0]
        time.sleep(0.1)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same runs without a cluster."""
    pytest.importorskip("ray")
    path = tmp_path_factory.mktemp("alone") / "runs"
    race(f"train probe/terminates --seeds 1,2 --jobs 2 --run-dir {path} {SMALL}")
    return path


@pytest.mark.slow
def test_a_node_that_is_killed_costs_no_row(alone: Path, tmp_path: Path) -> None:
    path, script = tmp_path / "runs", Path(__file__).with_name("several_nodes.py")
    nodes = subprocess.Popen(
        [sys.executable, str(script), "1", "1"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert nodes.stdin is not None
    assert nodes.stdout is not None
    try:
        address = nodes.stdout.readline().strip()
        training = started(
            f"train probe/terminates --seeds 1,2 --run-dir {path} --on {address} {SMALL}"
        )
        wait_for_rows(path, training)
        time.sleep(2)
        nodes.stdin.write("1\n")
        nodes.stdin.flush()
        assert nodes.stdout.readline() == "gone\n"
        said, _ = training.communicate(timeout=400)
    finally:
        nodes.communicate(timeout=60)  # nothing more to read: it ends all nodes
    assert training.returncode == 0, said
    assert said.count("its machine was lost; it goes on") == 1
    for seed in (1, 2):
        assert rows(path / f"seed{seed}") == rows(alone / f"seed{seed}")


@pytest.mark.slow
def test_an_interrupt_leaves_nothing_running_and_loses_nothing(alone: Path, tmp_path: Path) -> None:
    path = tmp_path / "runs"
    training = started(f"train probe/terminates --seeds 1,2 --run-dir {path} --on ray {SMALL}")
    wait_for_rows(path, training)
    training.send_signal(signal.SIGINT)
    said, _ = training.communicate(timeout=120)
    assert training.returncode == 130, said
    assert f"race resume {path}" in " ".join(said.split())
    assert not any(run_directory.is_finished(run) for run in directories_of(path))
    assert not list(path.glob(".cluster-*"))
    assert not [command for command in commands_running() if str(path) in command]
    race(f"resume {path} --jobs 2")
    for seed in (1, 2):
        assert rows(path / f"seed{seed}") == rows(alone / f"seed{seed}")
    shutil.rmtree(path)


def commands_running() -> list[str]:
    found = []
    for place in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            found.append(place.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
    return found


@pytest.mark.slow
def test_a_cluster_that_cannot_be_reached(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("ray")
    written_run(tmp_path / "runs/seed1", [], task="probe/target")
    began = time.monotonic()
    told = fails(f"resume {tmp_path / 'runs'} --on ray://127.0.0.1:9", capsys)
    assert "No Ray cluster answers at ray://127.0.0.1:9" in told
    assert time.monotonic() - began < 15 + 15  # and what is imported on a busy machine

"""Real command lines, with the real parser, in processes of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

# Each line as `python -m race` would take it, one after the other, because starting takes longer.
DRIVER = """
import contextlib, io, json, runpy, sys
for words in json.load(sys.stdin):
    sys.argv = ["race", *words]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            runpy.run_module("race", run_name="__main__")
        except SystemExit as stopped:
            code = stopped.code or 0
    print(json.dumps([code, out.getvalue(), err.getvalue()]), flush=True)
"""
SMALL = (
    "--algo matd3 --learner.random-steps 40 --env-steps 60 --learner.hidden-sizes 4 4 "
    "--learner.batch-size 4 --evaluation.episodes 2 --evaluation.every 30"
)
RUN = "a b[/red]"  # a name that shells and markup would read otherwise
LINES: list[tuple[list[str], int, str]] = [
    (["train", "bad_tasks:fine", *SMALL.split(), "--run-dir", RUN], 0, f"race evaluate '{RUN}'"),
    (["evaluate", RUN, "--episodes", "2"], 0, "return over 2 episodes"),
    (["evaluate", RUN, "--episodes", "2", "--json"], 0, '"return_mean"'),
    (["show", RUN], 0, "import the module bad_tasks"),
    (["show", RUN, "--json"], 0, '"finished": true'),
    (["plot", RUN, "--out", "p.svg"], 0, "Figure: p.svg"),
    (["archive", RUN, "--out", "a.jsonl.gz"], 0, "1 run of 1 experiment"),
    (["resume", RUN], 1, f"race resume '{RUN}' --env-steps 120"),
    (["resume", RUN, "--without-metrics"], 1, "--env-steps 120 --without-metrics"),
    (["resume", RUN, "--env-steps", "80"], 0, "Finished after 80"),
    (["resume", RUN, "--env-steps", "99", "--without-metrics"], 1, "has no effect"),
    (["render", RUN], 1, "cannot be drawn"),
    (["train", "bad_tasks:fine", *SMALL.split(), "--run-dir", RUN], 1, f"race resume '{RUN}'"),
    (["train", "bad_tasks:reset_alone", "--algo", "matd3"], 1, "return observation, {}"),
    (["train", "bad_tasks:exits", "--algo", "matd3"], 1, "it called sys.exit()"),
    (["train", "bad_tasks:late_exits", *SMALL.split(), "--env-steps", "140"], 0, "is repeated"),
    (["train", "bad_tasks:g_done_agents"], 1, "terminated is a list of 2"),
    (["train", "probe/chain", "--learner.exploration-noise", "1e308"], 1, "exploration-noise"),
    (["train", "probe/chain", "--algo", "sarsa"], 2, "sarsa"),
    (["train", "probe/chain", "--run-dir", ""], 2, "an argument is empty"),
    (["evaluate", RUN, "--episodes", "1000000000000"], 1, "at most 1000000"),
    (["trian"], 2, "Did you mean `race train`"),
    (["list"], 0, "mamujoco/Ant-2x4"),
    (["--version"], 0, "race "),
]


@pytest.fixture(scope="module")
def surroundings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    place = tmp_path_factory.mktemp("real")
    environment = os.environ | {
        "PYTHONPATH": str(Path(__file__).parent),
        "XDG_CACHE_HOME": str(place / "cache"),
        "MUJOCO_GL": "none",
    }
    return place, environment


def test_twenty_lines(surroundings: tuple[Path, dict[str, str]]) -> None:
    place, environment = surroundings
    done = subprocess.run(
        [sys.executable, "-c", DRIVER],
        input=json.dumps([words for words, *_ in LINES]),
        capture_output=True,
        text=True,
        cwd=place,
        env=environment,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    for (words, code, told), (found, out, err) in zip(LINES, answers, strict=True):
        said = " ".join((out + err).split())
        assert found == code, (words, said)
        assert told in said, (words, said)
        assert "Traceback" not in said, (words, said)
    assert json.loads(answers[2][1])["returns"]
    assert (place / RUN / "DONE").exists()
    rows = (place / "runs" / "bad_tasks-late_exits-matd3-seed1" / "metrics.jsonl").read_text()
    assert '"env/repeated_episodes"' in rows.splitlines()[-1]


def shell(command: str, surroundings: tuple[Path, dict[str, str]], **more: str) -> Any:
    place, environment = surroundings
    return subprocess.run(
        ["bash", "-c", command.replace("race ", f"{sys.executable} -m race ", 1)],
        capture_output=True,
        text=True,
        cwd=place,
        env=environment | more,
        check=False,
    )


@pytest.mark.parametrize(
    ("command", "more", "code", "told"),
    [
        ("race --version > /dev/full", {}, 1, "No space left on device"),
        ("race --version >&-", {}, 0, ""),
        ("race list | head -1", {"PYTHONIOENCODING": "ascii"}, 0, ""),
        ("race trian 2>&-", {}, 2, ""),
        ("race train probe/chain", {"JAX_PLATFORMS": "cuda"}, 1, "JAX_PLATFORMS='cuda'"),
    ],
)
def test_streams_and_machines(
    command: str,
    more: dict[str, str],
    code: int,
    told: str,
    surroundings: tuple[Path, dict[str, str]],
) -> None:
    done = shell(command, surroundings, **more)
    assert done.returncode == code, done.stderr
    assert told in done.stderr
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert not (surroundings[0] / "runs" / "probe-chain-race-matd3-seed1").exists()


def test_a_run_goes_on_where_its_words_cannot(surroundings: tuple[Path, dict[str, str]]) -> None:
    done = shell(f"race train bad_tasks:fine {SMALL} --run-dir full > /dev/full", surroundings)
    assert done.returncode == 0, done.stderr
    assert "the run went on without. All of it is in full" in done.stderr
    assert "Traceback" not in done.stderr
    assert (surroundings[0] / "full" / "DONE").exists()

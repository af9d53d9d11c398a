"""Measures on an accelerator, in a given time, all that a processor cannot tell.

Stages, in this order; each may be skipped:

agreement  runs on probes on the processor and on the device: how far their rows are apart
resume     a run that is interrupted and resumed, against one that is not, in deterministic mode
bench      `race bench` of gradient steps, cohorts and battles
evidence   five seeds of the base and of RACE, the two main tasks first, more while time is left

At most five files are left in the folder: log.txt, report.json (what came of each stage),
bench.json, evidence.jsonl.gz (an archive that `race plot` and the like read), doctor.txt. They are
brought up to date every minute, so that a run that is cut off loses no more than that.
"""

import argparse
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

STAGES = ("agreement", "resume", "bench", "evidence")
SHARE = {"agreement": 0.15, "resume": 0.1, "bench": 0.2}
"""Of all the time, the most that a stage may take; the rest is for evidence."""
PROBES = (
    ("probe/target", "race"),
    ("probe/matching", "race"),
    ("probe/target", "facmac"),
)
"""RACE holds its base within it."""
PROBE_STEPS = 400
SMALL = ("--learner.hidden-sizes", "32", "32", "--learner.random-steps", "100")
BENCHES = (
    "update/HalfCheetah-2x3/b128/ms",
    "cohort/HalfCheetah-2x3/vmap_10/*",
    "micro/2s3z/battles_1024/*",
    "micro/2s3z/kernels_per_step",
    "cohort/HalfCheetah-2x3/vmap_1/*",
    "cohort/HalfCheetah-2x3/vmap_16/*",
    "update-episodes/race/2s3z/ms",
    "cohort/HalfCheetah-2x3/vmap_4/*",
    "micro/MMM2/kernels_per_step",
)
EVIDENCE = (
    ("mamujoco/HalfCheetah-2x3", "race"),
    ("micro/2s3z", "race"),
    ("mamujoco/HalfCheetah-2x3", "matd3"),
    ("micro/2s3z", "facmac"),
    ("mamujoco/Hopper-3x1", "race"),
    ("mamujoco/Hopper-3x1", "matd3"),
    ("micro/3s_vs_3z", "race"),
    ("micro/3s_vs_3z", "facmac"),
    ("mamujoco/Ant-4x2", "race"),
    ("mamujoco/Ant-4x2", "matd3"),
)
GOAL_MINUTES = 4.0
REFRESH_SECONDS = 60.0
FAREWELL_SECONDS = 20.0
"""What is left at the end to save runs and bring the files up to date."""


class Command(NamedTuple):
    """A command that was begun."""

    words: str
    process: "subprocess.Popen[bytes]"
    printed: Path


class Evidence:
    """The folder of results, the time that is left, and the commands that are run in it."""

    def __init__(self, out: Path, minutes: float) -> None:
        self.begin = time.monotonic()
        self.end = self.begin + 60 * minutes
        self.out, self.work = out, Path(tempfile.mkdtemp(prefix="race-evidence-"))
        out.mkdir(parents=True, exist_ok=True)
        self.report: dict[str, Any] = {"minutes": minutes}
        self.benches: list[Any] = []
        self.refreshed = 0.0

    def left(self) -> float:
        """Seconds until the farewell."""
        return self.end - FAREWELL_SECONDS - time.monotonic()

    def say(self, words: str) -> None:
        """To the log and the terminal, with the seconds since the beginning."""
        line = f"[{time.monotonic() - self.begin:6.0f} s] {words}"
        print(line, flush=True)
        with (self.out / "log.txt").open("a") as log:
            log.write(line + "\n")

    def refresh(self, always: bool = True) -> None:
        """Brings the files up to date; without ``always`` once a minute."""
        if not always and time.monotonic() - self.refreshed < REFRESH_SECONDS:
            return
        self.refreshed = time.monotonic()
        (self.out / "report.json").write_text(json.dumps(self.report, indent=2))
        (self.out / "bench.json").write_text(json.dumps(self.benches, indent=2))
        runs = self.work / "evidence"
        if any(runs.rglob("metrics.jsonl")):
            made = self.work / "archive.jsonl.gz"
            told = subprocess.run(
                [sys.executable, "-m", "race", "archive", str(runs), "--out", made, "--force"],
                env=os.environ | {"JAX_PLATFORMS": "cpu"},
                capture_output=True,
                text=True,
                check=False,
            )
            if told.returncode:
                self.say(f"the archive could not be made: {told.stderr.strip()[-300:]}")
            else:
                shutil.copy(made, self.out / "evidence.jsonl.gz")

    def race(
        self, *arguments: object, seconds: float, env: dict[str, str] | None = None
    ) -> tuple[int, str]:
        """Runs a command of race; interrupted, so that it saves, when its time is over.

        Returns:
            Its exit status (124: it was interrupted) and what it printed.
        """
        return self.wait(self.begun(*arguments, env=env), seconds)

    def begun(self, *arguments: object, env: dict[str, str] | None = None) -> "Command":
        """Begins a command of race."""
        command = [sys.executable, "-m", "race", *map(str, arguments)]
        words = " ".join([*(f"{k}={v}" for k, v in (env or {}).items()), "race", *command[3:]])
        self.say(words)
        printed = Path(tempfile.mkstemp(dir=self.work)[1])
        with printed.open("w") as file:
            process = subprocess.Popen(
                command,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=os.environ | (env or {}),
                start_new_session=True,
            )
        return Command(words, process, printed)

    def wait(self, command: "Command", seconds: float) -> tuple[int, str]:
        """Waits for a command; what `race` returns."""
        process, late = command.process, False
        due = time.monotonic() + min(seconds, max(self.left(), 1.0))
        while process.poll() is None:
            if time.monotonic() > due:
                if late:
                    os.killpg(process.pid, signal.SIGKILL)
                else:
                    os.kill(process.pid, signal.SIGINT)
                late, due = True, time.monotonic() + FAREWELL_SECONDS / 2
            self.refresh(always=False)
            time.sleep(0.1)
        text = command.printed.read_text(errors="replace")
        code = 124 if late else int(process.returncode)
        if code:
            self.say(f"{command.words} ended with {code}: {text.strip()[-600:]}")
        return code, text

    def rows(self, run: Path) -> list[dict[str, Any]]:
        """What a run has written."""
        file = run / "metrics.jsonl"
        return [json.loads(line) for line in file.open()] if file.exists() else []


def agreement(evidence: Evidence, seconds: float) -> dict[str, Any]:
    """The largest relative difference of a number in a row, until and after learning begins."""
    found: dict[str, Any] = {}
    due = time.monotonic() + seconds
    for task, algo in PROBES:
        name = f"{task} {algo}"
        small = SMALL if task == "probe/target" else ()  # the other has discrete actions
        asked = (task, "--algo", algo, "--env-steps", PROBE_STEPS, *small)
        runs = [evidence.work / f"{name.replace('/', '-')} on {p}" for p in ("cpu", "device")]
        environments: tuple[dict[str, str], ...] = ({"JAX_PLATFORMS": "cpu"}, {})
        both = [
            evidence.begun("train", *asked, "--run-dir", run, env=env)
            for run, env in zip(runs, environments, strict=True)
        ]
        codes = [evidence.wait(one, due - time.monotonic())[0] for one in both]
        if any(codes):
            found[name] = {"exit_statuses": codes}
            continue
        rows = [evidence.rows(run) for run in runs]
        first, last = differences(*rows)
        found[name] = {"first_row_with_losses": first, "all_rows": last}
        evidence.report["agreement"] = found
    return found


def differences(
    one: list[dict[str, Any]], other: list[dict[str, Any]]
) -> tuple[float | None, float | None]:
    """Relative differences of losses: in the first rows that have any, and the largest of all."""
    apart = []
    for a, b in zip(one, other, strict=False):
        names = [n for n in a if n.startswith("loss") and is_number(a[n]) and is_number(b.get(n))]
        if names:
            apart.append(max(abs(a[n] - b[n]) / max(abs(a[n]), abs(b[n]), 1e-3) for n in names))
    return (apart[0], max(apart)) if apart else (None, None)


def is_number(value: object) -> bool:
    """Whether a value of a row is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def resume(evidence: Evidence, seconds: float) -> dict[str, Any]:
    """Whether an interrupted run comes to the same rows as one that is not interrupted."""
    due = time.monotonic() + seconds
    whole, broken = evidence.work / "whole", evidence.work / "broken"
    asked = ("probe/target", *SMALL, "--env-steps", 3000, "--compute.deterministic")
    code, _ = evidence.race("train", *asked, "--run-dir", whole, seconds=due - time.monotonic())
    if code:
        return {"stopped": "the whole run"}
    interruptions = 0
    command: tuple[object, ...] = ("train", *asked, "--run-dir", broken)
    takes = timed(evidence.rows(whole))
    while time.monotonic() < due:
        # Long enough to get somewhere, short enough to be interrupted.
        within = 3.0 + takes / 3 if interruptions < 2 else due - time.monotonic()
        code, _ = evidence.race(*command, seconds=within)
        if code == 0:
            rows = [evidence.rows(run) for run in (whole, broken)]
            same = comparable(rows[0]) == comparable(rows[1])
            return {"exact": same, "interruptions": interruptions, "rows": len(rows[0])}
        interruptions += 1
        if (broken / "config.json").exists() and evidence.rows(broken):
            command = ("resume", broken)
        else:
            shutil.rmtree(broken, ignore_errors=True)
    return {"stopped": "the interrupted run", "interruptions": interruptions}


def timed(rows: list[dict[str, Any]]) -> float:
    """Seconds that a run took."""
    return float(rows[-1].get("wall_seconds", 0.0)) if rows else 0.0


def comparable(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows without times and the name of the run."""
    return [
        {k: v for k, v in row.items() if k not in ("run", "wall_seconds") and "time/" not in k}
        for row in rows
    ]


def bench(evidence: Evidence, seconds: float) -> dict[str, Any]:
    """Measurements, one command each, so that what is too slow costs the others nothing."""
    due = time.monotonic() + seconds
    for pattern in BENCHES:
        if time.monotonic() > due:
            return {"stopped": pattern}
        code, text = evidence.race(
            "bench", "--only", pattern, "--json", seconds=due - time.monotonic()
        )
        if code == 0:
            evidence.benches += json.loads(text[text.index("[\n") :])
    return {"measured": len(evidence.benches)}


def evidence_runs(evidence: Evidence, seeds: str, env_steps: int) -> dict[str, Any]:
    """Runs of all seeds at once, from start to end, until the time is over."""
    found: dict[str, Any] = {}
    for task, algo in EVIDENCE:
        if evidence.left() < 2 * FAREWELL_SECONDS:
            break
        run = evidence.work / "evidence" / f"{task.replace('/', '-')}-{algo}"
        begin = time.monotonic()
        told = ("--algo", algo, "--seeds", seeds, "--env-steps", env_steps, "--run-dir", run)
        code, _ = evidence.race("train", task, *told, seconds=evidence.left())
        minutes = (time.monotonic() - begin) / 60
        name = f"{task} {algo}"
        found[name] = {"finished": code == 0, "minutes": round(minutes, 2), "env_steps": env_steps}
        for log in run.rglob("log.txt"):
            if code not in (0, 124):
                evidence.say(f"{log.parent.name}: {log.read_text(errors='replace')[-400:]}")
        if code == 0 and algo == "race" and (seeds, env_steps) == ("1-5", 200_000):
            goal = {"value": minutes, "unit": "min", "goal": GOAL_MINUTES}
            told_of = f"evidence/{task}/five_seeds_200k"
            evidence.benches.append({"name": told_of, **goal, "met": minutes <= GOAL_MINUTES})
        evidence.report["evidence"] = found
        evidence.refresh()
    return found


def main() -> int:
    """Goes through the stages."""
    parser = argparse.ArgumentParser(
        prog="scripts/gpu_evidence.sh",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="the folder of results")
    parser.add_argument("--minutes", type=float, required=True, help="when all must be over")
    parser.add_argument("--skip", choices=STAGES, action="append", default=[])
    parser.add_argument("--seeds", default="1-5", help="of the evidence (default: 1-5)")
    parser.add_argument("--env-steps", type=int, default=200_000, help="of each of its runs")
    asked = parser.parse_args()
    if not asked.minutes > 0:
        parser.error("--minutes must be above 0")
    evidence = Evidence(asked.out, asked.minutes)
    try:
        _, text = evidence.race("doctor", seconds=60)
        (asked.out / "doctor.txt").write_text(text)
        stages = {"agreement": agreement, "resume": resume, "bench": bench}
        for name in [name for name in STAGES if name not in asked.skip]:
            if evidence.left() <= 0:
                evidence.report[name] = "no time was left"
                continue
            evidence.say(f"stage {name}")
            if name == "evidence":
                told = evidence_runs(evidence, asked.seeds, asked.env_steps)
            else:
                told = stages[name](evidence, 60 * asked.minutes * SHARE[name])
            evidence.report[name] = told
            evidence.say(f"{name}: {json.dumps(told)}")
            evidence.refresh()
    finally:
        evidence.refresh()
        evidence.say("over")
        shutil.rmtree(evidence.work, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

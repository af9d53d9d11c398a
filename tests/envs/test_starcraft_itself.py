"""The real SMAC and its game, where they are installed; see docs/starcraft.md for how."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import race
from test_starcraft import gone, processes_in

from race.config.settings import EnvConfig
from race.envs import make_task, starcraft
from race.envs.checked import CheckedEnv
from race.envs.starcraft import scenarios
from race.types import DiscreteTask

PYTHON = os.environ.get("RACE_SMAC_PYTHON")
"""The interpreter that has SMAC; this one, without."""

pytestmark = pytest.mark.starcraft


@pytest.fixture(autouse=True)
def _needs_the_game() -> None:
    if not os.environ.get("SC2PATH"):
        pytest.skip("SC2PATH is not set: StarCraft II is not installed")


def needs(package: str) -> dict[str, Any]:
    found = starcraft.look(package, PYTHON)
    if found.wrong:
        pytest.skip(found.wrong)
    return found.facts


def test_a_run_of_300_steps(tmp_path: Path) -> None:
    facts = needs("smac")
    small = "--facmac.hidden-size 8 --facmac.utility-sizes 8 8 --facmac.batch-size 2"
    python = f"--env.python {PYTHON}" if PYTHON else ""
    before = processes_in(Path(os.environ["SC2PATH"]))
    race(
        f"train smac/2s3z --algo facmac --env-steps 300 --evaluation.every 200 "
        f"--evaluation.episodes 2 {small} {python} --run-dir {tmp_path}/run"
    )
    rows = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    tests = [row for row in rows if row["kind"] == "evaluation"]
    assert tests[-1]["env_steps"] >= 300
    assert all(0 <= row["eval/marl/win_rate"] <= 1 for row in tests)
    played = [row for row in rows if row["kind"] == "generation"]
    assert any(row["gradient_steps"] for row in played)
    assert all(0 <= row["marl/return"] <= 21 for row in played)  # SMAC scales a win to about 20
    metadata = json.loads((tmp_path / "run/metadata.json").read_text())["environment"]
    assert metadata["smac"] == facts["code"]
    assert metadata["game"] == facts["game"]
    assert metadata["packages"] == facts["libraries"]
    assert metadata["repeats"] is False
    assert gone([one for one in processes_in(Path(os.environ["SC2PATH"])) if one not in before])


def test_it_is_laid_out_as_the_battles_without_it() -> None:
    needs("smac")
    task, ours = make_task("smac/2s3z", EnvConfig(python=PYTHON)), make_task("micro/2s3z")
    assert isinstance(task, DiscreteTask)
    sizes = ("n_agents", "n_actions", "obs_size", "state_size", "episode_limit", "has_wins")
    assert all(getattr(task.spec, name) == getattr(ours.spec, name) for name in sizes)
    env = CheckedEnv(task)
    try:
        seen: Any = env.reset(1)
        assert not seen.avail_actions[:, 0].any()  # everybody lives
        step = env.step(np.ones(5, np.int64))
        assert step.reward == 0
    finally:
        env.close()


@pytest.mark.parametrize("name", ["protoss_5_vs_5", "terran_5_vs_5", "zerg_10_vs_11"])
def test_scenarios_are_those_of_the_package(name: str) -> None:
    yaml = pytest.importorskip("yaml")
    place = Path(needs("smacv2")["place"])
    path = place / f"examples/configs/sc2_gen_{name.partition('_')[0]}.yaml"
    if not path.exists():
        pytest.skip(f"{path} is not there: pip leaves it out")
    theirs = yaml.safe_load(path.read_text())["env_args"]
    ours = scenarios.settings(name)
    assert ours is not None
    counts = {key: ours["capability_config"][key] for key in ("n_units", "n_enemies")}
    assert ours.pop("capability_config") == theirs.pop("capability_config") | counts
    assert ours.items() <= theirs.items()
    script = (
        "import inspect, json, smacv2.env as e; "
        "p = inspect.signature(e.StarCraft2Env).parameters.values(); "
        "print(json.dumps({q.name: q.default for q in p}))"
    )
    done = subprocess.run(
        [PYTHON or sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    usual = json.loads(done.stdout.splitlines()[-1])
    others = {key: value for key, value in theirs.items() if key not in ours}
    assert others == {key: usual[key] for key in others}

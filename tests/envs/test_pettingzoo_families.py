"""Environments of PettingZoo's family, whole.

Those of sisl and butterfly need `pip install 'pettingzoo[sisl,butterfly]'`, whose physics compiles
from source where there is no wheel.
"""

import json
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from commands import race
from gymnasium.utils.env_checker import check_env

from race.config.settings import EnvConfig
from race.envs import make_continuous_task, make_task
from race.envs.checked import CheckedEnv
from race.envs.pettingzoo import conflict
from race.envs.trial import try_out
from race.types import AnyTask, Task

pytestmark = [
    pytest.mark.slow,
    # Box2D's modules: as an error it ends the process.
    pytest.mark.filterwarnings("ignore:builtin type .* has no __module__:DeprecationWarning"),
]

MPE = {
    "simple_v3": None,
    "simple_adversary_v3": ("adversary_0", "agent_0"),
    "simple_crypto_v3": ("eve_0", "bob_0"),
    "simple_push_v3": ("adversary_0", "agent_0"),
    "simple_reference_v3": None,
    "simple_speaker_listener_v4": None,
    "simple_spread_v3": None,
    "simple_tag_v3": ("adversary_0", "agent_0"),
    "simple_world_comm_v3": ("adversary_1", "agent_0"),
    "simple_formation_v1": None,
    "simple_line_v1": None,
    "collect_treasure_v1": None,
}
"""Every environment of mpe2, and two agents that its authors made rivals."""

OTHERS = {
    "pettingzoo.sisl.multiwalker_v9": "{}",
    "pettingzoo.sisl.pursuit_v5": "{}",
    "pettingzoo.butterfly.knights_archers_zombies_v11": "{}",
    "pettingzoo.butterfly.pistonball_v6": '{"n_pistons": 4}',
}


def play(task: AnyTask, seed: int) -> tuple[float, int]:
    """Return and length of a random episode."""
    env, random = CheckedEnv(task), np.random.default_rng(seed)
    seen: Any = env.reset(seed)
    total, length, over = 0.0, 0, False
    while not over:
        if isinstance(task, Task):
            action: Any = random.uniform(task.spec.action_low, task.spec.action_high)
            step = env.step(action.astype(np.float32))
        else:
            rows = seen.avail_actions
            step = env.step(np.array([random.choice(np.flatnonzero(row)) for row in rows]))
        seen, over = step.seen, step.terminated or step.truncated
        total, length = total + step.reward, length + 1
    env.close()
    return total, length


@pytest.mark.parametrize("kwargs", ["{}", '{"continuous_actions": true}'])
@pytest.mark.parametrize("name", MPE)
def test_mpe2(name: str, kwargs: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conflict, "_SECONDS", 1e9)  # on any machine the same
    task = make_task(f"pettingzoo:mpe2.{name}", EnvConfig(kwargs=kwargs))
    assert isinstance(task, Task) == (kwargs != "{}")
    trial = try_out(task)
    assert trial.repeats
    rivals = MPE[name]
    assert (trial.conflict is None) == (rivals is None)
    if trial.conflict is not None:
        kinds = [agent.rpartition("_")[0] for agent in trial.conflict]
        assert kinds[0] != kinds[1]
    first = play(task, 1)
    assert first[1] == task.spec.episode_limit == 25
    assert play(task, 1) == first


@pytest.mark.parametrize("name", OTHERS)
def test_sisl_and_butterfly(name: str) -> None:
    pytest.importorskip("pymunk", reason="pip install 'pettingzoo[sisl,butterfly]'")
    config = EnvConfig(kwargs=OTHERS[name], largest_observation=200_000, state="observations")
    task = make_task(f"pettingzoo:{name}", config)
    trial = try_out(task)
    assert trial.conflict is None
    first = play(task, 1)
    assert 1 <= first[1] <= task.spec.episode_limit
    if trial.repeats:
        assert play(task, 1) == first


@pytest.mark.filterwarnings("ignore:.*A Box observation space m.* value is")
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
@pytest.mark.parametrize("name", ["mpe2.simple_tag_v3", *list(OTHERS)[:3]])
def test_gymnasium_s_own_test(name: str) -> None:
    check_env(make_task(f"pettingzoo:{name}").make(None))


@pytest.mark.parametrize(("scenario", "parts"), [("HalfCheetah", "2x3"), ("Ant", "4x2")])
def test_multi_agent_mujoco_pays_the_same(scenario: str, parts: str) -> None:
    kwargs = json.dumps({"scenario": scenario, "agent_conf": parts})
    theirs = make_continuous_task(
        "pettingzoo:gymnasium_robotics.mamujoco_v1", EnvConfig(kwargs=kwargs)
    )
    ours = make_continuous_task(f"mamujoco/{scenario}-{parts}")
    assert theirs.spec.episode_limit == ours.spec.episode_limit == 1000
    one, other = CheckedEnv(theirs), CheckedEnv(ours)
    one.reset(3)
    other.reset(3)
    random = np.random.default_rng(0)
    low, high = np.array(ours.spec.action_low), np.array(ours.spec.action_high)
    for _ in range(300):
        action = random.uniform(low, high).astype(np.float32)
        # Theirs is agent after agent, ours in the order of the robot.
        order = [entry for agent in ours.spec.action_index for entry in agent]
        step, same = one.step(action[order]), other.step(action)
        # Theirs adds up the cost of moving in 64 bits, gymnasium in those of the action, 32.
        assert step.reward == pytest.approx(same.reward, abs=1e-6)
        assert (step.terminated, step.truncated) == (same.terminated, same.truncated)
        if same.terminated:
            break
    assert isinstance(one.env.action_space, gymnasium.spaces.Box)


def test_the_documents_example_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(__file__).parents[2] / "docs/environments.md").read_text()
    examples = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (example,) = [one for one in examples if "pistonball" in one]
    (tmp_path / "pistons.py").write_text(example)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    task = make_task("pistons:task", EnvConfig(team_reward="sum"))
    assert isinstance(task, Task)
    assert task.spec.obs_sizes == (23 * 6,) * 4
    assert play(task, 0)[1] == 125


def test_trained_from_the_shell(tmp_path: Path) -> None:
    tiny = (
        "--learner.random-steps 60 --learner.hidden-sizes 10 8 --learner.batch-size 4 "
        "--learner.gradient-steps-per-env-step 0.05 --evaluation.episodes 1"
    )
    spread = "pettingzoo:mpe2.simple_spread_v3"
    whole = """--env.kwargs {"continuous_actions":true,"N":2}"""
    run = tmp_path / "run"
    race(f"train {spread} {whole} {tiny} --env-steps 200 --run-dir {run}")
    recorded = json.loads((run / "metadata.json").read_text())["environment"]
    assert recorded["agent_names"] == ["agent_0", "agent_1"]
    assert (recorded["team_reward"], recorded["repeats"]) == ("mean", True)
    assert set(recorded["packages"]) == {"mpe2", "pettingzoo"}
    race(f"resume {run} --env-steps 400")
    race(f"evaluate {run} --episodes 2")
    race(f"render {run} --out {tmp_path / 'team.gif'} --seconds 0.5")
    few = "--facmac.batch-size 4 --evaluation.episodes 1 --env-steps 150 --algo facmac"
    team = "--env.agents adversary_* --env.processes True"
    race(f"train pettingzoo:mpe2.simple_tag_v3 {team} {few} --run-dir {tmp_path / 'tag'}")

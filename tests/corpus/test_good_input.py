"""What is plainly meant simply works, though it looks like some of the bad input."""

import json
from pathlib import Path
from typing import Any

import bad_tasks
import jax
import numpy as np
import pytest

from race.algorithms.base import Teams
from race.cli import main
from race.config.presets import resolve
from race.config.settings import Config, FacmacConfig
from race.config.shape import shape_of
from race.envs import make_task
from race.envs.trial import try_out
from race.learners.facmac import new_encoder
from race.rollouts.host import collect
from race.rollouts.host_episodes import HostEnvs
from race.rollouts.pool import EnvPool
from race.types import DiscreteTask, Task

CONTINUOUS = (
    *("fine", "sized_one", "ends_at_limit", "mutates", "reuses", "f64_bounds", "space_whole"),
    *("limit_numpy", "limit_short", "limit_long", "one_agent", "unseeded", "task_configured"),
)
DISCRETE = (
    *("g_fine", "g_five", "g_resets_seeded", "g_unseeded", "g_tells_seed"),
    *("o_fine", "o_mutates", "o_numpy", "o_short"),
)
UNSEEDED = ("unseeded", "g_unseeded", "g_tells_seed")


@pytest.mark.parametrize("name", [*CONTINUOUS, *DISCRETE])
def test_it_plays(name: str) -> None:
    task = make_task(f"bad_tasks:{name}")
    trial = try_out(task)
    assert trial.repeats == (name not in UNSEEDED)
    assert ("will not be the same again" in trial.note) == (name in UNSEEDED)
    with EnvPool(task, 2, False) as pool:
        if isinstance(task, Task):
            rollout = collect(pool, lambda seen, tick: np.ones((2, 2)), np.array([1, 2]))
            steps = 5 if name == "limit_short" else 20
            assert rollout.episode_length.tolist() == [steps] * 2
            assert bool(rollout.transitions.terminated.any()) == (name == "ends_at_limit")
            # What the environment did to what it was given or showed changes nothing.
            assert (rollout.transitions.action == 1).all()
            moved = rollout.transitions.state[2:] != rollout.transitions.state[:-2]
            assert moved.any(axis=1).all()
        else:
            played = HostEnvs(pool).play(two_teams(task), np.uint32([1, 2]), None, "float32")
            steps = 4 if name == "o_short" else 6
            assert played.episodes.length.tolist() == [steps] * 2
            ended = played.episodes.terminated[:, steps - 1].tolist()
            assert ended == [float(name.startswith("g_"))] * 2


def two_teams(task: DiscreteTask) -> Teams:
    facmac = FacmacConfig(hidden_size=3, batch_size=2)
    config = resolve(Config("bad", algo="facmac", facmac=facmac), discrete=True)
    encoder = new_encoder(jax.random.key(0), task.spec, shape_of(config))
    return Teams(encoder, jax.random.normal(jax.random.key(1), (2, 2, 4, 3)))


@pytest.mark.parametrize("name", ["close_raises", "unseeded"])
def test_a_run_comes_to_its_end(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    bad_tasks.Box.made.clear()
    options = (
        "--algo matd3 --learner.random-steps 40 --env-steps 41 --learner.hidden-sizes 4 4 "
        "--learner.batch-size 4 --evaluation.episodes 2 --run-dir a[/red]b"
    )
    main(["train", f"bad_tasks:{name}", *options.split()])
    said = capsys.readouterr()
    run = tmp_path / "a[" / "red]b"
    assert (run / "DONE").exists()
    assert "in a[/red]b" in said.out
    assert "race evaluate 'a[/red]b', race render 'a[/red]b'" in said.out
    recorded = json.loads((run / "metadata.json").read_text())["environment"]
    assert recorded["repeats"] == (name != "unseeded")
    assert (said.err.count("will not be the same again") == 1) == (name == "unseeded")
    closing = "bad failed when it was closed: ConnectionError: the simulator has gone, in"
    assert (closing in said.err) == (name == "close_raises")

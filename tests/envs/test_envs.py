import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from race.config.presets import TABLE_3, TABLE_4
from race.config.settings import EnvConfig
from race.envs import (
    describe_tasks,
    factorised,
    make_continuous_task,
    make_task,
    task_ids,
)
from race.envs.micro import load_map, map_names
from race.errors import TaskError
from race.rollouts.host import collect
from race.rollouts.pool import EnvPool
from race.types import DiscreteTask, Task

DOCUMENT = Path(__file__).parents[2] / "docs" / "environments.md"


@pytest.fixture
def directory(tmp_path, monkeypatch):
    """An empty current directory, whose modules are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path.copy())
    yield tmp_path
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


def write(directory: Path, name: str, text: str) -> None:
    (directory / name).write_text(text)


def test_ids_are_unique_and_the_papers_come_first():
    ids = task_ids()
    assert len(set(ids)) == len(ids)
    assert set(ids[:8]) == set(TABLE_3)
    assert set(ids[8:16]) == set(TABLE_4)
    assert {f"micro/{name}" for name in map_names()} <= set(ids)
    assert len(map_names()) == 23
    named = {info.id for info in describe_tasks() if info.paper_name is not None}
    assert named == set(ids[:16])


def test_battles_are_described_without_importing_jax():
    described = {info.id: info.description for info in describe_tasks()}
    for name in map_names():
        assert described[f"micro/{name}"] == load_map(name).description
    check = "import sys, race.envs as e; e.describe_tasks(); sys.exit('jax' in sys.modules)"
    subprocess.run([sys.executable, "-c", check], check=True)


def test_nearest_names():
    with pytest.raises(TaskError, match=r"mamujoco/Hopper-3x1"):
        make_task("Hopper-3x1")


def test_every_kind_of_task_is_made_and_the_narrow_maker_refuses_discrete_ones():
    for task_id, kind in (("probe/chain", Task), ("micro/2s3z", DiscreteTask)):
        task = make_task(task_id)
        assert isinstance(task, kind)
        assert task.spec.task == task_id
    assert make_continuous_task("probe/chain").spec == make_task("probe/chain").spec
    with pytest.raises(TaskError, match="discrete actions"):
        make_continuous_task("micro/2s3z")


def test_the_documents_example_works(directory):
    example, *_ = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    write(directory, "my_task.py", example)
    task = make_task("my_task:task")
    assert task.spec.obs_index == ((0, 2), (1, 3))
    assert task.spec.episode_limit == 100
    with EnvPool(task, 2, processes=False) as pool:
        push = collect(pool, lambda states, tick: -states[:, :2], np.array([1, 2]))
        idle = collect(pool, lambda states, tick: np.zeros((2, 2)), np.array([1, 2]))
    assert push.episode_length.tolist() == [100, 100]
    assert not push.transitions.terminated.any()
    assert (push.episode_return > idle.episode_return).all()


def test_the_documents_discrete_example_works(directory):
    _, example, *_ = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    write(directory, "my_battle.py", example)
    task = make_task("my_battle:task")
    assert isinstance(task, DiscreteTask)
    assert task.spec.n_actions == 3
    env = task.make(None)
    won = []
    for seed in range(20):
        observation, _ = env.reset(seed=seed)
        numbers = observation["obs"].argmax(axis=1)
        again, _ = env.reset(seed=seed)
        assert (again["state"] == observation["state"]).all()
        _, reward, terminated, _, info = env.step(numbers[::-1])
        assert (reward, terminated, info["battle_won"]) == (1.0, True, True)
        env.reset(seed=seed)
        won.append(env.step(numbers)[4]["battle_won"])
    assert set(won) == {True, False}  # one's own number is the other's by chance alone


def test_own_function_is_given_the_config(directory):
    write(
        directory,
        "own_config_task.py",
        "from race.envs import make_task\n"
        "def build(config):\n"
        "    return make_task('mamujoco/HalfCheetah-2x3', config)\n",
    )
    config = EnvConfig(library_observation=True)
    assert make_task("own_config_task:build", config).spec.obs_sizes == (12, 12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import no_such_thing\n", "needs the module no_such_thing"),
        ("def build(:\n", "SyntaxError"),
        ("1 / 0\n", "ZeroDivisionError"),
        ("def other(): pass\n", "no function build"),
        ("build = 3\n", "no function build"),
        ("def build(): return 3\n", "returned int"),
    ],
)
def test_own_module_that_is_wrong(directory, text, message):
    write(directory, "wrong_task.py", text)
    with pytest.raises(TaskError, match=message):
        make_task("wrong_task:build")


def test_own_module_that_is_not_there(directory):
    with pytest.raises(TaskError, match="no module no_such_task"):
        make_task("no_such_task:build")
    with pytest.raises(TaskError, match="no module no_such_package"):
        make_task("no_such_package.task:build")


def pendulum(render_mode):
    return gymnasium.make("Pendulum-v1", disable_env_checker=True)


def test_factorised_reads_spaces_and_limit():
    spec = factorised(pendulum, obs_index=[(0, 1, 2)], action_index=[(0,)], task="swing").spec
    assert (spec.task, spec.state_size, spec.episode_limit) == ("swing", 3, 200)
    assert (spec.action_low, spec.action_high) == ((-2.0,), (2.0,))


def with_spaces(observation, action):
    def make(render_mode):
        env = gymnasium.Env()
        env.observation_space, env.action_space = observation, action
        return env

    return make


BOX = gymnasium.spaces.Box(-1, 1, (2,))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (with_spaces(BOX, gymnasium.spaces.Discrete(3)), "action space must be a Box"),
        (with_spaces(gymnasium.spaces.Box(-1, 1, (2, 2)), BOX), "observation space must be a Box"),
        (with_spaces(BOX, gymnasium.spaces.Box(-np.inf, np.inf, (2,))), "no finite bounds"),
        (with_spaces(BOX, BOX), "no time limit"),
    ],
)
def test_factorised_explains_what_does_not_fit(make, message):
    with pytest.raises(TaskError, match=message):
        factorised(make, obs_index=[(0,), (1,)], action_index=[(0,), (1,)], task="odd")


def test_factorised_wants_every_action_to_have_an_owner():
    make = with_spaces(BOX, BOX)
    with pytest.raises(TaskError, match="exactly one agent"):
        factorised(
            make, obs_index=[(0,), (1,)], action_index=[(0,), (0,)], task="odd", episode_limit=5
        )

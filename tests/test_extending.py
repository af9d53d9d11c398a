"""The examples at the end of docs/extending: an operator, an environment, a learner."""

import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.algorithms.evolutions.own import evolution_by
from race.algorithms.population import new_population
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config, RaceConfig
from race.config.shape import shape_of
from race.envs import make_task
from race.envs.trial import try_out
from race.learners import LEARNERS, Learner, learner_of
from race.types import EnvSpec, Task, Team

PAGES = Path(__file__).parent.parent / "docs/extending"
LITTLE = "--env-steps 700 --evaluation.episodes 1 --learner.random-steps 600 " + (
    "--learner.hidden-sizes 10 8 --learner.batch-size 4 --learner.gradient-steps-per-env-step 0.01"
)


def saved(page: str, folder: Path) -> str:
    """The page's example as the file that it asks for; its text."""
    text = (PAGES / f"{page}.md").read_text()
    (name,) = re.findall(r"Save this as `(\w+)\.py`", text)
    example: str = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[-1]
    (folder / f"{name}.py").write_text(example)
    return example


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_operator_keeps_the_better_half_and_breeds_the_other(
    folder: Path, tiny_spec: EnvSpec
) -> None:
    saved("operator", folder)
    config = resolve(Config("tiny", race=RaceConfig(evolution="halving:halve", population_size=5)))
    shape, hyper = shape_of(config), hyper_of(config)
    mask = jnp.asarray(tiny_spec.action_mask, jnp.float32)[:, None]
    heads = jax.random.normal(jax.random.key(0), (5, 2, 3, 2)) * mask[None]
    evolution = evolution_by("halving:halve")
    fitness = jnp.array([2.0, 5.0, 1.0, 4.0, 3.0])

    @jax.jit
    def evolved(heads: jax.Array, key: jax.Array) -> jax.Array:
        population = new_population(Team(None, heads), None)
        after = evolution.step(population, fitness, key, tiny_spec, shape, hyper)
        return after.teams.heads

    after = np.asarray(evolved(heads, jax.random.key(1)))
    before = np.asarray(heads)
    assert np.array_equal(after[[1, 3, 4]], before[[1, 3, 4]])
    for child, parents in ((after[0], before[[1, 3]]), (after[2], before[[1, 3]])):
        nearest = np.abs(child[None] - parents).mean(axis=(2, 3)).min(axis=0)
        assert (nearest > 0).all()
        assert (nearest < 0.1).all()


def test_the_environment_is_a_task_that_keeps_the_contract(folder: Path) -> None:
    saved("environment", folder)
    task = make_task("carrying:task")
    assert isinstance(task, Task)
    assert task.spec.obs_index == ((0, 2), (1, 2))
    found = try_out(task)
    assert found.repeats
    assert found.note == ""
    env = task.make(None)
    state, _ = env.reset(seed=3)
    lifted, reward, dropped, cut, _ = env.step(np.array([1.0, -1.0], np.float32))
    np.testing.assert_allclose(lifted - state, [0.1, -0.1, 0.0], atol=1e-6)
    left, right, line = lifted
    assert reward == pytest.approx(-abs((left + right) / 2 - line) - abs(left - right))
    assert not dropped
    assert not cut
    for _ in range(5):
        *_, dropped, _, _ = env.step(np.array([1.0, -1.0], np.float32))
    assert dropped


def test_the_learner_is_matd3_but_for_its_targets(folder: Path) -> None:
    names: dict[str, object] = {"__name__": "cautious"}
    exec(saved("learner", folder), names)
    learner, matd3 = names["cautious_matd3"], LEARNERS["matd3"]
    assert isinstance(learner, Learner)
    differing = [
        name for name in Learner._fields if getattr(learner, name) is not getattr(matd3, name)
    ]
    assert differing == ["pessimistic"]
    # Means 2 and 5 less half of the standard deviations 1 and 0; the smaller ones are 1 and 5.
    values = jnp.array([[1.0, 5.0], [3.0, 5.0]])
    np.testing.assert_allclose(learner.pessimistic(values), [1.5, 5.0])
    np.testing.assert_allclose(matd3.pessimistic(values), [1.0, 5.0])


def test_an_exchanged_learner_is_the_one_that_runs_take(monkeypatch: pytest.MonkeyPatch) -> None:
    shape = shape_of(resolve(Config("tiny", algo="matd3")))
    other = LEARNERS["matd3"]._replace(pessimistic=lambda values: values[0])
    monkeypatch.setitem(LEARNERS, "matd3", other)
    assert learner_of(shape) is other


def test_pages_name_every_function_of_a_learner_and_places_that_there_are() -> None:
    text = (PAGES / "learner.md").read_text()
    assert [name for name in Learner._fields if f"`{name}`" not in text] == []
    root = PAGES.parent.parent
    for page in (*PAGES.glob("*.md"), root / "CONTRIBUTING.md", root / "docs/releasing.md"):
        for place in re.findall(
            r"`((?:race|tests|docs|results|\.github)/[\w/.]+)`", page.read_text()
        ):
            assert "NAME" in place or (root / place).exists(), (page.name, place)
    for place, name in (
        ("race/config/presets.py", "def resolve"),
        ("race/config/effects.py", "def _idle_of_learner"),
        ("race/envs/__init__.py", "def describe_tasks"),
    ):
        assert name in (root / place).read_text(), place


@pytest.mark.slow
@pytest.mark.parametrize("page", ["operator", "environment", "learner"])
def test_examples_train(page: str, folder: Path) -> None:
    """As a reader would: in a process that knows the file's directory alone."""
    saved(page, folder)
    text = (PAGES / f"{page}.md").read_text()
    if page == "learner":
        words = [sys.executable, "cautious.py"]
    else:
        (line,) = re.findall(r"^race (train .*)$", text, re.MULTILINE)
        words = [sys.executable, "-m", "race", *line.split(), *LITTLE.split()]
    done = subprocess.run(words, cwd=folder, env=os.environ, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert list(folder.glob("runs/**/DONE"))

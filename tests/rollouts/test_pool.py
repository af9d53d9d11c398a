"""Environments that fail: here and in processes, with continuous and with discrete actions."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
from seeded import Chooser, Seeded, make
from test_host import zeros

from race.algorithms.base import Teams
from race.config.presets import resolve
from race.config.settings import Config, FacmacConfig
from race.config.shape import shape_of
from race.envs import factorised
from race.errors import EnvFailedError, HandedOverError
from race.learners.facmac import new_encoder
from race.randomness import seed_again
from race.rollouts import pool as pool_module
from race.rollouts.host import collect
from race.rollouts.host_episodes import HostEnvs
from race.rollouts.pool import EnvPool
from race.types import DiscreteSpec, DiscreteTask, Task


def task_of(fails: str, *seeds: int) -> Task:
    return factorised(
        functools.partial(make, Seeded, fails, seeds),
        obs_index=[(0,), (1,)],
        action_index=[(0,), (1,)],
        task="seeded",
        episode_limit=9,
    )


def discrete_task_of(fails: str, *seeds: int) -> DiscreteTask:
    spec = DiscreteSpec("chooser", 2, 1, 2, 3, 9)
    return DiscreteTask(spec, functools.partial(make, Chooser, fails, seeds))


def shown(pool: EnvPool, seeds: list[int]) -> Any:
    """Whatever the episodes of a pool brought, as arrays."""
    if isinstance(pool.task, Task):
        return jax.tree.leaves(collect(pool, zeros, np.array(seeds)))
    played = HostEnvs(pool).play(teams(len(seeds)), np.array(seeds, np.uint32), None, "float32")
    return jax.tree.leaves(played)


def teams(count: int) -> Teams:
    facmac = FacmacConfig(hidden_size=3, batch_size=2)
    config = resolve(Config("chooser", algo="facmac", facmac=facmac), discrete=True)
    spec = discrete_task_of("").spec
    encoder = new_encoder(jax.random.key(0), spec, shape_of(config))
    return Teams(encoder, jax.random.normal(jax.random.key(1), (count, 2, 4, 3)))


def in_order(arrays: list[Any], continuous: bool) -> list[Any]:
    """Steps by seed and time: those of an episode that is begun anew come last."""
    if not continuous:
        return arrays
    *rows, returns, lengths, team, _ = arrays  # how often they were begun anew differs
    order = np.lexsort(rows[0].T)
    return [column[order] for column in (*rows, team)] + [returns, lengths]


KINDS = pytest.mark.parametrize("tasks", [task_of, discrete_task_of])


@KINDS
@pytest.mark.parametrize("fails", ["error", "exit"])
def test_a_failed_episode_is_played_anew_with_a_seed_that_is_fixed(
    tasks: Callable[..., Any], fails: str, capsys: pytest.CaptureFixture[str]
) -> None:
    again = seed_again(4, 1)
    third = seed_again(4, 2)
    for failing, instead in (((4,), again), ((4, again), third)):
        with EnvPool(tasks(fails, *failing), 3, False, retries=2, proven=True) as pool:
            found = shown(pool, [3, 4, 5])
            assert pool.repeated == len(failing)
        assert capsys.readouterr().err.count("is repeated in a fresh environment") == 1
        with EnvPool(tasks(""), 3, False) as pool:
            expected = shown(pool, [3, instead, 5])
        continuous = isinstance(pool.task, Task)
        pairs = zip(in_order(found, continuous), in_order(expected, continuous), strict=True)
        for mine, theirs in pairs:
            np.testing.assert_array_equal(mine, theirs)


@KINDS
def test_what_is_raised_when_nothing_helps(tasks: Callable[..., Any]) -> None:
    failing = (4, seed_again(4, 1), seed_again(4, 2))
    told = r"failed at step 2 .*on fire, in .*seeded.py, line \d+. .*anew 2 times .--env.retries"
    with (
        EnvPool(tasks("error", *failing), 2, False, retries=2, proven=True) as pool,
        pytest.raises(EnvFailedError, match=told),
    ):
        shown(pool, [3, 4])
    assert Seeded.alive == Chooser.alive == 0


@KINDS
@pytest.mark.parametrize(
    ("fails", "proven", "retries", "kind"),
    [
        ("error", False, 3, EnvFailedError),  # it has never worked: a mistake
        ("error", True, 0, EnvFailedError),
        ("wrong", True, 3, HandedOverError),  # a mistake whenever it comes
    ],
)
def test_what_is_not_played_anew(
    tasks: Callable[..., Any], fails: str, proven: bool, retries: int, kind: Any
) -> None:
    with EnvPool(tasks(fails, 4), 2, False, retries=retries, proven=proven) as pool:
        before = Seeded.made + Chooser.made
        with pytest.raises(kind, match="at step 2 of the episode of seed 4"):
            shown(pool, [3, 4])
        assert Seeded.made + Chooser.made == before + 2
        assert pool.repeated == 0


def test_an_episode_that_was_played_proves_the_task() -> None:
    with EnvPool(task_of("error", 4), 1, False, retries=1) as pool:
        shown(pool, [3])
        shown(pool, [4])
        assert pool.repeated == 1


def test_what_fails_in_closing_hides_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    task = task_of("closing")
    Seeded.alive = 0

    def broken(states: Any, tick: int) -> Any:
        raise KeyError("the cause")

    with EnvPool(task, 3, False) as pool, pytest.raises(KeyError, match="the cause"):
        collect(pool, broken, np.arange(3))
    assert Seeded.alive == 0  # all were closed
    said = capsys.readouterr().err
    assert said.count("seeded failed when it was closed: ConnectionError") == 1
    assert "So did 1 more" in said


@pytest.mark.slow
@KINDS
@pytest.mark.parametrize("fails", ["", "error", "exit", "dies", "hangs"])
def test_processes_give_the_same(tasks: Callable[..., Any], fails: str) -> None:
    options: dict[str, Any] = {"retries": 2, "proven": True, "step_seconds": 5.0}
    with EnvPool(tasks(fails, 4), 2, **options) as pool:
        assert pool.processes
        found = shown(pool, [3, 4])
        assert pool.repeated == (fails != "")
    like = "error" if fails else ""
    with EnvPool(tasks(like, 4), 2, False, retries=2, proven=True) as pool:
        expected = shown(pool, [3, 4])
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.slow
@KINDS
@pytest.mark.parametrize("fails", ["", "error", "dies"])
def test_environments_share_processes_where_there_are_many(
    tasks: Callable[..., Any], fails: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool_module, "_MOST_PROCESSES", 2)
    monkeypatch.setattr(pool_module, "_cores", lambda: 2)
    with EnvPool(tasks(fails, 4), 5, True, retries=2, proven=True) as pool:
        found = shown(pool, [3, 4, 5, 6, 7])
        processes = {worker.process_id for worker in pool._workers.values()}
        assert len(processes) == 2
        # A process that dies takes its other environments with it.
        assert pool.repeated == {"": 0, "error": 1, "dies": 3}[fails]
        again = shown(pool, [8, 9])
    fresh = {"": (), "error": (4,), "dies": (3, 4, 5)}[fails]
    seeds = [seed_again(seed, 1) if seed in fresh else seed for seed in range(3, 8)]
    with EnvPool(tasks(""), 5, False) as pool:
        expected, expected_again = shown(pool, seeds), shown(pool, [8, 9])
    continuous = isinstance(pool.task, Task)
    for mine, theirs in ((found, expected), (again, expected_again)):
        pairs = zip(in_order(mine, continuous), in_order(theirs, continuous), strict=True)
        for one, other in pairs:
            np.testing.assert_array_equal(one, other)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fails", "told"),
    [
        ("error", r"at step 2 of .*OSError: the motor is on fire, in .*seeded.py, line"),
        ("exit", r"at step 2 of .*it called sys.exit\(\), in .*seeded.py, line"),
        ("dies", "exited with 7 at step 2 of an episode .environment 1."),
        ("hangs", r"did not answer within 1 seconds at step 2 .*--env.step-seconds"),
        ("wrong", "broke the contract at step 2 .*step returned None"),
    ],
)
def test_failures_in_processes_are_told(fails: str, told: str) -> None:
    with (
        EnvPool(task_of(fails, 4), 2, step_seconds=1.0) as pool,
        pytest.raises((EnvFailedError, HandedOverError), match=told),
    ):
        shown(pool, [3, 4])

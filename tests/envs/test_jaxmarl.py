"""Environments of JaxMARL's interface as tasks on the device."""

import dataclasses
import sys
from functools import cache
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from jaxmarl_games import Climbers, Continuous, Duel

from race.config.settings import EnvConfig
from race.envs import jaxmarl, make_task, own, reads_team
from race.envs.jaxmarl import jaxmarl_task, source
from race.envs.jaxmarl.host import JaxmarlEnv
from race.envs.layout import layout
from race.envs.pettingzoo import conflict
from race.envs.trial import try_out
from race.errors import RenderError, TaskError
from race.rollouts import device
from race.rollouts.episodes import Part
from race.training import asking
from race.types import DiscreteTask

BLUE = EnvConfig(agents="blue_*")


@cache
def task_of(config: EnvConfig = BLUE, kind: Any = Climbers, **given: Any) -> DiscreteTask:
    return jaxmarl_task(lambda: kind(**given), "climb", config)


def changed(**settings: Any) -> EnvConfig:
    return dataclasses.replace(BLUE, **settings)


def played(task: DiscreteTask, actions: Any, seed: int = 3) -> list[tuple[Any, ...]]:
    """An episode on the host: what is seen first, then steps."""
    env: Any = task.make(None)
    found = [(env.reset(seed=seed)[0],)]
    for action in actions:
        found.append(env.step(np.asarray(action)))
        if found[-1][2] or found[-1][3]:
            break
    return found


def test_sizes_and_facts() -> None:
    spec, facts = task_of().spec, dict(task_of().facts)
    assert (spec.n_agents, spec.obs_size, spec.n_actions, spec.state_size) == (2, 2, 4, 4)
    assert (spec.episode_limit, spec.has_wins) == (4, False)
    assert facts["agent_names"] == ["blue_0", "blue_1"]
    assert (facts["other_agents"], facts["others_act"]) == (["red"], "random")
    assert (facts["team_reward"], facts["state_is"]) == ("mean", "environment")
    whole = task_of(EnvConfig(state="observations", episode_limit=2), world_state=True)
    # Heights of the first, of both, and the step.
    assert (whole.spec.n_agents, whole.spec.state_size, whole.spec.episode_limit) == (3, 4, 2)
    assert layout("jaxmarl:x", task_of()).agents == ("blue_0", "blue_1")


def test_an_episode_is_the_one_that_jaxmarl_plays() -> None:
    everyone = EnvConfig()
    task, env = task_of(everyone), Climbers()
    actions = [[1, 1, 0], [2, 3, 1], [1, 0, 1], [1, 2, 0]]
    mine = played(task, actions)
    key, now = jax.random.split(jax.random.key(3))
    shown, world = env.reset(jax.random.key_data(now))
    for t, step in enumerate(mine):
        if t:
            key, now = jax.random.split(key)
            chosen = dict(zip(env.agents, np.array(actions[t - 1]), strict=True))
            shown, world, gain, _, _ = env.step(jax.random.key_data(now), world, chosen)
            assert step[1] == pytest.approx(np.mean([float(gain[a]) for a in env.agents]))
        seen = step[0]
        height = np.asarray(world.x)
        np.testing.assert_array_equal(
            seen["obs"], [[height[0], 0], [height[0], height[1]], [world.step, 0]]
        )
        np.testing.assert_array_equal(seen["state"], shown["world_state"])
        np.testing.assert_array_equal(seen["state"], [*height, world.step])
    assert len(mine) == 5


def test_masks_are_padded_and_leave_everybody_something() -> None:
    seen = played(task_of(EnvConfig()), [[2, 3, 1]])
    for t, step in enumerate(seen):
        first, second, _ = step[0]["state"][:3]
        odd = step[0]["state"][3] % 2
        expected = [
            [first % 2, 1, 1, 0],
            [second % 2, 1, 1, 1],
            [1, 1, 0, 0],  # red, also where it could do nothing
        ]
        np.testing.assert_array_equal(step[0]["avail_actions"], expected)
        assert odd == t % 2
    without = played(task_of(EnvConfig(), masks=False), [])
    np.testing.assert_array_equal(without[0][0]["avail_actions"].sum(axis=1), [3, 4, 2])


@pytest.mark.parametrize(("how", "paid"), [("mean", 11.0), ("sum", 22.0)])
def test_the_team_is_paid_the_mean_or_the_sum(how: Any, paid: float) -> None:
    steps = played(task_of(changed(team_reward=how)), [[2, 2]])
    assert steps[1][1] == pytest.approx(paid)  # 2 for the one and 20 for the other


def test_the_limit_truncates_and_an_end_before_it_terminates() -> None:
    idle = [[0, 0]] * 9
    ends = [step[2:4] for step in played(task_of(), idle)[1:]]
    assert ends == [(False, False)] * 3 + [(False, True)]
    climbing = played(task_of(top=12), [[2, 3]] * 9)
    assert climbing[-1][2:4] == (True, False)
    assert len(climbing) < 5
    assert climbing[-1][0]["state"][:2].sum() >= 12  # what is seen last is the end itself
    short = played(task_of(changed(episode_limit=2)), idle)
    assert [step[2:4] for step in short[1:]] == [(False, False), (False, True)]


def test_other_agents_choose_at_random_what_they_can() -> None:
    moved = set()
    for seed in range(12):
        before, after = (s[0]["state"] for s in played(task_of(), [[0, 0]], seed))
        moved.add(bool(after[2] > before[2]))
        np.testing.assert_array_equal(after[:2], before[:2])
    assert moved == {True, False}


class Idle(Duel):
    """Its enemy never fights."""

    def step_env(self, key: Any, battle: Any, actions: Any) -> Any:
        return super().step_env(key, battle, actions | {"enemy_0": np.int32(0)})


@cache
def duel(team: str) -> DiscreteTask:
    return jaxmarl_task(Idle if team == "ally_*" else Duel, "duel", EnvConfig(agents=team))


@pytest.mark.parametrize(
    ("team", "actions", "end"),
    [
        ("ally_*", [[0, 2]], (True, False, True)),
        ("ally_*", [[1, 1]], (True, False, False)),
        ("ally_*", [[0, 0]] * 9, (False, True, False)),
        ("*", [[0, 2, 0]], (True, False, False)),
    ],
)
def test_battles_are_won_by_the_team_that_is_left(team: str, actions: Any, end: Any) -> None:
    task = duel(team)
    assert task.spec.has_wins == (team != "*")
    *_, last = played(task, actions)
    assert (*last[2:4], last[4]["battle_won"]) == end


def test_a_decision_in_the_last_step_is_no_time_limit() -> None:
    *_, last = played(duel("*"), [[0, 0, 0], [0, 0, 0], [0, 2, 0]])
    assert last[2:4] == (True, False)


def test_the_device_plays_what_the_host_plays() -> None:
    from race.algorithms.base import Teams
    from race.config.presets import resolve
    from race.config.settings import Config, FacmacConfig
    from race.config.shape import shape_of
    from race.learners.facmac import new_encoder

    task = task_of()
    config = resolve(Config("climb", facmac=FacmacConfig(hidden_size=3)), discrete=True)
    encoder = new_encoder(jax.random.key(0), task.spec, shape_of(config))
    teams = Teams(encoder, 3.0 * jax.random.normal(jax.random.key(1), (2, 2, 4, 4)))
    assert task.device is not None
    env = task.device()
    assert env == task.device()  # or nothing compiled would be found again
    seeds = np.array([3, 8], np.uint32)
    (found,) = device.play(env, [Part(teams, seeds, None)], task.spec, "float32")
    for team, seed in enumerate(seeds.tolist()):
        length = int(found.episodes.length[team])
        steps = played(task, np.asarray(found.episodes.action[team, :length]), seed)
        assert len(steps) == length + 1
        for t, step in enumerate(steps):
            for name in ("obs", "state", "avail_actions"):
                shown = np.asarray(getattr(found.episodes, name)[team, t])
                np.testing.assert_array_equal(shown, step[0][name])
        assert float(found.episode_return[team]) == pytest.approx(sum(s[1] for s in steps[1:]))
        assert bool(found.episodes.terminated[team, length - 1]) == steps[-1][2]


def test_a_first_look_tells_of_rivals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conflict, "_STEPS", 200)
    look = try_out(task_of(EnvConfig(), masks=False))
    assert look.repeats
    assert look.conflict is not None
    assert "red" in look.conflict
    assert "--env.agents" in look.note
    assert try_out(task_of()).conflict is None


@pytest.mark.parametrize(
    ("settings", "kind", "words"),
    [
        ({"agents": "green"}, Climbers, "none of its agents, which are blue_0, blue_1, red"),
        ({"others": "mine:policy"}, Climbers, "others random"),
        ({"episode_limit": 9}, Climbers, r"end after 4 steps.*max_steps"),
        ({"largest_observation": 1}, Climbers, "--env.largest-observation"),
        ({}, Continuous, r"Numbers.*Discrete.*mamujoco"),
    ],
)
def test_what_does_not_fit_is_told(settings: Any, kind: Any, words: str) -> None:
    with pytest.raises(TaskError, match=words):
        jaxmarl_task(kind, "climb", changed(**settings))


def test_what_is_not_there_is_told() -> None:
    class Endless(Climbers):
        max_steps = None  # type: ignore[assignment]

    with pytest.raises(TaskError, match=r"--env\.episode-limit"):
        jaxmarl_task(Endless, "climb", BLUE)
    with pytest.raises(TaskError, match="world_state"):
        jaxmarl_task(lambda: Climbers(world_state=False), "climb", changed(state="environment"))
    with pytest.raises(TaskError, match="its environment failed: ZeroDivisionError"):
        jaxmarl_task(lambda: 1 // 0, "climb", BLUE)
    with pytest.raises(RenderError, match="visualizers"):
        task_of().make("rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        task_of().make(None).step(np.zeros(2))


def registry(monkeypatch: pytest.MonkeyPatch, version: str = "0.2.0") -> list[Any]:
    """A jaxmarl of nothing but names; returns what it is asked to make."""
    asked: list[Any] = []

    def make(name: str, **given: Any) -> Any:
        asked.append((name, given))
        if given.get("bad"):
            raise ValueError("no such argument")
        return Climbers()

    known = ["MPE_simple_spread_v3", "HeuristicEnemySMAX", "overcooked", "hanabi"]
    module = SimpleNamespace(make=make, registered_envs=known)
    monkeypatch.setitem(sys.modules, "jaxmarl", module)  # type: ignore[arg-type]
    monkeypatch.setattr(source, "packages", lambda: {"jaxmarl": version})
    monkeypatch.setattr(source, "_maps", lambda: {"2s3z": "a battle", "3m": "another"})
    monkeypatch.setattr(source, "_layouts", lambda: {})
    return asked


def test_names(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = registry(monkeypatch)
    config = dataclasses.replace(BLUE, kwargs='{"top": 7}')
    for name in ("SMAX/2s3z", "MPE/simple_spread_v3", "hanabi"):
        task: Any = make_task(f"jaxmarl:{name}", config)
        assert task.spec.task == f"jaxmarl:{name}"
    assert asked == [
        ("HeuristicEnemySMAX", {"scenario": "a battle", "top": 7}),
        ("MPE_simple_spread_v3", {"top": 7}),
        ("hanabi", {"top": 7}),
    ]
    again: Any = make_task("jaxmarl:SMAX/2s3z", config)
    assert len(asked) == 3  # programs are found again
    assert isinstance(again.make(None), JaxmarlEnv)
    assert reads_team("jaxmarl:hanabi")
    assert not own.is_own("jaxmarl:hanabi")
    for name, words in [
        ("SMAX/2s4z", "nearest names are jaxmarl:SMAX/2s3z"),
        ("MPE/simple_spred_v3", "nearest names are jaxmarl:MPE/simple_spread_v3"),
        ("hanaby", "in jaxmarl 0.2.0.*jaxmarl:hanabi"),
    ]:
        with pytest.raises(TaskError, match=words):
            make_task(f"jaxmarl:{name}", BLUE)
    with pytest.raises(TaskError, match="no such argument"):
        make_task("jaxmarl:hanabi", changed(kwargs='{"bad": 1}'))
    with pytest.raises(TaskError, match="its name says what scenario is"):
        make_task("jaxmarl:SMAX/3m", changed(kwargs='{"scenario": "x"}'))


def test_an_old_or_missing_jaxmarl_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    registry(monkeypatch, "0.1.0")
    pip = r"pip install 'race-marl\[jaxmarl\]'"
    with pytest.raises(TaskError, match=f"jaxmarl 0.1.0 is installed.*SMAX.*{pip}"):
        make_task("jaxmarl:SMAX/5m", BLUE)
    monkeypatch.setitem(sys.modules, "jaxmarl", None)
    with pytest.raises(TaskError, match=f"jaxmarl is not installed: {pip}"):
        make_task("jaxmarl:SMAX/6m", BLUE)
    assert jaxmarl.PREFIX == "jaxmarl:"


def test_what_is_printed_at_the_import_is_kept_back(capsys: pytest.CaptureFixture[str]) -> None:
    there = sys.stdout, sys.stderr, sys.__stdout__
    with source._quiet():
        print("one")
        sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__  # type: ignore[assignment]
        print("two")
    assert (sys.stdout, sys.stderr, sys.__stdout__) == there
    assert capsys.readouterr().out == ""


def test_metadata_has_the_version(monkeypatch: pytest.MonkeyPatch) -> None:
    registry(monkeypatch)
    monkeypatch.setattr(conflict, "_STEPS", 3)
    monkeypatch.setattr(jaxmarl, "packages", lambda: {"jaxmarl": "0.2.0"})
    found = asking.tried("jaxmarl:MPE/simple_spread_v3", make_task("jaxmarl:MPE/simple_spread_v3"))
    assert found == {"repeats": True, "conflict": None, "packages": {"jaxmarl": "0.2.0"}}

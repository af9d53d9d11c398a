"""PettingZoo environments as tasks: who is there, what is paid, how episodes end."""

import functools
import json
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pettingzoo_games as games
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test

from race.config.checks import check_env as check_settings
from race.config.settings import EnvConfig
from race.envs import make_task, reads_config, reads_team
from race.envs.checked import CheckedEnv
from race.envs.description import describe, refuse_changed
from race.envs.pettingzoo import TeamEnv, conflict, parallel_task
from race.envs.trial import try_out
from race.errors import ConfigError, HandedOverError, TaskError
from race.rollouts.host import collect
from race.rollouts.pool import EnvPool
from race.types import DiscreteTask, EnvSpec, Task

GONE = [True, False, False, False, False, False]


def continuous(script: dict[int, Any] | None = None, **settings: Any) -> tuple[Task, CheckedEnv]:
    task = parallel_task(functools.partial(games.Numbers, script), None, EnvConfig(**settings))
    assert isinstance(task, Task)
    return task, CheckedEnv(task)


def choosing(
    script: dict[int, Any] | None = None, kind: Any = games.Choosing, **settings: Any
) -> CheckedEnv:
    task = parallel_task(functools.partial(kind, script), "mine", EnvConfig(**settings))
    assert isinstance(task, DiscreteTask)
    return CheckedEnv(task)


def team_of(env: CheckedEnv) -> TeamEnv:
    assert isinstance(env.env, TeamEnv)
    return env.env


def test_a_continuous_team() -> None:
    task, env = continuous()
    assert task.spec == EnvSpec(
        task="numbers_v0",
        state_size=5,
        obs_index=((0, 1, 2), (3, 4)),
        action_index=((0, 1), (2,)),
        action_low=(-1.0, -1.0, 0.0),
        action_high=(2.0, 4.0, 1.0),
        episode_limit=games.LIMIT,
    )
    np.testing.assert_array_equal(env.reset(7), [0, 1, 2, 0, 1])
    step = env.step(np.array([-1, 4, 0.5], np.float32))
    np.testing.assert_array_equal(step.seen, [10, 11, 12, 10, 11])
    assert step[1:] == ((1 + 3) / 2, False, False, False)
    calls = team_of(env).parallel.env.calls
    assert calls[0] == ("reset", 7)
    assert list(calls[1]) == ["big", "small"]
    assert calls[1]["big"].tolist() == [-1, 4]
    assert calls[1]["small"].tolist() == [0.5]
    assert all(action.dtype == np.float32 for action in calls[1].values())
    ends = [env.step(np.zeros(3, np.float32))[2:4] for _ in range(games.LIMIT - 1)]
    assert ends == [(False, False)] * (games.LIMIT - 2) + [(False, True)]
    with pytest.raises(gymnasium.error.ResetNeeded):
        team_of(env).step(np.zeros(3))


def test_a_discrete_team_is_padded() -> None:
    env = choosing()
    seen = env.reset(0)
    np.testing.assert_array_equal(seen.obs, [[0, 1, 2], [0, 1, 0]])
    np.testing.assert_array_equal(seen.state, [0, 1, 2, 0, 1])
    np.testing.assert_array_equal(seen.avail_actions, [[True] * 6, [True] * 4 + [False] * 2])
    env.step(np.array([4, 2]))
    (given,) = team_of(env).parallel.env.calls[1:]
    assert given["big"].tolist() == [1, 6]
    assert (given["small"], type(given["small"])) == (3, int)


def test_what_is_not_available_is_refused() -> None:
    env = team_of(choosing())
    env.reset()
    assert env.step(np.array([-1, 4]))[4]["refused"].tolist() == [True, True]
    assert env.parallel.env.calls[-1]["big"].tolist() == [0, 5]
    assert env.parallel.env.calls[-1]["small"] == 1


@pytest.mark.parametrize(("reward", "pays"), [("mean", [2.0, 1.0, 2.5]), ("sum", [4.0, 2.0, 5.0])])
def test_agents_leave_and_return(reward: Any, pays: list[float]) -> None:
    script = {
        1: {"terminations": {"big": True, "small": False}},
        2: {"there": ["small"], "rewards": {"small": 2.0}, "terminations": {"small": False}},
    }
    script[1]["agents"] = ["small"]
    script[2] |= {"truncations": {"small": False}}
    script[3] = {"rewards": {"small": 5.0}, "truncations": {"small": False}}
    script[3]["terminations"] = {"small": False}
    env = choosing(script, team_reward=reward)
    env.reset(0)
    first, second, third = [env.step(np.array([3, 1])) for _ in range(3)]
    # Its last observation is shown, but there is nothing left to choose.
    np.testing.assert_array_equal(first.seen.obs[0], [10, 11, 12])
    assert first.seen.avail_actions[0].tolist() == GONE
    np.testing.assert_array_equal(second.seen.obs, [[0, 0, 0], [20, 21, 0]])
    np.testing.assert_array_equal(second.seen.state, [0, 0, 0, 20, 21])
    assert second.seen.avail_actions[0].tolist() == GONE
    assert third.seen.avail_actions[0].all()  # it is back
    np.testing.assert_array_equal(third.seen.obs[0], [30, 31, 32])
    assert [step.reward for step in (first, second, third)] == pays
    env.step(np.array([3, 1]))
    given = [list(call) for call in team_of(env).parallel.env.calls[1:]]
    assert given == [["big", "small"], ["small"], ["small"], ["big", "small"]]


@pytest.mark.parametrize(
    ("terminations", "truncations", "ends"),
    [
        ((False, False), (False, False), (False, False)),
        ((True, False), (False, False), (False, False)),
        ((True, True), (False, False), (True, False)),
        ((False, False), (True, True), (False, True)),
        ((True, True), (True, True), (True, False)),  # an end of its own, at the time limit
        ((True, False), (False, True), (False, True)),
        ((np.True_, 1), (0, np.array([False])), (True, False)),
    ],
)
def test_how_episodes_end(terminations: Any, truncations: Any, ends: tuple[bool, bool]) -> None:
    names = ("big", "small")
    flags = zip(terminations, truncations, strict=True)
    script = {
        1: {
            "terminations": dict(zip(names, terminations, strict=True)),
            "truncations": dict(zip(names, truncations, strict=True)),
            "agents": [n for n, f in zip(names, flags, strict=True) if not any(map(bool, f))],
        }
    }
    env = choosing(script)
    env.reset(0)
    assert env.step(np.array([0, 0]))[2:4] == ends


def test_those_that_are_cut_off_keep_their_choices() -> None:
    both = {"terminations": {"big": True, "small": False}, "truncations": {"big": 0, "small": 1}}
    env = choosing({1: {**both, "agents": []}})
    env.reset(0)
    step = env.step(np.array([0, 0]))
    assert (step.terminated, step.truncated) == (False, True)
    np.testing.assert_array_equal(step.seen.avail_actions, [GONE, [True] * 4 + [False] * 2])


def test_the_limit_may_be_shorter() -> None:
    task, env = continuous(episode_limit=2)
    assert task.spec.episode_limit == 2
    env.reset(0)
    ends = [env.step(np.zeros(3, np.float32))[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]
    env = choosing(episode_limit=1)
    env.reset(0)
    assert env.step(np.array([0, 0])).seen.avail_actions.sum() == 10


def test_limits_that_are_not_told() -> None:
    class Endless(games.Numbers):
        def __init__(self) -> None:
            super().__init__()
            del self.max_cycles

    with pytest.raises(TaskError, match=r"numbers_v0: after how many steps .* --env.episode-limit"):
        parallel_task(Endless)
    assert parallel_task(Endless, None, EnvConfig(episode_limit=9)).spec.episode_limit == 9


def test_masks_of_observations_and_infos() -> None:
    env = choosing(kind=games.Masked)
    seen = env.reset(0)
    assert seen.avail_actions[1].tolist() == [False, True, True, False, False, False]
    # big's parts 0 and 1 may do (0 or not 1) and (0 or 1 but not 2): the mask is [1, 0 | 1, 1, 0].
    assert seen.avail_actions[0].tolist() == [True, True, False, False, False, False]
    np.testing.assert_array_equal(seen.obs, [[0, 1, 2], [0, 1, 0]])
    assert env.step(np.array([0, 1])).seen.avail_actions[1].tolist()[:4] == [
        False,
        True,
        True,
        True,
    ]


def state_task(kind: Any, **settings: Any) -> Any:
    return parallel_task(kind, "mine", EnvConfig(**settings))


def test_a_state_of_its_own_stands_before_what_agents_see() -> None:
    task = state_task(games.WithState)
    assert task.spec.state_size == 2 + 5
    assert task.spec.obs_index == ((2, 3, 4), (5, 6))
    env = CheckedEnv(task)
    env.reset(0)
    np.testing.assert_array_equal(
        env.step(np.zeros(3, np.float32)).seen, [1, -1, 10, 11, 12, 10, 11]
    )
    assert dict(task.facts)["state_is"] == "environment"
    other = state_task(games.WithState, state="observations")
    assert (other.spec.state_size, dict(other.facts)["state_is"]) == (5, "observations")


def test_a_state_that_is_all_observations_is_not_kept_twice() -> None:
    assert state_task(games.StateOfAll).spec.state_size == 5
    assert state_task(games.StateOfAll, state="environment").spec.state_size == 10


def test_a_discrete_team_s_state_is_the_environment_s_alone() -> None:
    class Both(games.Choosing, games.WithState): ...

    task = state_task(Both)
    assert (task.spec.state_size, task.spec.obs_size) == (2, 3)
    assert CheckedEnv(task).reset(0).state.tolist() == [0, -1]


class BreaksDown(games.WithState):
    def state(self) -> Any:
        if self.time == 2:
            raise AttributeError("body is gone")
        return super().state()


def test_a_state_may_be_gone_when_the_task_is_over() -> None:
    over = {"terminations": {"big": True, "small": True}, "agents": []}
    env = CheckedEnv(parallel_task(lambda: BreaksDown({2: over})))
    env.reset(0)
    env.step(np.zeros(3, np.float32))
    step = env.step(np.zeros(3, np.float32))
    assert step.terminated
    assert step.seen[:2].tolist() == [1, -1]
    env = CheckedEnv(parallel_task(BreaksDown))
    env.reset(0)
    env.step(np.zeros(3, np.float32))
    with pytest.raises(HandedOverError, match=r"body is gone.*--env.state observations"):
        env.step(np.zeros(3, np.float32))


def test_states_that_are_none() -> None:
    typo = type("Typo", (games.Numbers,), {"state": lambda self: self.tiem})
    with pytest.raises(TaskError, match=r"environment failed: AttributeError.*tiem"):
        state_task(typo)
    with pytest.raises(TaskError, match="has no state"):
        state_task(games.Numbers, state="environment")
    grown = type("Grown", (games.Numbers,), {"state": lambda self: np.zeros(1 + self.time)})
    env = CheckedEnv(state_task(grown))
    env.reset(0)
    with pytest.raises(HandedOverError, match=r"has shape \(2,\).*--env.state observations"):
        env.step(np.zeros(3, np.float32))


def test_the_others_act_at_random_from_the_episode_s_seed() -> None:
    task = parallel_task(games.Rivals, "mine", EnvConfig(agents="cat_*"))
    assert task.spec.n_agents == 2
    assert (task.spec.obs_size, task.spec.state_size) == (3, 8)  # the mouse's too
    facts = dict(task.facts)
    assert facts["agent_names"] == ["cat_0", "cat_1"]
    assert (facts["other_agents"], facts["others_act"]) == (["mouse"], "random")

    def played(env: CheckedEnv, seed: int) -> list[int]:
        env.reset(seed)
        for _ in range(games.LIMIT):
            env.step(np.array([0, 1]))
        return [call["mouse"] for call in team_of(env).parallel.env.calls[-games.LIMIT :]]

    env = CheckedEnv(task)
    first = [played(env, seed) for seed in range(4)]
    assert first == [played(env, seed) for seed in range(4)]
    assert len({tuple(actions) for actions in first}) > 1


def scripted(agent: Any, observation: Any, space: Any, random: np.random.Generator) -> Any:
    """A policy of agents outside the team."""
    assert agent == "mouse"
    assert space.contains(np.int64(random.integers(3)))
    return 2 - int(observation)


def test_the_others_act_by_a_function() -> None:
    task = parallel_task(
        games.Rivals, "mine", EnvConfig(agents="cat_0, cat_1", others=f"{__name__}:scripted")
    )
    env = CheckedEnv(task)
    env.reset(0)
    steps = [env.step(np.array([2, 0])) for _ in range(2)]
    assert [call["mouse"] for call in team_of(env).parallel.env.calls[1:]] == [2, 1]
    assert [step.reward for step in steps] == [1, 0]


def three(agent: Any, observation: Any, space: Any) -> Any:
    raise AssertionError


def test_functions_for_others_that_cannot_act() -> None:
    for agents, name, message in (
        ("cat_*", "three", "three takes other arguments"),
        ("*", "scripted", "scripted has no effect: all agents are the team.*cat_0.*mouse"),
    ):
        config = EnvConfig(agents=agents, others=f"{__name__}:{name}")
        with pytest.raises(TaskError, match=message):
            parallel_task(games.Rivals, "mine", config)


def test_rivals_are_told_apart() -> None:
    trial = try_out(parallel_task(games.Rivals))
    assert trial.conflict == ("cat_0", "mouse")
    assert "correlation -1.00" in trial.note
    assert "'cat_*' or 'mouse'" in trial.note
    friends = try_out(parallel_task(games.Rivals, None, EnvConfig(agents="cat_*")))
    assert (friends.conflict, friends.note) == (None, "")
    assert friends.repeats


def test_an_environment_that_fails_later_is_tried_all_the_same() -> None:
    class Fails(games.Rivals):
        def step(self, actions: Any) -> Any:
            if self.time == 3:
                raise OSError("the mouse is gone")
            return super().step(actions)

    assert try_out(parallel_task(Fails)).conflict is None


def test_opposed_rewards() -> None:
    random = np.random.default_rng(0)
    one, other, noise = random.normal(size=(3, 400))
    assert conflict.opposed(np.stack([one, other, noise], 1)) is None
    assert conflict.opposed(np.stack([one, one, np.ones(400)], 1)) is None
    first, second, correlation = conflict.opposed(np.stack([np.zeros(400), one, noise - one], 1))  # type: ignore[misc]
    assert (first, second) == (1, 2)
    assert correlation == pytest.approx(np.corrcoef(one, noise - one)[0, 1])
    assert conflict.opposed(np.stack([one, -one], 1)[:9]) is None  # too few to tell


def test_agents_that_take_turns() -> None:
    task = parallel_task(games.Turns)
    assert isinstance(task, DiscreteTask)
    env = CheckedEnv(task)
    seen = env.reset(0)
    nothing = [True, False, False]
    np.testing.assert_array_equal(seen.avail_actions, [[True] * 3, nothing])
    steps = [env.step(np.array(actions)) for actions in ([2, 0], [0, 2], [1, 0], [0, 1])]
    np.testing.assert_array_equal(steps[0].seen.avail_actions, [nothing, [True] * 3])
    np.testing.assert_array_equal(steps[0].seen.obs, [[0, 0, 1]] * 2)
    assert [step.reward for step in steps] == [0, 1, 0, 1]
    assert [step.terminated for step in steps] == [False, False, False, True]


# Their advice is for arrays that are images.
@pytest.mark.filterwarnings("ignore::UserWarning:pettingzoo")
def test_the_games_are_right_by_pettingzoo_s_own_tests() -> None:
    for kind in (games.Choosing, games.Rivals):
        parallel_api_test(kind(), num_cycles=20)
    api_test(games.Turns(), num_cycles=20)


# Boxes without bounds are meant; the last is about environments that gymnasium has registered.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.* value is")
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
@pytest.mark.parametrize("kind", [games.Numbers, games.Masked, games.Rivals, games.WithState])
def test_the_tasks_are_right_by_gymnasium_s_own_test(kind: Any) -> None:
    check_env(parallel_task(kind).make(None))


def test_pictures() -> None:
    env = CheckedEnv(parallel_task(games.Numbers), render_mode="rgb_array")
    env.reset(0)
    env.step(np.zeros(3, np.float32))
    assert (env.render() == 1).all()
    with pytest.raises(TaskError, match="takes no render_mode"):
        CheckedEnv(parallel_task(lambda: games.Numbers()), render_mode="rgb_array")
    # A function that asks for the mode is given it by place, as for other tasks.
    CheckedEnv(parallel_task(lambda mode: games.Numbers(render_mode=mode)), render_mode="rgb_array")


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"rewards": {"big": 1.0}}, "no reward of small, which was there before the step"),
        ({"rewards": {"big": 1.0, "small": [1, 2]}}, "the reward of small is a list of 2"),
        ({"rewards": {"big": np.nan, "small": 0.0}}, "the reward of big is nan"),
        ({"terminations": {"big": False}}, "no termination of small"),
        ({"truncations": {"big": "no", "small": False}}, "the truncation of big is str 'no'"),
        ({"seen": {"small": np.zeros(2)}, "agents": ["big"]}, "observations have none of it, only"),
        ({"seen": {"big": np.zeros(2), "small": np.zeros(2)}}, r"observation of big has shape \(2"),
        (
            {"seen": {"big": np.zeros(3), "small": np.array([0, np.inf], np.float32)}},
            "entry 1 of the observation of small is inf",
        ),
        ({"agents": ["huge"]}, "agents has huge, not one of possible_agents"),
        ({"agents": []}, "neither terminations nor truncations say so of big, small"),
        ({"infos": None}, r"step returned a tuple of 5 .* instead of five dictionaries"),
    ],
)
def test_what_steps_answer_must_fit(told: dict[str, Any], message: str) -> None:
    env = choosing({1: told})
    env.reset(0)
    with pytest.raises(HandedOverError, match=f"Task mine, at step 1 .*{message}.*Numbers.step"):
        env.step(np.array([0, 0]))


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({}, "instead of the pair"),
        (({"big": np.zeros(3)}, {}), "small is among agents"),
        (None, "reset returned None"),
    ],
)
def test_what_resets_answer_must_fit(answer: Any, message: str) -> None:
    class Wrong(games.Numbers):
        def reset(self, seed: int | None = None, options: Any = None) -> Any:
            super().reset(seed, options)
            return answer

    with pytest.raises(TaskError, match=f"{message}"):
        CheckedEnv(parallel_task(Wrong, None, EnvConfig(state="observations"))).reset(0)


def test_masks_that_are_none() -> None:
    class Wrong(games.Masked):
        mask: Any = np.ones(3)

        def _answer(self) -> Any:
            answer = super()._answer()
            answer[4]["big"]["action_mask"] = self.mask
            return answer

    for mask, message in (
        (np.ones(3), r"action_mask with the action space of big has shape \(3,\)"),
        ((np.ones(2), np.ones(4)), r"part 1 of the action_mask .* has shape \(4,\)"),
        (np.array([1, 2, 1, 1, 1]), "has the entry 2"),
        (np.zeros(5), r"the action_mask with the action space of big leaves no action\..*_games"),
    ):
        Wrong.mask = mask
        with pytest.raises(HandedOverError, match=message):
            choosing(kind=Wrong).reset(0)


class Odd(games.Numbers):
    """Its spaces are whatever is asked for."""

    def __init__(self, seen: Any = None, acts: Any = None) -> None:
        super().__init__()
        self.seen, self.acts = seen, acts

    def observation_space(self, agent: str) -> Any:
        return super().observation_space(agent) if self.seen is None else self.seen

    def action_space(self, agent: str) -> Any:
        return self.acts if self.acts and agent == "big" else super().action_space(agent)


SPACES = gymnasium.spaces


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (
            lambda: Odd(SPACES.Box(0, 255, (90, 90, 3), np.uint8)),
            "has 24,300 entries",
        ),
        (lambda: Odd(SPACES.Sequence(SPACES.Discrete(3))), "no array of a fixed size"),
        (lambda: Odd(SPACES.Dict({})), "has no entries"),
        (lambda: Odd(acts=SPACES.Box(-np.inf, 1, (2,))), "space of big is .* no finite bounds"),
        (lambda: Odd(acts=SPACES.Box(0, 3, (2,), np.int64)), "policies choose fractions"),
        (lambda: Odd(acts=SPACES.MultiDiscrete([9] * 4)), "6,561 joint choices"),
        (lambda: Odd(acts=SPACES.Discrete(2)), "small act by numbers and big by choices"),
        (lambda: Odd(acts=SPACES.Text(3)), "space of big is Text.*nothing else"),
        (lambda: gymnasium.Env(), "no PettingZoo environment: it has no observation_space"),
        (lambda: None, "None is no PettingZoo environment"),
        (lambda: 1 / 0, "making its environment failed: ZeroDivisionError"),
    ],
)
def test_environments_that_cannot_be_learned(kind: Callable[[], Any], message: str) -> None:
    with pytest.raises(TaskError, match=message):
        parallel_task(kind)


def test_agents_must_be_known_beforehand() -> None:
    class Crowd(games.Numbers):
        def __init__(self) -> None:
            super().__init__()
            del self.possible_agents

    with pytest.raises(TaskError, match=r"possible_agents is None.*fixed size"):
        parallel_task(Crowd)
    with pytest.raises(TaskError, match=r"--env\.agents dog is none of .*are big, small"):
        parallel_task(games.Numbers, None, EnvConfig(agents="big,dog"))


@pytest.mark.parametrize(
    ("setting", "wrong"),
    [
        ("kwargs", "N=3"),
        ("kwargs", "[1]"),
        ("agents", "a,,b"),
        ("agents", ""),
        ("others", "scripted"),
        ("episode_limit", 0),
        ("largest_observation", 0),
    ],
)
def test_settings_that_cannot_work(setting: str, wrong: Any) -> None:
    with pytest.raises(ConfigError, match=f"--env.{setting.replace('_', '-')} is"):
        check_settings(EnvConfig(**{setting: wrong}))


def test_what_decides_a_run_is_recorded() -> None:
    task = parallel_task(games.Numbers)
    recorded = json.loads(json.dumps(describe(task)))
    refuse_changed(recorded, task)
    with pytest.raises(TaskError, match="its team_reward was mean and is sum now"):
        refuse_changed(recorded, parallel_task(games.Numbers, None, EnvConfig(team_reward="sum")))


def test_environments_in_processes_give_the_same() -> None:
    task = parallel_task(games.Numbers, None, EnvConfig(agents="big"))

    def play(processes: bool) -> Any:
        random = np.random.default_rng(0)

        def act(states: Any, tick: int) -> Any:
            return random.uniform(-1, 1, (len(states), 2)).astype(np.float32)

        with EnvPool(task, 1, processes) as pool:
            return collect(pool, act, np.array([3]))

    here, there = play(False), play(True)
    assert here.episode_length.tolist() == [games.LIMIT]
    for one, other in zip(here.transitions, there.transitions, strict=True):
        np.testing.assert_array_equal(one, other)


NAMES = "pettingzoo:pettingzoo_games"


def test_names() -> None:
    task = make_task(f"{NAMES}.Numbers", EnvConfig(kwargs='{"max_cycles": 3}'))
    assert (task.spec.task, task.spec.episode_limit) == (f"{NAMES}.Numbers", 3)
    assert isinstance(make_task("pettingzoo:mpe2.simple_spread_v3"), DiscreteTask)
    assert reads_team(f"{NAMES}.Numbers")
    assert not reads_config(f"{NAMES}.Numbers")
    assert not reads_team("mamujoco/Hopper-3x1")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("pettingzoo:", "write pettingzoo:MODULE.ENV"),
        ("pettingzoo:no_such.thing", "there is no module no_such"),
        (f"{NAMES}.Nubmers", "pettingzoo_games has no Nubmers. The nearest are .*Numbers"),
        (f"{NAMES}.LIMIT", "LIMIT has no function parallel_env"),
        ("pettingzoo:mpe2.simple_spread", "Did you mean mpe2.simple_spread_v3?"),
        ("pettingzoo:mpe2", "Its modules are .*simple_spread_v3"),
        ("pettingzoo:pettingzoo.mpe.simple_v3", "have moved: pip install mpe2"),
        ("pettingzoo:pettingzoo.sisl.pursuit_v1", "pursuit_v1"),
    ],
)
def test_names_of_nothing(name: str, message: str) -> None:
    with pytest.raises(TaskError, match=message):
        make_task(name)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ('{"N": 3}', "--env.kwargs .* unexpected keyword"),
        ('{"render_mode": "human"}', "no argument"),
    ],
)
def test_arguments_that_are_not_its_own(kwargs: str, message: str) -> None:
    with pytest.raises(TaskError, match=message):
        make_task(f"{NAMES}.Numbers", EnvConfig(kwargs=kwargs))


@pytest.mark.parametrize("settings", ["{}", '{"continuous_actions": true, "N": 2}'])
def test_simple_spread_is_what_it_is_by_hand(settings: str) -> None:
    from mpe2 import simple_spread_v3

    task = make_task("pettingzoo:mpe2.simple_spread_v3", EnvConfig(kwargs=settings))
    assert task.spec.episode_limit == 25
    assert dict(task.facts)["state_is"] == "observations"  # its state is what its agents see
    env, hand = CheckedEnv(task), simple_spread_v3.parallel_env(**json.loads(settings))
    seen: Any = env.reset(5)
    theirs, _ = hand.reset(seed=5)
    random = np.random.default_rng(0)
    steps = 0
    while True:
        steps += 1
        state = seen if isinstance(task, Task) else seen.state
        np.testing.assert_array_equal(state, np.concatenate(list(theirs.values())))
        if isinstance(task, Task):
            action = random.uniform(task.spec.action_low, task.spec.action_high).astype(np.float32)
            by_agent = dict(zip(hand.agents, np.split(action, len(hand.agents)), strict=True))
        else:
            np.testing.assert_array_equal(seen.obs, list(theirs.values()))
            action = random.integers(5, size=3)
            by_agent = dict(zip(hand.agents, action.tolist(), strict=True))
        step = env.step(action)
        theirs, rewards, *_ = hand.step(by_agent)
        assert step.reward == pytest.approx(np.mean(list(rewards.values())), abs=1e-12)
        seen = step.seen
        if step.truncated:
            break
    assert steps == 25

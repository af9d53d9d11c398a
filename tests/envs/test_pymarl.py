"""Environments with PyMARL's interface behind gymnasium's."""

import functools
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from race.envs.discrete_probe import make_task
from race.envs.pymarl import PymarlEnv, pymarl_task
from race.errors import HandedOverError, RenderError, TaskError
from race.types import DiscreteSpec

LIMIT = 4


class Game:
    """Two agents, three actions; it remembers what is asked of it."""

    def __init__(self, last: int = LIMIT, facts: dict[str, Any] | None = None) -> None:
        self.last, self.facts = last, facts or {}
        self.calls: list[Any] = []
        self.time = 0
        self.numbers = np.zeros(2)

    def get_env_info(self) -> dict[str, Any]:
        return {
            "n_agents": np.int64(2),
            "obs_shape": 2,
            "state_shape": 1,
            "n_actions": 3,
            "episode_limit": LIMIT,
            "more": "that nobody asks for",
        }

    def reset(self) -> None:
        self.calls.append("reset")
        self.time = 0

    def get_obs(self) -> Any:
        return [np.array([self.time, 0.5]), np.array([self.time, 1.5])]

    def get_state(self) -> Any:
        self.numbers[:] = self.time
        return self.numbers[:1]  # the same memory again and again

    def get_avail_actions(self) -> Any:
        return [[0, 1, 1], [1, 0, self.time % 2]]

    def step(self, actions: Any) -> Any:
        self.calls.append(actions)
        self.time += 1
        over = self.time == self.last
        return self.time / 2, over, dict(self.facts) if over else {}

    def close(self) -> None:
        self.calls.append("close")


class Seeded(Game):
    def seed(self, seed: int | None = None) -> None:
        self.calls.append(("seed", seed))


class TellsSeed(Game):
    def seed(self) -> int:
        self.calls.append("asked")
        return 5


class ResetsSeeded(Game):
    """As in EPyMARL; its attribute ``seed`` is no method."""

    seed = None

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.calls.append(("reset", seed))
        return self.get_obs(), {}


class Both(ResetsSeeded):
    def seed(self, seed: int) -> None:  # type: ignore[override, assignment]
        self.calls.append(("seed", seed))


class AnyKeyword(Game):
    """Hands its keywords on, to what may not know them."""

    def reset(self, **keywords: Any) -> None:
        super().reset(**keywords)


class Drawn(Game):
    picture: Any = np.zeros((3, 4, 3), np.uint8)

    def render(self, mode: str = "human") -> Any:
        self.calls.append(mode)
        return self.picture


def answering(method: str, answer: Any) -> PymarlEnv:
    """A game one of whose methods always gives one answer."""
    game = Game()
    setattr(game, method, lambda *_: answer)
    return PymarlEnv(game, "mine")


def test_sizes_are_read_and_the_environment_is_closed() -> None:
    games: list[Game] = []

    def make() -> Game:
        games.append(Game())
        return games[-1]

    task = pymarl_task(make, "mine", has_wins=True)
    assert task.spec == DiscreteSpec(
        task="mine",
        n_agents=2,
        obs_size=2,
        state_size=1,
        n_actions=3,
        episode_limit=LIMIT,
        has_wins=True,
    )
    assert not pymarl_task(make, "mine").spec.has_wins
    assert task.device is None
    assert [game.calls for game in games] == [["close"], ["close"]]
    env = task.make(None)
    env.close()
    assert games[2].calls == ["close"]


def test_steps_are_handed_on() -> None:
    game = Game()
    env = PymarlEnv(game)
    start, info = env.reset()
    assert info == {}
    assert env.observation_space.contains(start)
    np.testing.assert_array_equal(start["obs"], [[0, 0.5], [0, 1.5]])
    np.testing.assert_array_equal(start["avail_actions"], [[0, 1, 1], [1, 0, 0]])
    after, reward, terminated, truncated, _ = env.step(np.array([2, 0]))
    assert env.observation_space.contains(after)
    np.testing.assert_array_equal(after["obs"], [[1, 0.5], [1, 1.5]])
    np.testing.assert_array_equal(after["avail_actions"], [[0, 1, 1], [1, 0, 1]])
    assert (reward, terminated, truncated) == (0.5, False, False)
    assert game.calls == ["reset", [2, 0]]
    assert all(type(action) is int for action in game.calls[1])
    # What was seen stays as it was, though the game writes to the same memory.
    assert (start["state"].tolist(), after["state"].tolist()) == ([0.0], [1.0])
    after["avail_actions"][:] = 0  # a reader that scribbles on it changes nothing
    assert not env.step(np.array([2, 2]))[4]["refused"].any()


def test_what_is_not_available_is_refused() -> None:
    game = Game()
    env = PymarlEnv(game)
    env.reset()
    refused = [env.step(np.array(actions))[4]["refused"].tolist() for actions in ([0, 2], [-1, 3])]
    assert game.calls[1:] == [[1, 0], [1, 0]]
    assert refused == [[True, True], [True, True]]
    # The masks are those of the moment: action 2 of the second agent is available at odd times.
    assert env.step(np.array([1, 2]))[4]["refused"].tolist() == [False, True]
    assert env.step(np.array([1, 2]))[4]["refused"].tolist() == [False, False]


@pytest.mark.parametrize(
    ("facts", "terminated", "truncated"),
    [
        ({}, True, False),
        ({"episode_limit": False}, True, False),
        ({"episode_limit": True}, False, True),
    ],
)
def test_a_limit_that_is_none_of_the_task_truncates(
    facts: dict[str, Any], terminated: bool, truncated: bool
) -> None:
    env = PymarlEnv(Game(2, facts))
    env.reset()
    ends = [env.step(np.array([1, 0]))[2:4] for _ in range(2)]
    assert ends == [(False, False), (terminated, truncated)]
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.array([1, 0]))
    env.reset()
    assert env.step(np.array([1, 0]))[2:4] == (False, False)


def test_what_has_not_ended_is_not_truncated() -> None:
    env = answering("step", (0.0, False, {"episode_limit": True}))
    env.reset()
    assert env.step(np.array([1, 0]))[2:4] == (False, False)


@pytest.mark.parametrize(
    ("facts", "has_wins", "told"),
    [
        ({"battle_won": np.True_}, True, [False, True]),
        ({"battle_won": False}, True, [False, False]),
        ({}, True, [False, False]),
        ({}, False, [None, None]),
    ],
)
def test_wins_are_told(facts: dict[str, Any], has_wins: bool, told: list[Any]) -> None:
    env = PymarlEnv(Game(2, facts | {"more": 7}), has_wins=has_wins)
    env.reset()
    infos = [env.step(np.array([1, 0]))[4] for _ in range(2)]
    assert [info.get("battle_won") for info in infos] == told
    assert all(type(info.get("battle_won")) in (bool, type(None)) for info in infos)
    assert infos[1]["more"] == 7


@pytest.mark.parametrize(
    ("game", "calls"),
    [
        (Seeded(), [("seed", 3), "reset", "reset"]),
        (ResetsSeeded(), [("reset", 3), ("reset", None)]),
        (Both(), [("seed", 3), ("reset", 3), ("reset", None)]),
        (AnyKeyword(), ["reset", "reset"]),
        (TellsSeed(), ["reset", "reset"]),
        (Game(), ["reset", "reset"]),
    ],
)
def test_seeds_are_handed_on_where_they_are_taken(game: Game, calls: list[Any]) -> None:
    env = PymarlEnv(game)
    env.reset(seed=3)
    env.reset()
    assert game.calls == calls
    calls.clear()
    kind = type(game)
    assert pymarl_task(kind, "mine").seeded == (kind in (Seeded, ResetsSeeded, Both))


def test_pictures() -> None:
    game = Drawn()
    env = PymarlEnv(game, render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    env.reset()
    assert env.render() is Drawn.picture
    assert game.calls == ["reset", "rgb_array"]
    silent = PymarlEnv(Drawn())
    silent.reset()
    assert silent.render() is None
    for picture in (None, np.zeros((3, 4, 3)), np.zeros((3, 4), np.uint8)):
        game.picture = picture
        with pytest.raises(RenderError, match="uint8"):
            env.render()


def test_pictures_that_are_not_offered() -> None:
    class DrawsOtherwise(Game):
        def render(self) -> None: ...

    for game in (Game(), DrawsOtherwise()):
        PymarlEnv(game, "mine")
        with pytest.raises(RenderError, match="mine has no picture"):
            PymarlEnv(game, "mine", render_mode="rgb_array")
    with pytest.raises(RenderError, match="'human'"):
        PymarlEnv(Drawn(), render_mode="human")


def test_methods_that_are_missing() -> None:
    with pytest.raises(TaskError, match="object has no get_env_info, reset"):
        pymarl_task(object, "mine")
    game = Game()
    game.close = None  # type: ignore[method-assign, assignment]
    with pytest.raises(TaskError, match="mine: Game has no close"):
        pymarl_task(lambda: game, "mine")


@pytest.mark.parametrize("wrong", [None, 0, -1, 2.5, (2, 3), "two"])
@pytest.mark.parametrize("size", ["n_agents", "obs_shape", "episode_limit"])
def test_sizes_that_cannot_be(size: str, wrong: Any) -> None:
    sizes = Game().get_env_info() | {size: wrong}
    if wrong is None:
        del sizes[size]
    with pytest.raises(TaskError, match=f"{size} is a whole number"):
        answering("get_env_info", sizes)


def test_get_env_info_that_is_no_dictionary() -> None:
    with pytest.raises(TaskError, match="returned None"):
        answering("get_env_info", None)


@pytest.mark.parametrize(
    ("method", "answer", "told"),
    [
        ("get_obs", [np.zeros(2)], r"get_obs returned has shape \(1, 2\).*\(2, 2\)"),
        ("get_obs", [np.zeros(2), np.zeros(3)], r"get_obs returned is no array of shape \(2, 2\)"),
        ("get_obs", None, "get_obs returned"),
        ("get_obs", [[0.0, 1.0], [np.inf, 0.0]], r"entry \(1, 0\) of what get_obs returned is inf"),
        ("get_state", np.zeros((1, 2)), r"get_state returned has shape \(1, 2\).*\(1,\)"),
        ("get_state", [{}], r"get_state returned is a list of 1 \(dict\)"),
        ("get_avail_actions", [[1, 1, 1]], r"get_avail_actions returned has shape \(1, 3\)"),
        ("get_avail_actions", [[1, 0, 0], [-1, 1, 0]], "has the entry -1"),
        ("get_avail_actions", [[1, 0, 0], [0, 0, 0]], "no action is available to agent 1"),
        ("get_avail_actions", [[1, 0, 0], [1, float("nan"), 0]], "must say 1 or 0 of every action"),
        ("get_avail_actions", [[1, 0, 0], [2, 0, 0]], "must say 1 or 0 of every action"),
    ],
)
def test_what_is_shown_must_fit(method: str, answer: Any, told: str) -> None:
    with pytest.raises(TaskError, match=told):
        answering(method, answer).reset()


@pytest.mark.parametrize(
    "answer",
    [None, (0.0, False), (0.0, False, False, {}), (1.0, False, 3), {"reward": 1.0}],
)
def test_steps_must_answer_as_pymarl_s_do(answer: Any) -> None:
    env = answering("step", answer)
    env.reset()
    with pytest.raises(TaskError, match=r"step must return \(reward, terminated, info\)"):
        env.step(np.array([1, 0]))


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (([1.0, 1.0], False, {}), "after 1 step: the reward is a list of 2"),
        ((1.0, [False, True], {}), r"terminated is a list of 2 \(False, True\)"),
        ((1.0, {"agent_0": True}, {}), "terminated is a dictionary"),
        ((1.0, "False", {}), "terminated is str 'False'"),
        ((1.0, True, {"episode_limit": 25}), r'info\["episode_limit"\] is int 25'),
        ((None, 1.0, False, [True], {}), None),
        ((None, 1.0, False, [True, False], {}), "truncated is a list of 2"),
    ],
)
def test_what_steps_answer_must_be_for_the_whole_team(answer: Any, told: str | None) -> None:
    env = answering("step", answer)
    env.reset()
    if told is None:  # one agent's list says what is plainly meant
        assert env.step(np.array([1, 0]))[2:4] == (False, True)
        return
    with pytest.raises(HandedOverError, match=told):
        env.step(np.array([1, 0]))


@pytest.mark.parametrize(
    ("terminated", "truncated", "limit", "ends"),
    [
        (False, True, False, (False, True)),
        (True, False, False, (True, False)),
        (True, True, False, (True, False)),  # an end of its own, at the moment of the limit
        (True, False, True, (False, True)),
        (1, np.bool_(False), 0, (True, False)),
    ],
)
def test_steps_as_in_epymarl(
    terminated: Any, truncated: Any, limit: Any, ends: tuple[bool, bool]
) -> None:
    answer = ([0], np.array([2.0]), terminated, truncated, {"episode_limit": limit})
    env = answering("step", answer)
    env.reset()
    _, reward, *told, _ = env.step(np.array([1, 0]))
    assert (reward, tuple(told)) == (2.0, ends)


def test_episodes_must_end_by_their_limit() -> None:
    env = PymarlEnv(Game(LIMIT + 1))
    env.reset()
    for _ in range(LIMIT - 1):
        env.step(np.array([1, 0]))
    with pytest.raises(TaskError, match=f"goes on after {LIMIT} steps"):
        env.step(np.array([1, 0]))


@pytest.mark.parametrize("action", [[1, 0, 1], [[1, 0]], [1.0, 0.0], 1])
def test_actions_that_are_none(action: Any) -> None:
    env = PymarlEnv(Game(), "mine")
    env.reset()
    with pytest.raises(TaskError, match="mine needs one whole number per agent, 2 in all"):
        env.step(np.array(action))


def test_steps_need_a_reset() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded):
        PymarlEnv(Game()).step(np.array([1, 0]))


# Boxes without bounds are meant; the last is about environments that gymnasium has registered.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.* value is")
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
def test_gymnasiums_checks_pass() -> None:
    check_env(make_task("probe/matching").make(None))
    check_env(PymarlEnv(Drawn(), render_mode="rgb_array"))


def test_environments_run_side_by_side() -> None:
    task = pymarl_task(functools.partial(Game, 2, {"battle_won": True}), "mine", has_wins=True)
    make = pickle.loads(pickle.dumps(task.make))
    envs = gymnasium.vector.SyncVectorEnv([functools.partial(make, None)] * 3)
    envs.reset(seed=[1, 2, 3])
    for won in (False, True):
        observation, _, terminated, _, info = envs.step(np.array([[1, 0]] * 3))
        assert observation["obs"].shape == (3, 2, 2)
        assert terminated.tolist() == info["battle_won"].tolist() == [won] * 3
    envs.close()

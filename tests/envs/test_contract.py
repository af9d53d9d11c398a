"""What environments may hand over: plainly meant answers pass, all others are told."""

import functools
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from race.envs import contract, factorised
from race.envs.checked import CheckedEnv
from race.errors import EnvFailedError, HandedOverError, RenderError, TaskError
from race.types import LARGEST, DiscreteSpec, DiscreteTask, EnvSpec, Observation, Task

NAN, INF = float("nan"), float("inf")
STATE = np.array([0.5, -1.0, 2.0])
SEEN = {"obs": np.ones((2, 1)), "state": np.ones(2), "avail_actions": np.ones((2, 3))}
SPEC = DiscreteSpec("mine", 2, 1, 2, 3, 5)


class Answers(gymnasium.Env[Any, Any]):
    """Answers what it was told to."""

    def __init__(self, reset: Any = (STATE, {}), step: Any = None, space: Any = None) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)
        self.action_space = space or gymnasium.spaces.Box(-1, 1, (2,), np.float32)
        self.answers = (reset, (STATE, 1.0, False, False, {}) if step is None else step)
        self.seeds: list[Any] = []
        self.actions: list[Any] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.seeds.append(seed)
        return self.answers[0]

    def step(self, action: Any) -> Any:
        self.actions.append(action.copy())
        action[:] = 99  # its own, to write to
        return self.answers[1]

    def render(self) -> Any:
        return self.answers[1]


def continuous(env: Any) -> Task:
    spec = EnvSpec("mine", 3, ((0,), (1, 2)), ((0,), (1,)), (-1.0,) * 2, (1.0,) * 2, 5)
    return Task(spec, lambda mode: env)


def discrete(env: Any, has_wins: bool = False) -> DiscreteTask:
    return DiscreteTask(DiscreteSpec("mine", 2, 1, 2, 3, 5, has_wins), lambda mode: env)


def answer_of(step: Any = None, reset: Any = (STATE, {})) -> Any:
    env = CheckedEnv(continuous(Answers(reset, step)))
    env.reset(7)
    return env.step(np.zeros(2, np.float32))


@pytest.mark.parametrize(
    ("observation", "expected"),
    [
        (STATE, STATE),
        (STATE.astype(np.float32), STATE),
        ([1, 2, 3], [1, 2, 3]),
        (np.array([1, 0, 1], np.uint8), [1, 0, 1]),
        (np.array([True, False, True]), [1, 0, 1]),
        (STATE[None], STATE),  # as vectorised simulators give
        (STATE[None, None], STATE),
        (np.array([LARGEST, -LARGEST, 0]), [LARGEST, -LARGEST, 0]),
        (np.full(3, 9e14), [9e14] * 3),  # the norm alone is larger than an entry may be
    ],
)
def test_observations_that_are_plainly_meant(observation: Any, expected: Any) -> None:
    found = answer_of((observation, 1.0, False, False, {})).seen
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.array(expected, np.float32))


@pytest.mark.parametrize(
    ("observation", "told"),
    [
        (None, "is NoneType|is None"),
        (0.5, r"has shape \(\), but the task says \(3,\)"),
        (np.zeros(1), r"has shape \(1,\)"),
        (np.zeros(4), r"has shape \(4,\)"),
        (STATE[:, None], r"has shape \(3, 1\)"),
        (np.zeros((3, 3)), r"has shape \(3, 3\)"),
        ("abc", "str 'abc'"),
        (np.zeros(3) + 1j, "type complex128"),
        (np.array([None] * 3), "type object"),
        ([[1], [2, 3], 4], "is no array of shape"),
        ({"left": STATE}, "FlattenObservation"),
        (np.array([0, NAN, 0]), "entry 1 of the observation is nan"),
        (np.array([0, 0, -INF]), "entry 2 of the observation is -inf"),
        (np.array([0, 0, 1e300]), r"entry 2 .* is 1e\+300.*scale it"),
        (np.float32([2e15, 0, 0]), "entry 0 .*scale it"),
    ],
)
def test_observations_that_are_refused_in_reset_and_step(observation: Any, told: str) -> None:
    where = r"mine broke the contract at step 1 of the episode of seed 7 \(environment 0\): "
    with pytest.raises(HandedOverError, match=f"{where}.*{told}.*Answers.step: .*line"):
        answer_of((observation, 1.0, False, False, {}))
    with pytest.raises(HandedOverError, match=f"in the reset .*{told}.*Answers.reset: .*line"):
        answer_of(reset=(observation, {}))


@pytest.mark.parametrize(
    "answer", [STATE, STATE[:2], None, (STATE,), (STATE, None), (STATE, STATE), (STATE, {}, {})]
)
def test_reset_must_return_a_pair(answer: Any) -> None:
    with pytest.raises(HandedOverError, match=r"reset returned .*return observation, \{\}"):
        answer_of(reset=answer)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        ((STATE, 1.0, False, {}), "a tuple of 4.*a time limit is truncated"),
        ((STATE, 1.0, False, False, None), "a tuple of 5"),
        (STATE, "an array of shape"),
        (5, "int 5"),
    ],
)
def test_step_must_return_five(answer: Any, told: str) -> None:
    with pytest.raises(HandedOverError, match=rf"step returned {told}"):
        answer_of(answer)


YES: list[Any] = [True, np.True_, 1, 1.0, np.int8(1), np.array(True), np.array([[1]]), [True]]
NEITHER: list[Any] = [
    *(None, "False", "", 2, -1, 0.5, NAN, [False, True], [], {}),
    *({"agent_0": True}, np.array([True, False]), np.zeros(0), object()),
]


def test_truths() -> None:
    for yes in YES:
        assert contract.truth(yes, "x") is True
    for no in (False, np.False_, 0, 0.0, np.array(0), np.array([False]), [0]):
        assert contract.truth(no, "x") is False
    for neither in NEITHER:
        for place, name in ((2, "terminated"), (3, "truncated")):
            answer = [STATE, 1.0, False, False, {}]
            answer[place] = neither
            with pytest.raises(HandedOverError, match=f"{name} is .* for the whole team"):
                answer_of(tuple(answer))


@pytest.mark.parametrize(
    ("reward", "worth"), [(1, 1.0), (np.float32(0.5), 0.5), (np.array([2.0]), 2.0), (True, 1.0)]
)
def test_rewards_that_are_plainly_meant(reward: Any, worth: float) -> None:
    found = answer_of((STATE, reward, False, False, {})).reward
    assert type(found) is float
    assert found == worth


@pytest.mark.parametrize(
    ("reward", "told"),
    [
        (None, "None"),
        ("1.5", "str '1.5'"),
        (1j, "complex 1j"),
        ([1.0, 2.0], r"a list of 2 \(1.0, 2.0\).*Add up"),
        ({"agent_0": 1.0}, "a dictionary"),
        (NAN, "nan. That is no number"),
        (-INF, "-inf. That is not finite"),
        (1e30, r"1e\+30. .*scale it to about 1"),
        (10**400, "int 1000"),
    ],
)
def test_rewards_that_are_refused(reward: Any, told: str) -> None:
    with pytest.raises(HandedOverError, match=f"the reward is {told}"):
        answer_of((STATE, reward, False, False, {}))


@given(arrays(np.float64, 3, elements=st.floats(width=64)))
def test_no_state_passes_that_networks_cannot_take(state: Any) -> None:
    good = bool((np.abs(state) <= LARGEST).all())
    try:
        found = contract.numbers(state, (3,), "it")
    except HandedOverError:
        assert not good
    else:
        assert good
        np.testing.assert_array_equal(found, state.astype(np.float32))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({}, None),
        ({"avail_actions": np.ones((2, 3), bool)}, None),
        ({"avail_actions": [[1, 0, 1], [0, 0, 1]]}, None),
        ({"avail_actions": np.array([[1.0, 0, -1], [1, 1, 1]])}, "the entry -1.0"),
        ({"avail_actions": np.array([[1.0, 0.2, 1], [1, 1, 1]])}, "the entry 0.2"),
        ({"avail_actions": np.array([[1.0, NAN, 1], [1, 1, 1]])}, "the entry nan"),
        ({"avail_actions": np.array([[0, 0, 0], [1, 1, 1]])}, "no action is available to agent 0"),
        ({"avail_actions": np.ones(3)}, r"has shape \(3,\)"),
        ({"obs": np.ones((2, 2))}, r"obs has shape \(2, 2\)"),
        ({"obs": np.array([[0.0], [INF]])}, r"entry \(1, 0\) of obs is inf"),
        ({"state": np.array([0.0, NAN])}, "entry 1 of state is nan"),
        ({"state": None}, "state is "),
    ],
)
def test_moments(change: dict[str, Any], told: str | None) -> None:
    env = CheckedEnv(discrete(Answers((SEEN | change, {}))))
    if told is None:
        seen = env.reset(0)
        assert isinstance(seen, Observation)
        assert (seen.obs.dtype, seen.avail_actions.dtype) == (np.float32, np.bool_)
        return
    with pytest.raises(HandedOverError, match=told):
        env.reset(0)


def test_wins_are_truths_too() -> None:
    for won, has_wins, expected in ((True, True, True), (1, True, True), (True, False, False)):
        step = (SEEN, 0.0, True, False, {"battle_won": won})
        env = CheckedEnv(discrete(Answers((SEEN, {}), step), has_wins))
        env.reset(0)
        assert env.step(np.zeros(2, np.int32)).won is expected
    env = CheckedEnv(discrete(Answers((SEEN, {}), (*step[:4], {"battle_won": "lost"})), True))
    env.reset(0)
    with pytest.raises(HandedOverError, match=r"battle_won.* is str 'lost'"):
        env.step(np.zeros(2, np.int32))


# What environments are handed.


def test_actions_are_copies_in_the_type_and_bounds_of_the_space() -> None:
    space = gymnasium.spaces.Box(-0.1, 0.1, (2,), np.float64)
    env = Answers(space=space)
    task = factorised(
        lambda mode: env, obs_index=[(0,), (1,)], action_index=[(0,), (1,)], task="a",
        episode_limit=3,
    )  # fmt: skip
    checked = CheckedEnv(task)
    checked.reset(0)
    low, high = (np.array(b, np.float32) for b in (task.spec.action_low, task.spec.action_high))
    chosen = contract.in_units(np.array([1.0, -1.0], np.float32), low, high)
    checked.step(chosen)
    (given,) = env.actions
    assert space.contains(given)
    assert given.tolist() == [0.1, -0.1]
    assert not space.contains(chosen.astype(np.float64))  # as it would be without care
    assert (np.abs(chosen) < 1).all()  # what was chosen is still there


def test_discrete_actions_are_copies() -> None:
    env = Answers((SEEN, {}), (SEEN, 0.0, False, False, {}))
    checked = CheckedEnv(discrete(env))
    checked.reset(0)
    chosen = np.array([2, 1], np.int32)
    chosen.flags.writeable = False  # as arrays of JAX are
    checked.step(chosen)
    assert env.actions[0].tolist() == chosen.tolist() == [2, 1]


@pytest.mark.parametrize("dtype", [np.int64, np.uint8])
def test_spaces_of_whole_numbers_are_refused(dtype: Any) -> None:
    space = gymnasium.spaces.Box(0, 9, (2,), dtype)
    with pytest.raises(TaskError, match=r"of whole numbers .*round in step"):
        factorised(
            lambda mode: Answers(space=space), obs_index=[(0,), (1,)],
            action_index=[(0,), (1,)], task="whole", episode_limit=3,
        )  # fmt: skip
    with pytest.raises(HandedOverError, match=r"of whole numbers .*round in step"):
        CheckedEnv(continuous(Answers(space=space)))


# Failures.


class Fails(Answers):
    def __init__(self, method: str, error: BaseException | None) -> None:
        super().__init__()
        self.method, self.error = method, error

    def _perhaps(self, method: str) -> None:
        if method == self.method:
            if self.error is None:
                sys.exit()
            raise self.error

    def reset(self, **options: Any) -> Any:
        self._perhaps("reset")
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        self._perhaps("step")
        return super().step(action)

    def render(self) -> Any:
        self._perhaps("render")

    def close(self) -> None:
        self._perhaps("close")


class StrangeError(BaseException):
    def __str__(self) -> str:
        raise ValueError


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (None, r"it called sys.exit\(\)"),
        (SystemExit(0), r"it called sys.exit\(0\)"),
        (SystemExit("bye"), r"it called sys.exit\('bye'\)"),
        (RuntimeError(), "RuntimeError, in"),
        (RuntimeError("one\ntwo\n\nthree"), "RuntimeError: one two three"),
        (OSError(28, "No space left"), r"OSError: \[Errno 28\] No space left"),
        (BrokenPipeError("lost"), "BrokenPipeError: lost"),
        (MemoryError(), "MemoryError, in"),
        (StopIteration(), "StopIteration, in"),
        (RuntimeError("x" * 5000), r"x{600} \.\.\."),
        (StrangeError(), "StrangeError: .its text cannot be shown"),
    ],
)
@pytest.mark.parametrize("method", ["reset", "step", "close"])
def test_failures_name_the_line_in_the_users_file(
    error: BaseException | None, told: str, method: str
) -> None:
    def play() -> None:
        env = CheckedEnv(continuous(Fails(method, error)), number=3)
        env.reset(7)
        env.step(np.zeros(2, np.float32))
        env.close()

    with pytest.raises(EnvFailedError, match=f"{told}.*test_contract.py, line ") as raised:
        play()
    place = {"reset": "in the reset of", "step": "at step 1 of", "close": "when it was closed"}
    assert place[method] in str(raised.value)
    assert "\n" not in str(raised.value)


def test_ctrl_c_is_nobodys_failure() -> None:
    with pytest.raises(KeyboardInterrupt):
        CheckedEnv(continuous(Fails("reset", KeyboardInterrupt()))).reset(0)


def test_what_is_made_must_be_an_environment() -> None:
    with pytest.raises(HandedOverError, match="make function returned None instead"):
        CheckedEnv(continuous(None))
    with pytest.raises(EnvFailedError, match="failed when it was made: ZeroDivisionError"):
        CheckedEnv(continuous(None)._replace(make=lambda mode: 1 / 0))  # type: ignore[arg-type, return-value]


def test_environments_without_a_place_for_a_seed_are_reset_without() -> None:
    class Old(Answers):
        def reset(self) -> Any:  # type: ignore[override]
            return super().reset()

    for kind, takes in ((Old, False), (Answers, True)):
        made = kind()
        env = CheckedEnv(continuous(made))
        env.reset(5)
        assert env.takes_seed is takes
        assert made.seeds == [5 if takes else None]
        task = factorised(
            lambda mode, made=made: made, obs_index=[(0,), (1,)],
            action_index=[(0,), (1,)], task="old", episode_limit=3,
        )  # fmt: skip
        assert task.seeded is takes


@pytest.mark.parametrize(
    ("picture", "told"),
    [
        ([[1, 2], [3]], "a list of 2"),
        (np.zeros((4, 4, 3)), "type float64"),
        (np.zeros((4, 4), np.uint8), r"shape \(4, 4\)"),
        (np.zeros((4, 4, 5), np.uint8), r"shape \(4, 4, 5\)"),
        ("picture", "str"),
    ],
)
def test_pictures_must_be_pictures(picture: Any, told: str) -> None:
    env = CheckedEnv(continuous(Answers(step=picture)))
    with pytest.raises(RenderError, match=f"{told}.*uint8"):
        env.render()


def test_pictures_may_have_an_alpha_channel() -> None:
    env = CheckedEnv(continuous(Answers(step=np.full((4, 5, 4), 7, np.uint8))))
    assert env.render().shape == (4, 5, 3)


# What users write down of a task.


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("episode_limit", 20.0, "must be a whole number of at least 1: write 20"),
        ("episode_limit", 20.5, "whole number"),
        ("episode_limit", 0, "at least 1"),
        ("episode_limit", "20", "whole number"),
        ("episode_limit", True, "whole number"),
        ("episode_limit", NAN, "whole number"),
        ("state_size", None, "whole number"),
        ("obs_index", [(0.7, 1.9), (1,)], "an entry of obs_index is 0.7"),
        ("obs_index", [(0, -1), (1,)], "an entry of obs_index is -1"),
        ("obs_index", [0, 1], "entries of each agent"),
        ("obs_index", ["ab", "c"], "an entry of obs_index is 'a'"),
        ("obs_index", [(0, 9), (1,)], "outside the state"),
        ("action_index", [(0,), (0, 1)], "exactly one agent"),
        ("action_index", [(0, 1), ()], "at least one"),
        ("action_low", (-INF, 0.0), "no larger than"),
        ("action_high", (1.0, 3e38), "no larger than"),
        ("action_high", (1.0, -1.0), "low below high"),
        ("action_high", (-1.0 + 1e-12, 1.0), "in 32 bits too"),
        ("task", None, "must be a text"),
        ("task", "", "must be a text"),
    ],
)
def test_descriptions_that_do_not_fit(field: str, value: Any, told: str) -> None:
    fields: dict[str, Any] = {
        "task": "mine",
        "state_size": 3,
        "obs_index": [(0,), (1, 2)],
        "action_index": [(0,), (1,)],
        "action_low": (-1.0, -1.0),
        "action_high": (1.0, 1.0),
        "episode_limit": 5,
    }
    assert EnvSpec(**fields).obs_index == ((0,), (1, 2))
    with pytest.raises(TaskError, match=told):
        EnvSpec(**(fields | {field: value}))


@pytest.mark.parametrize("value", [None, 0, -1, 1e3, 2.5, "3", True, (3,)])
@pytest.mark.parametrize("field", ["n_agents", "obs_size", "n_actions", "episode_limit"])
def test_discrete_descriptions_that_do_not_fit(field: str, value: Any) -> None:
    fields = {"n_agents": 2, "obs_size": 1, "state_size": 2, "n_actions": 3, "episode_limit": 5}
    with pytest.raises(TaskError, match=f"{field} is .* whole number of at least 1"):
        DiscreteSpec("mine", **(fields | {field: value}))


def test_whole_numbers_of_numpy_become_pythons() -> None:
    spec = DiscreteSpec("mine", np.int64(2), 1, 2, np.uint8(3), 5, np.bool_(True))
    assert {type(spec.n_agents), type(spec.n_actions)} == {int}
    assert spec.has_wins is True
    assert hash(spec) == hash(DiscreteSpec("mine", 2, 1, 2, 3, 5, True))


def test_factorised_takes_numpys_limit_and_says_what_make_did() -> None:
    make = functools.partial(
        factorised, obs_index=[(0,), (1,)], action_index=[(0,), (1,)], task="mine"
    )
    limit = make(lambda mode: Answers(), episode_limit=np.int64(20)).spec.episode_limit
    assert (limit, type(limit)) == (20, int)
    with pytest.raises(TaskError, match=r"make\(None\) returned None instead of"):
        make(lambda mode: None, episode_limit=3)
    with pytest.raises(TaskError, match=r"make\(None\) failed: it called sys.exit\('bye'\)"):
        make(lambda mode: sys.exit("bye"), episode_limit=3)

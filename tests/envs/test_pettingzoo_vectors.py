"""Spaces of PettingZoo's agents as vectors and numbers, against gymnasium's own flattening."""

import itertools
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from race.envs.pettingzoo.vectors import Choices, Reach, Sight, moves
from race.errors import HandedOverError

FLOATS = spaces.Box(-1, np.array([[1, 2], [3, 4]], np.float32), (2, 2))
MIXED = spaces.Dict(
    {
        "velocity": FLOATS,
        "around": spaces.Tuple([spaces.Discrete(3, start=2), spaces.MultiBinary(2)]),
        "kinds": spaces.MultiDiscrete([2, 3]),
    }
)


@pytest.mark.parametrize("space", [FLOATS, MIXED, spaces.Discrete(4), spaces.MultiBinary([2, 2])])
def test_observations_are_flattened_as_gymnasium_does(space: Any) -> None:
    space.seed(0)
    sight = Sight(space, "it")
    assert sight.size == gymnasium.spaces.flatdim(space) == len(sight.names())
    for _ in range(20):
        seen = space.sample()
        np.testing.assert_array_equal(
            sight(seen), np.asarray(gymnasium.spaces.flatten(space, seen), np.float32)
        )
        np.testing.assert_array_equal(sight.quick(seen), sight(seen))


def test_names_of_entries_are_in_the_order_of_the_vector() -> None:
    # gymnasium sorts a dictionary's keys.
    assert Sight(MIXED, "it").names() == [
        *("around.0[is 2]", "around.0[is 3]", "around.0[is 4]", "around.1[0]", "around.1[1]"),
        *(f"kinds[{number}]" for number in range(5)),
        *("velocity[0,0]", "velocity[0,1]", "velocity[1,0]", "velocity[1,1]"),
    ]
    sight = Sight(spaces.Dict({"a": FLOATS, "b": spaces.Discrete(2)}), "it")
    seen = sight({"a": np.array([[0, 2], [0, 0]], np.float32), "b": 1})
    assert [n for n, v in zip(sight.names(), seen, strict=True) if v] == ["a[0,1]", "b[is 1]"]


def test_images_are_from_0_to_1() -> None:
    image = spaces.Box(0, 255, (2, 3), np.uint8)
    seen = np.array([[0, 51, 255], [1, 2, 3]], np.uint8)
    np.testing.assert_allclose(Sight(image, "it")(seen), seen.ravel() / 255, rtol=1e-6)
    np.testing.assert_allclose(Sight(image, "it").quick(seen), seen.ravel() / 255, rtol=1e-6)
    few = Sight(spaces.Box(0, 4, (2,), np.uint8), "it")
    np.testing.assert_array_equal(few(np.array([1, 4], np.uint8)), [0.25, 1])


def test_what_is_quick_is_shared_and_what_is_called_is_not() -> None:
    sight = Sight(spaces.Box(-1, 1, (2,)), "it")
    seen = np.array([0.5, np.nan], np.float32)
    assert sight.quick(seen).base is seen
    with pytest.raises(HandedOverError, match="entry 1 of it is nan"):
        sight(seen)
    with pytest.raises(HandedOverError, match="entry 1 of it is nan"):  # 64 bits are looked at
        sight.quick(seen.astype(np.float64))


@pytest.mark.parametrize(
    ("space", "value", "message"),
    [
        (MIXED, {"velocity": np.zeros((2, 2))}, "has no around.0, which the observation space has"),
        (MIXED, np.zeros(3), "has no around.0"),
        (spaces.Discrete(3), -1, r"it is int -1, but must be of Discrete\(3\)"),
        (spaces.Discrete(3), None, "it is None, but must be of"),
        (spaces.MultiBinary(2), np.array([0, 2]), "must be of MultiBinary"),
        (FLOATS, np.zeros(4), r"it has shape \(4,\), but the task says \(2, 2\)"),
    ],
)
def test_observations_that_are_none(space: Any, value: Any, message: str) -> None:
    with pytest.raises(HandedOverError, match=message):
        Sight(space, "it")(value)


def test_actions_of_several_boxes() -> None:
    space = spaces.Dict({"b": spaces.Box(-1, 1, (2,)), "a": spaces.Box(0, 3, (), np.float64)})
    reach = moves(space, "it")
    assert isinstance(reach, Reach)
    assert (reach.low.tolist(), reach.high.tolist()) == ([0, -1, -1], [3, 1, 1])
    assert not reach.exact
    action = reach.action(np.array([2.5, -1, 1]))
    assert space.contains(action)
    assert float(action["a"]) == 2.5
    assert action["b"].tolist() == [-1, 1]
    assert isinstance(moves(spaces.Box(-1, 1, (2,)), "it"), Reach)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(5, start=-2),
        spaces.MultiDiscrete([2, 3], start=[1, 0]),
        spaces.MultiDiscrete([[2, 2], [1, 3]]),
        spaces.MultiBinary(3),
        spaces.Tuple([spaces.Discrete(2), spaces.MultiBinary(1)]),
        spaces.Dict({"say": spaces.Discrete(3), "go": spaces.MultiDiscrete([2, 2])}),
    ],
)
def test_joint_choices_are_all_actions_once(space: Any) -> None:
    choices = moves(space, "it")
    assert isinstance(choices, Choices)

    def flat(action: Any) -> bytes:
        return np.asarray(gymnasium.spaces.flatten(space, action), np.float64).tobytes()

    actions = [choices.action(number) for number in range(choices.count)]
    assert all(space.contains(action) for action in actions)
    assert len(set(choices.names())) == choices.count
    space.seed(0)
    sampled = {flat(space.sample()) for _ in range(60 * choices.count)}
    assert sampled == {flat(action) for action in actions}


def test_masks_of_parts_make_masks_of_joint_choices() -> None:
    space = spaces.MultiDiscrete([2, 3])
    choices = Choices(space, "it")
    for bits in itertools.product([0, 1], repeat=5):
        parts = (np.array(bits[:2], np.int8), np.array(bits[2:], np.int8))
        if not (any(bits[:2]) and any(bits[2:])):
            for nothing in (parts, np.array(bits)):
                with pytest.raises(HandedOverError, match="leaves no action"):
                    choices.available(nothing)
            continue
        found = choices.available(parts)
        np.testing.assert_array_equal(found, choices.available(np.array(bits)))
        allowed = {tuple(choices.action(n).tolist()) for n in np.flatnonzero(found).tolist()}
        assert allowed == {(a, b) for a in range(2) for b in range(3) if bits[a] and bits[2 + b]}

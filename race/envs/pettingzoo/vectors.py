"""What one agent of a PettingZoo environment sees and does, as vectors and numbers.

Observations are flattened in the order of `gymnasium.spaces.flatten`. Actions are vectors, where
all parts of the space are boxes of floats, or one of a number of joint choices, where all parts are
discrete.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple, final

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float32, Int
from numpy.typing import NDArray

from race.envs import contract
from race.errors import HandedOverError, TaskError

MASK: Final = "action_mask"
"""What PettingZoo calls the mask of available actions, in observations and infos."""
MOST_CHOICES: Final = 1024
"""Most joint choices of one agent: policies have an output for each."""


class Leaf(NamedTuple):
    """A part of a space that is no Dict or Tuple. ``path`` leads there."""

    path: tuple[Any, ...]
    space: Any


def leaves(space: Any, path: tuple[Any, ...] = ()) -> Iterator[Leaf]:
    """The parts of a space, in the order of `gymnasium.spaces.flatten`."""
    if isinstance(space, spaces.Dict):
        for name, inner in space.spaces.items():
            yield from leaves(inner, (*path, name))
    elif isinstance(space, spaces.Tuple):
        for number, inner in enumerate(space.spaces):
            yield from leaves(inner, (*path, number))
    else:
        yield Leaf(path, space)


def named(path: tuple[Any, ...]) -> str:
    """A path in words, such as ``camera.left``; empty for the whole."""
    return ".".join(map(str, path))


@final
class Sight:
    """How an observation becomes a vector.

    Boxes of bytes are divided by their highest values, so that images are from 0 to 1.

    Attributes:
        size: entries of the vector.
        has_mask: whether the observation holds a mask of actions beside what is seen.
    """

    def __init__(self, space: Any, whose: str, *, masked: bool = False) -> None:
        """Looks at a space.

        Args:
            space: the observation space.
            whose: what it is, for messages, such as ``the observation of walker_0``.
            masked: whether an entry `MASK` of a dictionary is the mask of actions and not seen.

        Raises:
            TaskError: if the space has no fixed number of entries.
        """
        self._whose = whose
        self.has_mask = masked and isinstance(space, spaces.Dict) and MASK in space.spaces
        self._leaves = [
            leaf for leaf in leaves(space) if not (self.has_mask and leaf.path[0] == MASK)
        ]
        for leaf in self._leaves:
            if not leaf.space.is_np_flattenable:
                raise TaskError(
                    f"{_capital(whose)} has a part {leaf.space}, which is no array of a fixed "
                    "size. Let the environment show boxes, numbers or dictionaries of them."
                )
        self._sizes = [spaces.flatdim(leaf.space) for leaf in self._leaves]
        self._scales = [_scale(leaf.space) for leaf in self._leaves]
        self.size = sum(self._sizes)
        plain = len(self._leaves) == 1 and not self._leaves[0].path and self._scales[0] is None
        self._plain = self._leaves[0].space.shape if plain else None

    def quick(self, observation: Any) -> Float32[np.ndarray, "O"]:
        """As a call, but unchecked where it is already an array of the right kind.

        Such an array may be the environment's own memory, and nobody has looked whether its numbers
        are finite.
        """
        if (
            type(observation) is np.ndarray
            and observation.shape == self._plain
            and observation.dtype == np.float32
        ):
            return observation.ravel()
        return self(observation)

    def __call__(self, observation: Any) -> Float32[np.ndarray, "O"]:
        """The vector of an observation, a copy.

        Raises:
            HandedOverError: if it is not of the space, up to the bounds of boxes.
        """
        parts = []
        for leaf, scale in zip(self._leaves, self._scales, strict=True):
            part = self._part(leaf, observation)
            parts.append(part if scale is None else part * scale)
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def names(self) -> list[str]:
        """What each entry is, such as ``position[0]``; an index alone in a plain box."""
        found = []
        for leaf, size in zip(self._leaves, self._sizes, strict=True):
            name = named(leaf.path)
            if isinstance(leaf.space, spaces.Box):
                inner = [",".join(map(str, place)) for place in np.ndindex(leaf.space.shape)]
            elif isinstance(leaf.space, spaces.Discrete):
                start = int(leaf.space.start)
                inner = [f"is {value}" for value in range(start, start + size)]
            else:
                inner = [str(number) for number in range(size)]
            found += [f"{name}[{entry}]" for entry in inner]
        return found

    def _part(self, leaf: Leaf, observation: Any) -> Float32[np.ndarray, "O"]:
        whose = f"{named(leaf.path)} of {self._whose}" if leaf.path else self._whose
        value = observation
        for step in leaf.path:
            try:
                value = value[step]
            except (KeyError, IndexError, TypeError) as error:
                raise HandedOverError(
                    f"{self._whose} is {contract.came(observation)} and has no {named(leaf.path)}, "
                    "which the observation space has"
                ) from error
        if isinstance(leaf.space, spaces.Box):
            return contract.numbers(value, leaf.space.shape, whose).ravel()
        try:
            fits = leaf.space.contains(value)
        except Exception:  # whatever it is, it is not of the space
            fits = False
        if not fits:
            raise HandedOverError(f"{whose} is {contract.came(value)}, but must be of {leaf.space}")
        flat: NDArray[Any] = spaces.flatten(leaf.space, value)  # type: ignore[assignment]
        return flat.astype(np.float32)


def _scale(space: Any) -> NDArray[np.float32] | None:
    if isinstance(space, spaces.Box) and space.dtype == np.uint8:
        return np.float32(1) / np.maximum(space.high, 1).astype(np.float32).ravel()
    return None


@final
class Reach:
    """What a continuous agent does: a vector within bounds.

    Attributes:
        low: lowest values [A], in float64.
        high: highest values.
        exact: whether float32 holds all that the space does.
    """

    def __init__(self, space: Any, whose: str) -> None:
        """Looks at a space whose parts are all boxes.

        Raises:
            TaskError: if a box has no finite bounds or is of whole numbers.
        """
        self._space = space
        boxes = [leaf.space for leaf in leaves(space)]
        for box in boxes:
            try:
                contract.refuse_whole(box)
            except HandedOverError as error:
                raise TaskError(f"{_capital(whose)}: {error}.") from error
            if not (np.isfinite(box.low).all() and np.isfinite(box.high).all()):
                raise TaskError(
                    f"{_capital(whose)} is {box}, which has no finite bounds. Give each entry a "
                    "lowest and a highest value."
                )
        self.low = np.concatenate([box.low.ravel().astype(np.float64) for box in boxes])
        self.high = np.concatenate([box.high.ravel().astype(np.float64) for box in boxes])
        self.exact = all(np.dtype(box.dtype).itemsize <= 4 for box in boxes)

    def action(self, units: NDArray[Any]) -> Any:
        """The action of a vector [A] within the bounds."""
        if isinstance(self._space, spaces.Box):
            return units.astype(self._space.dtype).reshape(self._space.shape)
        return spaces.unflatten(self._space, units)


@final
class Choices:
    """What a discrete agent does: one of all combinations of what its parts may do.

    Attributes:
        count: number of joint choices; the last part changes fastest.
    """

    def __init__(self, space: Any, whose: str) -> None:
        """Looks at a space whose parts are all discrete.

        Raises:
            TaskError: if there are more than `MOST_CHOICES`.
        """
        self._space, self._whose = space, whose
        self._counts = [count for leaf in leaves(space) for count in _counts(leaf.space)]
        self.count = math.prod(self._counts)
        if self.count > MOST_CHOICES:
            raise TaskError(
                f"{_capital(whose)} is {space}: {self.count:,} joint choices, and at most "
                f"{MOST_CHOICES:,} are learned. Offer fewer, or let several agents share them."
            )
        digits = np.unravel_index(np.arange(self.count), self._counts)
        self._digits: Int[np.ndarray, "A D"] = np.stack(digits, axis=1)

    def action(self, choice: int) -> Any:
        """The action of a choice from 0 to `count` - 1."""
        if isinstance(self._space, spaces.Discrete):
            return int(self._space.start) + choice
        return _built(self._space, iter(self._digits[choice].tolist()))

    def names(self) -> list[str]:
        """What each choice is, as the environment is handed it."""
        return [_said(self.action(choice)) for choice in range(self.count)]

    def available(self, mask: Any) -> Bool[np.ndarray, "A"]:
        """Which choices a mask leaves.

        Args:
            mask: an entry for each action. Where several parts act at once, an array for each of
                them, as `gymnasium.spaces.MultiDiscrete` has it, or all of these in one.

        Raises:
            HandedOverError: for another mask, and for one that leaves nothing.
        """
        whose = f"the {MASK} with {self._whose}"
        found = self._available(mask, whose)
        if not found.any():
            raise HandedOverError(f"{whose} leaves no action. {contract.NEVER_IDLE}")
        return found

    def _available(self, mask: Any, whose: str) -> Bool[np.ndarray, "A"]:
        if len(self._counts) == 1:
            return contract.mask(mask, (self.count,), whose)
        if isinstance(mask, tuple | list) and len(mask) == len(self._counts):
            parts = [
                contract.mask(part, (count,), f"part {number} of {whose}")
                for number, (part, count) in enumerate(zip(mask, self._counts, strict=True))
            ]
        else:
            flat = contract.mask(mask, (sum(self._counts),), whose)
            parts = np.split(flat, np.cumsum(self._counts)[:-1])
        columns = [part[self._digits[:, number]] for number, part in enumerate(parts)]
        found: NDArray[np.bool_] = np.all(columns, axis=0)
        return found


def moves(space: Any, whose: str) -> Reach | Choices:
    """How an agent acts.

    Args:
        space: its action space.
        whose: what that is, for messages.

    Raises:
        TaskError: if policies cannot act so.
    """
    if is_continuous(space):
        return Reach(space, whose)
    found = [leaf.space for leaf in leaves(space)]
    discrete = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
    if found and all(isinstance(part, discrete) for part in found):
        return Choices(space, whose)
    raise TaskError(
        f"{_capital(whose)} is {space}. Policies choose either numbers within bounds (a Box, or "
        "several in a Dict or Tuple) or one of some choices (Discrete, MultiDiscrete, MultiBinary, "
        "or several of them), and nothing else."
    )


def is_continuous(space: Any) -> bool:
    """Whether all parts of an action space are boxes."""
    found = list(leaves(space))
    return bool(found) and all(isinstance(leaf.space, spaces.Box) for leaf in found)


def _counts(space: Any) -> list[int]:
    if isinstance(space, spaces.Discrete):
        return [int(space.n)]
    if isinstance(space, spaces.MultiDiscrete):
        return [int(count) for count in space.nvec.ravel()]
    return [2] * math.prod(space.shape)


def _built(space: Any, digits: Iterator[int]) -> Any:
    """An action out of what each part does, counted from 0."""
    if isinstance(space, spaces.Dict):
        return {name: _built(inner, digits) for name, inner in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_built(inner, digits) for inner in space.spaces)
    if isinstance(space, spaces.Discrete):
        return int(space.start) + next(digits)
    chosen = np.array([next(digits) for _ in _counts(space)], space.dtype).reshape(space.shape)
    if isinstance(space, spaces.MultiDiscrete):
        return (chosen + space.start).astype(space.dtype)
    return chosen


def _said(action: Any) -> str:
    if isinstance(action, Mapping):
        return ", ".join(f"{name} {_said(part)}" for name, part in action.items())
    if isinstance(action, np.ndarray):
        return "(" + ", ".join(map(str, action.ravel().tolist())) + ")"
    if isinstance(action, tuple):
        return "(" + ", ".join(map(_said, action)) + ")"
    return str(action)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]

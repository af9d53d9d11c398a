"""What an environment may hand over, and what it is handed: the one place that decides.

Continuous and discrete tasks, in this process and in workers, in training, tests, evaluation and
videos, all go through these checks (`race.envs.checked` calls them). Nothing is guessed: what is
not plainly meant is refused with a `HandedOverError` whose text begins with what was wrong.
"""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple, final

import gymnasium
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy.typing import NDArray

from race.errors import HandedOverError
from race.types import LARGEST, DiscreteSpec, EnvSpec, Observation

Seen = Float32[np.ndarray, "S"] | Observation
"""What an environment shows: the state, or a moment of a task with discrete actions."""

NEVER_IDLE: Final = (
    "Give every agent one that does nothing, also when it is dead and after the last step"
)
_NUMBERS: Final = "buif"  # kinds of numpy's types that are real numbers


class Step(NamedTuple):
    """What a step of an environment brought."""

    seen: Any  # a `Seen`
    reward: float
    terminated: bool
    truncated: bool
    won: bool


def observation_of(answer: Any) -> Any:
    """The observation out of what ``reset`` returned.

    Raises:
        HandedOverError: if that is not a pair (observation, info).
    """
    match answer:
        case (observation, Mapping()) if isinstance(answer, tuple | list):
            return observation
    raise HandedOverError(
        f"reset returned {came(answer)} instead of the pair (observation, info). Let it end with "
        "`return observation, {}`"
    )


def parts_of(answer: Any) -> tuple[Any, Any, Any, Any, Mapping[str, Any]]:
    """Observation, reward, terminated, truncated and info out of what ``step`` returned.

    Raises:
        HandedOverError: if these are not five.
    """
    if isinstance(answer, tuple | list) and len(answer) == 5 and isinstance(answer[4], Mapping):
        observation, reward, terminated, truncated, info = answer
        return observation, reward, terminated, truncated, info
    advice = "Let it return five values: observation, reward, terminated, truncated, info"
    if isinstance(answer, tuple | list) and len(answer) == 4:
        advice += ", where a time limit is truncated and any other end is terminated"
    raise HandedOverError(f"step returned {came(answer)}. {advice}")


def numbers(value: Any, shape: tuple[int, ...], name: str) -> NDArray[np.float32]:
    """An array of that shape as float32, a copy. Axes of length one before it are dropped.

    Args:
        value: what came.
        shape: what it must be.
        name: what it is, for the message.

    Raises:
        HandedOverError: if it is no array of real numbers, has another shape, or an entry that is
            not finite or larger than `LARGEST`.
    """
    array = _array(value, shape, name)
    # The plain reduction takes half as long as `max`, and this is done at every step.
    if not np.maximum.reduce(np.abs(array.ravel()), initial=0.0) <= LARGEST:
        for place in np.argwhere(~(np.abs(array) <= LARGEST)).tolist():
            entry = float(array[tuple(place)])
            where = place[0] if len(place) == 1 else tuple(place)
            raise HandedOverError(f"entry {where} of {name} is {entry}. {_too_large(entry)}")
    return array.astype(np.float32)


def mask(value: Any, shape: tuple[int, ...], name: str) -> NDArray[np.bool_]:
    """An array of that shape that says yes or no.

    Raises:
        HandedOverError: if it is something else than bools, zeros and ones.
    """
    if isinstance(value, np.ndarray) and value.dtype == np.bool_ and value.shape == shape:
        return value.copy()
    array = _array(value, shape, name)
    if not ((array == 0) | (array == 1)).all():
        strange = array[(array != 0) & (array != 1)].flat[0]
        raise HandedOverError(
            f"{name} has the entry {strange}, but must say 1 or 0 of every action"
        )
    return array.astype(np.bool_)


def truth(value: Any, name: str, agent: str | None = None) -> bool:
    """A yes or no: a bool, a 0 or 1, or an array of one of these.

    Args:
        value: what came.
        name: what it is, for the message.
        agent: whose alone it is; None: the team's.

    Raises:
        HandedOverError: for anything else, such as one value per agent where it is the team's.
    """
    if value is True or value is False:
        return value
    one = _single(value)
    if one in (0, 1):
        return bool(one)
    if agent is not None:
        raise HandedOverError(f"{name} of {agent} is {came(value)}, but must be True or False")
    advice = ": the same as all() or any() of the agents, where each has its own"
    if one is not None or isinstance(value, str):
        advice = ", and no number or text"
    raise HandedOverError(
        f"{name} is {came(value)}, but must be one True or False for the whole team{advice}"
    )


def payment(value: Any, agent: str | None = None) -> float:
    """A reward: a number, or an array of one.

    Args:
        value: what came.
        agent: whose alone it is; None: the team's.

    Raises:
        HandedOverError: for anything else, and for what is not finite or larger than `LARGEST`.
    """
    one = float(value) if isinstance(value, float) else _single(value)
    if one is not None and abs(one) <= LARGEST:
        return one
    name = "the reward" if agent is None else f"the reward of {agent}"
    if one is None:
        must = "one number"
        if agent is None:
            must += " for the whole team. Add up what the agents get, if it is one for each"
        raise HandedOverError(f"{name} is {came(value)}, but must be {must}")
    raise HandedOverError(f"{name} is {one}. {_too_large(one)}")


def state(spec: EnvSpec, observation: Any) -> Float32[np.ndarray, "S"]:
    """The global state that an environment with continuous actions shows.

    Raises:
        HandedOverError: if it is not what the task says.
    """
    return numbers(observation, (spec.state_size,), "the observation")


def moment(spec: DiscreteSpec, observation: Any) -> Observation:
    """What an environment with discrete actions shows.

    Raises:
        HandedOverError: if it is not what the task says, or leaves an agent no action.
    """
    if not isinstance(observation, dict | Mapping) or not all(
        name in observation for name in Observation._fields
    ):
        raise HandedOverError(
            f"the observation is {came(observation)}, but must be a dictionary of obs "
            f"[{spec.n_agents}, {spec.obs_size}], state [{spec.state_size}] and avail_actions "
            f"[{spec.n_agents}, {spec.n_actions}]"
        )
    seen = Observation(
        obs=numbers(observation["obs"], (spec.n_agents, spec.obs_size), "obs"),
        state=numbers(observation["state"], (spec.state_size,), "state"),
        avail_actions=mask(
            observation["avail_actions"], (spec.n_agents, spec.n_actions), "avail_actions"
        ),
    )
    refuse_idle(seen.avail_actions)
    return seen


def refuse_idle(avail_actions: Bool[np.ndarray, "N A"]) -> None:
    """Every agent needs an action at every moment.

    Raises:
        HandedOverError: if one has none.
    """
    offered = avail_actions.any(axis=1)
    if not offered.all():
        raise HandedOverError(f"no action is available to agent {offered.argmin()}. {NEVER_IDLE}")


@final
class ActionBox:
    """How a continuous environment is handed actions: in its own units, type and bounds."""

    def __init__(self, spec: EnvSpec, space: Any) -> None:
        """Looks at an environment's action space.

        Args:
            spec: the task's bounds.
            space: the environment's own space; its type, if it is a Box, else float32.

        Raises:
            HandedOverError: if it is a Box of whole numbers.
        """
        self._dtype = np.dtype(np.float32)
        if isinstance(space, gymnasium.spaces.Box) and space.dtype is not None:
            self._dtype = refuse_whole(space)
        self._low = np.array(spec.action_low, self._dtype)
        self._high = np.array(spec.action_high, self._dtype)

    def handed(self, units: Float[np.ndarray, "U"]) -> NDArray[Any]:
        """A fresh array that the environment may write to, within its bounds.

        The bounds of a float64 box are no float32 numbers: 0.1 would become 0.10000000149.
        """
        if self._dtype == units.dtype:
            return units.copy()
        return np.clip(units.astype(self._dtype), self._low, self._high)


def refuse_whole(space: gymnasium.spaces.Box) -> np.dtype[Any]:
    """The type of an action space.

    Raises:
        HandedOverError: if it is one of whole numbers, which policies do not choose.
    """
    dtype = np.dtype(space.dtype)
    if dtype.kind != "f":
        raise HandedOverError(
            f"the action space {space} is of whole numbers ({dtype}), and policies choose "
            "fractions. Declare it as float32 and round in step, or make it a task with discrete "
            "actions (race.types.DiscreteTask)"
        )
    return dtype


def in_units(
    actions: Float32[np.ndarray, "*b U"],
    low: Float32[np.ndarray, "U"],
    high: Float32[np.ndarray, "U"],
) -> Float32[np.ndarray, "*b U"]:
    """Actions between -1 and 1 to the environment's units, in float32.

    A range around 0 is scaled by one exact product, so that a policy means the same as in the
    environment's own units.
    """
    shifted = np.clip(low + (actions + 1) / 2 * (high - low), low, high)
    return np.where(low == -high, actions * high, shifted)


def place(env: Any, method: str) -> str:
    """Where the user wrote a method of an environment, in brackets; nothing if it is not known."""
    written: Any = getattr(type(getattr(env, "unwrapped", env)), method, None)
    code = getattr(inspect.unwrap(written), "__code__", None) if callable(written) else None
    if code is None:
        return ""
    return f" ({written.__qualname__}: {code.co_filename}, line {code.co_firstlineno})"


def came(value: Any) -> str:
    """What something is, in a few words."""
    if value is None:
        return "None"
    if isinstance(value, Mapping):
        return f"a dictionary ({', '.join(map(repr, list(value)[:6]))})"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} and type {value.dtype}"
    if isinstance(value, tuple | list):
        kind = type(value).__name__
        return f"a {kind} of {len(value)} ({', '.join(_kind(entry) for entry in value[:6])})"
    try:
        text = " ".join(repr(value).split())
    except Exception:  # it is somebody else's class
        text = "?"
    return f"{type(value).__name__} {text[:80]}"


def _kind(value: Any) -> str:
    return repr(value) if isinstance(value, bool | int | float) else type(value).__name__


def _array(value: Any, shape: tuple[int, ...], name: str) -> NDArray[Any]:
    """The value as an array of that shape and of real numbers."""
    try:
        array = np.asarray(value)
    except Exception as error:  # ragged lists, tensors elsewhere
        raise HandedOverError(f"{name} is no array of shape {shape} ({error})") from error
    if array.dtype.kind not in _NUMBERS:
        advice = ""
        if isinstance(value, Mapping):
            advice = ". gymnasium.wrappers.FlattenObservation makes one array of a dictionary"
        raise HandedOverError(
            f"{name} is {came(value)}, but must be an array of numbers of shape {shape}{advice}"
        )
    if array.shape != shape:
        if array.shape[-len(shape) :] != shape or array.size != np.prod(shape):
            raise HandedOverError(
                f"{name} has shape {array.shape}, but the task says {shape}. Let the two agree"
            )
        array = array.reshape(shape)
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def _single(value: Any) -> float | None:
    """The only number in something; None if there is none, or more than one."""
    try:
        array = np.asarray(value)
    except Exception:  # whatever it is, it is no number
        return None
    return float(array.item()) if array.size == 1 and array.dtype.kind in _NUMBERS else None


def _too_large(entry: float) -> str:
    if np.isnan(entry):
        return "That is no number: look for a division by zero or a root of a negative number"
    if np.isinf(entry):
        return "That is not finite: nothing can be learned from it"
    return f"Networks cannot take numbers beyond {LARGEST:g}: scale it to about 1"


def reader(spec: EnvSpec | DiscreteSpec) -> Callable[[Any], Any]:
    """The function that checks what an environment of a task shows."""
    if isinstance(spec, EnvSpec):
        return functools.partial(state, spec)
    return functools.partial(moment, spec)

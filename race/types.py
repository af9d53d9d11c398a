"""The data that flows between environments, learners and algorithms.

Axes and their letters, used in every shape of the project:

| letter | axis |
|---|---|
| `B` | samples of a batch |
| `N` | agents of a team |
| `O` | entries of one agent's observation, padded to the largest agent |
| `A` | entries of one agent's action, padded to the largest agent |
| `U` | entries of the joint action, all agents, no padding |
| `S` | entries of the global state |
| `H` | units of an observation embedding z |
| `P` | teams of the population |
| `T` | teams that act: the population, then the MARL team |
| `K` | critics of an ensemble (2 for MATD3, 1 for MADDPG and FACMAC) |
| `L` | moments of an episode: before each of its steps, and after the last |
| `R` | rows of a minibatch of episodes, each of one or more of them |
"""

import dataclasses
import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import gymnasium
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from race.errors import TaskError

LARGEST: Final = 1e15
"""Largest magnitude of what environments show, pay and are told. Networks compute in 32 bits, where
squares of more would overflow, and the networks would be blamed."""


# What users write down of a task is checked and put in order when it is written, so that the type
# checks of the tests let everything in; from then on it is of the first type.
Whole = int | Any
Indices = tuple[tuple[int, ...], ...] | Any
Bounds = tuple[float, ...] | Any
Name = str | Any


class Transition(NamedTuple):
    """One step of the environment, or a batch of them (leading axes ``...``).

    Observations are not stored: they are gathered from the states (:class:`EnvSpec`).
    ``terminated`` is 1 where the task itself ended; a time limit leaves it 0, so that targets
    bootstrap through it.
    """

    state: Float[Any, "*b S"]
    action: Float[Any, "*b U"]
    reward: Float[Any, "*b"]
    terminated: Float[Any, "*b"]
    next_state: Float[Any, "*b S"]


class Observation(NamedTuple):
    """A moment of a task with discrete actions; ``A`` counts the actions to choose from."""

    obs: Float[Any, "N O"]
    state: Float[Any, "S"]
    avail_actions: Bool[Any, "N A"]


class Episode(NamedTuple):
    """A whole episode of a task with discrete actions, or a batch of them (axes ``...``).

    It has room for ``L - 1`` steps, of which the first ``length`` were made; the rest is padding,
    zeros. Moment t is before step t, so the moment of index ``length`` is the one after the last
    step. ``terminated`` is 1 at a last step that ended the task itself, and 0 at one that an
    outer time limit made the last.
    """

    obs: Float[Any, "*b L N O"]
    state: Float[Any, "*b L S"]
    avail_actions: Bool[Any, "*b L N A"]
    action: Int[Any, "*b L-1 N"]
    reward: Float[Any, "*b L-1"]
    terminated: Float[Any, "*b L-1"]
    length: Int[Any, "*b"]


class Slots(NamedTuple):
    """Episodes of unequal lengths laid end to end in ``R`` rows of ``L`` slots, time first.

    A slot holds a moment of an episode or nothing. Each episode lies in one row with all its
    moments, that after its last step included, so that the slot behind a step is the moment it led
    to; a row begins with an episode's first moment or with nothing.
    """

    obs: Float[Any, "L R N O"]
    state: Float[Any, "L R S"]
    avail_actions: Bool[Any, "L R N A"]
    action: Int[Any, "L R N"]
    last_action: Int[Any, "L R N"]  # of the step that led here; -1 at an episode's first moment
    reward: Float[Any, "L R"]
    terminated: Float[Any, "L R"]
    first: Bool[Any, "L R"]  # an episode begins here
    acted: Bool[Any, "L R"]  # a step was made here
    real: Bool[Any, "L R"]  # there is something here
    moment: Int[Any, "L R"]  # a number of its own for each moment in the buffer


class Team(NamedTuple):
    """A team, or what of it evolves; with further leading axes many of them.

    ``encoder`` is a pytree whose leaves begin with the agents' axis, or None where all teams share
    one and the heads alone are a team's own. In `heads`, the last row holds the biases.
    """

    encoder: Any
    heads: Float[Any, "*b N H1 A"]


class Rollout(NamedTuple):
    """What one batch of episodes brought back to the host, one episode per acting team.

    ``transitions`` hold the steps of all teams in the order they were made: by tick, then by
    team. ``episode_return`` is the undiscounted sum of rewards.
    """

    transitions: Transition  # leading axis: steps of all teams
    episode_return: Float[np.ndarray, "T"]
    episode_length: NDArray[np.int64]  # [T]
    team: NDArray[np.int64]  # whose each step is
    repeated: NDArray[np.int64]  # [T], how often each episode was begun anew

    def of(self, teams: range) -> "Rollout":
        """What some of the teams brought."""
        part = slice(teams.start, teams.stop)
        results = (self.episode_return[part], self.episode_length[part])
        if len(teams) == len(self.episode_return):
            return self
        rows = np.flatnonzero((self.team >= teams.start) & (self.team < teams.stop))
        transitions = Transition(*(column[rows] for column in self.transitions))
        return Rollout(transitions, *results, self.team[rows] - teams.start, self.repeated[part])


@dataclass(frozen=True)
class EnvSpec:
    """Who sees what and who moves what in a task: everything a learner knows of it.

    An environment is an ordinary single-agent `gymnasium.Env` over the global state and the
    joint action; this factorisation makes it a multi-agent task. Hashable, so it can be a static
    argument of a compiled function.

    Attributes:
        task: the task's id.
        state_size: entries of the global state.
        obs_index: for each agent, the entries of the state it observes, in its order.
        action_index: for each agent, the entries of the joint action it controls.
        action_low: lowest value of each entry of the joint action, in the environment's units.
        action_high: highest value of each entry.
        episode_limit: steps after which an episode is cut off (truncated).

    Raises:
        TaskError: if something is of the wrong kind, an index is out of range, or the agents'
            actions do not cover each entry of the joint action exactly once.
    """

    task: Name
    state_size: Whole
    obs_index: Indices
    action_index: Indices
    action_low: Bounds
    action_high: Bounds
    episode_limit: Whole

    def __post_init__(self) -> None:
        _keep(self, "task", _name(self.task))
        for field in ("state_size", "episode_limit"):
            _keep(self, field, _whole(getattr(self, field), field, self.task, least=1))
        for field in ("obs_index", "action_index"):
            _keep(self, field, _indices(getattr(self, field), field, self.task))
        for field in ("action_low", "action_high"):
            _keep(self, field, _bounds(getattr(self, field), field, self.task))
        covered = sorted(entry for agent in self.action_index for entry in agent)
        if covered != list(range(len(self.action_low))):
            raise TaskError(
                f"Task {self.task}: each of the {len(self.action_low)} entries of the joint action "
                f"must belong to exactly one agent, but action_index covers {covered}."
            )
        if len(self.obs_index) != len(self.action_index):
            raise TaskError(
                f"Task {self.task}: obs_index describes {len(self.obs_index)} agents and "
                f"action_index {len(self.action_index)}; they must describe the same agents."
            )
        if any(not 0 <= e < self.state_size for agent in self.obs_index for e in agent):
            raise TaskError(
                f"Task {self.task}: obs_index names entries outside the state of size "
                f"{self.state_size}."
            )
        if not all(self.obs_index) or not all(self.action_index):
            raise TaskError(
                f"Task {self.task}: every agent needs at least one observation entry and one "
                "action entry."
            )
        if len(self.action_high) != len(self.action_low) or not all(
            abs(low) <= LARGEST and abs(high) <= LARGEST and np.float32(low) < np.float32(high)
            for low, high in zip(self.action_low, self.action_high, strict=True)
        ):
            raise TaskError(
                f"Task {self.task}: action_low and action_high must be of equal length, no larger "
                f"than {LARGEST:g}, and low below high, in 32 bits too; they are "
                f"{self.action_low} and {self.action_high}."
            )

    @property
    def n_agents(self) -> int:
        """Number of agents N."""
        return len(self.action_index)

    @property
    def obs_sizes(self) -> tuple[int, ...]:
        """Observation entries of each agent."""
        return tuple(len(agent) for agent in self.obs_index)

    @property
    def action_sizes(self) -> tuple[int, ...]:
        """Action entries of each agent."""
        return tuple(len(agent) for agent in self.action_index)

    @property
    def obs_size(self) -> int:
        """Observation entries O after padding to the largest agent."""
        return max(self.obs_sizes)

    @property
    def action_size(self) -> int:
        """Action entries A after padding to the largest agent."""
        return max(self.action_sizes)

    @property
    def joint_action_size(self) -> int:
        """Entries U of the joint action."""
        return len(self.action_low)

    @cached_property
    def obs_gather(self) -> NDArray[np.int32]:
        """State entry of each observation entry, shape [N, O]; padding points at entry 0."""
        return _padded(self.obs_index, self.obs_size)

    @cached_property
    def obs_mask(self) -> NDArray[np.bool_]:
        """True where an observation entry is real and not padding, shape [N, O]."""
        return np.arange(self.obs_size)[None] < np.array(self.obs_sizes)[:, None]

    @cached_property
    def action_mask(self) -> NDArray[np.bool_]:
        """True where an action entry is real and not padding, shape [N, A]."""
        return np.arange(self.action_size)[None] < np.array(self.action_sizes)[:, None]

    @cached_property
    def joint_gather(self) -> NDArray[np.int32]:
        """For each entry of the joint action, its place in the flattened [N * A], shape [U].

        ``padded.reshape(N * A)[joint_gather]`` turns the agents' padded actions into the joint
        action in the environment's order, without padding.
        """
        gather = np.zeros(self.joint_action_size, np.int32)
        for agent, entries in enumerate(self.action_index):
            for place, entry in enumerate(entries):
                gather[entry] = agent * self.action_size + place
        return gather


def _keep(spec: Any, field: str, value: Any) -> None:
    object.__setattr__(spec, field, value)  # frozen, but not yet seen by anybody


def _name(task: Any) -> str:
    if not isinstance(task, str) or not task:
        raise TaskError(f"The name of a task must be a text, and it is {task!r}.")
    return task


def _whole(value: Any, field: str, task: str, least: int) -> int:
    """A whole number, of Python or numpy."""
    try:
        number = least - 1 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = least - 1
    if number < least:
        meant = isinstance(value, float) and value.is_integer() and value >= least
        raise TaskError(
            f"Task {task}: {field} is {value!r}, but must be a whole number of at least {least}"
            f"{f': write {value:.0f}' if meant else ''}."
        )
    return number


def _indices(value: Any, field: str, task: str) -> tuple[tuple[int, ...], ...]:
    try:
        agents = [tuple(agent) for agent in _several(value)]
    except TypeError as error:
        raise TaskError(
            f"Task {task}: {field} is {value!r}, but must name the entries of each agent, such as "
            "[(0, 1), (2,)] of two agents."
        ) from error
    return tuple(tuple(_whole(e, f"an entry of {field}", task, 0) for e in a) for a in agents)


def _bounds(value: Any, field: str, task: str) -> tuple[float, ...]:
    try:
        return tuple(float(bound) for bound in _several(value))
    except (TypeError, ValueError) as error:
        raise TaskError(f"Task {task}: {field} is {value!r}, but must be numbers.") from error


def _several(value: Any) -> Iterable[Any]:
    if isinstance(value, str | bytes | dict):
        raise TypeError("no list")
    return iter(value)


def _padded(index: tuple[tuple[int, ...], ...], size: int) -> NDArray[np.int32]:
    return np.array([[*agent, *[0] * (size - len(agent))] for agent in index], np.int32)


@dataclass(frozen=True)
class DiscreteSpec:
    """The sizes of a task whose agents each choose one of a number of actions. Hashable.

    Attributes:
        task: the task's id.
        n_agents: number of agents N.
        obs_size: entries of an agent's observation O.
        state_size: entries of the global state S.
        n_actions: actions that each agent has to choose from; not all are always available.
        episode_limit: steps after which an episode ends.
        has_wins: whether an episode can be won, which ``info["battle_won"]`` of a step tells.

    Raises:
        TaskError: if a size is no whole number of at least 1.
    """

    task: Name
    n_agents: Whole
    obs_size: Whole
    state_size: Whole
    n_actions: Whole
    episode_limit: Whole
    has_wins: bool | Any = False

    def __post_init__(self) -> None:
        _keep(self, "task", _name(self.task))
        for field in dataclasses.fields(self):
            if field.name not in ("task", "has_wins"):
                value = getattr(self, field.name)
                _keep(self, field.name, _whole(value, field.name, self.task, least=1))
        if not isinstance(self.has_wins, bool | np.bool_):
            raise TaskError(
                f"Task {self.task}: has_wins is {self.has_wins!r}, but must be True or False."
            )
        _keep(self, "has_wins", bool(self.has_wins))

    @property
    def action_mask(self) -> NDArray[np.bool_]:
        """True everywhere, shape [N, A]: no action of a head is padding."""
        return np.ones((self.n_agents, self.n_actions), np.bool_)


Spec = EnvSpec | DiscreteSpec
"""What a learner knows of a task."""


class Outcome(NamedTuple):
    """What a step of a `DeviceEnv` brought, besides the next observation."""

    reward: Float[Any, ""]
    terminated: Bool[Any, ""]
    truncated: Bool[Any, ""]
    won: Bool[Any, ""]


class DeviceEnv(NamedTuple):
    """A task with discrete actions as pure functions of JAX, whose rollouts are compiled.

    ``reset`` and ``step`` are functions of a module, so that one program serves all environments
    that differ in ``arrays`` alone. An `environment <DiscreteTask.make>` on the host and this one
    are the same task: with the same key, each reset and each step takes
    ``key, now = jax.random.split(key)`` and uses ``now``.
    """

    arrays: Any
    """What the functions read of the task: a pytree."""
    reset: Callable[[Any, Any], tuple[Any, Observation]]
    """(arrays, key) -> env_state, observation."""
    step: Callable[[Any, Any, Any, Any], tuple[Any, Observation, Outcome]]
    """(arrays, env_state, actions [N], key) -> env_state, observation, outcome. It is also called
    after the end of an episode, where only its result is ignored."""


class DiscreteTask(NamedTuple):
    """A task with discrete actions: its sizes and the ways to make its environment.

    ``make(render_mode)`` returns a `gymnasium.Env` whose observation is a dictionary of ``obs``
    [N, O], ``state`` [S] and ``avail_actions`` [N, n_actions], and whose action is one number per
    agent, [N]. ``render_mode`` is None or ``"rgb_array"``. ``device()``, where there is one,
    returns the same task for rollouts on the device. ``seeded`` is False where an environment has
    no place for a seed, so that its episodes do not repeat. ``facts`` are what else decides what a
    run means, by name, as plain JSON values; they are kept in ``metadata.json``. ``waits`` tells
    that a step waits for another program, a game: environments are then worth processes.
    """

    spec: DiscreteSpec
    make: Callable[[str | None], gymnasium.Env[Any, Any]]
    device: Callable[[], DeviceEnv] | None = None
    seeded: bool = True
    facts: tuple[tuple[str, Any], ...] = ()
    waits: bool = False


class Task(NamedTuple):
    """A task: its factorisation and the way to make its environment.

    ``make(render_mode)`` returns a `gymnasium.Env` whose observation is the global state, a
    float array of shape [S], and whose action is the joint action, shape [U], in its own units
    (between ``spec.action_low`` and ``spec.action_high``). Time limits are the environment's
    ``truncated``. ``render_mode`` is None or ``"rgb_array"``. ``seeded`` and ``facts`` are as in
    `DiscreteTask`.
    """

    spec: EnvSpec
    make: Callable[[str | None], gymnasium.Env[Any, Any]]
    seeded: bool = True
    facts: tuple[tuple[str, Any], ...] = ()


AnyTask = Task | DiscreteTask

"""A trained team that acts: on what its agents observe, in the units of their environment."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from race.errors import ConfigError, HandedOverError
from race.teams.portable import Portable, joint_action, next_actions, of_agent, portable
from race.teams.trained import Trained
from race.types import LARGEST, EnvSpec, Spec


@final
class Team:
    """One team of a run. It acts with numpy alone, without exploration.

    With discrete actions it remembers an episode: call `reset` before every further one.

    Attributes:
        name: ``marl`` or ``champion``.
        trained: the run's teams, of which this is one.
        portable: its weights.
    """

    def __init__(self, trained: Trained, name: str) -> None:
        self.trained, self.name = trained, name
        spec, scaling = trained.task.spec, trained.scaling
        self.portable = portable(trained.encoders[name], trained.heads[name], spec, scaling)
        self._arrays = self.portable.arrays
        self._memory: NDArray[np.float32] | None = None

    def __repr__(self) -> str:
        spec = self.spec
        return f"Team({self.name!r}, {spec.task}, {spec.n_agents} agents, from {self.run_dir})"

    @property
    def run_dir(self) -> Path:
        """The directory of its run."""
        return self.trained.path

    @property
    def spec(self) -> Spec:
        """The sizes of its task, and who sees and moves what."""
        return self.trained.task.spec

    @property
    def agent_names(self) -> list[str] | None:
        """What the task calls its agents, in their order; None if they have only numbers."""
        names = dict(self.trained.task.facts).get("agent_names")
        return None if names is None else list(names)

    def reset(self) -> None:
        """Forgets the episode. Teams with continuous actions have nothing to forget."""
        self._memory = None

    def act(
        self,
        obs: ArrayLike | Mapping[Any, ArrayLike] | None = None,
        avail_actions: ArrayLike | None = None,
        *,
        state: ArrayLike | None = None,
    ) -> NDArray[Any]:
        """The team's next actions.

        Args:
            obs: what the agents observe: an array [N, O], padded to the largest agent; or one
                array of its own size per agent, in a list or in a dictionary. It is by the agents'
                names where the task has such (`agent_names`), whatever its order, and may hold the
                task's other agents too; elsewhere it is in the agents' order. Several environments
                at once have a leading axis: [B, N, O].
            avail_actions: of discrete actions, which each agent can choose, [N, A] or [B, N, A],
                as 1 and 0. None: all.
            state: instead of ``obs``, the global state [S] or [B, S] of a task with continuous
                actions, as its environment shows it. What the agents see of it is taken out.

        Returns:
            The joint action [U] in the environment's units and order, ready for its ``step``; of
            discrete actions one number per agent, [N]. With a leading axis [B] if there was one.

        Raises:
            HandedOverError: if sizes or values are not those of the task.
        """
        spec = self.spec
        if (obs is None) == (state is None):
            raise HandedOverError("A team acts on obs or on state: give one of the two.")
        if isinstance(spec, EnvSpec):
            if avail_actions is not None:
                raise HandedOverError(
                    f"The actions of {spec.task} are continuous: leave avail_actions out."
                )
            if state is not None:
                seen = _numbers(state, (spec.state_size,), "state")[..., spec.obs_gather]
            else:
                seen = self._observed(obs)
            batch = seen.reshape(-1, *seen.shape[-2:])
            action = joint_action(np, self._arrays, self.portable.layer_norm, batch)
            return action.reshape(*seen.shape[:-2], -1)
        if state is not None:
            raise HandedOverError(
                f"The agents of {spec.task} act on what each observes: give obs, not state."
            )
        return self._remembered(self._observed(obs), avail_actions)

    def split(self, action: ArrayLike) -> list[NDArray[Any]]:
        """A joint action [..., U] as one array per agent, in its own order and size.

        Of discrete actions, [..., N], it is one number per agent.
        """
        joint = np.asarray(action)
        if not isinstance(self.spec, EnvSpec):
            return [joint[..., agent] for agent in range(self.spec.n_agents)]
        return [joint[..., list(entries)] for entries in self.spec.action_index]

    def agent(self, number: int) -> Portable:
        """The weights of one agent alone, as a team of one.

        Raises:
            ConfigError: if there is no such agent.
        """
        if not 0 <= number < self.spec.n_agents:
            raise ConfigError(f"The team has agents 0 to {self.spec.n_agents - 1}, not {number}.")
        return of_agent(self.portable, number)

    def _remembered(
        self, obs: NDArray[np.float32], avail_actions: ArrayLike | None
    ) -> NDArray[np.int32]:
        spec = self.spec
        assert not isinstance(spec, EnvSpec)
        batch = obs.reshape(-1, *obs.shape[-2:])
        shape = (*batch.shape[:2], spec.n_actions)
        if avail_actions is None:
            available = np.ones(shape, np.bool_)
        else:
            available = _mask(avail_actions, obs.shape[:-1], spec.n_actions).reshape(shape)
        if self._memory is None:
            self._memory = np.zeros((*batch.shape[:2], self.portable.memory_size), np.float32)
        elif self._memory.shape[0] != batch.shape[0]:
            raise HandedOverError(
                f"The team remembers {self._memory.shape[0]} episodes and is shown {len(batch)}. "
                "Call reset() before other ones."
            )
        action, self._memory = next_actions(
            np, self._arrays, self.portable.layer_norm, batch, self._memory, available
        )
        return action.reshape(obs.shape[:-1])

    def _observed(self, obs: Any) -> NDArray[np.float32]:
        spec = self.spec
        sizes = spec.obs_sizes if isinstance(spec, EnvSpec) else (spec.obs_size,) * spec.n_agents
        if isinstance(obs, Mapping):
            obs = self._in_order(obs)
        if isinstance(obs, list | tuple) and len(obs) == spec.n_agents:
            each = [_numbers(one, (s,), f"obs of agent {i}") for i, (one, s) in _of(obs, sizes)]
            if len({one.shape[:-1] for one in each}) == 1:
                seen = np.zeros((*each[0].shape[:-1], spec.n_agents, spec.obs_size), np.float32)
                for i, one in enumerate(each):
                    seen[..., i, : one.shape[-1]] = one
                return seen
        shape = (spec.n_agents, spec.obs_size)
        array = _array(obs, shape, "obs")
        if isinstance(spec, EnvSpec) and array.shape == (spec.state_size,):
            raise HandedOverError(
                f"obs has shape [{spec.state_size}], as the global state has, but must be what "
                f"each agent observes, {list(shape)}. Give it as state=."
            )
        return _numbers(array, shape, "obs")

    def _in_order(self, obs: Mapping[Any, Any]) -> list[Any]:
        names = self.agent_names
        if names is None:
            return list(obs.values())
        by_name = {str(agent): seen for agent, seen in obs.items()}
        others = dict(self.trained.task.facts).get("other_agents", ())
        missing = [name for name in names if name not in by_name]
        strange = [name for name in by_name if name not in (*names, *others)]
        if missing or strange:
            wrong = [f"lacks {', '.join(missing)}"] if missing else []
            wrong += [f"has {', '.join(strange)}"] if strange else []
            raise HandedOverError(
                f"obs {' and '.join(wrong)}: the agents of the team are {', '.join(names)}. One "
                "that is not there observes zeros."
            )
        return [by_name[name] for name in names]


def _of(obs: Any, sizes: tuple[int, ...]) -> Any:
    return enumerate(zip(obs, sizes, strict=True))


def _numbers(value: Any, shape: tuple[int, ...], name: str) -> NDArray[np.float32]:
    """Numbers as float32, with at most one axis before those of ``shape``."""
    array = _array(value, shape, name)
    if array.dtype.kind not in "buif":
        raise HandedOverError(f"{name} is of type {array.dtype}, but must be numbers.")
    if array.shape[-len(shape) :] != shape or array.ndim > len(shape) + 1 or array.size == 0:
        raise HandedOverError(
            f"{name} has shape {list(array.shape)}, but the task says {list(shape)}, or with one "
            "axis before it for several environments at once."
        )
    # Not a number compares as False.
    if not (np.abs(array) <= LARGEST).all():
        raise HandedOverError(f"{name} has an entry that is not finite, or beyond {LARGEST:g}.")
    return array.astype(np.float32)


def _array(value: Any, shape: tuple[int, ...], name: str) -> NDArray[Any]:
    try:
        return np.asarray(value)
    except ValueError as error:  # lists of unequal lengths
        raise HandedOverError(f"{name} is no array of shape {list(shape)}: {error}.") from error


def _mask(value: Any, leading: tuple[int, ...], n_actions: int) -> NDArray[np.bool_]:
    array = _array(value, (*leading, n_actions), "avail_actions")
    if array.shape != (*leading, n_actions) or not ((array == 0) | (array == 1)).all():
        raise HandedOverError(
            f"avail_actions must be 1 and 0 of shape {[*leading, n_actions]}, as obs says; it has "
            f"shape {list(array.shape)}."
        )
    available = array.astype(np.bool_)
    if not available.any(axis=-1).all():
        raise HandedOverError("avail_actions leaves an agent no action.")
    return available


def chosen_team(trained: Trained, team: str) -> Team:
    """The team of that name: ``marl``, ``champion`` or ``selected``.

    Raises:
        ConfigError: if there is none.
    """
    return Team(trained, trained.resolve(team))

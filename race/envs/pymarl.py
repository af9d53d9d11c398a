"""Environments with PyMARL's interface (SMAC's ``MultiAgentEnv``) as tasks.

Such an environment has ``get_env_info``, ``reset``, ``get_obs``, ``get_state``,
``get_avail_actions``, ``step(actions) -> reward, terminated, info`` and ``close``; the interface is
that of github.com/oxwhirl/pymarl. It may have ``seed(seed)`` and ``render(mode="rgb_array")``.
"""

import functools
import inspect
import operator
from collections.abc import Callable
from typing import Any, ClassVar, Final, final

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import UInt8
from numpy.typing import NDArray

from race.errors import RenderError, TaskError
from race.types import DiscreteSpec, DiscreteTask

_METHODS: Final = (
    *("get_env_info", "reset", "get_obs", "get_state", "get_avail_actions", "step", "close"),
)
_SIZES: Final = {
    "n_agents": "n_agents",
    "obs_size": "obs_shape",
    "state_size": "state_shape",
    "n_actions": "n_actions",
    "episode_limit": "episode_limit",
}


def pymarl_task(make: Callable[[], Any], task: str, *, has_wins: bool = False) -> DiscreteTask:
    """A task out of an environment with PyMARL's interface.

    Args:
        make: returns the environment. Let it be a function of a module (or a `functools.partial`
            of one): worker processes import it by name.
        task: the name of the task.
        has_wins: whether ``info["battle_won"]`` of the last step tells that the episode was won,
            as in SMAC.

    Raises:
        TaskError: if the environment lacks a method or a size.
    """
    env = make()
    try:
        spec = _spec(env, task, has_wins)
    finally:
        close = getattr(env, "close", None)
        if callable(close):
            close()
    return DiscreteTask(spec, functools.partial(_make, make, task, has_wins))


def _make(
    make: Callable[[], Any], task: str, has_wins: bool, render_mode: str | None = None
) -> gymnasium.Env[Any, Any]:
    return PymarlEnv(make(), task, has_wins=has_wins, render_mode=render_mode)


def _spec(env: Any, task: str, has_wins: bool) -> DiscreteSpec:
    missing = [name for name in _METHODS if not callable(getattr(env, name, None))]
    if missing:
        raise TaskError(
            f"Task {task}: {type(env).__name__} has no {', '.join(missing)}. An environment with "
            f"PyMARL's interface has the methods {', '.join(_METHODS)}; give pymarl_task a "
            "function that returns one."
        )
    info = env.get_env_info()
    sizes = {}
    for ours, theirs in _SIZES.items():
        try:
            sizes[ours] = operator.index(info[theirs])
        except (KeyError, TypeError):
            sizes[ours] = 0
        if sizes[ours] < 1:
            raise TaskError(
                f"Task {task}: get_env_info of {type(env).__name__} must return a dictionary whose "
                f"{theirs} is a whole number of at least 1; it returned {info!r}."
            )
    return DiscreteSpec(task=task, has_wins=has_wins, **sizes)


@final
class PymarlEnv(gymnasium.Env[dict[str, Any], NDArray[np.integer[Any]]]):
    """An environment with PyMARL's interface behind gymnasium's.

    An observation is a dictionary of ``obs`` [N, O], ``state`` [S] and ``avail_actions`` [N, A]
    (0 or 1). An action is one number per agent; an agent whose action is not available takes the
    available one of the lowest number instead (in SMAC: it stops, or does nothing if dead), and
    ``info["refused"]`` [N] tells. Otherwise ``info`` is the environment's own, with
    ``battle_won`` always there where the task has wins.

    An end that the environment calls ``info["episode_limit"]`` is ``truncated``: a learner
    bootstraps through it. Any other end is ``terminated``, a time limit too.

    ``reset(seed=s)`` calls ``seed(s)`` of the environment if it has such a method. An environment
    whose ``seed`` takes no argument (SMAC's only tells its seed) is given one where it is made.

    Attributes:
        sizes: the sizes, from ``get_env_info``.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": 2,  # steps of SMAC in a second of the game at its "normal" speed
    }

    def __init__(
        self,
        env: Any,
        task: str = "pymarl",
        *,
        has_wins: bool = False,
        render_mode: str | None = None,
    ) -> None:
        """Wraps an environment, which is closed with this one.

        Args:
            env: the environment.
            task: the name of the task, for messages.
            has_wins: whether an episode can be won.
            render_mode: ``"rgb_array"``, if ``env.render`` takes it as ``mode``, or None.

        Raises:
            TaskError: if the environment lacks a method or a size.
            RenderError: for a render mode that it does not offer.
        """
        self.sizes = _spec(env, task, has_wins)
        if render_mode not in (None, "rgb_array"):
            raise RenderError(
                f"Task {task} can be rendered as 'rgb_array' or not at all (None), not as "
                f"{render_mode!r}."
            )
        if render_mode and not _takes(getattr(env, "render", None), mode=render_mode):
            raise RenderError(
                f"Task {task} has no picture: {type(env).__name__} has no render that takes "
                "mode='rgb_array'. Add one that returns an array [height, width, 3] of uint8."
            )
        n, actions = self.sizes.n_agents, self.sizes.n_actions
        obs, state = self.sizes.obs_size, self.sizes.state_size
        self.render_mode = render_mode
        self.observation_space = spaces.Dict(
            {
                "obs": spaces.Box(-np.inf, np.inf, (n, obs), np.float32),
                "state": spaces.Box(-np.inf, np.inf, (state,), np.float32),
                "avail_actions": spaces.MultiBinary([n, actions]),
            }
        )
        self.action_space = spaces.MultiDiscrete([actions] * n)
        self._env = env
        self._available: NDArray[np.int8] | None = None
        self._steps = 0
        self._over = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode; returns its first observation and an empty dictionary.

        Raises:
            TaskError: if what the environment shows does not fit its sizes.
        """
        super().reset(seed=seed)
        reseed = getattr(self._env, "seed", None)
        if seed is not None and _takes(reseed, seed):
            reseed(seed)  # type: ignore[misc]
        self._env.reset()
        self._steps, self._over = 0, False
        return self._observe(), {}

    def step(
        self, action: NDArray[Any]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One step of the environment.

        Returns:
            observation, reward, terminated, truncated, and the environment's facts.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset, and after the end of an episode.
            TaskError: if the action is not one whole number per agent, what the environment
                answers does not fit its interface, or it goes on after its episode limit.
        """
        if self._over or self._available is None:
            raise gymnasium.error.ResetNeeded("The episode is over: call reset before step.")
        spec, actions = self.sizes, np.asarray(action)
        if actions.shape != (spec.n_agents,) or not np.issubdtype(actions.dtype, np.integer):
            raise TaskError(
                f"Task {spec.task} needs one whole number per agent, {spec.n_agents} in all; the "
                f"action was an array of shape {actions.shape} and type {actions.dtype}."
            )
        offered = actions[:, None] == np.arange(spec.n_actions)[None]
        refused = ~(offered & (self._available == 1)).any(axis=1)
        taken = np.where(refused, self._available.argmax(axis=1), actions)
        reward, ended, facts = self._answer(self._env.step(taken.tolist()))
        self._steps, self._over = self._steps + 1, ended
        if not ended and self._steps >= spec.episode_limit:
            raise TaskError(
                f"Task {spec.task}: the episode goes on after {self._steps} steps, though "
                f"get_env_info says episode_limit {spec.episode_limit}. Let step return "
                'terminated there, with info["episode_limit"] = True unless the limit is part of '
                "the task."
            )
        if spec.has_wins:
            # SMAC does not tell after its game broke down and had to be started again.
            facts["battle_won"] = bool(facts.get("battle_won", False))
        truncated = ended and bool(facts.get("episode_limit", False))
        facts["refused"] = refused
        return self._observe(), reward, ended and not truncated, truncated, facts

    def render(self) -> UInt8[np.ndarray, "h w 3"] | None:
        """A picture of the environment as it stands; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            RenderError: if the environment returns no picture.
        """
        if self.render_mode is None:
            return None
        if self._available is None:
            raise gymnasium.error.ResetNeeded("Call reset before render.")
        picture = np.asarray(self._env.render(mode=self.render_mode))
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            raise RenderError(
                f"Task {self.sizes.task}: render must return an array [height, width, 3] of "
                f"uint8; it returned shape {picture.shape} of {picture.dtype}."
            )
        return picture

    def close(self) -> None:
        """Closes the environment."""
        self._env.close()

    def _answer(self, answer: Any) -> tuple[float, bool, dict[str, Any]]:
        try:
            reward, ended, facts = answer
            return float(reward), bool(ended), dict(facts)
        except (TypeError, ValueError) as error:
            raise TaskError(
                f"Task {self.sizes.task}: step must return (reward, terminated, info): a "
                f"number for the team, a bool and a dictionary; it returned {answer!r}."
            ) from error

    def _observe(self) -> dict[str, Any]:
        spec, env = self.sizes, self._env
        n = spec.n_agents
        observation = {
            "obs": self._array("get_obs", env.get_obs(), (n, spec.obs_size)),
            "state": self._array("get_state", env.get_state(), (spec.state_size,)),
        }
        available = self._array("get_avail_actions", env.get_avail_actions(), (n, spec.n_actions))
        if not np.isin(available, (0.0, 1.0)).all():
            raise TaskError(
                f"Task {spec.task}: get_avail_actions must say 1 or 0 of every action, available "
                f"or not; after {self._steps} steps it returned {available.tolist()}."
            )
        idle = np.flatnonzero(~available.any(axis=1))
        if len(idle):
            raise TaskError(
                f"Task {spec.task}: no action is available to agent {idle[0]} after "
                f"{self._steps} steps. Give it one that does nothing, also when it is dead and "
                "after the last step."
            )
        self._available = available.astype(np.int8)
        return observation | {"avail_actions": self._available.copy()}

    def _array(self, method: str, value: Any, shape: tuple[int, ...]) -> NDArray[np.float32]:
        try:
            array = np.array(value, np.float32)  # a copy: environments may write to theirs again
        except (TypeError, ValueError) as error:
            raise TaskError(
                f"Task {self.sizes.task}: {method} returned what is no array of numbers "
                f"of shape {shape} ({error})."
            ) from error
        if array.shape != shape:
            raise TaskError(
                f"Task {self.sizes.task}: {method} returned shape {array.shape}, but "
                f"get_env_info says {shape}. Let the two agree; agents whose observations or "
                "actions are fewer are padded with zeros."
            )
        return array


def _takes(function: Any, *args: Any, **kwargs: Any) -> bool:
    try:
        inspect.signature(function).bind(*args, **kwargs)
    except (TypeError, ValueError):  # no function, other arguments, or none that can be known
        return False
    return True

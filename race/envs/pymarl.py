"""Environments with PyMARL's interface (SMAC's ``MultiAgentEnv``) as tasks.

Such an environment has ``get_env_info``, ``reset``, ``get_obs``, ``get_state``,
``get_avail_actions``, ``step(actions) -> reward, terminated, info`` and ``close``; the interface
is that of github.com/oxwhirl/pymarl. It may have ``seed(seed)``, or take ``reset(seed=...)`` and
answer a step with ``observation, reward, terminated, truncated, info`` as in EPyMARL, and have
``render(mode="rgb_array")``.
"""

import contextlib
import functools
import inspect
import operator
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final, final

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import UInt8
from numpy.typing import NDArray

from race.envs import contract
from race.envs.checked import takes
from race.envs.dictionary import space_of
from race.errors import HandedOverError, RenderError, TaskError
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
        spec = spec_of(env, task, has_wins)
        seeded = _takes_seed(env)
    finally:
        with contextlib.suppress(Exception, SystemExit):  # it would hide what was wrong before
            env.close()
    made = functools.partial(_make, make, task, has_wins)
    return DiscreteTask(spec, made, seeded=seeded)


def _takes_seed(env: Any) -> bool:
    return takes(getattr(env, "seed", None), 0) or _resets_with_seed(env)


def _resets_with_seed(env: Any) -> bool:
    # Named: one that takes any keyword may hand it on to one that does not.
    return takes(env.reset, seed=0) and "seed" in inspect.signature(env.reset).parameters


def _make(
    make: Callable[[], Any], task: str, has_wins: bool, render_mode: str | None = None
) -> gymnasium.Env[Any, Any]:
    return PymarlEnv(make(), task, has_wins=has_wins, render_mode=render_mode)


def spec_of(env: Any, task: str, has_wins: bool) -> DiscreteSpec:
    """The sizes of an environment with PyMARL's interface.

    Raises:
        TaskError: if it lacks a method or a size.
    """
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

    ``reset(seed=s)`` calls ``seed(s)`` of the environment if it has such a method, and passes the
    seed to its ``reset`` if that has a place for it. An environment whose ``seed`` takes no
    argument (SMAC's only tells its seed) is given one where it is made.

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
        self.sizes = spec_of(env, task, has_wins)
        if render_mode not in (None, "rgb_array"):
            raise RenderError(
                f"Task {task} can be rendered as 'rgb_array' or not at all (None), not as "
                f"{render_mode!r}."
            )
        if render_mode and not takes(getattr(env, "render", None), mode=render_mode):
            raise RenderError(
                f"Task {task} has no picture: {type(env).__name__} has no render that takes "
                "mode='rgb_array'. Add one that returns an array [height, width, 3] of uint8."
            )
        n, actions = self.sizes.n_agents, self.sizes.n_actions
        obs, state = self.sizes.obs_size, self.sizes.state_size
        self.render_mode = render_mode
        self.observation_space = space_of(n, obs, state, actions)
        self.action_space = spaces.MultiDiscrete([actions] * n)
        self._env = env
        self._available: NDArray[np.int8] | None = None
        self._steps = 0
        self._over = True

    @property
    def inner(self) -> Any:
        """The environment with PyMARL's interface."""
        return self._env

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode; returns its first observation and an empty dictionary.

        Raises:
            TaskError: if what the environment shows does not fit its sizes.
        """
        super().reset(seed=seed)
        reseed = getattr(self._env, "seed", None)
        if seed is not None and takes(reseed, seed):
            reseed(seed)  # type: ignore[misc]
        if seed is not None and _resets_with_seed(self._env):
            self._env.reset(seed=seed)
        else:
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
        answer = self._env.step(taken.tolist())
        self._steps += 1
        reward, terminated, truncated, facts = self._answer(answer)
        self._over = terminated or truncated
        if not self._over and self._steps >= spec.episode_limit:
            raise HandedOverError(
                f"Task {spec.task}: the episode goes on after {self._steps} steps, though "
                f"get_env_info says episode_limit {spec.episode_limit}. Let step return "
                'terminated there, with info["episode_limit"] = True unless the limit is part of '
                "the task."
            )
        if spec.has_wins:
            # SMAC does not tell after its game broke down and had to be started again.
            facts["battle_won"] = self._checked(
                "step", contract.truth, facts.get("battle_won", False), 'info["battle_won"]'
            )
        facts["refused"] = refused
        return self._observe(), reward, terminated, truncated, facts

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

    def _answer(self, answer: Any) -> tuple[float, bool, bool, dict[str, Any]]:
        """Reward, whether the task ended itself, whether an outer limit ended it, and facts."""
        cut: Any = False
        match answer:
            case (reward, ended, Mapping() as facts):
                pass
            case (_, reward, ended, cut, Mapping() as facts):
                pass
            case _:
                raise HandedOverError(
                    f"Task {self.sizes.task}: step must return (reward, terminated, info): a "
                    "number for the team, a bool and a dictionary, or EPyMARL's five values; it "
                    f"returned {contract.came(answer)}."
                )
        worth = self._checked("step", contract.payment, reward)
        over = self._checked("step", contract.truth, ended, "terminated")
        truncated = self._checked("step", contract.truth, cut, "truncated")
        limit = facts.get("episode_limit", False)
        limited = self._checked("step", contract.truth, limit, 'info["episode_limit"]')
        terminated = over and not limited
        return worth, terminated, (over or truncated) and not terminated, dict(facts)

    def _observe(self) -> dict[str, Any]:
        spec, n = self.sizes, self.sizes.n_agents
        seen = {
            "obs": self._shown("get_obs", contract.numbers, (n, spec.obs_size)),
            "state": self._shown("get_state", contract.numbers, (spec.state_size,)),
        }
        available = self._shown("get_avail_actions", contract.mask, (n, spec.n_actions))
        self._checked("get_avail_actions", contract.refuse_idle, available)
        self._available = available.astype(np.int8)
        return seen | {"avail_actions": self._available.copy()}

    def _shown(self, method: str, check: Callable[..., Any], shape: tuple[int, ...]) -> Any:
        value = getattr(self._env, method)()
        return self._checked(method, check, value, shape, f"what {method} returned")

    def _checked(self, method: str, check: Callable[..., Any], *arguments: Any) -> Any:
        """A check of what a method of the environment returned."""
        try:
            return check(*arguments)
        except HandedOverError as error:
            steps = f"{self._steps} step{'s' * (self._steps != 1)}"
            raise HandedOverError(
                f"Task {self.sizes.task}, after {steps}: {error}"
                f"{contract.place(self._env, method)}."
            ) from error

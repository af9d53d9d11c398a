"""An environment whose every answer has been checked, and whose errors are told as the user's."""

import inspect
import signal
from typing import Any, Final, NoReturn, final

import numpy as np
from jaxtyping import Int, UInt8
from numpy.typing import NDArray

from race.envs import contract
from race.envs.contract import ActionBox, Seen, Step
from race.errors import EnvFailedError, HandedOverError, RaceError, RenderError, described
from race.types import AnyTask, EnvSpec, Task

_PASSING: Final = (RaceError, KeyboardInterrupt, GeneratorExit)
"""What is raised as it is: our own errors, and what is nobody's error."""


@final
class CheckedEnv:
    """One environment of a task, through the checks of `race.envs.contract`.

    Attributes:
        takes_seed: whether its ``reset`` has a place for a seed. Where it has none, episodes do not
            repeat.
    """

    def __init__(self, task: AnyTask, number: int = 0, render_mode: str | None = None) -> None:
        """Makes the environment.

        Args:
            task: the task.
            number: which of several it is, for messages.
            render_mode: None or ``"rgb_array"``.

        Raises:
            EnvFailedError: if making it fails.
            HandedOverError: if what was made is no environment.
        """
        self._spec, self._number = task.spec, number
        self._seed: int | None = None
        self._steps = 0
        self._read = contract.reader(task.spec)
        self._wins = not isinstance(task.spec, EnvSpec) and task.spec.has_wins
        self._env: Any = None
        try:
            self._env = task.make(render_mode)
        except BaseException as error:
            self._failed(error, "when it was made")
        if not all(callable(getattr(self._env, name, None)) for name in ("reset", "step")):
            raise HandedOverError(
                f"Task {task.spec.task}: its make function returned {contract.came(self._env)} "
                "instead of a gymnasium environment, which has reset and step. Let it return one."
            )
        self.takes_seed = takes(self._env.reset, seed=0)
        self._box: ActionBox | None = None
        if isinstance(task, Task):
            try:
                self._box = ActionBox(task.spec, getattr(self._env, "action_space", None))
            except HandedOverError as error:
                raise HandedOverError(f"Task {task.spec.task}: {error}.") from error

    @property
    def env(self) -> Any:
        """The environment itself, for what draws it."""
        return self._env

    def reset(self, seed: int) -> Seen:
        """Begins an episode; returns what is seen first.

        Raises:
            EnvFailedError: if the environment raises an error.
            HandedOverError: if what it shows breaks the contract.
        """
        self._seed, self._steps = seed, 0
        try:
            answer = self._env.reset(seed=seed) if self.takes_seed else self._env.reset()
        except BaseException as error:
            self._failed(error, self._where())
        try:
            seen: Seen = self._read(contract.observation_of(answer))
        except HandedOverError as error:
            raise self._wrong(error, "reset") from error
        return seen

    def step(self, action: NDArray[np.float32] | Int[np.ndarray, "N"]) -> Step:
        """One step.

        Args:
            action: the joint action [U] in the environment's units, or one number per agent [N].
                The environment is given a copy, which it may write to.

        Raises:
            EnvFailedError: if the environment raises an error.
            HandedOverError: if what it answers breaks the contract.
        """
        self._steps += 1
        given = np.array(action, np.int64) if self._box is None else self._box.handed(action)
        try:
            answer = self._env.step(given)
        except BaseException as error:
            self._failed(error, self._where())
        try:
            observation, reward, terminated, truncated, info = contract.parts_of(answer)
            won = self._wins and contract.truth(info.get("battle_won", False), 'info["battle_won"]')
            return Step(
                self._read(observation),
                contract.payment(reward),
                contract.truth(terminated, "terminated"),
                contract.truth(truncated, "truncated"),
                won,
            )
        except HandedOverError as error:
            raise self._wrong(error, "step") from error

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """A picture of the environment as it stands.

        Raises:
            RenderError: if it gives none.
        """
        try:
            drawn = self._env.render()
        except BaseException as error:
            self._failed(error, f"while it was drawn, {self._where()}")
        picture: NDArray[Any] = drawn if isinstance(drawn, np.ndarray) else np.zeros(())
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] not in (3, 4):
            raise RenderError(
                f"The environment of {self._spec.task} drew no picture: render returned "
                f"{contract.came(drawn)}, but must return an array [height, width, 3] of uint8. "
                "Let make('rgb_array') make an environment that does"
                f"{contract.place(self._env, 'render')}."
            )
        return np.ascontiguousarray(picture[..., :3])

    def close(self) -> None:
        """Closes the environment; a second time does nothing.

        Raises:
            EnvFailedError: if that fails.
        """
        env, self._env = self._env, None
        close = getattr(env, "close", None)
        if not callable(close):
            return
        try:
            close()
        except BaseException as error:
            self._failed(error, "when it was closed")

    def _where(self) -> str:
        what = f"at step {self._steps}" if self._steps else "in the reset"
        return f"{what} of the episode of seed {self._seed} (environment {self._number})"

    def _failed(self, error: BaseException, where: str) -> NoReturn:
        if isinstance(error, _PASSING) and not _is_own_interrupt(error):
            raise error
        raise EnvFailedError(
            f"The environment of {self._spec.task} failed {where}: {described(error)}."
        ) from error

    def _wrong(self, error: HandedOverError, method: str) -> HandedOverError:
        text = str(error)
        return HandedOverError(
            f"The environment of {self._spec.task} broke the contract {self._where()}: {text}"
            f"{contract.place(self._env, method)}."
        )


def _is_own_interrupt(error: BaseException) -> bool:
    """Whether an environment itself raised `KeyboardInterrupt`, where Ctrl-C does not raise it."""
    asks = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    return isinstance(error, KeyboardInterrupt) and not asks


def takes(function: Any, *args: Any, **kwargs: Any) -> bool:
    """Whether a function can be called with such arguments."""
    try:
        inspect.signature(function).bind(*args, **kwargs)
    except (TypeError, ValueError):  # no function, other arguments, or none that can be known
        return False
    return True

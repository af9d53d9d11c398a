"""A battle of StarCraft II in a process of its own, as an environment with PyMARL's interface."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from multiprocessing import connection
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, final

import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from race.envs.starcraft import game, telling
from race.errors import EnvFailedError, TaskError

_PROGRAM: Final = Path(game.__file__)
OPENING_SECONDS: Final = 180.0
"""Importing SMAC from a slow disk takes its time."""
_CLOSING_SECONDS: Final = 4.0
_LAST_LINES: Final = 3


class Wanted(NamedTuple):
    """A battle to be played. ``python`` is the interpreter with SMAC; None: this one."""

    package: str
    """``smac`` or ``smacv2``."""
    name: str
    """Of the map or scenario."""
    kwargs: dict[str, Any]
    """Arguments of SMAC's environment."""
    usual: dict[str, Any] | None = None
    """Those of a scenario of SMACv2, for where its package does not bring them along."""
    python: str | None = None

    @property
    def task(self) -> str:
        """The id of its task."""
        return f"{self.package}/{self.name}"


def interpreter(python: str | None) -> str:
    """The path of an interpreter, without following links: a virtual environment is one.

    Raises:
        TaskError: if there is none.
    """
    if python is None:
        return sys.executable
    # Not by pathlib, to which ./python is python, which is looked for elsewhere.
    found = shutil.which(os.path.expanduser(python))  # noqa: PTH111
    if found is None:
        raise TaskError(
            f"--env.python {python} is no program that there is. Name the interpreter that has "
            "SMAC, such as sc2-python/bin/python (docs/starcraft.md)."
        )
    return str(Path(found).absolute())


@final
class Worker:
    """The process in which SMAC and its game run: `race.envs.starcraft.game`. Close it.

    It and its game are a process group of their own, which Ctrl-C does not reach; nothing of it is
    left when it is closed, nor for longer than a few seconds when whoever made it is gone.
    """

    def __init__(self, python: str | None) -> None:
        """Starts the process.

        Raises:
            TaskError: if there is no such interpreter.
        """
        self.python = interpreter(python)
        self._said: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - until it is closed
        folders = [str(Path(self.python).parent), os.environ.get("PATH", os.defpath)]
        try:
            self._process = subprocess.Popen(
                [self.python, "-u", str(_PROGRAM)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._said,
                start_new_session=True,
                env={**os.environ, "PATH": os.pathsep.join(folders)},
            )
        except OSError as error:
            self._said.close()
            raise TaskError(
                f"{self.python} cannot be started: {error.strerror}. Name another interpreter "
                "with --env.python."
            ) from error
        self._busy = self._closed = False

    @property
    def process_id(self) -> int:
        """Of the process, and of its process group."""
        return self._process.pid

    def ask(
        self, message: dict[str, Any], seconds: float | None = None
    ) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Asks and waits for the answer.

        Args:
            message: as `race.envs.starcraft.game` understands it.
            seconds: how long to wait; None: as long as it takes.

        Returns:
            What is told, and arrays.

        Raises:
            game.RefusedError: if it cannot be done.
            EnvFailedError: if the process ended, or answers nothing that can be understood.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._busy = True
        try:
            game.send(self._process.stdin, message)
            if not connection.wait([self._process.stdout.fileno()], seconds):
                raise EnvFailedError(
                    f"{self.python} did not answer within {seconds:g} seconds. Is it a Python that "
                    "can import SMAC?"
                )
            answer, arrays = game.receive(self._process.stdout)
        except (EOFError, OSError, ValueError) as error:
            raise EnvFailedError(self._end()) from error
        self._busy = False
        if "refused" in answer:
            raise game.RefusedError(answer["refused"], **answer["facts"])
        return answer["done"], arrays

    def close(self) -> None:
        """Ends the game and the process; at once if it is busy. A second time does nothing."""
        if self._closed:
            return
        self._closed = True
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
        self._finish(0.0 if self._busy else _CLOSING_SECONDS)
        self._said.close()

    def _finish(self, seconds: float) -> int | None:
        """Lets the process end, then kills what is left of its group; its exit code, if it ended.

        It is reaped last: until then its number is that of its group and nobody else's.
        """
        if self._process.returncode is not None:
            return self._process.returncode
        deadline = time.monotonic() + seconds
        while not (ended := self._has_ended()) and time.monotonic() < deadline:
            time.sleep(0.01)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process_id, signal.SIGKILL)
        code = self._process.wait()
        return code if ended else None

    def _has_ended(self) -> bool:
        how = os.WEXITED | os.WNOWAIT | os.WNOHANG
        return os.waitid(os.P_PID, self.process_id, how) is not None

    def _end(self) -> str:
        """How the process ended, and what it said last."""
        code = self._finish(_CLOSING_SECONDS)
        how = "gave no answer that can be understood"
        if code is not None:
            how = f"was ended by signal {-code}" if code < 0 else f"exited with {code}"
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").split("\n")
        last = [line.strip() for line in lines if line.strip()][-_LAST_LINES:]
        said = f", after it had said: {' / '.join(last)[-600:]}" if last else ""
        return f"{self.python} {how}{said}."


@final
class RemoteBattle:
    """SMAC's environment of a map or scenario, with PyMARL's interface.

    Attributes:
        told: versions, names and where things are, as `race.envs.starcraft.game.Battle.open` says.
    """

    def __init__(self, wanted: Wanted) -> None:
        """Starts the process; the game starts with the first reset.

        Raises:
            TaskError: if SMAC, the game or the map is not there.
        """
        self._wanted = wanted
        self._steps = 0
        self._seen: dict[str, NDArray[Any]] = {}
        self._worker = Worker(wanted.python)
        asked = {**wanted._asdict(), "do": "open"}
        try:
            self.told, _ = self._worker.ask(asked, OPENING_SECONDS)
        except BaseException as error:
            self._worker.close()
            if isinstance(error, game.RefusedError):
                text = telling.refusal(wanted.task, self._worker.python, error.kind, error.facts)
                raise TaskError(text) from error
            if isinstance(error, EnvFailedError):
                text = f"Task {wanted.task}: {error} {telling.CHOOSE}"
                raise TaskError(text) from error
            raise

    def get_env_info(self) -> dict[str, Any]:
        """Numbers of agents and actions, sizes, and the episode limit."""
        return dict(self.told["info"])

    def reset(self, seed: int) -> None:
        """Begins an episode. The first seed is the game's; SMACv2 draws teams and places by each.

        Raises:
            EnvFailedError: if the game cannot be started or breaks down.
        """
        self._steps = 0
        _, self._seen = self._ask({"do": "reset", "seed": seed})

    def step(self, actions: list[int]) -> tuple[float, bool, dict[str, Any]]:
        """Reward, whether the episode is over, and facts such as ``battle_won``.

        Raises:
            EnvFailedError: if the game breaks down.
        """
        self._steps += 1
        told, self._seen = self._ask({"do": "step", "actions": actions})
        return told["reward"], told["over"], told["facts"]

    def get_obs(self) -> NDArray[np.float32]:
        """What each agent observes, [N, O]."""
        return self._seen["obs"]

    def get_state(self) -> NDArray[np.float32]:
        """The global state, [S]."""
        return self._seen["state"]

    def get_avail_actions(self) -> NDArray[np.int8]:
        """1 where an action is available, [N, A]."""
        return self._seen["avail_actions"]

    def render(self, mode: str) -> UInt8[np.ndarray, "h w 3"]:
        """A picture of the battle, by SMAC's own renderer.

        Raises:
            EnvFailedError: if it fails.
        """
        _, arrays = self._ask({"do": "render"})
        return arrays["picture"]

    def close(self) -> None:
        """Ends the game and its process."""
        self._worker.close()

    def _ask(self, message: dict[str, Any]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        try:
            return self._worker.ask(message)
        except game.RefusedError as error:
            text = telling.failure(error.kind, error.facts)
        except EnvFailedError as error:
            text = f"its process is gone: {error}"
        where = f"at step {self._steps} of an episode" if self._steps else "when a battle began"
        if message["do"] == "render":
            where = "when it was drawn"
            text += " PySC2 draws with Python 3.10 or older."
        raise EnvFailedError(f"The game of {self._wanted.task} failed {where}: {text}")

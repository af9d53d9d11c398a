"""An environment in a process of its own, which may hang, crash or be killed and harms nobody.

The checks are made there, so that what comes back is the same as from an environment in this
process. Nothing here imports jax: a worker is up in the time that the user's module takes.
"""

import contextlib
import multiprocessing
import os
import pickle
import signal
from multiprocessing.connection import Connection
from typing import Any, Final, final

import cloudpickle

from race import errors
from race.envs.checked import CheckedEnv
from race.errors import EnvFailedError, RaceError, described
from race.types import AnyTask, DiscreteTask

_CLOSING_SECONDS: Final = 5.0
_SLOW: Final = 10
"""Making and resetting an environment may take so many times as long as a step."""
_LEAST_SLOW_SECONDS: Final = 60.0

# A process in which JAX runs threads must not be forked: workers start from one that has none.
_processes: Final = multiprocessing.get_context("forkserver")


@final
class WorkerEnv:
    """A `CheckedEnv` in a process: ask, then wait for the answer, so that several work at once.

    Making it starts the process; its first answer says that the environment was made.

    Args:
        task: the task. What makes its environment must be importable, or pickled by cloudpickle.
        number: which of several it is, for messages.
        step_seconds: a step that takes longer is a failure; None: it may take for ever.
    """

    def __init__(self, task: AnyTask, number: int, step_seconds: float | None = None) -> None:
        self._name, self._number, self._limit = task.spec.task, number, step_seconds
        if isinstance(task, DiscreteTask):
            task = task._replace(device=None)
        try:
            pickled = cloudpickle.dumps((task, number))
        except Exception as error:  # whatever their objects do when they are pickled
            raise EnvFailedError(
                f"The environment of {self._name} cannot be sent to a process of its own: "
                f"{described(error)}. Let its make be a function of a module, or keep it in this "
                "process with --env.processes False."
            ) from error
        self._pipe, theirs = _processes.Pipe()
        self._process = _processes.Process(target=_serve, args=(theirs, pickled), daemon=True)
        self._process.start()
        theirs.close()
        self._waiting = "made"
        self._steps = 0

    @property
    def process_id(self) -> int | None:
        """The process's id."""
        return self._process.pid

    def ask_reset(self, seed: int) -> None:
        """Asks for `CheckedEnv.reset`."""
        self._steps = 0
        self._ask("reset", seed)

    def ask_step(self, action: Any) -> None:
        """Asks for `CheckedEnv.step`."""
        self._steps += 1
        self._ask("step", action)

    def answer(self) -> Any:
        """What was asked for.

        Raises:
            EnvFailedError: if the environment failed, its process ended or was too slow.
            HandedOverError: if what it answered breaks the contract.
        """
        waiting, limit = self._waiting, self._limit
        if limit is not None and waiting != "step":
            limit = max(_SLOW * limit, _LEAST_SLOW_SECONDS)
        try:
            if limit is not None and not self._pipe.poll(limit):
                self._kill()
                raise EnvFailedError(
                    f"The environment of {self._name} did not answer within {limit:g} seconds "
                    f"{self._where()}, so its process was ended. Give it more time with "
                    "--env.step-seconds, or look for what it waits for."
                )
            kind, value = self._pipe.recv()
        except (EOFError, OSError) as error:
            self._process.join(_CLOSING_SECONDS)
            code = self._process.exitcode
            how = f"was ended by signal {-code}" if code and code < 0 else f"exited with {code}"
            script = 'A script of yours needs the usual `if __name__ == "__main__":`. '
            raise EnvFailedError(
                f"The process of an environment of {self._name} {how} {self._where()}, without an "
                f"error message. {script if waiting == 'made' else ''}Run it with --env.processes "
                "False to see what ends it."
            ) from error
        self._waiting = ""
        if kind == "done":
            return value
        raise getattr(errors, kind)(value)

    def close(self) -> None:
        """Closes the environment and ends the process; at once if it is busy.

        Raises:
            EnvFailedError: if the environment fails when it is closed.
        """
        if self._pipe.closed:
            return
        try:
            if not self._waiting and self._process.is_alive():
                with contextlib.suppress(OSError):
                    self._ask("close", None)
                    if self._pipe.poll(_CLOSING_SECONDS):
                        self.answer()
        finally:
            self._kill()

    def _ask(self, what: str, value: Any) -> None:
        self._waiting = what
        with contextlib.suppress(OSError):  # it has ended, which the answer tells
            self._pipe.send((what, value))

    def _where(self) -> str:
        match self._waiting:
            case "made":
                what = "when it was made"
            case "reset":
                what = "in a reset"
            case "close":
                what = "when it was closed"
            case _:
                what = f"at step {self._steps} of an episode"
        return f"{what} (environment {self._number})"

    def _kill(self) -> None:
        self._pipe.close()
        self._process.kill()
        self._process.join()


def _serve(pipe: Connection, pickled: bytes) -> None:
    """What the process does: answers, until its pipe is closed or it is told to end."""
    os.dup2(2, 1)  # what an environment prints is no output of a command
    # Ctrl-C reaches every process of a terminal, and a hang-up too; the main one ends its workers.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    env: Any = None
    what, value = "make", None
    while True:
        try:
            if what == "make":
                env = _made(pickled)
                reply: tuple[str, Any] = ("done", None)
            else:
                reply = ("done", getattr(env, what)(*([] if value is None else [value])))
        except RaceError as error:
            reply = (type(error).__name__, str(error))
        except KeyboardInterrupt:
            reply = ("EnvFailedError", "The environment raised KeyboardInterrupt.")
        try:
            pipe.send(reply)
            what, value = pipe.recv()
        except (EOFError, OSError):  # nobody is there any more
            return


def _made(pickled: bytes) -> CheckedEnv:
    try:
        task, number = pickle.loads(pickled)
    except BaseException as error:
        raise EnvFailedError(
            f"What makes the environment cannot be imported in a process: {described(error)}."
        ) from error
    return CheckedEnv(task, number)

"""Environments in processes, which may hang, crash or be killed and harm nobody else.

The checks are made there, so that what comes back is the same as from an environment in this
process. Nothing here imports jax: a worker is up in the time that the user's module takes.
"""

import contextlib
import multiprocessing
import os
import pickle
import signal
from collections.abc import Mapping
from multiprocessing.connection import Connection
from typing import Any, Final, Literal, final

import cloudpickle

from race import errors
from race.envs.checked import CheckedEnv
from race.errors import EnvFailedError, RaceError, described
from race.types import AnyTask, DiscreteTask

Request = Literal["make", "reset", "step", "close"]

_CLOSING_SECONDS: Final = 5.0
_SLOW: Final = 10
"""Making and resetting an environment may take so many times as long as a step."""
_LEAST_SLOW_SECONDS: Final = 60.0

# A process in which JAX runs threads must not be forked: workers start from one that has none.
_processes: Final = multiprocessing.get_context("forkserver")


@final
class EnvProcess:
    """A process with some `CheckedEnv`: ask, then wait for the answers, so that several work.

    Environments go by numbers, those of messages. They work one after the other, each answer comes
    when it is there. A process that ends or is too slow takes all its environments with it.

    Args:
        task: the task. What makes its environment must be importable, or pickled by cloudpickle.
        step_seconds: a step that takes longer is a failure; None: it may take for ever.

    Attributes:
        ended: whether it is no longer there, and so will answer nothing any more.
    """

    def __init__(self, task: AnyTask, step_seconds: float | None = None) -> None:
        self._name, self._limit, self.ended = task.spec.task, step_seconds, False
        if isinstance(task, DiscreteTask):
            task = task._replace(device=None)
        try:
            pickled = cloudpickle.dumps(task)
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
        self._waiting: dict[int, str] = {}
        self._answers: dict[int, tuple[str, Any]] = {}
        self._steps: dict[int, int] = {}

    @property
    def process_id(self) -> int | None:
        """The process's id."""
        return self._process.pid

    def ask(self, what: Request, values: Mapping[int, Any]) -> None:
        """Asks some environments, which must have answered what they were asked before.

        Args:
            what: to make an environment, or for the method of `CheckedEnv` of that name.
            values: its argument, by the environments' numbers.
        """
        for number in values:
            self._waiting[number] = what
            begun = 0 if what != "step" else self._steps.get(number, 0)
            self._steps[number] = begun + (what == "step")
        with contextlib.suppress(OSError):  # it has ended, which the answers tell
            self._pipe.send((what, dict(values)))

    def answer(self, number: int) -> Any:
        """What an environment was asked for.

        Raises:
            EnvFailedError: if it failed, its process ended or was too slow.
            HandedOverError: if what it answered breaks the contract.
        """
        while number not in self._answers:
            self._receive()
        kind, value = self._answers.pop(number)
        if kind == "done":
            return value
        raise getattr(errors, kind)(value)

    def close(self) -> None:
        """Closes the environments and ends the process; at once if it is busy.

        Raises:
            EnvFailedError: if one of the environments fails when it is closed.
        """
        if self.ended:
            return
        try:
            if not self._waiting and self._process.is_alive():
                numbers = list(self._steps)
                self.ask("close", dict.fromkeys(numbers))
                failures = [error for number in numbers if (error := self._failure(number))]
                if failures:
                    raise failures[0]
        finally:
            self._kill()

    def _failure(self, number: int) -> EnvFailedError | None:
        try:
            self.answer(number)
        except EnvFailedError as error:
            return error
        return None

    def _receive(self) -> None:
        """Waits for the next answer; without one, all that are waited for have failed."""
        number, what = next(iter(self._waiting.items()))
        limit = self._limit
        if what == "close":
            limit = _CLOSING_SECONDS
        elif limit is not None and what != "step":
            limit = max(_SLOW * limit, _LEAST_SLOW_SECONDS)
        try:
            if limit is not None and not self._pipe.poll(limit):
                told = (
                    f"The environment of {self._name} did not answer within {limit:g} seconds "
                    f"{self._where(number)}, so its process was ended. Give it more time with "
                    "--env.step-seconds, or look for what it waits for."
                )
                return self._fail(number, "" if what == "close" else told)
            number, kind, value = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join(_CLOSING_SECONDS)
            code = self._process.exitcode
            how = f"was ended by signal {-code}" if code and code < 0 else f"exited with {code}"
            script = 'A script of yours needs the usual `if __name__ == "__main__":`. '
            return self._fail(
                number,
                f"The process of an environment of {self._name} {how} {self._where(number)}, "
                f"without an error message. {script if what == 'make' else ''}Run it with "
                "--env.processes False to see what ends it.",
            )
        del self._waiting[number]
        self._answers[number] = kind, value
        return None

    def _fail(self, culprit: int, told: str) -> None:
        """All that are waited for have failed, those behind the first because of it."""
        for number, what in self._waiting.items():
            beside = (
                f"The process of an environment of {self._name} ended because of another one in it "
                f"(environment {culprit})."
            )
            said = told if number == culprit else beside
            closing = what == "close" and not told  # too slow to be closed, which harms nobody
            self._answers[number] = ("done", None) if closing else ("EnvFailedError", said)
        self._waiting.clear()
        self._kill()

    def _where(self, number: int) -> str:
        match self._waiting[number]:
            case "make":
                what = "when it was made"
            case "reset":
                what = "in a reset"
            case "close":
                what = "when it was closed"
            case _:
                what = f"at step {self._steps[number]} of an episode"
        return f"{what} (environment {number})"

    def _kill(self) -> None:
        self.ended = True
        self._pipe.close()
        self._process.kill()
        self._process.join()


def _serve(pipe: Connection, pickled: bytes) -> None:
    """What the process does: answers, until its pipe is closed or it is told to end."""
    os.dup2(2, 1)  # what an environment prints is no output of a command
    # Ctrl-C reaches every process of a terminal, and a hang-up too; the main one ends its workers.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    envs: dict[int, CheckedEnv] = {}
    while True:
        try:
            what, values = pipe.recv()
            for number, value in values.items():
                pipe.send((number, *_answered(envs, what, number, value, pickled)))
        except (EOFError, OSError):  # nobody is there any more
            return


def _answered(
    envs: dict[int, CheckedEnv], what: Request, number: int, value: Any, pickled: bytes
) -> tuple[str, Any]:
    """Whether it is done, or the name of the error; and what it gave, or was said."""
    try:
        if what == "make":
            before = envs.pop(number, None)  # it has failed
            if before is not None:
                with contextlib.suppress(EnvFailedError):
                    before.close()
            envs[number] = _made(pickled, number)
            return "done", None
        if what == "close":
            env = envs.pop(number, None)  # none, if it could not be made
            if env is not None:
                env.close()
            return "done", None
        return "done", getattr(envs[number], what)(value)
    except RaceError as error:
        return type(error).__name__, str(error)
    except KeyboardInterrupt:
        return "EnvFailedError", "The environment raised KeyboardInterrupt."


def _made(pickled: bytes, number: int) -> CheckedEnv:
    try:
        task = pickle.loads(pickled)
    except BaseException as error:
        raise EnvFailedError(
            f"What makes the environment cannot be imported in a process: {described(error)}."
        ) from error
    return CheckedEnv(task, number)

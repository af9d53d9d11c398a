"""Ctrl-C, SIGTERM and SIGHUP as a request: what is under way is finished and saved first."""

import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, final

Handlers = dict[int, Any]
"""Handlers of signals, by their numbers."""


def listen(handler: Callable[[int, FrameType | None], None]) -> Handlers:
    """Hands SIGINT, SIGTERM and SIGHUP to ``handler``; returns who had them before.

    What is ignored, as SIGHUP under ``nohup``, stays so.
    """
    previous: Handlers = {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number == signal.SIGHUP and signal.getsignal(number) == signal.SIG_IGN:
            continue
        previous[number] = signal.signal(number, handler)
    return previous


def give_back(previous: Handlers) -> None:
    """Gives the signals back to those who had them, once."""
    while previous:
        number, handler = previous.popitem()
        signal.signal(number, handler)


@final
class Interrupts:
    """Turns the first SIGINT, SIGTERM or SIGHUP within a ``with`` block into `requested`.

    A second one interrupts at once, as if there were no handler. What is ignored, as SIGHUP under
    ``nohup``, stays so. Outside the main thread, where Python delivers no signals, it does nothing.
    """

    def __init__(self) -> None:
        self.requested = False
        self._previous: Handlers = {}

    def __enter__(self) -> "Interrupts":
        if threading.current_thread() is threading.main_thread():
            self._previous = listen(self._request)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        give_back(self._previous)

    def stop(self) -> None:
        """The same wish, from within the program."""
        self.requested = True

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        give_back(self._previous)

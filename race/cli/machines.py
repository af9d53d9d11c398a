"""Where processes of runs run: on this machine, or wherever else something offers to."""

import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, final, runtime_checkable

from race.cli.worker import Process, start_here
from race.config.cohort import Batching


@runtime_checkable
class Machines(Protocol):
    """Takes the processes of cohorts."""

    def room(self) -> bool:
        """Whether one more can be started now."""

    def start(self, paths: Sequence[Path], batching: Batching, log: Path) -> Process:
        """Goes on with the runs of some directories."""


@final
class ThisMachine:
    """So many processes at a time, each on a core or an accelerator of its own."""

    def __init__(self, slots: Sequence[tuple[int | None, str | None]]) -> None:
        """A machine.

        Args:
            slots: for each process that may run at a time the core that it is kept on, if any,
                and what its accelerator is called, if it has one.
        """
        self._free = list(slots)

    def room(self) -> bool:
        """Whether one more can be started now."""
        return bool(self._free)

    def start(self, paths: Sequence[Path], batching: Batching, log: Path) -> Process:
        """Goes on with the runs of some directories."""
        slot = self._free.pop(0)
        return _Local(start_here(paths, batching, log, *slot), self._free, slot)


@final
class _Local:
    """A process of this machine, which gives its slot back when it has ended."""

    def __init__(
        self,
        process: "subprocess.Popen[bytes]",
        free: list[tuple[int | None, str | None]],
        slot: tuple[int | None, str | None],
    ) -> None:
        self._process, self._free, self._slot = process, free, slot
        self._ended = False

    def poll(self) -> int | None:
        code = self._process.poll()
        if code is not None and not self._ended:
            self._ended = True
            self._free.append(self._slot)
        return code

    def interrupt(self) -> None:
        self._process.send_signal(signal.SIGINT)

    def end(self) -> None:
        self._process.terminate()

    def told(self) -> str:
        return ""

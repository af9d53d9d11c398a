"""A Ray cluster as machines for runs: ``--on ray`` (one on this machine) or ``--on ray://HOST``.

A cohort is a task with its cores, memory and accelerator stated. Tasks are sent as far as there is
room, so that whoever stops sending leaves nothing behind; one that is lost with its machine is sent
again by `race.cli.fleet`, and goes on from its last checkpoint.
"""

import contextlib
import logging
import math
import os
import re
import shutil
import socket
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, final

from race.cli.carried import STOP, begun, carry_out
from race.cli.worker import INTERRUPTED, LOST
from race.closing import Closing
from race.compilation import cores
from race.config.cohort import Batching
from race.errors import ConfigError, RaceError

PORT = 10001
"""Where Ray listens for clients, unless told otherwise."""
ANSWER_WITHIN = 8.0
"""Seconds."""
_LOOK_FOR_NODES_EVERY = 5.0
_LEAST_STORE = 100_000_000  # bytes for Ray's objects, of which there are none


class Need(NamedTuple):
    """What a task asks for."""

    memory: int  # bytes
    cores: int = 1
    gpus: int = 0

    def __str__(self) -> str:
        gpu = ", a GPU" if self.gpus else ""
        return f"{self.cores} core{gpu} and {self.memory / 1e9:.1f} GB of memory"

    def fits(self, resources: dict[str, float]) -> int:
        """How many such tasks a machine has room for."""
        shares = [resources.get("CPU", 0.0) / self.cores, resources.get("memory", 0) / self.memory]
        if self.gpus:
            shares.append(resources.get("GPU", 0.0) / self.gpus)
        return math.floor(min(shares))


def check_address(on: str) -> None:
    """Refuses what names no cluster.

    Raises:
        ConfigError: saying what does.
    """
    named = re.fullmatch(r"ray://[\w.-]+(?::(\d{1,5}))?", on)
    if on != "ray" and (named is None or int(named[1] or PORT) not in range(1, 65536)):
        raise ConfigError(
            f"--on is {on!r}, but it must be ray, to start a cluster of this machine alone, or "
            f"ray://HOST or ray://HOST:PORT, where a cluster listens for clients (port {PORT} "
            "unless told otherwise)."
        )


@final
class Cluster(Closing):
    """A connection to a cluster; a context that ends what it has sent.

    Attributes:
        gpus: accelerators of all machines.
    """

    def __init__(self, on: str, folder: Path) -> None:
        """Connects.

        Args:
            on: ``ray`` or ``ray://HOST:PORT``.
            folder: that of the runs, which all machines share.

        Raises:
            ConfigError: if ``on`` is neither.
            RaceError: if Ray is not installed, or no cluster answers.
        """
        check_address(on)
        self._ray = _connected(on)
        self._here = Path.cwd()
        self._signs = Path(tempfile.mkdtemp(prefix=".cluster-", dir=folder.resolve()))
        self._needs: dict[Path, Need] = {}
        self._most: int | None = None
        self._sent: list[_Task] = []
        self._nodes: list[dict[str, float]] = []
        self._looked = -math.inf
        self.gpus = int(sum(node.get("GPU", 0) for node in self._machines()))

    def plan(self, needs: dict[Path, Need], most: int | None) -> None:
        """What the cohorts need, by the directory of their first run, and how many go at a time.

        Raises:
            RaceError: if no machine is large enough for one of them.
        """
        self._needs, self._most = needs, most
        for need in needs.values():
            if not any(need.fits(machine) for machine in self._machines()):
                raise RaceError(
                    f"No machine of the cluster offers {need}, which a process of these runs "
                    f"needs. It has {_described(self._machines())}. Add one, or make less of a "
                    "run: a smaller replay buffer, or fewer runs in a cohort (--cohort.width)."
                )

    def room(self) -> bool:
        """Whether one more can be started now."""
        self._sent = [task for task in self._sent if task.poll() is None]
        widest = Need(*map(max, zip(*self._needs.values(), strict=True)))
        most = sum(widest.fits(machine) for machine in self._machines())
        return len(self._sent) < (most if self._most is None else min(most, self._most))

    def start(self, paths: Sequence[Path], batching: Batching, log: Path) -> "_Task":
        """Sends a task that goes on with the runs of some directories."""
        del log  # where it is, the task knows
        task = _Task(self._ray, self._signs, self._needs[paths[0]], paths, batching, self._here)
        self._sent.append(task)
        return task

    def _machines(self) -> list[dict[str, float]]:
        if time.monotonic() - self._looked > _LOOK_FOR_NODES_EVERY:
            with _told_of_loss():
                nodes = self._ray.nodes()
            self._nodes = [node["Resources"] for node in nodes if node["Alive"]]
            self._looked = time.monotonic()
        return self._nodes

    def close(self) -> None:
        """Ends what has been sent, and leaves the cluster."""
        for task in self._sent:
            if not task.ended:
                task.end()
        with contextlib.suppress(Exception):  # it may be gone
            self._ray.shutdown()
        shutil.rmtree(self._signs, ignore_errors=True)


_numbers = iter(range(1, 1_000_000_000))


@final
class _Task:
    """A cohort that was sent to a cluster."""

    def __init__(
        self,
        ray: Any,
        signs: Path,
        need: Need,
        paths: Sequence[Path],
        batching: Batching,
        here: Path,
    ) -> None:
        self._ray, self._signs, self._number = ray, signs, next(_numbers)
        self._code: int | None = None
        self._asked = 0  # times
        self._cancelled = False
        self._told = ""
        send = ray.remote(carry_out).options(
            num_cpus=need.cores,
            num_gpus=need.gpus,
            memory=need.memory,
            max_retries=0,  # whoever sends it decides
            scheduling_strategy="SPREAD",
            name=f"race {paths[0].name}",
        )
        places = [path.resolve() for path in paths]
        with _told_of_loss():
            self._answer = send.remote(signs, self._number, places, batching, here, need.gpus)

    def poll(self) -> int | None:
        """Its exit status, None while it goes on, `LOST` if its machine is gone."""
        if self._code is None:
            with _told_of_loss():
                ended, _ = self._ray.wait([self._answer], timeout=0)
            if ended:
                self._code = self._ending()
            elif self._asked > 1:
                self.end()
            elif self._asked and not self._cancelled:
                self._cancelled = True
                if not begun(self._signs, self._number).exists():
                    with contextlib.suppress(Exception):  # it may have ended
                        self._ray.cancel(self._answer)
        return self._code

    @property
    def ended(self) -> bool:
        """Whether its end has been seen."""
        return self._code is not None

    def _ending(self) -> int:
        errors = self._ray.exceptions
        machine = "a machine that never answered"
        with contextlib.suppress(OSError):
            machine = f"the machine {begun(self._signs, self._number).read_text()}"
        try:
            return int(self._ray.get(self._answer))
        except errors.TaskCancelledError:
            return INTERRUPTED
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError) as error:
            words = " ".join(str(error).split())[:300]
            self._told = f"Its process was lost on {machine}: {words}"
            return LOST
        except errors.RayTaskError as error:
            self._told = str(error.cause)
        except errors.RayError as error:
            self._told = " ".join(str(error).split())[:300]
        return 1

    def interrupt(self) -> None:
        """Asks it, and all others, to save and stop; asked again, it ends at once.

        What is to be said to Ray is said at the next look: a signal's handler may come in between
        anything that is being said to it.
        """
        self._asked += 1
        with contextlib.suppress(OSError):
            (self._signs / STOP).touch()

    def end(self) -> None:
        """Ends it at once."""
        with contextlib.suppress(Exception):
            self._ray.cancel(self._answer, force=True)

    def told(self) -> str:
        """What is known of its end besides what it has written to its log."""
        return self._told


def _connected(on: str) -> Any:
    """The module, connected.

    Raises:
        RaceError: if it is not installed, or no cluster answers.
    """
    # Read when ray is imported: nothing is told to its makers, no metrics are kept, and where it
    # serves this machine alone, it listens on the loopback address alone.
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    if on == "ray":
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    try:
        import grpc
        import ray
    except ImportError as error:
        raise RaceError(
            f"--on {on} needs Ray, which is not installed: pip install 'race-marl[ray]'"
        ) from error
    try:
        with warnings.catch_warnings():
            # Its children become Ray at once and touch nothing of JAX.
            warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called")
            _join(ray, grpc, on)
    except RaceError:
        raise
    except Exception as error:  # of many kinds, such as other versions of Python or Ray
        words = " ".join(str(error).split())[:300]
        raise RaceError(f"The cluster {on} cannot be used: {words}") from error
    return ray


def _join(ray: Any, grpc: Any, on: str) -> None:
    quiet = {"logging_level": logging.ERROR, "log_to_driver": False}
    if on == "ray":
        ray.init(
            address="local",
            num_cpus=max(len(cores()), 1),
            include_dashboard=False,
            object_store_memory=_LEAST_STORE,
            _node_ip_address="127.0.0.1",
            **quiet,
        )
        return
    address = on.removeprefix("ray://")
    address = address if ":" in address else f"{address}:{PORT}"
    _await_answer(grpc, address, on)
    try:
        ray.init(f"ray://{address}", **quiet)
    except ConnectionAbortedError:
        # What the cluster starts for each client has been seen to die at its start now and then.
        ray.shutdown()
        ray.init(f"ray://{address}", **quiet)


def _await_answer(grpc: Any, address: str, on: str) -> None:
    """Ray itself would try for a minute."""
    host, _, port = address.rpartition(":")
    channel = grpc.insecure_channel(address)
    try:
        with socket.create_connection((host, int(port)), timeout=ANSWER_WITHIN):
            pass  # what refuses is heard of at once
        grpc.channel_ready_future(channel).result(timeout=ANSWER_WITHIN)
    except (OSError, grpc.FutureTimeoutError) as error:
        why = str(error) or "what listens there speaks another language, or does not answer"
        raise RaceError(
            f"No Ray cluster answers at {on} ({why}). See that it runs (`ray start --head "
            "--ray-client-server-port=10001` on its first machine), that this machine may reach "
            "it, and that the port is that for clients."
        ) from error
    finally:
        channel.close()


@contextlib.contextmanager
def _told_of_loss() -> Iterator[None]:
    try:
        yield
    except (ConnectionError, RuntimeError) as error:
        words = " ".join(str(error).split())[:200]
        raise RaceError(
            f"The connection to the cluster was lost ({words}). What was trained is kept; give the "
            "same command again to go on, or `race resume DIR` to go on without the cluster."
        ) from error


def _described(machines: Sequence[dict[str, float]]) -> str:
    told = [
        f"{machine.get('CPU', 0):.0f} cores, {machine.get('GPU', 0):.0f} GPUs and "
        f"{machine.get('memory', 0) / 1e9:.1f} GB"
        for machine in machines
    ]
    return "; ".join(dict.fromkeys(told)) or "no machine"

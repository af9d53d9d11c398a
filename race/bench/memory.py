"""The memory that a replay buffer takes while it is filled and learned from.

As a program, ``python -m race.bench.memory``, it does that and prints the bytes: a process's peak
is its own and never goes down, so each measurement needs a process of its own.
"""

import resource
import subprocess
import sys
from pathlib import Path

from race.bench.measurement import Measurement, Subject

GOAL_GB = 4.0
CAPACITY = 1_000_000
NAME = "memory/Humanoid-9x8/replay_1M"


def subjects() -> list[Subject]:
    """The buffer of the task with the largest state."""
    return [Subject((NAME,), _measure)]


def _measure() -> list[Measurement]:
    command = [sys.executable, "-m", "race.bench.memory"]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    return [Measurement(NAME, int(printed) / 1e9, "GB", GOAL_GB)]


def _peak() -> int:
    """Most bytes of memory that this process has used so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _now() -> int:
    """Bytes of memory that this process uses; where that is not known, the peak so far."""
    table = Path("/proc/self/statm")
    return int(table.read_text().split()[1]) * resource.getpagesize() if table.exists() else _peak()


def _bytes_of_replay() -> int:
    import jax
    import numpy as np

    from race import programs
    from race.bench.update import Updates, setting
    from race.replay import init_replay

    # MATD3 compiles sooner than RACE and reads the buffer in the same loop.
    updates = Updates(setting("Humanoid-9x8", 128, "matd3"), programs.INSERT_ROWS)
    rows = updates.replay.data
    jax.block_until_ready(updates(2))
    before = _now()
    replay = init_replay(updates.spec, CAPACITY)
    for _ in range(-(-CAPACITY // programs.INSERT_ROWS)):
        replay = programs.store(replay, rows, np.int32(programs.INSERT_ROWS))
    updates.replay = replay
    jax.block_until_ready(updates(2))
    return _peak() - before


if __name__ == "__main__":
    print(_bytes_of_replay())

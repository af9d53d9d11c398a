"""The memory that a replay buffer takes while it is filled and learned from.

As a program, ``python -m race.bench.memory transitions`` (or ``episodes``), it does that and prints
the bytes: a process's peak is its own and never goes down, so each measurement needs a process of
its own.
"""

import resource
import subprocess
import sys
from functools import partial
from pathlib import Path

from race.bench.measurement import Measurement, Subject

TRANSITIONS_GOAL_GB = 4.0
TRANSITIONS = 1_000_000
TASK = "Humanoid-9x8"
EPISODES_GOAL_GB = 6.0
MAP = "2c_vs_64zg"
"""The map whose episodes are the largest, because they are the longest."""


def subjects() -> list[Subject]:
    """The buffers of the task with the largest state and of the map with the largest episodes."""
    asked = [
        (f"memory/{TASK}/replay_1M", "transitions", TRANSITIONS_GOAL_GB),
        (f"memory/micro/{MAP}/replay_5000", "episodes", EPISODES_GOAL_GB),
    ]
    return [Subject((name,), partial(_measure, name, kind, goal)) for name, kind, goal in asked]


def _measure(name: str, kind: str, goal: float) -> list[Measurement]:
    command = [sys.executable, "-m", "race.bench.memory", kind]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    return [Measurement(name, int(printed) / 1e9, "GB", goal)]


def _peak() -> int:
    """Most bytes of memory that this process has used so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _now() -> int:
    """Bytes of memory that this process uses; where that is not known, the peak so far."""
    table = Path("/proc/self/statm")
    return int(table.read_text().split()[1]) * resource.getpagesize() if table.exists() else _peak()


def _bytes_of_transitions() -> int:
    import jax
    import numpy as np

    from race import programs
    from race.bench.update import Updates, setting
    from race.replay.buffer import init_replay
    from race.rollouts.transitions import empty_transition

    # MATD3 compiles sooner than RACE and reads the buffer in the same loop.
    updates = Updates(setting(TASK, 128, "matd3"), programs.INSERT_ROWS)
    rows = updates.replay.data
    jax.block_until_ready(updates(2))
    before = _now()
    replay = init_replay(empty_transition(updates.spec), TRANSITIONS)
    for _ in range(-(-TRANSITIONS // programs.INSERT_ROWS)):
        replay = programs.store(replay, rows, np.int32(programs.INSERT_ROWS))
    updates.replay = replay
    jax.block_until_ready(updates(2))
    return _peak() - before


def _bytes_of_episodes() -> int:
    import jax
    import numpy as np

    from race import programs
    from race.bench.episodes import EpisodeUpdates, random_episodes
    from race.config.presets import resolve
    from race.config.settings import Config
    from race.envs import make_discrete_task
    from race.replay.buffer import init_replay
    from race.rollouts.episodes import empty_episode

    spec = make_discrete_task(f"micro/{MAP}").spec
    config = resolve(Config(spec.task, "facmac"), discrete=True)
    rows = random_episodes(spec, 50, str(config.facmac.replay_precision))
    updates = EpisodeUpdates(config, spec, rows)
    jax.block_until_ready(updates(1))
    before = _now()
    item = empty_episode(spec, str(config.facmac.replay_precision))
    replay = init_replay(item, config.facmac.replay_capacity)
    for _ in range(config.facmac.replay_capacity // 50):
        replay = programs.store(replay, rows, np.int32(50))
    updates.replay = replay
    jax.block_until_ready(updates(1))
    return _peak() - before


if __name__ == "__main__":
    print({"transitions": _bytes_of_transitions, "episodes": _bytes_of_episodes}[sys.argv[1]]())

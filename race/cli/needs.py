"""What a process of some runs takes."""

from collections.abc import Sequence
from typing import Any

from race.cli.cluster import Need
from race.cli.worker import Watched

PROCESS_BYTES = 1_500_000_000
"""Memory of a process besides replay buffers: JAX, environments and compilation."""


def need_of(runs: Sequence[Watched], gpus: int) -> Need:
    """What a process of these runs asks a cluster with so many accelerators for."""
    replay = 0 if gpus else sum(replay_bytes(run.config) for run in runs)
    return Need(memory=PROCESS_BYTES + replay, gpus=min(gpus, 1))


def replay_bytes(config: Any) -> int:
    """Memory of a run's replay buffer."""
    import jax

    from race.envs import make_task
    from race.rollouts import rollouts_of

    with rollouts_of(config, make_task(config.task, config.env)) as rollouts:
        shapes = jax.eval_shape(lambda: rollouts.empty_replay(config))
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))

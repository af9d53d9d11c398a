"""The state of a run: everything that a checkpoint holds and a resumed run needs."""

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from race.algorithms import Algorithm
from race.algorithms.base import Losses
from race.config.settings import Config
from race.errors import CheckpointError
from race.networks.optimization import copy
from race.programs import empty_losses, start
from race.randomness import Purpose, root_key
from race.replay.buffer import Replay
from race.runs.checkpoints import SEGMENT_ROWS, Checkpoint, Rows
from race.runs.trees import flatten, restore
from race.types import Spec

SEGMENT_BYTES = 2**26


@dataclass(frozen=True)
class Progress:
    """How far a run is, as plain numbers (JSON holds it exactly)."""

    env_steps: int = 0
    """Steps of all teams, the random ones included."""
    random_steps: int = 0
    """Steps of the warm-up."""
    gradient_steps: int = 0
    episodes: int = 0
    """Episodes of all teams, without those of the warm-up."""
    generation: int = 0
    """Generations begun."""
    learning: bool = False
    """Whether the current generation has been rolled out and its gradient steps are under way."""
    gradient_steps_before: int = 0
    """Gradient steps before the current generation."""
    env_steps_before: int = 0
    """Environment steps before the current generation."""
    fitness: tuple[float, ...] = ()
    """Training returns of the population in the newest generation; empty without one."""
    marl_return: float = 0.0
    """Training return of the MARL team in the newest generation."""
    evaluated_at: int = 0
    """``env_steps`` of the newest evaluation."""
    wall_seconds: float = 0.0
    """Wall time of the run so far, without the time it was interrupted."""
    generation_seconds: float = 0.0
    """Wall time of the current generation so far."""
    rollout_seconds: float = 0.0
    """Part of it that went into rollouts and their bookkeeping."""
    metrics_offset: int = 0
    """Bytes of ``metrics.jsonl`` when the checkpoint was written."""

    @property
    def selected(self) -> str:
        """Of the MARL team and the champion, the one with the better training return."""
        return "champion" if self.fitness and max(self.fitness) > self.marl_return else "marl"

    def but(self, **changes: Any) -> "Progress":
        """The same with some values changed."""
        return dataclasses.replace(self, **changes)


class RunState(NamedTuple):
    """All of a run that changes."""

    algorithm: Any
    losses: Losses  # sums over the gradient steps of the current generation
    replay: Replay
    progress: Progress


def statics(config: Config, spec: Spec, algorithm: Algorithm) -> dict[str, Any]:
    """The static arguments of the compiled programs.

    What no program reads is set to one value, so that runs that differ in it alone share programs.
    """
    unread = Config(config.task)
    shared = dataclasses.replace(
        config,
        seed=unread.seed,
        env_steps=unread.env_steps,
        env=unread.env,
        evaluation=unread.evaluation,
        checkpoint=unread.checkpoint,
    )
    return {"algorithm": algorithm, "spec": spec, "config": shared}


def fresh(config: Config, spec: Spec, algorithm: Algorithm, replay: Replay) -> RunState:
    """The state before the first step, with an empty buffer."""
    key = root_key(config, Purpose.INIT)
    return RunState(
        algorithm=copy(start(key, **statics(config, spec, algorithm))),
        losses=empty_losses(algorithm),
        replay=replay,
        progress=Progress(),
    )


def to_arrays(state: RunState) -> tuple[dict[str, Any], dict[str, Any], dict[str, Rows]]:
    """What `race.runs.checkpoints.save` takes: arrays, info, rows."""
    replay = state.replay
    columns = {name: np.asarray(column) for name, column in replay.data._asdict().items()}
    rows = Rows(columns, int(replay.inserted), replay.capacity)
    arrays = flatten({"algorithm": state.algorithm, "losses": state.losses})
    return arrays, {"progress": dataclasses.asdict(state.progress)}, {"replay": rows}


def segment_rows(replay: Replay) -> int:
    """Items of a file of a checkpoint: of transitions many, of episodes about 64 MB."""
    item = sum(leaf.nbytes // leaf.shape[0] for leaf in jax.tree.leaves(replay.data))
    return min(SEGMENT_ROWS, max(1, SEGMENT_BYTES // item))


def from_checkpoint(
    saved: Checkpoint, config: Config, spec: Spec, algorithm: Algorithm, replay: Replay
) -> RunState:
    """The state that a checkpoint holds; ``replay`` has the shapes of the run's buffer.

    Raises:
        CheckpointError: if it was written by a run with other networks or another task.
    """
    progress = progress_of(saved)
    trained = learned_of(saved, config, spec, algorithm)
    filled = _filled(saved, replay)
    return RunState(trained["algorithm"], trained["losses"], filled, progress)


def learned_of(
    saved: Checkpoint, config: Config, spec: Spec, algorithm: Algorithm
) -> dict[str, Any]:
    """The algorithm's state and the loss sums that a checkpoint holds.

    Raises:
        CheckpointError: if it was written by a run with other networks or another task.
    """
    key = root_key(config, Purpose.INIT)
    template = {
        "algorithm": start(key, **statics(config, spec, algorithm)),
        "losses": empty_losses(algorithm),
    }
    # Restored arrays may live in the file's memory; the programs of a run reuse what they get.
    return copy(restore(template, saved.arrays))


def progress_of(saved: Checkpoint) -> Progress:
    """The progress that a checkpoint holds.

    Raises:
        CheckpointError: if it holds none that this version understands.
    """
    values = saved.info.get("progress")
    names = {f.name for f in dataclasses.fields(Progress)}
    if not isinstance(values, dict) or set(values) != names:
        raise CheckpointError(
            f"The checkpoint {saved.path} was not written by this version of race: its record of "
            "the run's progress differs. Use the version named in metadata.json."
        )
    return Progress(**{**values, "fitness": tuple(values["fitness"])})


def _filled(saved: Checkpoint, replay: Replay) -> Replay:
    """The buffer with what the checkpoint holds."""
    if "replay" not in saved.rows:
        raise CheckpointError(f"The checkpoint {saved.path} holds no replay buffer.")
    rows, capacity = saved.rows["replay"], replay.capacity
    if rows.size > capacity or rows.inserted > rows.capacity != capacity:
        raise CheckpointError(
            f"The checkpoint {saved.path} holds a replay buffer of {rows.capacity} items, "
            f"which does not go into the {capacity} that config.json asks for. Put "
            "replay_capacity back to what the run began with."
        )
    columns = {}
    for name, column in replay.data._asdict().items():
        kept = rows.columns.get(name)
        if kept is None or kept.shape[1:] != column.shape[1:] or kept.dtype != column.dtype:
            raise CheckpointError(
                f"The checkpoint {saved.path} holds experience of another task: its replay "
                f"column {name} does not fit. Is config.json the one that the run began with?"
            )
        if rows.capacity != capacity:
            larger = np.zeros(column.shape, column.dtype)
            larger[: rows.size] = kept[: rows.size]
            kept = larger
        columns[name] = jnp.array(kept)
    return Replay(replay.data._replace(**columns), jnp.asarray(rows.inserted, jnp.int32))

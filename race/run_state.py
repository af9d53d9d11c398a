"""The state of a run: everything that a checkpoint holds and a resumed run needs."""

import dataclasses
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray
from numpy.typing import NDArray

from race.algorithms import Algorithm
from race.algorithms.base import Losses
from race.checkpoints import Checkpoint, Rows
from race.config import Config
from race.errors import CheckpointError
from race.optimization import copy
from race.programs import INSERT_ROWS, empty_losses, start
from race.replay import Replay, init_replay
from race.trees import flatten, restore
from race.types import EnvSpec, Transition


class Purpose(IntEnum):
    """What randomness is for. Every use has its own stream, numbered by a counter of the run."""

    INIT = 0
    WARM_UP = 1
    ROLLOUT = 2
    EVOLUTION = 3
    LEARNING = 4
    EVALUATION = 5


@dataclass(frozen=True)
class Progress:
    """How far a run is, as plain numbers (JSON holds it exactly)."""

    env_steps: int = 0
    """Steps of all teams, the random ones included."""
    random_steps: int = 0
    """Steps of the warm-up."""
    gradient_steps: int = 0
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


def n_teams(config: Config) -> int:
    """Teams that act: the population and the MARL team."""
    return config.race.population_size + 1 if config.has_population else 1


def root_key(config: Config, purpose: Purpose) -> PRNGKeyArray:
    """The random key of one purpose."""
    return jax.random.fold_in(jax.random.key(config.seed), int(purpose))


def host_seeds(config: Config, purpose: Purpose, index: int, count: int) -> NDArray[np.int64]:
    """Seeds for environments, from the run's seed, the purpose and a counter."""
    sequence = np.random.SeedSequence((config.seed, int(purpose), index))
    return sequence.generate_state(count).astype(np.int64)


def replay_rows(config: Config, spec: EnvSpec) -> int:
    """Transitions to make room for: a short run does not pay for a long one's memory."""
    longest = config.learner.random_steps + config.env_steps + n_teams(config) * spec.episode_limit
    return min(config.learner.replay_capacity, max(longest, INSERT_ROWS))


def statics(config: Config, spec: EnvSpec, algorithm: Algorithm) -> dict[str, Any]:
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


def fresh(config: Config, spec: EnvSpec, algorithm: Algorithm) -> RunState:
    """The state before the first step."""
    key = root_key(config, Purpose.INIT)
    return RunState(
        algorithm=copy(start(key, **statics(config, spec, algorithm))),
        losses=empty_losses(algorithm),
        replay=init_replay(spec, replay_rows(config, spec)),
        progress=Progress(),
    )


def to_arrays(state: RunState) -> tuple[dict[str, Any], dict[str, Any], dict[str, Rows]]:
    """What `race.checkpoints.save` takes: arrays, info, rows."""
    replay = state.replay
    columns = {name: np.asarray(column) for name, column in replay.data._asdict().items()}
    rows = Rows(columns, int(replay.inserted), replay.capacity)
    arrays = flatten({"algorithm": state.algorithm, "losses": state.losses})
    return arrays, {"progress": dataclasses.asdict(state.progress)}, {"replay": rows}


def from_checkpoint(
    saved: Checkpoint, config: Config, spec: EnvSpec, algorithm: Algorithm
) -> RunState:
    """The state that a checkpoint holds.

    Raises:
        CheckpointError: if it was written by a run with other networks or another task.
    """
    progress = progress_of(saved)
    trained = learned_of(saved, config, spec, algorithm)
    replay = _replay(saved, config, spec)
    return RunState(trained["algorithm"], trained["losses"], replay, progress)


def learned_of(
    saved: Checkpoint, config: Config, spec: EnvSpec, algorithm: Algorithm
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


def _replay(saved: Checkpoint, config: Config, spec: EnvSpec) -> Replay:
    if "replay" not in saved.rows:
        raise CheckpointError(f"The checkpoint {saved.path} holds no replay buffer.")
    rows = saved.rows["replay"]
    capacity = replay_rows(config, spec)
    if rows.size > capacity or rows.inserted > rows.capacity != capacity:
        raise CheckpointError(
            f"The checkpoint {saved.path} holds a replay buffer of {rows.capacity} transitions, "
            f"which does not go into the {capacity} that config.json asks for. Put "
            "learner.replay_capacity back to what the run began with."
        )
    shapes = jax.eval_shape(lambda: init_replay(spec, capacity)).data
    columns = {}
    for name, column in shapes._asdict().items():
        kept = rows.columns.get(name)
        if kept is None or kept.shape[1:] != column.shape[1:] or kept.dtype != column.dtype:
            raise CheckpointError(
                f"The checkpoint {saved.path} holds transitions of another task: its replay "
                f"column {name} does not fit. Is config.json the one that the run began with?"
            )
        if rows.capacity != capacity:
            larger = np.zeros(column.shape, column.dtype)
            larger[: rows.size] = kept[: rows.size]
            kept = larger
        columns[name] = jnp.array(kept)
    return Replay(Transition(**columns), jnp.asarray(rows.inserted, jnp.int32))

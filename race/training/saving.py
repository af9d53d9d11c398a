"""How a run's state gets to disk and back; `race.training.trainer` alone decides when."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from race import ALGORITHM_VERSION, programs
from race.algorithms import Algorithm
from race.config.hyper import hyper_of
from race.config.saved import tupled
from race.config.settings import Config
from race.errors import CheckpointError, DivergenceError
from race.method.normalisation import Observed, nothing_observed
from race.networks.optimization import copy
from race.programs import empty_losses, start
from race.randomness import Purpose, root_key
from race.replay.buffer import Replay, columns, with_columns
from race.runs import checkpoints
from race.runs.checkpoints import SEGMENT_ROWS, Checkpoint, Rows
from race.runs.metrics import Extent
from race.runs.trees import blank, flatten, restore
from race.training.run import Run, stamped
from race.training.run_state import Progress, RunState, statics
from race.types import Spec

SEGMENT_BYTES = 2**26


def save(run: Run, state: RunState) -> None:
    """Writes a checkpoint.

    Raises:
        DivergenceError: if a number of the algorithm's state is not finite.
        CheckpointError: if it cannot be written.
    """
    if not programs.all_finite(state.algorithm):
        raise DivergenceError(
            "A network's parameters are no longer finite numbers, though its last loss was. Start "
            "a new run with smaller learning rates (--learner.actor-learning-rate, "
            "--learner.critic-learning-rate, or of --facmac)."
        )
    run.metrics.sync()
    progress = stamped(run, state.progress).but(metrics_offset=run.metrics.offset)
    run.report("saving", progress, {})
    checkpoints.save(
        run.directory.checkpoints,
        f"step-{progress.env_steps:012d}",
        *_contents(run, state, progress),
        run.config.checkpoint.keep,
        _segment_rows(state.replay),
    )


def _contents(
    run: Run, state: RunState, progress: Progress
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Rows]]:
    """What `race.runs.checkpoints.save` takes: arrays, info, rows."""
    replay = state.replay
    kept = {name: np.asarray(column) for name, column in columns(replay).items()}
    rows = Rows(kept, int(replay.inserted), replay.capacity)
    held = {"algorithm": state.algorithm, "losses": state.losses}
    if state.observed is not None:
        held[_OBSERVED] = state.observed
    arrays = flatten(held)
    info = {
        "progress": dataclasses.asdict(progress),
        "algorithm_version": ALGORITHM_VERSION,
        "run": run.identity,
        "metrics": run.metrics.extent._asdict(),
    }
    return arrays, info, {"replay": rows}


def _segment_rows(replay: Replay) -> int:
    """Items of a file of a checkpoint: of transitions many, of episodes about 64 MB."""
    item = sum(leaf.nbytes for leaf in jax.tree.leaves(replay.data)) // max(replay.capacity, 1)
    return min(SEGMENT_ROWS, max(1, SEGMENT_BYTES // max(item, 1)))


def check_version(began_with: Any) -> None:
    """Refuses to go on with a run of another version of the algorithm; None: it is not known.

    Raises:
        CheckpointError: naming both versions.
    """
    if began_with not in (None, ALGORITHM_VERSION):
        raise CheckpointError(
            f"The run was begun by another version of race, whose algorithm ({began_with}) gives "
            f"other numbers than this one's ({ALGORITHM_VERSION}), so it cannot go on here. Go on "
            "with the version named in metadata.json, or begin a new run; evaluate, render and "
            "plot read this one as it is."
        )


def check_owner(saved: Checkpoint, identity: str | None) -> None:
    """Refuses a checkpoint of another run; those of old runs name none.

    Raises:
        CheckpointError: naming both.
    """
    owner = saved.info.get("run")
    if owner != identity:
        raise CheckpointError(
            f"The checkpoint {saved.path} belongs to another run ({owner or 'without a name'}) "
            f"than the config.json of its directory ({identity or 'without a name'}), whose "
            "settings say nothing of it. Put each back where it was."
        )


def metrics_kept(saved: Checkpoint | None) -> Extent:
    """The rows that a checkpoint knows of."""
    if saved is None:
        return Extent(0)
    told = saved.info.get("metrics", {})
    return Extent(progress_of(saved).metrics_offset, told.get("digest"))


def from_checkpoint(
    saved: Checkpoint, config: Config, spec: Spec, algorithm: Algorithm, replay: Replay
) -> RunState:
    """The state that a checkpoint holds; ``replay`` has the shapes of the run's buffer.

    Raises:
        CheckpointError: if it was written by a run with other networks or another task, or by a
            version whose numbers differ from this one's.
    """
    check_version(saved.info.get("algorithm_version", 1))
    progress = progress_of(saved)
    trained = learned_of(saved, config, spec, algorithm)
    filled, observed = _filled(saved, replay), observed_of(saved, config, spec)
    hyper = hyper_of(config)
    return RunState(trained["algorithm"], trained["losses"], filled, progress, hyper, observed)


def observed_of(saved: Checkpoint, config: Config, spec: Spec) -> Observed | None:
    """What the run's teams had seen by then, where observations are normalised.

    Raises:
        CheckpointError: if the checkpoint does not hold it.
    """
    if not config.env.normalise:
        return None
    found: Observed = restore({_OBSERVED: nothing_observed(spec)}, _parts(saved.arrays)[1])[
        _OBSERVED
    ]
    return found


_OBSERVED = "observed"


def _parts(arrays: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The arrays of programs, and those that stay on the host in 64 bits."""
    mine = {name for name in arrays if name.startswith(f"['{_OBSERVED}']")}
    kept = {name: value for name, value in arrays.items() if name not in mine}
    return kept, {name: arrays[name] for name in mine}


def _of_programs(saved: Checkpoint, config: Config) -> dict[str, Any]:
    # Without the setting nothing reads statistics, and restoring refuses what nothing reads.
    return _parts(saved.arrays)[0] if config.env.normalise else saved.arrays


def learned_of(
    saved: Checkpoint, config: Config, spec: Spec, algorithm: Algorithm
) -> dict[str, Any]:
    """The algorithm's state and the loss sums that a checkpoint holds.

    Raises:
        CheckpointError: if it was written by a run with other networks or another task.
    """
    template = _fresh(config, spec, algorithm)
    # Restored arrays may live in the file's memory; the programs of a run reuse what they get.
    return copy(restore(template, _as_now(_of_programs(saved, config), template)))


def looked_at(saved: Checkpoint, config: Config, spec: Spec, algorithm: Algorithm) -> Any:
    """The algorithm's state that a checkpoint holds, to look at and not to go on with.

    No program is compiled for it, so that a team is there at once.

    Raises:
        CheckpointError: if it was written by a run with other networks or another task.
    """
    template = blank(jax.eval_shape(lambda: _fresh(config, spec, algorithm)))
    arrays = _as_now(_of_programs(saved, config), template)
    return _on_device(restore(template, arrays)["algorithm"])


def one_of(
    saved: Checkpoint, name: str, config: Config, spec: Spec, algorithm: Algorithm
) -> tuple[Any, Any]:
    """Encoders and heads of the one team that a kept file holds.

    Raises:
        CheckpointError: if it was written by a run with other networks or another task.
    """

    def tested() -> dict[str, Any]:
        groups = algorithm.tested(_fresh(config, spec, algorithm)["algorithm"], spec)
        (found,) = ((group.encoder, group.heads[name]) for group in groups if name in group.heads)
        return {"encoder": found[0], "head": found[1]}

    template = blank(jax.eval_shape(tested))
    restored = _on_device(restore(template, _of_programs(saved, config)))
    return restored["encoder"], restored["head"]


def _fresh(config: Config, spec: Spec, algorithm: Algorithm) -> dict[str, Any]:
    key = root_key(config.seed, Purpose.INIT)
    state = start(key, hyper=hyper_of(config), **statics(config, spec, algorithm))
    return {"algorithm": state, "losses": empty_losses(algorithm)}


def _on_device(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf if callable(leaf) else jnp.asarray(leaf), tree)


# Arrays of a population, by the names they had before it was a part of its own.
_BEFORE = ("heads", "elite", "worst", "injected", "injection_counts")


def _as_now(arrays: Mapping[str, Any], template: Any) -> dict[str, Any]:
    """Arrays of a checkpoint, also of one from before populations kept a record of their teams."""
    old = {name: f"['algorithm'].{name}" for name in _BEFORE}
    if old["heads"] not in arrays:
        return dict(arrays)
    now = {name: f"['algorithm'].population.{name}" for name in _BEFORE}
    now["heads"] = "['algorithm'].population.teams.heads"
    renamed = {old[name]: now[name] for name in _BEFORE}
    found = {renamed.get(name, name): value for name, value in arrays.items()}
    found["['algorithm'].population.champion.heads"] = arrays[old["heads"]][arrays[old["elite"]]]
    missing = {
        name: value
        for name, value in flatten(template).items()
        if name.startswith("['algorithm'].population.record")
    }
    return missing | found


def progress_of(saved: Checkpoint) -> Progress:
    """The progress that a checkpoint holds.

    Raises:
        CheckpointError: if it holds none that this version understands.
    """
    values = saved.info.get("progress")
    names = {f.name for f in dataclasses.fields(Progress)}
    # Runs of before they were there lack these.
    later = {"repeated", "estimated", "stored", "returns", "played"}
    if not isinstance(values, dict) or set(values) | later != names:
        raise CheckpointError(
            f"The checkpoint {saved.path} was not written by this version of race: its record of "
            "the run's progress differs. Use the version named in metadata.json."
        )
    values = {"stored": values["episodes"], **values}  # all of them went into the buffer then
    listed = ("fitness", "returns", "played")
    return Progress(**{**values, **{name: tupled(values.get(name, ())) for name in listed}})


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
    found = {}
    for name, column in columns(replay).items():
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
        found[name] = jnp.array(kept)
    return with_columns(replay, found, rows.inserted)

"""Training from the start or from a checkpoint, until the budget is used up.

Everything that changes is one `RunState`; a generation maps it to the next. All randomness is
drawn by purpose and counter from the run's seed, environments are reset with explicit seeds, and
gradient steps may be split over calls in any way. So a run that goes on from a checkpoint,
wherever it was written, does what the uninterrupted run does.
"""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from race.config.cohort import Batching
from race.config.settings import Config
from race.envs import make_task
from race.errors import ConfigError, RaceError
from race.rollouts import rollouts_of
from race.runs import checkpoints
from race.runs.directory import RunDirectory
from race.training.cohort import kind_of, together
from race.training.interrupts import Interrupts
from race.training.lockstep import Member, Results, lockstep, released
from race.training.opening import Order, begin
from race.training.run import Report, silent
from race.training.run_state import Progress, is_over

__all__ = ["Order", "is_over", "train", "train_cohort"]


def train(
    path: Path,
    config: Config,
    *,
    extend: bool = False,
    without_metrics: bool = False,
    report: Report = silent,
    began: float | None = None,
    interrupts: Interrupts | None = None,
) -> Progress:
    """Trains in ``path``: from the newest checkpoint if there is one, else from the start.

    ``path`` is a run directory made by `race.runs.directory.create`. Returns how far it came:
    short of ``config.env_steps`` if it was interrupted, after saving a checkpoint.

    Args:
        path: the run directory.
        config: its configuration, resolved.
        extend: whether ``config.env_steps`` is a new budget, to be kept in the directory.
        without_metrics: whether to go on with new metrics, because those before are lost.
        report: told what is going on.
        began: `time.perf_counter` when the process began.
        interrupts: by whose `stop` the run is to be saved and left, as by Ctrl-C.

    Raises:
        RaceError: each with a message for the user; see the subclasses in `race.errors`.
    """
    order = Order(path, config, extend, without_metrics, report)
    (result,) = train_cohort([order], began=began, interrupts=interrupts)
    if isinstance(result, RaceError):
        raise result
    return result


def train_cohort(
    orders: Sequence[Order],
    *,
    batching: Batching = "auto",
    began: float | None = None,
    interrupts: Interrupts | None = None,
) -> list[Progress | RaceError]:
    """The same for several runs at once, in lockstep.

    A run that cannot begin, or diverges, leaves the others to go on.

    Args:
        orders: runs of one `race.training.cohort.kind_of`.
        batching: whether they are one program.
        began: `time.perf_counter` when the process began.
        interrupts: by whose `stop` all are to be saved and left.

    Returns:
        How far each came, or what ended it.

    Raises:
        TaskError: if the task cannot be made or an environment fails, which ends all; what they
            had done is saved.
        CheckpointError: if a run cannot be saved.
    """
    if len({kind_of(order.config) for order in orders}) > 1:
        raise ConfigError("Runs of a cohort differ in numbers and seeds alone; these do not.")
    began = time.perf_counter() if began is None else began
    # An environment may change the current directory.
    paths = [order.path.absolute() for order in orders]
    config, as_one = orders[0].config, together(batching, len(orders))
    orders[0].report("preparing the task", Progress(), {})
    task = make_task(config.task, config.env)
    results: Results = {}
    members: list[Member] = []
    proven = any(checkpoints.newest(RunDirectory(path).checkpoints) for path in paths)
    with (
        rollouts_of(config, task, proven=proven, runs=len(orders), together=as_one) as rollouts,
        ExitStack() as files,
        interrupts or Interrupts() as listening,
    ):
        for place, (order, path) in enumerate(zip(orders, paths, strict=True)):
            try:
                begun = begin(order, path, task, rollouts, listening, files, began)
            except RaceError as error:
                results[place] = released(error) if len(orders) > 1 else error
                continue
            if isinstance(begun, Progress):
                results[place] = begun
            else:
                members.append(Member(place, *begun))
        lockstep(members, as_one, results)
    return [results[place] for place in range(len(orders))]

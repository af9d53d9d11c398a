"""Teams playing episodes, on the host or in a compiled loop on the device.

How actions are chosen and experience collected may be changed here; training sees `Rollouts`.
"""

from race.config.settings import Config
from race.rollouts.base import Rollouts
from race.rollouts.discrete import EpisodeRollouts
from race.rollouts.transitions import TransitionRollouts
from race.types import AnyTask, Task


def rollouts_of(
    config: Config, task: AnyTask, *, proven: bool = False, runs: int = 1, together: bool = False
) -> Rollouts:
    """The rollouts of a task, for one run of a resolved configuration or for several.

    Args:
        config: of one of the runs, which differ in their numbers alone.
        task: the task.
        proven: whether a run has played an episode before, so that an environment that fails is an
            accident from the start.
        runs: how many there are.
        together: whether what several runs do at once is one program.
    """
    if isinstance(task, Task):
        return TransitionRollouts(config, task, proven=proven, runs=runs, together=together)
    return EpisodeRollouts(config, task, proven=proven, runs=runs if together else 1)


__all__ = ["Rollouts", "rollouts_of"]

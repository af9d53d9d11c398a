"""Teams playing episodes, on the host or in a compiled loop on the device.

How actions are chosen and experience collected may be changed here; training sees `Rollouts`.
"""

from race.config.settings import Config
from race.rollouts.base import Rollouts
from race.rollouts.discrete import EpisodeRollouts
from race.rollouts.transitions import TransitionRollouts
from race.types import AnyTask, Task


def rollouts_of(config: Config, task: AnyTask, *, proven: bool = False) -> Rollouts:
    """The rollouts of a task, for a run of a resolved configuration.

    ``proven``: the run has played an episode before, so that an environment that fails is an
    accident from the start.
    """
    if isinstance(task, Task):
        return TransitionRollouts(config, task, proven=proven)
    return EpisodeRollouts(config, task, proven=proven)


__all__ = ["Rollouts", "rollouts_of"]

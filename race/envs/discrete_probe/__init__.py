"""Tiny tasks with discrete actions and known answers, on which a broken learner shows it at once.

Each is here twice: as functions of JAX (`race.envs.discrete_probe.device`) and on the host, with
PyMARL's interface (`race.envs.discrete_probe.host`). An action that is not available is refused:
the agent takes the available one of the lowest number instead. They have no picture to render.
"""

import functools
from typing import Final

from race.envs.discrete_probe.host import ProbeHost
from race.envs.discrete_probe.rules import CLIMB_PAYOFFS, LIVES_STEPS, MEMORY_STEPS, WINS
from race.envs.probe import ProbeInfo
from race.envs.pymarl import pymarl_task
from race.types import DeviceEnv, DiscreteTask

PROBES: Final[dict[str, ProbeInfo]] = {
    "probe/matching": ProbeInfo(
        "one step; each agent has to choose the action that its own cue names", 1.0
    ),
    "probe/memory": ProbeInfo(
        f"{MEMORY_STEPS} steps; each agent has to name at the end the cue it saw at the start", 1.0
    ),
    "probe/climb": ProbeInfo(
        "one step; a safe joint action, and a better one that both agents must move to together",
        CLIMB_PAYOFFS[0][0],
    ),
    "probe/lives": ProbeInfo(
        f"{LIVES_STEPS[0]} to {LIVES_STEPS[1]} steps; agents die one after the other", 1.0
    ),
}


def make_task(task_id: str) -> DiscreteTask:
    """The probe of that id (a key of `PROBES`), on the host and on the device.

    Raises:
        TaskError: if there is no such probe.
    """
    make = functools.partial(ProbeHost, task_id)
    task = pymarl_task(make, task_id, has_wins=task_id in WINS)
    return task._replace(device=functools.partial(_device, task_id))


def _device(task_id: str) -> DeviceEnv:
    from race.envs.discrete_probe import device  # imports jax

    return device.ENVS[task_id]

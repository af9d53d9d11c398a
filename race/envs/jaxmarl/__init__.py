"""JaxMARL environments with discrete actions, played on the device in one compiled loop.

What JaxMARL's dictionaries by agent mean is decided here, in `adapter`; nobody else knows of them.
Importing this imports neither jax nor jaxmarl.
"""

import functools
from typing import TYPE_CHECKING, Any

from race.config.settings import EnvConfig
from race.envs.jaxmarl.source import PREFIX, packages
from race.errors import TaskError, blamed, of_task
from race.types import DeviceEnv, DiscreteTask

if TYPE_CHECKING:
    from race.envs.jaxmarl.adapter import Adapter

__all__ = ["PREFIX", "jaxmarl_task", "make_task", "packages"]

_DEFAULT = EnvConfig()


def make_task(task_id: str, config: EnvConfig) -> DiscreteTask:
    """The task of an id such as ``jaxmarl:SMAX/2s3z`` or ``jaxmarl:MPE/simple_spread_v3``.

    Raises:
        TaskError: if jaxmarl is missing or too old, there is no such environment, or it is none
            that can be learned.
    """
    return _task(_named(task_id, config), functools.partial(_named, task_id, config))


def jaxmarl_task(
    make: Any, task: str = "jaxmarl environment", config: EnvConfig = _DEFAULT
) -> DiscreteTask:
    """A task out of an environment of one's own with JaxMARL's interface.

    Args:
        make: ``make()`` returns the environment: ``agents``, ``action_space(agent)``,
            ``reset(key)``, ``step_env(key, state, actions)``, and ``get_avail_actions(state)`` and
            ``max_steps`` if there are such.
        task: its name.
        config: who is the team, what it is paid, what the state is, the step limit and the largest
            observation; its ``kwargs`` are not read.

    Raises:
        TaskError: if it is none that can be learned.
    """
    adapter = functools.cache(functools.partial(_adapted, make, task, config))
    return _task(adapter(), adapter)


def _task(adapter: "Adapter", again: Any) -> DiscreteTask:
    return DiscreteTask(
        adapter.spec,
        functools.partial(_host, again),
        functools.partial(_device, again),
        facts=adapter.facts,
    )


# One adapter for equal settings in a process, so that its compiled programs are found again.
@functools.lru_cache(maxsize=16)
def _named(task_id: str, config: EnvConfig) -> "Adapter":
    from race.envs.jaxmarl import source

    name = task_id.removeprefix(PREFIX)
    return _adapted(functools.partial(source.made, name, config.kwargs), task_id, config)


def _adapted(make: Any, task: str, config: EnvConfig) -> "Adapter":
    from race.envs.jaxmarl.adapter import Adapter  # imports jax

    with blamed(TaskError, f"Task {task}: its environment failed"), of_task(task):
        return Adapter(make(), task, config)


def _device(again: Any) -> DeviceEnv:
    adapter = again()
    return DeviceEnv(None, adapter.reset, adapter.step)


def _host(again: Any, render_mode: str | None = None) -> Any:
    from race.envs.jaxmarl.host import JaxmarlEnv

    return JaxmarlEnv(again(), render_mode)

"""From what a person asks for to a run directory: settings settled, the environment tried."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from race.algorithms.evolutions import evolution_of
from race.config.ablations import ablated
from race.config.effects import Facts, refuse_without_effect, setting, usual, without_effect
from race.config.files import Wanted, with_settings
from race.config.presets import PRESETS, resolve
from race.config.settings import Config
from race.envs import jaxmarl, pettingzoo, reads_config, reads_game, reads_team, starcraft
from race.envs.own import is_own
from race.envs.trial import try_out
from race.errors import ConfigError, say
from race.types import AnyTask, DiscreteTask


def settled(asked: Config, preset: str, ablation: tuple[str, ...], task: AnyTask) -> Config:
    """What a person asks for, with ablations and all that follows from the task.

    Raises:
        ConfigError: if something is wrong, has no effect, or does not go together.
    """
    facts = _facts(asked, task)
    asked = ablated(asked, ablation, facts.discrete)
    if facts.discrete and preset != "paper":
        raise ConfigError(
            f"--preset {preset} has no effect on {asked.task}: its actions are discrete, and the "
            "presets are of learners of continuous actions. Leave it out; --facmac.* are the "
            "settings of the learner on this task."
        )
    refuse_without_effect(asked, PRESETS[preset], facts)
    config = resolve(asked, discrete=facts.discrete)
    evolution_of(config.race.evolution)  # an operator that is not there is told of at once
    return config


def without_idle(
    asked: Config, preset: str, given: Mapping[str, Any], task: AnyTask
) -> tuple[Config, list[str]]:
    """A configuration without those settings of a file that the rest leaves no effect.

    One file may serve several methods; what a person says beside it is refused instead.

    Args:
        asked: the file's settings and a person's.
        preset: the name of the preset.
        given: the file's settings.
        task: the task.

    Returns:
        The configuration, and the names of what was left out.
    """
    idle = without_effect(asked, PRESETS[preset], _facts(asked, task))
    dropped = [name for name in idle if name in given and setting(asked, name) == given[name]]
    changed = {name: usual(name, PRESETS[preset]) for name in dropped}
    return with_settings(asked, changed), dropped


def settled_with_file(
    asked: Config,
    preset: str,
    ablation: tuple[str, ...],
    task: AnyTask,
    file: Wanted,
    name: str,
) -> Config:
    """`settled`, where some settings come from a file.

    Args:
        asked: the file's settings and a person's.
        preset: the name of the preset.
        ablation: names of ablations.
        task: the task.
        file: what the file asks for.
        name: of the file, for a note on what was left out.

    Raises:
        ConfigError: as `settled`.
    """
    asked, dropped = without_idle(asked, preset, file.settings, task)
    if dropped:
        say(f"{name}: left out, because it has no effect here: {', '.join(sorted(dropped))}.")
    return settled(asked, preset, ablation, task)


def _facts(asked: Config, task: AnyTask) -> Facts:
    return Facts(
        discrete=isinstance(task, DiscreteTask),
        reads_env=reads_config(asked.task),
        on_host=not isinstance(task, DiscreteTask) or task.device is None,
        reads_parallel=reads_team(asked.task),
        reads_game=reads_game(asked.task),
    )


def is_tried(task_id: str) -> bool:
    """Whether an environment of that name is looked at before it is trained on; others repeat."""
    others = (pettingzoo.PREFIX, jaxmarl.PREFIX)
    return is_own(task_id) or task_id.startswith(others) or starcraft.is_game(task_id)


def tried(task_id: str, task: AnyTask) -> dict[str, Any]:
    """What a first look at an environment of the user's own says; others repeat.

    Raises:
        TaskError: if it fails, or breaks the contract.
    """
    if not is_tried(task_id):
        return {"repeats": True}
    if starcraft.is_game(task_id):
        assert isinstance(task, DiscreteTask)
        libraries = starcraft.try_out(task)
        say(starcraft.NOTE)
        return {"repeats": False, "packages": libraries}
    trial = try_out(task)
    if trial.note:
        say(trial.note)
    found: dict[str, Any] = {"repeats": trial.repeats, "conflict": trial.conflict}
    if task_id.startswith(pettingzoo.PREFIX):
        found["packages"] = pettingzoo.packages(task_id.removeprefix(pettingzoo.PREFIX))
    if task_id.startswith(jaxmarl.PREFIX):
        found["packages"] = jaxmarl.packages()
    return found


def name_of(config: Config) -> str:
    """What a run is called after: its task, method and ablations."""
    task = config.task.replace("/", "-").replace(":", "-")
    method = config.method.replace("(", "-").replace(")", "").lower()
    return "-".join([task, method, *config.ablation])


def usual_directory(config: Config) -> Path:
    """Where a run is kept that was given no place."""
    return Path("runs") / f"{name_of(config)}-seed{config.seed}"

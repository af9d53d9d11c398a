"""The runs that figures need, each once."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

from race.config.ablations import ablated
from race.config.presets import PRESETS, resolve
from race.config.settings import Config
from race.envs import make_task
from race.errors import ConfigError
from race.reproduce.figures import FIGURES, Variant, budget, variants
from race.training.asking import name_of
from race.types import DiscreteTask

SMALLEST = 100
"""Environment steps that a scaled budget has at least."""


class Place(NamedTuple):
    """A curve's seed in a panel."""

    figure: str
    task: str
    label: str


class Plan(NamedTuple):
    """Runs by the names of their directories, and where each is seen."""

    runs: dict[str, Config]
    """All first seeds, then all second ones, so that figures fill up evenly."""
    seen: dict[str, list[Place]]


def plan(
    figures: Sequence[str],
    seeds: Sequence[int],
    asked: Config,
    *,
    tasks: Sequence[str] = (),
    env_steps: int | None = None,
    scale: float = 1.0,
    preset: str = "paper",
) -> Plan:
    """The runs of some figures.

    A run that several figures show, such as RACE with the alpha of Table 3, is made once.

    Args:
        figures: names of `FIGURES`.
        seeds: of every curve.
        asked: what all runs have in common; its task, method, seed and length do not count.
        tasks: instead of those of the figures.
        env_steps: instead of the paper's budgets.
        scale: of the budgets.
        preset: of the gradient learner, where actions are continuous.

    Raises:
        ConfigError: for a figure that there is not, a budget that is none, or settings that do not
            go together.
    """
    if not 0 < scale <= 10:
        raise ConfigError(f"--scale is {scale:g}, but it must be above 0 and at most 10.")
    if env_steps is not None and env_steps < 1:
        raise ConfigError(f"--env-steps is {env_steps}, but it must be at least 1.")
    plain = asked
    if preset != "paper" and asked.learner == PRESETS["paper"]:
        plain = dataclasses.replace(asked, learner=PRESETS[preset])
    found: list[tuple[int, str, Config, Place]] = []
    discrete = {t: _is_discrete(t) for f in figures for t in tasks or FIGURES[f].tasks}
    for figure in figures:
        for task in tasks or FIGURES[figure].tasks:
            steps = max(SMALLEST, round((env_steps or budget(task)) * scale))
            for variant in variants(figure, discrete[task]):
                config = _config(plain, task, variant, discrete[task], steps)
                usual = _config(plain, task, variant._replace(settings=()), discrete[task], steps)
                named = "" if config == usual else _named(variant)
                place = Place(figure, task, variant.label)
                for order, seed in enumerate(seeds):
                    one = dataclasses.replace(config, seed=seed)
                    found.append((order, f"{name_of(config)}{named}-seed{seed}", one, place))
    runs: dict[str, Config] = {}
    seen: dict[str, list[Place]] = {}
    for _, name, config, place in sorted(found, key=lambda entry: entry[0]):
        runs[name] = config
        seen.setdefault(name, []).append(place)
    return Plan(runs, seen)


def _config(asked: Config, task: str, variant: Variant, discrete: bool, steps: int) -> Config:
    race = dataclasses.replace(asked.race, **dict(variant.settings))
    config = dataclasses.replace(
        asked, task=task, algo=variant.algo, base=None, env_steps=steps, race=race
    )
    return resolve(ablated(config, variant.ablation, discrete), discrete=discrete)


def _named(variant: Variant) -> str:
    return "".join(f"-{name}={value:g}" for name, value in variant.settings)


def _is_discrete(task: str) -> bool:
    if task.startswith(("mamujoco/", "micro/")):  # known without making it
        return task.startswith("micro/")
    return isinstance(make_task(task), DiscreteTask)

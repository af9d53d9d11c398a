"""Settings that would have no effect: a mistake, and a costly one if it is not told."""

import dataclasses
from collections.abc import Iterator
from typing import Any

from race.config.settings import Config, EnvConfig, FacmacConfig, LearnerConfig, RaceConfig
from race.errors import ConfigError

_MATD3_ALONE = ("policy_delay", "smoothing_noise", "smoothing_clip")
_MIXER = ("mixer_size", "hypernet_size")
_OBSERVATION = ("agent_obsk", "local_categories", "global_categories")
_HOST = ("processes", "retries", "step_seconds")


def refuse_without_effect(
    asked: Config,
    defaults: LearnerConfig,
    *,
    discrete: bool,
    reads_env: bool,
    on_host: bool,
) -> None:
    """Refuses settings that nothing would read.

    Args:
        asked: what was asked for, before presets are filled in.
        defaults: the learner settings of the preset.
        discrete: whether the task's actions are.
        reads_env: whether the task reads what its agents observe.
        on_host: whether its environments run on the host.

    Raises:
        ConfigError: naming the settings, and why they would have no effect.
    """
    told: dict[str, list[str]] = {}
    facts = {"discrete": discrete, "reads_env": reads_env, "on_host": on_host}
    for name, why in _idle(asked, **facts):
        group, _, setting = name.rpartition(".")
        default = defaults if group == "learner" else _DEFAULTS.get(group)
        value = getattr(getattr(asked, group) if group else asked, setting)
        if value != (None if default is None else getattr(default, setting)):
            told.setdefault(why, []).append(f"--{name.replace('_', '-')}")
    if told:
        sentences = [
            f"{' and '.join(names)} would have no effect {w}." for w, names in told.items()
        ]
        raise ConfigError(f"{' '.join(sentences)} Leave out what has no effect.")


_DEFAULTS: dict[str, Any] = {"facmac": FacmacConfig(), "race": RaceConfig(), "env": EnvConfig()}


def _idle(
    asked: Config, *, discrete: bool, reads_env: bool, on_host: bool
) -> Iterator[tuple[str, str]]:
    """The settings that nothing reads, and why."""
    evolves = asked.has_population
    usual = "facmac" if discrete else "matd3"
    base = asked.base or usual if evolves else asked.algo
    if not evolves:
        why = f"with --algo {asked.algo}, which has no population"
        yield from ((f"race.{name}", why) for name in _names(RaceConfig))
        if asked.base != asked.algo:
            yield "base", f"with --algo {asked.algo}, which is its own gradient learner"
    if discrete:
        why = (
            f"on {asked.task}. Its actions are discrete; the settings of its learner are --facmac.*"
        )
        yield from ((f"learner.{name}", why) for name in _names(LearnerConfig))
        if not evolves:
            yield "facmac.value_size", "without a population, which alone has a state-value net"
    else:
        why = f"on {asked.task}. Its actions are continuous; its learner's settings are --learner.*"
        mixes = _MIXER if base == "facmac" else ()
        yield from ((f"facmac.{name}", why) for name in _names(FacmacConfig) if name not in mixes)
        if base != "matd3":
            yield from (
                (f"learner.{name}", f"with {base}: MATD3 alone has it") for name in _MATD3_ALONE
            )
    if not reads_env:
        why = f"on {asked.task}, whose agents observe what they do in any case"
        yield from ((f"env.{name}", why) for name in (*_OBSERVATION, "library_observation"))
    elif asked.env.library_observation:
        why = "with --env.library-observation, which chooses for itself"
        yield from ((f"env.{name}", why) for name in _OBSERVATION)
    if not on_host:
        why = f"on {asked.task}, which runs in one compiled program"
        yield from ((f"env.{name}", why) for name in _HOST)


def _names(group: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(group)]

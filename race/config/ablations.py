"""The paper's ablations by name: each is a few settings, and may be set without its name too."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

from race.config.settings import Config, RaceConfig
from race.errors import ConfigError

AblationName = Literal[
    "vfm-only",
    "vmm-only",
    "vfm-marl-only",
    "vfm-ea-only",
    "unweighted-mi",
    "no-crossover",
    "no-mutation",
    "no-injection",
]


class Ablation(NamedTuple):
    """What is taken away."""

    description: str
    settings: dict[str, Any]
    """Of `race.config.settings.RaceConfig`."""


ABLATIONS: dict[str, Ablation] = {
    "vfm-only": Ablation(
        "encoders learn from values alone (Figure 5: RACE w/o VMM)", {"vmm_weight": 0.0}
    ),
    "vmm-only": Ablation(
        "encoders learn from mutual information alone, heads still by Eq. (7) (Figure 5: RACE w/o "
        "VFM)",
        {"vfm_marl_weight": 0.0, "vfm_team_weight": 0.0},
    ),
    "vfm-marl-only": Ablation(
        "of Eq. (2) only the MARL team's value (Figure 5: w/o considering EA)",
        {"vfm_team_weight": 0.0},
    ),
    "vfm-ea-only": Ablation(
        "of Eq. (2) only the population's value (Figure 5: w/o considering MARL)",
        {"vfm_marl_weight": 0.0},
    ),
    "unweighted-mi": Ablation("Eq. (5) with all weights 1", {"value_awareness": 0.0}),
    "no-crossover": Ablation(
        "offspring are copies of their parents", {"crossover_probability": 0.0}
    ),
    "no-mutation": Ablation("nothing mutates", {"mutation_probability": 0.0}),
    "no-injection": Ablation(
        "the MARL team never enters the population", {"injection_probability": 0.0}
    ),
}

assert set(ABLATIONS) == set(get_args(AblationName))

# Pairs of which one leaves nothing for the other to do, and why.
_CONTRADICTIONS: tuple[tuple[set[str], str], ...] = (
    ({"vfm-only", "vmm-only"}, "the encoders would learn from nothing"),
    ({"vfm-marl-only", "vfm-ea-only"}, "together they are vmm-only"),
    ({"vmm-only", "vfm-marl-only"}, "vmm-only leaves neither term of Eq. (2)"),
    ({"vmm-only", "vfm-ea-only"}, "vmm-only leaves neither term of Eq. (2)"),
    ({"vfm-only", "unweighted-mi"}, "vfm-only leaves no mutual information to weigh"),
    (
        {"no-crossover", "no-mutation", "no-injection"},
        "the population would never hold a team that was not there at the start",
    ),
)


def ablated(config: Config, names: Sequence[str]) -> Config:
    """A configuration with the settings of some ablations, before presets are filled in.

    Raises:
        ConfigError: if the method has nothing of the kind, if two names contradict each other, or
            if a setting that was asked for contradicts one.
    """
    if not names:
        return config
    if config.algo != "race":
        raise ConfigError(
            f"--ablation {' '.join(names)} takes something away from RACE, and --algo "
            f"{config.algo} is another method. Leave one of the two out."
        )
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"--ablation names {name} twice.")
    for together, why in _CONTRADICTIONS:
        if together <= set(names):
            raise ConfigError(f"--ablation {' '.join(sorted(together))} makes no sense: {why}.")
    race, default = config.race, RaceConfig()
    for name in names:
        for setting, value in ABLATIONS[name].settings.items():
            asked = getattr(config.race, setting)
            if asked not in (getattr(default, setting), value):
                option = f"--race.{setting.replace('_', '-')}"
                raise ConfigError(
                    f"--ablation {name} sets {option} to {value}, but it was set to {asked}. Leave "
                    "one of the two out."
                )
            race = dataclasses.replace(race, **{setting: value})
    return dataclasses.replace(config, race=race, ablation=tuple(names))


def told_by_name(config: Config) -> set[str]:
    """The settings that the names of a run's ablations tell, such as ``race.vmm_weight``."""
    return {
        f"race.{setting}"
        for name in config.ablation
        if name in ABLATIONS
        for setting in ABLATIONS[name].settings
    }

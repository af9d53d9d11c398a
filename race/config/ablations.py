"""The paper's ablations by name: each is a few settings, and may be set without its name too."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

from race.config.settings import Config
from race.errors import ConfigError

AblationName = Literal[
    "vfm-only",
    "vmm-only",
    "vfm-marl-only",
    "vfm-ea-only",
    "unweighted-mi",
    "parameter-crossover",
    "parameter-mutation",
    "no-crossover",
    "no-mutation",
    "no-injection",
    "one-pevfa",
    "shared-agents",
    "no-sharing",
]


class Ablation(NamedTuple):
    """What is taken away."""

    description: str
    settings: dict[str, Any]
    """Values by their names, such as ``race.vmm_weight``."""


ABLATIONS: dict[str, Ablation] = {
    "vfm-only": Ablation(
        "encoders learn from values alone (Figure 5: RACE w/o VMM)", {"race.vmm_weight": 0.0}
    ),
    "vmm-only": Ablation(
        "encoders learn from mutual information alone, heads still by Eq. (7) (Figure 5: RACE w/o "
        "VFM)",
        {"race.vfm_marl_weight": 0.0, "race.vfm_team_weight": 0.0},
    ),
    "vfm-marl-only": Ablation(
        "of Eq. (2) only the MARL team's value (Figure 5: w/o considering EA)",
        {"race.vfm_team_weight": 0.0},
    ),
    "vfm-ea-only": Ablation(
        "of Eq. (2) only the population's value (Figure 5: w/o considering MARL)",
        {"race.vfm_marl_weight": 0.0},
    ),
    "unweighted-mi": Ablation("Eq. (5) with all weights 1", {"race.value_awareness": 0.0}),
    "parameter-crossover": Ablation(
        "crossover exchanges action rows with no regard to agents (Figure 6)",
        {"race.crossover": "parameter"},
    ),
    "parameter-mutation": Ablation(
        "mutation draws weights with no regard to agents (Figure 6)",
        {"race.mutation": "parameter"},
    ),
    "no-crossover": Ablation(
        "offspring are copies of their parents", {"race.crossover_probability": 0.0}
    ),
    "no-mutation": Ablation("nothing mutates", {"race.mutation_probability": 0.0}),
    "no-injection": Ablation(
        "the MARL team never enters the population", {"race.injection_probability": 0.0}
    ),
    "one-pevfa": Ablation(
        "the PeVFA serves the MARL team too (Section 3.2: feasible)", {"race.one_pevfa": True}
    ),
    "shared-agents": Ablation(
        "one encoder for all agents on continuous tasks, as on discrete ones (Appendix A.1)",
        {"learner.shared_agents": True},
    ),
    "no-sharing": Ablation(
        "teams with encoders of their own, and no PeVFA: MERL with agent-level operators",
        {"race.sharing": False},
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
    ({"no-crossover", "parameter-crossover"}, "no-crossover leaves none of any kind"),
    ({"no-mutation", "parameter-mutation"}, "no-mutation leaves none of any kind"),
    *(
        ({"no-sharing", name}, "without shared encoders there is neither Eq. (2) nor Eq. (5)")
        for name in ("vfm-only", "vmm-only", "vfm-marl-only", "vfm-ea-only", "unweighted-mi")
    ),
    ({"no-sharing", "one-pevfa"}, "no-sharing leaves no PeVFA"),
    ({"no-sharing", "shared-agents"}, "the one shares networks and the other does not"),
    (
        {"no-crossover", "no-mutation", "no-injection"},
        "the population would never hold a team that was not there at the start",
    ),
)


_OF_GENETICS = ("parameter-crossover", "parameter-mutation", "no-crossover", "no-mutation")


def ablated(config: Config, names: Sequence[str], discrete: bool = False) -> Config:
    """A configuration with the settings of some ablations, before presets are filled in.

    Args:
        config: what was asked for.
        names: of the ablations.
        discrete: whether the task has discrete actions.

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
    if discrete and "shared-agents" in names:
        raise ConfigError(
            f"--ablation shared-agents changes nothing on {config.task}: on discrete actions all "
            "agents share an encoder anyway. Leave it out."
        )
    if discrete and "parameter-crossover" in names and config.race.team_heads == "shared":
        raise ConfigError(
            "--ablation parameter-crossover changes nothing with --race.team-heads shared: where a "
            "team has one head there is no other crossover. Leave one of the two out."
        )
    of_genetics = [name for name in names if name in _OF_GENETICS]
    if of_genetics and config.race.evolution != "ga":
        raise ConfigError(
            f"--ablation {' '.join(of_genetics)} is of the genetic algorithm, and "
            f"--race.evolution is {config.race.evolution}. Leave one of the two out."
        )
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"--ablation names {name} twice.")
    for together, why in _CONTRADICTIONS:
        if together <= set(names):
            raise ConfigError(f"--ablation {' '.join(sorted(together))} makes no sense: {why}.")
    changed = dataclasses.replace(config, ablation=tuple(names))
    for name in names:
        for setting, value in ABLATIONS[name].settings.items():
            group, field = setting.split(".")
            asked, usual = (getattr(getattr(c, group), field) for c in (config, Config("")))
            if asked not in (usual, value):
                raise ConfigError(
                    f"--ablation {name} sets --{setting.replace('_', '-')} to {value}, but it was "
                    f"set to {asked}. Leave one of the two out."
                )
            settings = dataclasses.replace(getattr(changed, group), **{field: value})
            changed = dataclasses.replace(changed, **{group: settings})
    return changed


def told_by_name(config: Config) -> set[str]:
    """The settings that the names of a run's ablations tell, such as ``race.vmm_weight``."""
    known = (ABLATIONS[name] for name in config.ablation if name in ABLATIONS)
    return {setting for ablation in known for setting in ablation.settings}

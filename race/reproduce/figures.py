"""What each figure of the paper compares."""

from typing import Any, Final, Literal, NamedTuple

from race.config.presets import TABLE_3, TABLE_4
from race.config.settings import Algo
from race.errors import ConfigError

FigureName = Literal["fig2", "fig3", "fig4", "fig5", "fig6", "fig7", "fig8"]

# The text does not say on which tasks Figures 5 to 8 were made; these four are our choice.
_CHOSEN: Final = (
    *("mamujoco/HalfCheetah-2x3", "mamujoco/Ant-4x2"),
    *("micro/2s3z", "micro/3s_vs_3z"),
)
_LONG: Final = ("micro/2c_vs_64zg", "micro/MMM2", "micro/3s5z")
_ALPHAS: Final = {False: (0.2, 0.5, 0.7, 1.0), True: (0.005, 0.01, 0.05, 0.1)}
_BETAS: Final = (1e-1, 1e-2, 1e-3, 1e-4)


class Variant(NamedTuple):
    """One curve of a figure."""

    label: str
    algo: Algo
    ablation: tuple[str, ...] = ()
    settings: tuple[tuple[str, Any], ...] = ()
    """Of the group ``race``, by their names."""


class Figure(NamedTuple):
    """A figure: the same curves on each of some tasks."""

    title: str
    tasks: tuple[str, ...]
    curves: bool = True
    """Learning curves; else what became of injected teams."""


FIGURES: Final[dict[str, Figure]] = {
    "fig2": Figure("Multi-Agent MuJoCo", tuple(TABLE_3)),
    "fig3": Figure("StarCraft micromanagement", tuple(TABLE_4)),
    "fig4": Figure("elite and discarded rate", (*TABLE_3, *TABLE_4), curves=False),
    "fig5": Figure("how encoders are updated", _CHOSEN),
    "fig6": Figure("agent-level operators", _CHOSEN),
    "fig7": Figure("alpha, the share of mutated weights", _CHOSEN),
    "fig8": Figure("beta, the weight of mutual information", _CHOSEN),
}


def budget(task: str) -> int:
    """Environment steps of the paper's runs on a task."""
    return 2_000_000 if task in _LONG else 1_000_000


def variants(figure: str, discrete: bool) -> tuple[Variant, ...]:
    """The curves of a figure on a task with continuous or discrete actions."""
    race = Variant("RACE", "race")
    match figure:
        case "fig2" | "fig3":
            plain: tuple[Algo, ...] = ("facmac",) if discrete else ("matd3", "facmac")
            others: tuple[Algo, ...] = ("merl", *plain, "ea")
            return (race, *(Variant(name.upper(), name) for name in others))
        case "fig4":
            return (race,)
        case "fig5":
            return (race, *_ablations("vfm-only", "vmm-only", "vfm-marl-only", "vfm-ea-only"))
        case "fig6":
            levels = ("parameter-crossover", "parameter-mutation", "no-crossover", "no-mutation")
            return (race, *_ablations(*levels))
        case "fig7":
            return _values("alpha", "mutation_fraction", _ALPHAS[discrete])
        case "fig8":
            return _values("beta", "vmm_weight", _BETAS)
    raise ConfigError(f"The paper has no {figure} of runs. There are {', '.join(FIGURES)} and all.")


def _ablations(*names: str) -> tuple[Variant, ...]:
    return tuple(Variant(f"RACE, {name}", "race", (name,)) for name in names)


def _values(letter: str, name: str, values: tuple[float, ...]) -> tuple[Variant, ...]:
    return tuple(Variant(f"{letter} = {v:g}", "race", (), ((name, v),)) for v in values)

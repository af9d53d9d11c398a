"""``race list``."""

import dataclasses
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, get_args

import tyro

from race.cli import streams
from race.config.ablations import ABLATIONS
from race.config.presets import PRESETS, TABLES
from race.config.settings import EVOLUTIONS, Algo

if TYPE_CHECKING:
    from race.envs import TaskInfo

ALGORITHMS = {
    "race": "RACE: a MARL team and an evolving population over shared encoders (--base matd3, "
    "maddpg, facmac)",
    "merl": "MERL: a MARL team and an evolving population of whole networks beside it (--base as "
    "for race)",
    "ea": "EA: an evolving population of whole networks, no gradients",
    "matd3": "MATD3: twin central critics, delayed policies, target smoothing",
    "maddpg": "MADDPG: one central critic",
    "facmac": "FACMAC: the agents' utilities, mixed; for discrete actions too, recurrent there",
}

_OF_ONES_OWN = {
    "micro/PATH.toml": "a map of your own (docs/micro.md)",
    "pettingzoo:MODULE.ENV": "an environment of PettingZoo's interface (docs/environments.md)",
    "jaxmarl:SMAX/MAP": "a battle of JaxMARL on the device (docs/environments.md)",
    "jaxmarl:MPE/NAME": "a particle world of JaxMARL on the device, and its other environments",
    "smac/MAP": "StarCraft II itself through SMAC, such as smac/2s3z (docs/starcraft.md)",
    "smacv2/RACE_N_vs_M": "the same through SMACv2, such as smacv2/protoss_5_vs_5",
    "MODULE:FUNCTION": "a task of your own (docs/environments.md)",
}
_EVOLUTIONS = {
    "ga": "the paper's genetic algorithm",
    "cem": "cross-entropy method",
    "es": "evolution strategy",
    "MODULE:FUNCTION": "your own (docs/evolution.md)",
}
_OF_TASKS = ("task", "in the paper", "alpha", "beta", "what it is")


@dataclass(frozen=True)
class List:
    """Show tasks, algorithms, ablations and presets: a line each.

    In a pipe it is plain text with tabs, to be searched and cut: race list | grep Ant.
    """

    json: bool = False
    """Print one JSON object instead."""


def main(arguments: list[str]) -> None:
    """Parses the arguments and prints."""
    chosen = tyro.cli(List, args=arguments, prog="race list")
    from race.envs import describe_tasks

    tasks = describe_tasks()
    assert set(ALGORITHMS) == set(get_args(Algo))
    assert set(EVOLUTIONS) < set(_EVOLUTIONS)
    if chosen.json:
        listing = {
            "tasks": [
                {
                    **info._asdict(),
                    **_battle_sizes(info.id),
                    "alpha": TABLES.get(info.id, (None, None))[0],
                    "beta": TABLES.get(info.id, (None, None))[1],
                }
                for info in tasks
            ],
            "algorithms": ALGORITHMS,
            "ablations": {name: ablation._asdict() for name, ablation in ABLATIONS.items()},
            "presets": {name: dataclasses.asdict(preset) for name, preset in PRESETS.items()},
        }
        print(json.dumps(listing, indent=2))
        return
    told = _sections(tasks)
    if streams.is_terminal():
        _show(told)
        return
    for title, rows in told.items():  # to be searched and cut: a line each, a tab between columns
        for name, *columns in rows:
            print("\t".join((name if title == "task" else f"{title} {name}", *columns)))


def _sections(tasks: "tuple[TaskInfo, ...]") -> dict[str, list[tuple[str, ...]]]:
    """What there is, by kind: name, of tasks what the paper says, and what it is."""
    found: dict[str, list[tuple[str, ...]]] = {"task": []}
    for info in tasks:
        alpha, beta = TABLES.get(info.id, ("", ""))
        paper = (info.paper_name or "", str(alpha), str(beta))
        found["task"].append((info.id, *paper, info.description))
    for form, what in _OF_ONES_OWN.items():
        found["task"].append((form, "", "", "", what))
    found["--algo"] = list(ALGORITHMS.items())
    found["--ablation"] = [(name, ablation.description) for name, ablation in ABLATIONS.items()]
    found["--race.evolution"] = list(_EVOLUTIONS.items())
    found["--preset"] = [
        (
            name,
            f"layers {preset.hidden_sizes}, batch {preset.batch_size}, "
            f"Adam {preset.actor_learning_rate:g}, {preset.random_steps:,} random steps "
            "(continuous actions)",
        )
        for name, preset in PRESETS.items()
    ]
    return found


def _show(told: dict[str, list[tuple[str, ...]]]) -> None:
    """A table of each kind, a line for each row, whatever the width."""
    console = streams.console()
    for title, rows in told.items():
        head = _OF_TASKS if title == "task" else (title, "what it is")
        widths = [max(map(len, cells)) for cells in zip(head, *rows, strict=True)]
        for row in (head, *rows):
            line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            style = "bold" if row is head else ""
            console.print(line.rstrip(), style=style, no_wrap=True, overflow="ellipsis")
        console.print()
    console.print("Lines that are cut off here are whole in a pipe: race list | grep NAME")


def _battle_sizes(task_id: str) -> dict[str, int]:
    """Agents, enemies, actions, entries of observations and state, and step limit of a battle."""
    if not task_id.startswith("micro/"):
        return {}
    from race.envs import make_discrete_task
    from race.envs.micro import load_map

    spec = make_discrete_task(task_id).spec
    return {
        "agents": spec.n_agents,
        "enemies": len(load_map(task_id.removeprefix("micro/")).enemies),
        "actions": spec.n_actions,
        "obs": spec.obs_size,
        "state": spec.state_size,
        "limit": spec.episode_limit,
    }

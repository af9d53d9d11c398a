"""``race list``."""

import dataclasses
import json
from dataclasses import dataclass
from typing import get_args

import tyro

from race.config.ablations import ABLATIONS
from race.config.presets import PRESETS, TABLES
from race.config.settings import EVOLUTIONS, Algo

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


@dataclass(frozen=True)
class List:
    """Show tasks, algorithms, ablations and presets."""

    json: bool = False
    """Print one JSON object instead of tables."""


def main(arguments: list[str]) -> None:
    """Parses the arguments and prints."""
    chosen = tyro.cli(List, args=arguments, prog="race list")
    from race.envs import describe_tasks

    tasks = describe_tasks()
    assert set(ALGORITHMS) == set(get_args(Algo))
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
    from rich.table import Table

    from race.cli import streams

    console = streams.console()
    table = Table("task", "in the paper", "alpha", "beta", "what it is", title="Tasks")
    table.columns[0].no_wrap = True
    group = None
    for info in tasks:
        kind = info.id.partition("/")[0], info.paper_name is not None
        if kind != group:  # of each kind the paper's tasks first, then the others
            table.add_section()
        group = kind
        alpha, beta = TABLES.get(info.id, ("", ""))
        table.add_row(info.id, info.paper_name or "", str(alpha), str(beta), info.description)
    console.print(table)
    console.print("Also your own: package.module:function, see docs/environments.md\n")
    algorithms = Table("--algo", "what it is", title="Algorithms")
    for name, what in ALGORITHMS.items():
        algorithms.add_row(name, what)
    console.print(algorithms)
    ablations = Table("--ablation", "what is left of RACE", title="Ablations")
    for name, ablation in ABLATIONS.items():
        ablations.add_row(name, ablation.description)
    console.print(ablations)
    console.print(
        f"--race.evolution: {', '.join(EVOLUTIONS)}, or your own: package.module:function, see "
        "docs/evolution.md\n"
    )
    presets = Table("--preset", "settings", title="Presets of the learner")
    for name, preset in PRESETS.items():
        presets.add_row(
            name,
            f"layers {preset.hidden_sizes}, batch {preset.batch_size}, "
            f"Adam {preset.actor_learning_rate:g}, {preset.random_steps:,} random steps",
        )
    console.print(presets)
    console.print(
        "Presets are for continuous actions; on discrete ones see race train --help, --facmac."
    )


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

"""``race export``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from race.cli import streams
from race.cli.naming import CHECKPOINT
from race.config.settings import TeamName


@dataclass(frozen=True)
class Export:
    """Write a trained team to a file that runs elsewhere, without JAX and without race.

    The file takes what the agents observe and gives actions in the environment's units, for any
    number of environments at once; docs/export.md shows how to run it. It is checked against the
    team, on random observations and those of an episode, before it is put in place. A card beside
    it (.json) says what it is.
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The run's directory."""
    checkpoint: Annotated[str | None, CHECKPOINT] = None
    """One of the run's checkpoints, or of the best teams that it kept (`race show DIR` names them);
    best: the best tested of these."""
    team: TeamName = "selected"
    """The gradient learner's team, the population's team of best training fitness, or of these
    two the one with the better training return."""
    format: Annotated[
        Literal["onnx", "stablehlo", "numpy"] | None,
        tyro.conf.arg(
            metavar="{onnx,stablehlo,numpy}", help_behavior_hint="(default: what --out ends with)"
        ),
    ] = None
    """onnx for ONNX runtimes (needs race-marl[onnx]), stablehlo for jax.export and XLA, numpy for a
    safetensors file of the weights."""
    out: Annotated[
        Path | None,
        tyro.conf.arg(metavar="PATH", help_behavior_hint="(default: team.onnx, or as --format is)"),
    ] = None
    """The file: .onnx, .stablehlo or .safetensors."""
    per_agent: bool = False
    """One file for each agent, which acts on what it alone observes: NAME-agent0.onnx, ..."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, writes the files and says what is in them."""
    chosen = tyro.cli(Export, args=arguments, prog="race export")
    from race.compilation import use_cache
    from race.runs import directory as run_directory
    from race.teams.export import export, format_of
    from race.teams.formats import SUFFIXES
    from race.teams.team import chosen_team
    from race.teams.trained import load_trained

    out = chosen.out or Path(f"team{SUFFIXES[chosen.format or 'onnx']}")
    kind = format_of(out, chosen.format)
    use_cache(run_directory.open_run(chosen.run_dir).compute)
    console = streams.console(stderr=True)
    with console.status("loading the team"):
        team = chosen_team(load_trained(chosen.run_dir, chosen.checkpoint), chosen.team)
    with console.status("writing and checking"):
        files = export(team, out, kind, per_agent=chosen.per_agent)
    label = {"marl": "MARL team", "champion": "champion"}[team.name]
    for file in files:
        print(
            f"{file.path}: the {label}, {file.bytes / 1000:,.0f} kB, acts as the team does to "
            f"{file.difference:.1e}; {file.card} says what goes in and comes out"
        )

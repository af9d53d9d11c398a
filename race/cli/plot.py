"""``race plot``."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Plot:
    """Draw learning curves; runs of one method become their mean with a 95% interval.

    The interval is Student's t over seeds. Folders of runs are expanded.
    """

    run_dirs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DIR...")]
    """Run directories, or folders that hold some."""
    out: Path = Path("curves.png")
    """The figure: .png, .svg or .pdf."""
    metric: str = "return_mean"
    """Quantity of the evaluations (return_mean, win_rate, length_mean), or any key of metrics.jsonl
    such as injection/elite_rate."""
    team: Literal["selected", "marl", "champion", "all"] = "selected"
    """Whose evaluations; methods without a population have the MARL team alone."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, draws, and prints the curves' last points."""
    chosen = tyro.cli(Plot, args=arguments, prog="race plot")
    from race.cli.progress import rounded
    from race.errors import RunDirectoryError
    from race.viewing.plotting import plot

    if not chosen.run_dirs:
        raise RunDirectoryError("Say which runs to draw: race plot DIR [DIR ...] --out curves.png")
    for row in plot(chosen.run_dirs, chosen.out, chosen.metric, chosen.team):
        interval = "" if math.isnan(row.half_width) else f" ± {rounded(row.half_width)}"
        seeds = f"{row.seeds} seed{'s' if row.seeds > 1 else ''}"
        print(
            f"{row.task}, {row.curve}: {chosen.metric} {rounded(row.mean)}{interval} "
            f"at {row.env_steps:,} environment steps ({seeds})"
        )
    print(f"Figure: {chosen.out}")

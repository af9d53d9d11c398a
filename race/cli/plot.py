"""``race plot``."""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Plot:
    """Draw learning curves; runs of one method become their mean.

    From four seeds on with a 95% interval of the mean (Student's t over seeds, cut to what the
    quantity can be), below that with thin lines of the seeds. Where some of a method's runs end
    early (a cross), its line goes on fainter with the others.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DIR...")]
    """Run directories, folders that hold some, or archives (`race archive`)."""
    out: Path = Path("curves.png")
    """The figure: .png, .svg or .pdf."""
    metric: str = "return_mean"
    """Quantity of the evaluations (return_mean, win_rate, length_mean), or any key of metrics.jsonl
    such as injection/elite_rate."""
    team: Literal["selected", "marl", "champion", "best", "all"] = "selected"
    """Whose evaluations; methods without a population have the MARL team alone. best is the larger
    of the two test results, as in the paper's figures: biased upwards."""
    x: Literal["env_steps", "wall_time"] = "env_steps"
    """What is on the x axis."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, draws, and prints the curves' last points."""
    chosen = tyro.cli(Plot, args=arguments, prog="race plot")
    from race.errors import RunDirectoryError
    from race.viewing.plotting import plot
    from race.viewing.progress import duration, rounded

    if not chosen.runs:
        raise RunDirectoryError("Say which runs to draw: race plot DIR [DIR ...] --out curves.png")

    def place(x: float) -> str:
        return duration(60 * x) if chosen.x == "wall_time" else f"{x:,.0f} environment steps"

    drawn = plot(chosen.runs, chosen.out, chosen.metric, chosen.team, chosen.x)
    for row in drawn.summaries:
        interval = f" (95%: {rounded(row.low)} to {rounded(row.high)})"
        seeds = f"{row.seeds} seed{'s' if row.seeds > 1 else ''}"
        print(
            f"{row.task}, {row.curve}: {chosen.metric} {rounded(row.mean)}"
            f"{'' if math.isnan(row.low) else interval} at {place(row.x)} ({seeds})"
        )
        for run in row.ended_early:
            print(f"  seed {run.seed} ends at {place(run.x[-1])} ({run.name})")
    for name in drawn.without:
        print(f"No {chosen.metric} in {name}: left out.", file=sys.stderr)
    print(f"Figure: {chosen.out}")

"""The figure of performance profiles: how many runs are above a score."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from race.errors import RaceError
from race.runs.aside import written_aside
from race.statistics.intervals import LEAST_SEEDS_OF_A_BAND
from race.viewing.comparison import Comparison
from race.viewing.plotting import FORMATS, colours_of


def draw_profiles(found: Comparison, out: Path) -> None:
    """Draws the share of runs above each normalised score, with pointwise 95% intervals.

    Bands are drawn from four runs on.

    Raises:
        RaceError: if no tasks are common to the methods, or the file cannot be written.
    """
    if out.suffix.lower() not in FORMATS:
        raise RaceError(f"{out} cannot be drawn: the name must end with {', '.join(FORMATS)}.")
    if not found.overall:
        raise RaceError(
            "There is no performance profile: no task was tried with every method. Compare runs "
            "of methods that have a task in common."
        )
    figure = Figure(figsize=(6.4, 4.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    colours = colours_of([row.method for row in found.overall])
    for row in found.overall:
        colour, x = colours[row.method], found.thresholds
        axes.step(
            x, [point.value for point in row.profile], color=colour, label=row.method, where="post"
        )
        if row.runs < LEAST_SEEDS_OF_A_BAND:
            continue  # as in curves: it would hide everything else
        low, high = ([getattr(p, end) for p in row.profile] for end in ("low", "high"))
        axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0, step="post")
    axes.set_xlabel("normalised final score")
    axes.set_ylabel("share of runs above it")
    tasks = f"{len(found.common)} task{'s' if len(found.common) != 1 else ''}"
    axes.set_title(f"{tasks}; bands: 95%, each point alone")
    axes.set_ylim(-0.02, 1.02)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(
        frameon=False, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=1
    )
    with written_aside(out) as temporary:
        figure.savefig(temporary, dpi=150)

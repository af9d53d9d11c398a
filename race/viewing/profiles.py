"""The figure of performance profiles: how many runs are above a score."""

import math
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from race.errors import RaceError
from race.runs.aside import written_aside
from race.statistics.intervals import LEAST_SEEDS_OF_A_BAND
from race.viewing.comparison import Comparison
from race.viewing.plotting import FORMATS, colours_of, make_room, wrapped


def draw_profiles(found: Comparison, out: Path) -> None:
    """Draws the share of runs above each normalised score, with pointwise 95% intervals.

    A panel for each group of tasks that have the same methods. Bands are drawn from four runs on.

    Raises:
        RaceError: if no tasks are common to the methods, or the file cannot be written.
    """
    if out.suffix.lower() not in FORMATS:
        raise RaceError(f"{out} cannot be drawn: the name must end with {', '.join(FORMATS)}.")
    if not found.overall:
        raise RaceError(
            "There is no performance profile: no task with a scale was tried with two methods. "
            "Compare runs of methods that have a task in common."
        )
    columns = min(len(found.families), 3)
    rows = math.ceil(len(found.families) / columns)
    figure = Figure(figsize=(6.4 * columns, 4.8 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    colours = colours_of(sorted({row.method for row in found.overall}))
    for place, tasks in enumerate(found.families, 1):
        _panel(figure.add_subplot(rows, columns, place), found, tasks, colours)
    make_room(figure, rows, 4.8)
    with written_aside(out) as temporary:
        figure.savefig(temporary, dpi=150)


def _panel(axes: Axes, found: Comparison, tasks: tuple[str, ...], colours: dict[str, str]) -> None:
    for row in (row for row in found.overall if row.tasks == tasks):
        colour, x = colours[row.method], found.thresholds
        shares = [point.value for point in row.profile]
        axes.step(x, shares, color=colour, label=wrapped(row.method), where="post")
        if row.runs < LEAST_SEEDS_OF_A_BAND:
            continue  # as in curves: it would hide everything else
        low, high = ([getattr(p, end) for p in row.profile] for end in ("low", "high"))
        axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0, step="post")
    axes.set_xlabel("normalised final score")
    axes.set_ylabel("share of runs above it")
    told = tasks[0] if len(tasks) == 1 else f"{len(tasks)} tasks"
    axes.set_title(f"{told}; bands: 95%, each point alone", fontsize="medium")
    axes.set_ylim(-0.02, 1.02)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(
        frameon=False, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=1
    )

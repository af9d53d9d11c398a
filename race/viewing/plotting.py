"""Figures of learning curves: runs of one method together, one panel per task."""

import itertools
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from race.errors import RaceError
from race.runs.aside import written_aside
from race.runs.recorded import Recorded
from race.runs.results import load
from race.statistics.intervals import LEAST_SEEDS_OF_A_BAND, bounds_of
from race.viewing import curves as chosen
from race.viewing.curves import LABELS, Axis, Band, Curve, aggregate, ended_early

FORMATS = (".png", ".svg", ".pdf")
LONGEST_LINE = 64
"""Characters of a line below a panel."""
LINES_WITH_ROOM = 5
"""Of a legend, in a panel of the usual height."""
LINE_INCHES = 0.18

# The paper's colours where it has any.
_COLOURS = {
    "RACE(MATD3)": "#d62728",
    "MATD3": "#222222",
    "MADDPG": "#1f77b4",
    "RACE(FACMAC)": "#e377c2",
    "FACMAC": "#8c564b",
    "MERL(MATD3)": "#1f77b4",
    "MERL(FACMAC)": "#1f77b4",
    "EA": "#2ca02c",
}
# Where discrete actions leave only these two, they have the colours of the paper's other figure.
_DISCRETE_COLOURS = {
    **{"RACE(FACMAC)": "#d62728", "FACMAC": "#222222"},
    **{"MERL(FACMAC)": "#1f77b4", "EA": "#2ca02c"},
}
_OTHER_COLOURS = (
    *("#ff7f0e", "#9467bd", "#17becf", "#bcbd22", "#7f7f7f", "#e6ab02", "#1b4f9c", "#a6d96a"),
    *("#c51b7d", "#66c2a5", "#b15928", "#fb9a99"),
)
_AXES = {"return_mean": "test return", "win_rate": "test win rate"}
_LINES = {"selected": "-", "marl": "--", "champion": ":", "best": "-."}

Methods = dict[tuple[str, str], list[Curve]]


class Summary(NamedTuple):
    """The last point of a curve, and which of its runs end before it."""

    task: str
    curve: str
    seeds: int
    """At the last point."""
    x: float
    """Environment steps of the last point; with time on the axis, minutes."""
    mean: float
    low: float  # of the 95% interval; NaN with one seed
    high: float
    ended_early: tuple[Curve, ...]


class Drawn(NamedTuple):
    """What a figure shows, and the runs that had nothing to show."""

    summaries: list[Summary]
    without: list[str]


def plot(
    paths: Sequence[Path],
    out: Path,
    metric: str = "return_mean",
    team: str = "selected",
    axis: Axis = "env_steps",
) -> Drawn:
    """Draws ``metric`` of runs to ``out``.

    Args:
        paths: run directories, folders of them, or archives.
        out: a .png, .svg or .pdf file.
        metric: a quantity of evaluations (``return_mean``, ``win_rate``: of ``team``), or any key
            in ``metrics.jsonl``, such as ``injection/elite_rate``.
        team: ``selected``, ``marl``, ``champion``, ``best``, or ``all`` of the first three.
        axis: what is on the x axis.

    Raises:
        RunDirectoryError: for a path without a run, or one that cannot be read.
        RaceError: if no run has a value, two are the same, or the file cannot be written.
    """
    if out.suffix.lower() not in FORMATS:
        raise RaceError(f"{out} cannot be drawn: the name must end with {', '.join(FORMATS)}.")
    runs = load(paths)
    chosen.refuse_twins(runs)
    panels, without = _panels(runs, metric, team, axis)
    if not panels:
        raise chosen.no_values(runs, metric)
    columns = 2 if len(panels) == 4 else min(len(panels), 3)
    rows = math.ceil(len(panels) / columns)
    figure = Figure(figsize=(6.4 * columns, 4.8 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    found = []
    for index, (task, methods) in enumerate(sorted(panels.items())):
        axes = figure.add_subplot(rows, columns, index + 1)
        found += _panel(axes, task, methods, metric, axis, with_seeds=team != "all")
    make_room(figure, rows, 4.8)
    with written_aside(out) as temporary:
        figure.savefig(temporary, dpi=150)
    return Drawn(found, without)


def _panels(
    runs: Sequence[Recorded], metric: str, team: str, axis: Axis
) -> tuple[dict[str, Methods], list[str]]:
    panels: dict[str, Methods] = {}
    without = []
    for run, method in zip(runs, chosen.names_of(runs), strict=True):
        drawn = False
        for label, key in chosen.keys(metric, team, run.config).items():
            curve = chosen.curve_of(run, key, axis)
            if curve is not None:
                name = f"{method}, {label}" if label else method
                methods = panels.setdefault(run.config.task, {})
                methods.setdefault((run.config.method, name), []).append(curve)
                drawn = True
        if not drawn:
            without.append(run.name)
    return panels, without


def _panel(
    axes: Axes, task: str, methods: Methods, metric: str, axis: Axis, *, with_seeds: bool
) -> list[Summary]:
    """One task. Seeds or bands of all teams would hide the lines: then there are none."""
    found = []
    colours = _colours(methods)
    for (method, name), runs in sorted(methods.items(), reverse=True):
        band = aggregate(runs, bounds_of(metric))
        label = next((n for n, text in LABELS.items() if name.endswith(text)), "selected")
        draw(axes, band, runs, colours[method, name], _LINES[label], name, with_seeds)
        found.append(
            Summary(
                task,
                name,
                int(band.seeds[-1]),
                float(band.x[-1]),
                float(band.mean[-1]),
                float(band.low[-1]),
                float(band.high[-1]),
                tuple(ended_early(runs)),
            )
        )
    frame(axes, task, metric, axis)
    return found


def draw(
    axes: Axes, band: Band, runs: list[Curve], colour: str, line: str, name: str, with_seeds: bool
) -> None:
    """A mean with what surrounds it; fainter where some of its runs have already ended."""
    seeds = f"{len(runs)} seed{'s' if len(runs) > 1 else ''}"
    label = wrapped(f"{name} ({seeds})")
    style: dict[str, Any] = {"color": colour, "linestyle": line, "linewidth": 1.8}
    marker = "o" if band.x.size == 1 else None
    whole = np.flatnonzero(band.seeds == band.seeds.max())
    first, last = int(whole[0]), int(whole[-1]) + 1
    axes.plot(band.x, band.mean, alpha=0.4, **style)
    axes.plot(band.x[first:last], band.mean[first:last], marker=marker, label=label, **style)
    if with_seeds and len(runs) >= LEAST_SEEDS_OF_A_BAND:
        limits = axes.dataLim.frozen()
        axes.fill_between(band.x, band.low, band.high, color=colour, alpha=0.18, linewidth=0)
        axes.dataLim.set(limits)  # axes follow the lines: a wide band is cut off
    elif with_seeds and len(runs) > 1:
        for run in runs:
            axes.plot(run.x, run.values, color=colour, linestyle=line, linewidth=0.7, alpha=0.5)
    for run in ended_early(runs):
        if band.x[0] <= run.x[-1] <= band.x[-1]:
            height = np.interp(run.x[-1], band.x, band.mean)
            axes.plot(run.x[-1], height, marker="x", color=colour, markersize=7)


def colours_of(names: Sequence[str]) -> dict[str, str]:
    """A colour for each method, whose name may tell settings after it (`curves.names_of`)."""
    found = _colours({(name.partition(" ")[0], name): [] for name in names})
    return {name: colour for (_, name), colour in found.items()}


def _colours(methods: Methods) -> dict[tuple[str, str], str]:
    """A colour for each method, and for each of several experiments with one method."""
    known = _DISCRETE_COLOURS if set(_DISCRETE_COLOURS) >= {m for m, _ in methods} else _COLOURS
    all_of = dict.fromkeys((m, _experiment(name)) for m, name in sorted(methods, reverse=True))
    own: dict[str, tuple[str, str]] = {}  # whose colour it is
    for method, experiment in all_of:
        if method in known:
            own.setdefault(known[method], (method, experiment))
    colours = {of: colour for colour, of in own.items()}
    spare = itertools.cycle([colour for colour in _OTHER_COLOURS if colour not in own])
    colours |= {of: next(spare) for of in all_of if of not in colours}
    return {(method, name): colours[method, _experiment(name)] for method, name in methods}


def _experiment(name: str) -> str:
    """A curve's name without whose tests it shows."""
    return name.rsplit(", ", 1)[0] if name.endswith(tuple(LABELS.values())) else name


def wrapped(name: str) -> str:
    """A name that fits below a panel: those of runs with many settings are long."""
    return "\n".join(textwrap.wrap(name, LONGEST_LINE, break_on_hyphens=False))


def make_room(figure: Figure, rows: int, height: float) -> None:
    """Gives each row of panels its height in inches, and more where a legend has many lines."""
    legends = [legend for axes in figure.axes if (legend := axes.get_legend()) is not None]
    lines = max(
        sum(1 + text.get_text().count("\n") for text in legend.get_texts()) for legend in legends
    )
    figure.set_figheight(rows * (height + LINE_INCHES * max(lines - LINES_WITH_ROOM, 0)))


def frame(axes: Axes, task: str, metric: str, axis: Axis) -> None:
    """Names and limits of a panel's axes, and its legend."""
    axes.set_title(task)
    axes.set_ylabel(_AXES.get(metric, metric))
    axes.autoscale_view()
    if metric == "win_rate":
        axes.set_ylim(-0.02, 1.02)
    if axis == "env_steps":
        axes.set_xlabel("environment steps (all teams)")
        axes.xaxis.set_major_formatter(
            lambda x, _: f"{x / 1e6:g}M" if x >= 1e6 else f"{x / 1e3:g}k"
        )
    else:
        axes.set_xlabel("wall time (minutes)")
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(
        frameon=False, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=1
    )

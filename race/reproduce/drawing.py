"""The paper's figures with runs of one's own."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas

from race.reproduce import paper
from race.reproduce.figures import FIGURES, variants
from race.reproduce.planning import Place
from race.runs.aside import written_aside
from race.runs.recorded import Recorded
from race.statistics.intervals import bounds_of, mean_estimate
from race.viewing import curves as chosen
from race.viewing.curves import Curve, aggregate
from race.viewing.plotting import draw, frame, make_room

_COLOURS = ("#d62728", "#1f77b4", "#222222", "#8c564b", "#2ca02c", "#ff7f0e")
_RATES = {"elite": "injection/elite_rate", "discarded": "injection/discarded_rate"}


class Drawn(NamedTuple):
    """A figure that was drawn, and what is missing in it."""

    file: Path
    gaps: list[str]


def draw_figure(
    name: str, runs: Sequence[tuple[Recorded, Place]], tasks: Sequence[str], team: str, out: Path
) -> Drawn | None:
    """Draws a figure in the paper's form: a panel for each task.

    Args:
        name: of the figure.
        runs: those of the figure, with the curves that they belong to.
        tasks: the panels, in their order.
        team: whose tests are drawn.
        out: the file.

    Returns:
        None if there is nothing to draw yet.

    Raises:
        RaceError: if it cannot be written.
    """
    gaps: list[str] = []
    figure = FIGURES[name]
    if not figure.curves:
        return _draw_rates(name, runs, tasks, out)
    panels = {task: _panel(task, name, runs, team, gaps) for task in tasks}
    shown = {task: curves for task, curves in panels.items() if curves}
    if not shown:
        return None
    columns = min(len(shown), 4)
    rows = math.ceil(len(shown) / columns)
    canvas = Canvas(figsize=(max(4.2 * columns, 6.4), 4.4 * rows), layout="constrained")
    FigureCanvasAgg(canvas)
    rings = False
    labels = {label for curves in shown.values() for label in curves}
    for number, (task, curves) in enumerate(shown.items()):
        axes = canvas.add_subplot(rows, columns, number + 1)
        order = [v.label for d in (False, True) for v in variants(name, d) if v.label in labels]
        hues = dict(zip(dict.fromkeys(order), _COLOURS * 3, strict=False))
        for label in [label for label in hues if label in curves]:
            rings |= _curve(axes, name, task, label, curves[label], hues[label])
        frame(axes, task, _metric(task, runs), "env_steps")
        axes.legend(
            frameon=False, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.22)
        )
    make_room(canvas, rows, 4.4)
    told = "; rings: the paper's numbers" if rings else ""
    canvas.suptitle(f"{name}: {figure.title}{told}", fontsize="medium")
    with written_aside(out) as temporary:
        canvas.savefig(temporary, dpi=130)
    return Drawn(out, gaps)


def _curve(axes: Axes, name: str, task: str, label: str, curves: list[Curve], colour: str) -> bool:
    """Draws a curve, and the paper's numbers if there are any: then True."""
    band = aggregate(curves, bounds_of("win_rate" if task.startswith("micro/") else ""))
    draw(axes, band, curves, colour, "-", label, True)
    told = [(x, y) for x, y in paper.points(name, task, label) if x <= 1.05 * band.x[-1]]
    if told:
        x, y = zip(*told, strict=True)
        axes.plot(x, y, "o", color=colour, alpha=0.45, fillstyle="none", markersize=7)
    return bool(told)


def _metric(task: str, runs: Sequence[tuple[Recorded, Place]]) -> str:
    won = (
        any(key.endswith("/win_rate") for row in run.rows for key in row)
        for run, place in runs
        if place.task == task
    )
    return "win_rate" if any(won) else "return_mean"


def _panel(
    task: str, name: str, runs: Sequence[tuple[Recorded, Place]], team: str, gaps: list[str]
) -> dict[str, list[Curve]]:
    metric = _metric(task, runs)
    curves: dict[str, list[Curve]] = {}
    for run, place in runs:
        if place.task == task:
            (key,) = chosen.keys(metric, team, run.config).values()
            curve = chosen.curve_of(run, key, "env_steps")
            if curve is not None:
                curves.setdefault(place.label, []).append(curve)
    wanted = {place.label for _, place in runs if place.task == task}
    for label in sorted(wanted - set(curves)):
        gaps.append(f"{name}: {task} has no test of {label} yet")
    return curves


def _draw_rates(
    name: str, runs: Sequence[tuple[Recorded, Place]], tasks: Sequence[str], out: Path
) -> Drawn | None:
    """Bars of the rates at the end of runs, means over seeds with their intervals."""
    ends: dict[str, dict[str, list[float]]] = {}
    for run, place in runs:
        for label, key in _RATES.items():
            values = [row[key] for row in run.rows if row.get(key) is not None]
            if values:
                ends.setdefault(place.task, {}).setdefault(label, []).append(values[-1])
    shown = [task for task in tasks if task in ends]
    if not shown:
        return None
    canvas = Canvas(figsize=(max(2 + 1.1 * len(shown), 6.4), 4.4), layout="constrained")
    FigureCanvasAgg(canvas)
    axes = canvas.add_subplot()
    for side, (label, colour) in enumerate(zip(_RATES, ("#d62728", "#8b93a1"), strict=True)):
        found = [mean_estimate(ends[task][label], (0.0, 1.0)) for task in shown]
        x = np.arange(len(shown)) + 0.38 * (side - 0.5)
        axes.bar(x, [e.value for e in found], 0.36, color=colour, label=f"{label} rate")
        ranges = [(e.value - e.low, e.high - e.value) for e in found]
        axes.errorbar(x, [e.value for e in found], np.nan_to_num(ranges).T, fmt="none", color="k")
    axes.set_xticks(
        range(len(shown)), [t.partition("/")[2] for t in shown], rotation=40, ha="right"
    )
    axes.set_ylim(0, 1)
    axes.set_ylabel("share of injected MARL teams")
    axes.set_title(f"{name}: what became of injected MARL teams (95%)", fontsize="medium")
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    with written_aside(out) as temporary:
        canvas.savefig(temporary, dpi=130)
    return Drawn(out, [f"{name}: {task} has no rate yet" for task in tasks if task not in ends])

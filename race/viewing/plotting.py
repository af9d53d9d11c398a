"""Learning curves: runs of one method aggregated, one panel per task."""

import dataclasses
import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from race.config.settings import Config
from race.errors import RaceError, RunDirectoryError
from race.runs import directory as run_directory
from race.runs import metrics
from race.runs.directory import RunDirectory

FORMATS = (".png", ".svg", ".pdf")
TEAMS = ("selected", "marl", "champion")

# The paper's colours where it has any.
_COLOURS = {
    "RACE(MATD3)": "#d62728",
    "MATD3": "#222222",
    "MADDPG": "#1f77b4",
    "RACE(FACMAC)": "#e377c2",
    "FACMAC": "#8c564b",
}
# Where discrete actions leave only these two, they have the colours of the paper's other figure.
_DISCRETE_COLOURS = {"RACE(FACMAC)": "#d62728", "FACMAC": "#222222"}
_OTHER_COLOURS = ("#ff7f0e", "#9467bd", "#2ca02c", "#17becf", "#bcbd22")
_AXES = {"return_mean": "test return", "win_rate": "test win rate"}
_LINES = {"selected": "-", "marl": "--", "champion": ":"}
_LABELS = {"selected": "selected team", "marl": "MARL team", "champion": "champion"}


class Summary(NamedTuple):
    """The last point of a curve."""

    task: str
    curve: str
    seeds: int
    env_steps: int
    mean: float
    half_width: float  # of the 95% interval; NaN with one seed


@dataclass(frozen=True)
class Curve:
    """One quantity of one run over environment steps."""

    env_steps: NDArray[np.float64]
    values: NDArray[np.float64]


class Band(NamedTuple):
    """The mean over seeds and its 95% interval (Student's t), on a common grid."""

    env_steps: NDArray[np.float64]
    mean: NDArray[np.float64]
    half_width: NDArray[np.float64]  # NaN with one seed


def plot(
    directories: Sequence[Path], out: Path, metric: str = "return_mean", team: str = "selected"
) -> list[Summary]:
    """Draws ``metric`` of the runs in ``directories`` to ``out``.

    Args:
        directories: run directories, or folders of run directories.
        out: a .png, .svg or .pdf file.
        metric: a quantity of evaluations (``return_mean``, ``win_rate``: of ``team``), or any key
            in ``metrics.jsonl``, such as ``injection/elite_rate``.
        team: ``selected``, ``marl``, ``champion``, or ``all`` of them.

    Returns:
        The last point of every curve.

    Raises:
        RunDirectoryError: for a directory without a run, or a run without the rows needed.
        RaceError: for an unknown metric, or a file that cannot be written.
    """
    if out.suffix.lower() not in FORMATS:
        raise RaceError(f"{out} cannot be drawn: the name must end with {', '.join(FORMATS)}.")
    runs = [(path, run_directory.open_run(path)) for path in _expand(directories)]
    _refuse_twins(runs)
    names = _names([config for _, config in runs])
    curves: dict[str, dict[tuple[str, str], list[Curve]]] = {}
    read = [metrics.read(RunDirectory(path).metrics) for path, _ in runs]
    keys_of = {True: set[str](), False: set[str]()}
    for (_, config), rows in zip(runs, read, strict=True):
        keys_of[config.has_population] |= {key for row in rows for key in row}
    of_populations = keys_of[True] - keys_of[False]
    for (path, config), method, rows in zip(runs, names, read, strict=True):
        if not rows:
            raise RunDirectoryError(
                f"The run in {path} has no rows of metrics yet: wait until its first generation "
                "is over."
            )
        for label, key in _keys(metric, team, config).items():
            name = f"{method}, {label}" if label else method
            if not config.has_population and key in of_populations:
                continue  # a quantity of populations, asked for of several methods
            curve = _curve(path, rows, key, metric)
            curves.setdefault(config.task, {}).setdefault((method, name), []).append(curve)
    columns = 2 if len(curves) == 4 else min(len(curves), 3)
    rows_of_panels = math.ceil(len(curves) / columns)
    figure = Figure(figsize=(6.4 * columns, 4.4 * rows_of_panels))
    FigureCanvasAgg(figure)
    found = []
    for index, (task, methods) in enumerate(sorted(curves.items())):
        axes = figure.add_subplot(rows_of_panels, columns, index + 1)
        found += _panel(axes, task, methods, metric)
    figure.tight_layout()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, dpi=150)
    except OSError as error:
        raise RaceError(f"{out} cannot be written: {error}.") from error
    return found


def aggregate(curves: Sequence[Curve]) -> Band:
    """The mean of several runs where all have values, with a 95% interval of the mean.

    Runs are evaluated at different steps; each is interpolated linearly onto all steps at which
    any of them was evaluated, within the range that all cover. With n seeds the half width is
    ``t_{0.975, n-1} s / sqrt(n)``.
    """
    first = max(curve.env_steps[0] for curve in curves)
    last = min(curve.env_steps[-1] for curve in curves)
    grid = np.unique(np.concatenate([curve.env_steps for curve in curves]))
    grid = grid[(grid >= first) & (grid <= last)]
    if not grid.size:
        return Band(grid, grid, grid)
    values = np.stack([np.interp(grid, curve.env_steps, curve.values) for curve in curves])
    n = len(curves)
    if n == 1:
        return Band(grid, values[0], np.full(grid.shape, np.nan))
    half = stats.t.ppf(0.975, n - 1) * values.std(axis=0, ddof=1) / math.sqrt(n)
    return Band(grid, values.mean(axis=0), half)


def _expand(directories: Sequence[Path]) -> list[Path]:
    found: list[Path] = []
    for path in directories:
        if not path.is_dir():
            raise RunDirectoryError(f"{path} is not a directory, so it holds no run to draw.")
        inside = sorted(child.parent for child in path.glob("*/config.json"))
        found += [path] if (path / "config.json").exists() or not inside else inside
    return list(dict.fromkeys(found))


def _settings(config: Config) -> dict[str, Any]:
    """What makes two runs the same experiment: everything but seed, length and bookkeeping."""
    kept = dataclasses.asdict(config)
    for name in ("seed", "env_steps", "checkpoint"):
        del kept[name]
    del kept["env"]["processes"]
    return {
        f"{group}.{name}" if isinstance(values, dict) else group: value
        for group, values in kept.items()
        for name, value in (values.items() if isinstance(values, dict) else [("", values)])
    }


def _refuse_twins(runs: Sequence[tuple[Path, Config]]) -> None:
    seen: dict[tuple[int, str], Path] = {}
    for path, config in runs:
        twin = seen.setdefault((config.seed, repr(_settings(config))), path)
        if twin != path:
            raise RaceError(
                f"{twin} and {path} are the same experiment with the same seed {config.seed}; "
                "counted as two seeds they would make the interval too narrow. Name one of them."
            )


def _names(configs: Sequence[Config]) -> list[str]:
    """Each run's method, with the settings in which runs of one method and task differ."""
    names = []
    for config in configs:
        mine = _settings(config)
        rivals = [
            _settings(other)
            for other in configs
            if (other.task, other.method) == (config.task, config.method)
        ]
        differ = [key for key in mine if any(rival[key] != mine[key] for rival in rivals)]
        settings = ", ".join(f"{key}={mine[key]}" for key in differ)
        names.append(f"{config.method} {settings}" if settings else config.method)
    return names


def _keys(metric: str, team: str, config: Config) -> dict[str, str]:
    """Keys of the rows to draw, by the label that tells a method's curves apart."""
    if "/" in metric or metric == "wall_seconds" or metric == "gradient_steps":
        return {"": metric}
    if team == "all" and config.has_population:
        return {_LABELS[name]: f"eval/{name}/{metric}" for name in TEAMS}
    # Without a population there is the MARL team alone, whatever the choice.
    name = team if config.has_population and team != "all" else "marl"
    return {"" if team in ("selected", "all") else _LABELS[name]: f"eval/{name}/{metric}"}


def _curve(path: Path, rows: list[dict[str, object]], key: str, metric: str) -> Curve:
    known = {k for row in rows for k, v in row.items() if isinstance(v, int | float)}
    points = [
        (float(str(row["env_steps"])), float(str(row[key])))
        for row in rows
        if isinstance(row.get(key), int | float) and not isinstance(row.get(key), bool)
    ]
    if not points and key.startswith("eval/") and not any(k.startswith("eval/") for k in known):
        raise RunDirectoryError(
            f"The run in {path} has not been evaluated yet. Wait for its first evaluation, or "
            "draw a training quantity such as --metric marl/return."
        )
    if not points:
        short = {k.removeprefix("eval/selected/") for k in known}
        near = difflib.get_close_matches(metric, sorted(known | short), n=3, cutoff=0.3)
        raise RaceError(
            f"The run in {path} has no values of {metric!r}. "
            + (f"Nearest: {', '.join(near)}. " if near else "")
            + f"All: {', '.join(sorted(known))}."
        )
    steps, values = np.array(points).T
    return Curve(steps, values)


def _panel(
    axes: Axes, task: str, methods: dict[tuple[str, str], list[Curve]], metric: str
) -> list[Summary]:
    found = []
    spare = iter(_OTHER_COLOURS * 4)
    colours: dict[str, str] = {}
    known = _DISCRETE_COLOURS if set(_DISCRETE_COLOURS) >= {m for m, _ in methods} else _COLOURS
    for (method, name), runs in sorted(methods.items(), reverse=True):
        if method not in colours:
            colours[method] = known.get(method) or next(spare)
        band = aggregate(runs)
        if not band.env_steps.size:
            raise RaceError(
                f"The runs of {name} on {task} have no range of environment steps in common. "
                "Train the shorter ones further, or draw them apart."
            )
        label = next((n for n, text in _LABELS.items() if name.endswith(text)), "selected")
        seeds = f"{len(runs)} seed{'s' if len(runs) > 1 else ''}"
        axes.plot(
            band.env_steps,
            band.mean,
            color=colours[method],
            linestyle=_LINES[label],
            linewidth=1.8 if label == "selected" else 1.1,
            marker="o" if band.env_steps.size == 1 else None,
            label=f"{name} ({seeds})",
        )
        if len(runs) > 1 and label == "selected":  # bands of all teams would hide the lines
            low, high = band.mean - band.half_width, band.mean + band.half_width
            axes.fill_between(
                band.env_steps, low, high, color=colours[method], alpha=0.18, linewidth=0
            )
        found.append(
            Summary(
                task,
                name,
                len(runs),
                int(band.env_steps[-1]),
                float(band.mean[-1]),
                float(band.half_width[-1]),
            )
        )
    axes.set_title(task)
    axes.set_xlabel("environment steps (all teams)")
    axes.set_ylabel(_AXES.get(metric, metric))
    if metric == "win_rate":
        axes.set_ylim(-0.02, 1.02)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_formatter(lambda x, _: f"{x / 1e6:g}M" if x >= 1e6 else f"{x / 1e3:g}k")
    axes.legend(frameon=False, fontsize="small", loc="upper left")
    return found

"""What the page shows, as plain JSON values."""

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from race.errors import RaceError
from race.runs.recorded import Recorded, settings
from race.statistics.intervals import LEAST_SEEDS_OF_A_BAND, bounds_of, mean_estimate
from race.viewing import curves as chosen
from race.viewing.comparison import compare
from race.viewing.curves import Axis
from race.viewing.plotting import colours_of
from race.viewing.report import evolution
from race.viewing.report.made import Made
from race.viewing.scores import scores_of, tests_and_end
from race.viewing.tables import LEGEND, as_json, estimate, remarks, seconds, tables_of

TEST_METRICS = ("return_mean", "win_rate", "length_mean")
TEAMS = ("selected", "marl", "champion", "best")
MOST_POINTS = 150
DIGITS = 5
_TRAINING = ("loss/", "time/", "injection/", "operators/", "population/", "marl/")
_NUMBER = (int, float)
_AXES: tuple[Axis, ...] = ("env_steps", "wall_time")
_FATES = ("injection/elite_rate", "injection/parent_rate", "injection/discarded_rate")
_BETTER = tuple(
    f"operators/{name}_better_rate" for name in ("crossover", "mutation", "crossover_and_mutation")
)


def content_of(
    runs: Sequence[Recorded],
    metric: str,
    team: str,
    base: str | None,
    made: Made | None = None,
) -> Any:
    """Everything on the page.

    Args:
        runs: of any tasks and methods.
        metric: as `race.viewing.scores.scores_of`.
        team: whose tests the tables are about.
        base: as `race.viewing.comparison.compare`.
        made: what was made of the runs' checkpoints.

    Raises:
        RaceError: if no run has a row yet, or two are the same.
    """
    if not any(run.rows for run in runs):
        raise chosen.no_values(runs, "return_mean")
    chosen.refuse_twins(runs)
    names = chosen.names_of(runs)
    made = made or Made({}, [])
    tables: list[dict[str, Any]] = []
    comparison, said = None, []
    try:
        found = compare(scores_of(runs, metric, team), team, base)
    except RaceError as error:  # such as no test yet: the page shows what there is
        said = [str(error)]
    else:
        comparison, said = as_json(found), remarks(found)
        tables = [table._asdict() for table in tables_of(found)]
    return {
        "tables": tables,
        "legend": LEGEND,
        "remarks": said,
        "comparison": comparison,
        "settings": _differing(runs, names),
        "fates": _fates(runs, names),
        "kinds": list(evolution.KINDS),
        "colours": colours_of(sorted(set(names))),
        "bands": _bands(runs, names),
        "not_made": made.remarks,
        "runs": [
            _run(run, name) | made.of_runs.get(run.name, {})
            for run, name in zip(runs, names, strict=True)
        ],
    }


def as_text(content: Any) -> str:
    """JSON that may stand in a page: numbers short, no sign that would end the script."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _run(run: Recorded, method: str) -> dict[str, Any]:
    tests = [row for row in run.rows if row.get("kind") == "evaluation"]
    training = _binned([row for row in run.rows if row.get("kind") == "generation"])
    keys = [f"eval/{team}/{metric}" for team in TEAMS for metric in TEST_METRICS]
    told = sorted({key for row in training for key in row if key.startswith(_TRAINING)})
    last = run.rows[-1] if run.rows else {}
    story = evolution.Story(run.rows)
    return {
        "name": run.name,
        "task": run.config.task,
        "method": method,
        "seed": run.config.seed,
        "steps": last.get("env_steps", 0),
        "asked": run.config.env_steps,
        "time": seconds(float(last.get("wall_seconds", 0))),
        "version": run.algorithm_version,
        "keys": {
            f"{team}/{metric}": next(iter(chosen.keys(metric, team, run.config).values()))
            for team in TEAMS
            for metric in TEST_METRICS
        },
        "tests": _columns(_thinned(tests), keys),
        "training": _columns(training, told),
        "teams": evolution.fitness_of_teams(story) if story.rows else None,
        "ancestry": _rounded(evolution.ancestry(story)) if story.rows else None,
        "winners": evolution.winners(story) if story.rows else None,
        "population": run.config.has_population,
    }


def _columns(rows: Sequence[dict[str, Any]], keys: Sequence[str]) -> dict[str, list[Any]]:
    """Columns of numbers; those without any are left out."""
    found: dict[str, list[Any]] = {
        "env_steps": [row.get("env_steps") for row in rows],
        "wall_time": [_short(float(row.get("wall_seconds", 0)) / 60) for row in rows],
    }
    for key in keys:
        values = [_short(row.get(key)) for row in rows]
        if any(value is not None for value in values):
            found[key] = values
    return found


def _thinned(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    step = max(1, -(-len(rows) // MOST_POINTS))
    return rows[::-1][::step][::-1]


def _binned(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over generations in a row, so that there are at most `MOST_POINTS`."""
    step = max(1, -(-len(rows) // MOST_POINTS))
    told = [key for key in set().union(*rows) if key.startswith(_TRAINING)]
    found = []
    for begin in range(0, len(rows), step):
        bin_ = rows[begin : begin + step]
        one = {key: bin_[-1].get(key) for key in ("env_steps", "wall_seconds")}
        for key in told:
            values = [v for row in bin_ if isinstance(v := row.get(key), _NUMBER)]
            one[key] = sum(values) / len(values) if values else None
        found.append(one)
    return found


def _bands(runs: Sequence[Recorded], names: Sequence[str]) -> list[dict[str, Any]]:
    """Means with intervals of all seeds, as `race plot` draws them."""
    found = []
    runs = [run._replace(rows=tests_and_end(run.rows)) for run in runs]
    for task, name in sorted({(r.config.task, n) for r, n in zip(runs, names, strict=True)}):
        mine = [r for r, n in zip(runs, names, strict=True) if (r.config.task, n) == (task, name)]
        for metric in TEST_METRICS:
            for team in TEAMS:
                for axis in _AXES:
                    (key,) = chosen.keys(metric, team, mine[0].config).values()
                    curves = [c for run in mine if (c := chosen.curve_of(run, key, axis))]
                    if not curves:
                        continue
                    band = chosen.aggregate(curves, bounds_of(metric))
                    step = max(1, -(-len(band.x) // MOST_POINTS))
                    parts = {
                        part: [_short(float(v)) for v in getattr(band, part)[::-1][::step][::-1]]
                        for part in ("x", "mean", "low", "high")
                    }
                    if len(curves) < LEAST_SEEDS_OF_A_BAND:
                        del parts["low"], parts["high"]
                    at = {"task": task, "method": name, "metric": metric, "team": team}
                    found.append({**at, "axis": axis, "seeds": len(curves), **parts})
    return found


def _differing(runs: Sequence[Recorded], names: Sequence[str]) -> dict[str, Any]:
    """Settings in which runs differ, of those that use them: columns are tasks and methods."""
    columns: dict[tuple[str, str], dict[str, Any]] = {}
    for run, name in zip(runs, names, strict=True):
        columns.setdefault((run.config.task, name), settings(run.config))
    keys = sorted({key for values in columns.values() for key in values} - {"task"})

    def text(values: dict[str, Any], key: str) -> str:
        return json.dumps(values[key]).strip('"') if key in values else "-"

    rows = [[key, *(text(values, key) for values in columns.values())] for key in keys]
    tasks = {task for task, _ in columns}
    heads = [f"{name}, {task}" if len(tasks) > 1 else name for task, name in columns]
    differing = [row for row in rows if len({*row[1:]} - {"-"}) > 1]
    return {"columns": ["setting", *heads], "rows": differing}


def _fates(runs: Sequence[Recorded], names: Sequence[str]) -> dict[str, Any]:
    """What became of injected teams and which operators improved teams, at the end of runs."""
    rows = []
    for task, name in sorted({(r.config.task, n) for r, n in zip(runs, names, strict=True)}):
        mine = [r for r, n in zip(runs, names, strict=True) if (r.config.task, n) == (task, name)]
        line = []
        for key in (*_FATES, *_BETTER):
            last = (_last(run.rows, key) for run in mine)
            ends = [value for value in last if value is not None]
            line.append(estimate(mean_estimate(ends, (0.0, 1.0)), percent=True) if ends else "-")
        if set(line) != {"-"}:
            rows.append([task, name, str(len(mine)), *line])
    heads = ["became elite", "became parent", "was discarded"]
    heads += ["crossover better", "mutation better", "both better"]
    return {"columns": ["task", "method", "seeds", *heads], "rows": rows}


def _last(rows: Sequence[dict[str, Any]], key: str) -> Any:
    return next((row[key] for row in reversed(rows) if row.get(key) is not None), None)


def _short(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return None
    if not math.isfinite(value):
        return None
    return float(f"{float(value):.{DIGITS}g}")


def _rounded(columns: dict[str, list[Any]]) -> dict[str, list[Any]]:
    return {**columns, "fitness": [_short(value) for value in columns["fitness"]]}

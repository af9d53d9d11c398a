"""A comparison as text, Markdown, LaTeX, CSV and JSON."""

import csv
import dataclasses
import io
import json
import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from race.statistics.intervals import Estimate
from race.statistics.separation import MOST_SEEDS
from race.viewing.comparison import Against, Comparison, OnTask, Pair

Format = Literal["text", "markdown", "latex", "csv", "json"]
SUFFIXES: dict[str, Format] = {
    ".txt": "text",
    ".md": "markdown",
    ".tex": "latex",
    ".csv": "csv",
    ".json": "json",
}
MISSING = "-"


class Table(NamedTuple):
    """A table of words for people."""

    title: str
    columns: list[str]
    rows: list[list[str]]
    note: str = ""


def tables_of(found: Comparison) -> list[Table]:
    """What people read: a table for each task, and one over tasks."""
    said = [_of_task(found, task) for task in found.tasks]
    if len(found.families) > 1:
        said += [_over_tasks(found, family, with_base=False) for family in found.families]
        return [*said, _against(found)] if found.against else said
    if not found.overall and not found.against:
        return said
    return [*said, _over_tasks(found, *found.families, with_base=True)]


def remarks(found: Comparison) -> list[str]:
    """What stands in the way of the comparison, then what a reader should know besides."""
    return [*found.differences, *found.notes]


def written(found: Comparison, form: Format) -> str:
    """The comparison in a format, ending with a line break."""
    writers = {
        "text": _text,
        "markdown": _markdown,
        "latex": _latex,
        "csv": _csv,
        "json": lambda c: json.dumps(as_json(c), indent=2) + "\n",
    }
    return writers[form](found)


def as_json(found: Comparison) -> dict[str, Any]:
    """Plain JSON values, in the form of `Comparison`; what is not finite is null."""
    plain: dict[str, Any] = _plain(found)
    return plain


def number(value: float) -> str:
    """A score for people: whole from a hundred on, three digits below."""
    if not math.isfinite(value):
        return MISSING
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def estimate(found: Estimate, percent: bool = False) -> str:
    """A number with its interval in brackets, where it has one."""

    def one(value: float) -> str:
        return f"{100 * value:.1f}%" if percent else number(value)

    if math.isnan(found.low):
        return one(found.value)
    return f"{one(found.value)} [{one(found.low)}, {one(found.high)}]"


def seconds(value: float) -> str:
    """A time for people."""
    if not math.isfinite(value):
        return "never"
    minutes, rest = divmod(round(value), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}h{minutes:02}m" if hours else f"{minutes}m{rest:02}s"


def _of_task(found: Comparison, task: str) -> Table:
    rows = [row for row in found.on_tasks if row.task == task]
    pairs = {pair.method: pair for pair in found.pairs if pair.task == task}
    based = f"minus {found.bases[task]}" if pairs else ""
    columns = ["method", "seeds", "final", "area", f"time to {number(rows[0].time_to.score)}"]
    lines = []
    for row in sorted(rows, key=lambda row: -row.final.value):
        line = [row.method, str(len(row.seeds)), estimate(row.final), estimate(row.area)]
        line += [_time(row), *(_pair(pairs.get(row.method)) if pairs else [])]
        lines.append(line)
    if pairs:
        columns += [based, "told apart"]
    quantity = rows[0].metric.replace("return_mean", "test return").replace("_", " ")
    title = f"{task}: {quantity} of the {found.team} team at {rows[0].horizon:,.0f} steps"
    return Table(title, columns, lines)


def _time(row: OnTask) -> str:
    found = row.time_to
    if len(row.seeds) == 1:
        return seconds(found.seconds[0])
    share = f"{found.reached}/{len(row.seeds)}"
    if math.isfinite(found.seconds[0]) or not found.reached:
        return f"{seconds(found.seconds[0])} ({share})"
    return f"fastest {seconds(found.seconds[1])} ({share})"


def _pair(pair: Pair | None) -> list[str]:
    if pair is None:
        return [MISSING, MISSING]
    told = {True: "yes", None: "too few seeds to tell"}.get(pair.told_apart)
    if told is None:
        needed = pair.seeds_needed
        told = f"no: {needed} seeds each" if needed else f"no: over {MOST_SEEDS:,} seeds"
    return [estimate(pair.difference), told]


def _over_tasks(found: Comparison, tasks: tuple[str, ...] = (), *, with_base: bool) -> Table:
    """Methods over some tasks; with what tells them from the base, if that is all there is."""
    against = {row.method: row for row in found.against if with_base}
    overall = {row.method: row for row in found.overall if row.tasks == tasks}
    methods = sorted({*against, *overall})
    if overall:
        methods.sort(key=lambda name: -overall[name].iqm.value if name in overall else math.inf)
    lines = []
    for name in methods:
        line = [name]
        whole, pair = overall.get(name), against.get(name)
        line += [MISSING] * 3 if whole is None else [str(whole.runs), estimate(whole.iqm)]
        line += [] if whole is None else [estimate(whole.gap)]
        if against:
            line += [MISSING] * 2 if pair is None else _beside(pair)
        lines.append(line)
    columns = ["method", "runs", "interquartile mean", "optimality gap"]
    if against:
        columns += [f"P(beats {found.base})", f"gain over {found.base}"]
    note = f"Normalised: {found.normalised}. Tasks: {', '.join(tasks) or 'none'}."
    if any(row.tasks != tasks for row in against.values()):
        note += f" Against {found.base}, over all tasks that both were tried on."
    return Table(
        f"Over {_count(tasks) if tasks else 'tasks'}, final scores",
        *(columns, lines, note + _odd_gains(found if against else None)),
    )


def _against(found: Comparison) -> Table:
    """Methods and their bases where there is no one set of tasks for all."""
    rows = sorted(found.against, key=lambda row: -row.improvement.value)
    base = found.base
    lines = [[row.method, row.base, _count(row.tasks), *_beside(row)] for row in rows]
    heads = ["method", "base", "over", f"P(beats {base})", f"gain over {base}"]
    note = f"Over all tasks that both were tried on.{_odd_gains(found)}"
    return Table(f"Against {base}, final scores", heads, lines, note)


def _beside(row: Against) -> list[str]:
    gain = MISSING if row.gain is None else estimate(row.gain, percent=True)
    return [estimate(row.improvement), gain]


def _count(tasks: Sequence[str]) -> str:
    return f"{len(tasks)} task{'s' if len(tasks) != 1 else ''}"


def _odd_gains(found: Comparison | None) -> str:
    odd = [] if found is None else [r for r in found.against if r.gain_tasks != r.tasks]
    if found is None or not odd:
        return ""
    names = ", ".join(sorted({row.method for row in odd}))
    return f" Gain over {found.base} of {names}: tasks where each of its runs is above zero alone."


LEGEND = (
    "Brackets: 95% intervals over seeds. final: score at these steps; area: mean score up to them; "
    "time to: wall time of the median run to a test at that score (runs that came there), of the "
    "fastest where half never did; told "
    "apart: whether the interval of the difference of final scores leaves out zero, else how many "
    "seeds of each would show a difference as large as this one with probability 0.8."
)


def _text(found: Comparison) -> str:
    parts = []
    for table in tables_of(found):
        grid = [table.columns, *table.rows]
        widths = [max(len(row[c]) for row in grid) for c in range(len(table.columns))]
        lines = [
            "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip()
            for row in grid
        ]
        parts.append("\n".join([table.title, *(f"  {line}" for line in lines)]))
        if table.note:
            parts[-1] += f"\n  {table.note}"
    parts.append(LEGEND)
    said = remarks(found)
    if said:
        parts.append("\n".join(["Mind:", *(f"- {line}" for line in said)]))
    return "\n\n".join(parts) + "\n"


def _markdown(found: Comparison) -> str:
    parts = []
    for table in tables_of(found):
        rows = [table.columns, ["---"] * len(table.columns), *table.rows]
        lines = ["| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in rows]
        parts += [f"**{table.title}**", "\n".join(lines), *([table.note] if table.note else [])]
    parts.append(LEGEND)
    said = remarks(found)
    return (
        "\n\n".join([*parts, *(["\n".join(f"- {line}" for line in said)] if said else [])]) + "\n"
    )


_ESCAPES = {c: f"\\{c}" for c in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}


def _latex(found: Comparison) -> str:
    def tex(text: str) -> str:
        return "".join(_ESCAPES.get(letter, letter) for letter in text)

    parts = []
    for table in tables_of(found):
        lines = [" & ".join(map(tex, row)) + r" \\" for row in table.rows]
        caption = " ".join([f"{table.title}.", *([table.note] if table.note else [])])
        parts.append(
            "\n".join(
                [
                    r"\begin{table}",
                    r"\centering",
                    rf"\caption{{{tex(caption)}}}",
                    rf"\begin{{tabular}}{{{'l' * len(table.columns)}}}",
                    r"\hline",
                    " & ".join(map(tex, table.columns)) + r" \\",
                    r"\hline",
                    *lines,
                    r"\hline",
                    r"\end{tabular}",
                    r"\end{table}",
                ]
            )
        )
    comments = [f"% {line}" for line in [LEGEND, *remarks(found)]]
    return "\n\n".join(parts) + "\n\n" + "\n".join(comments) + "\n"


def _csv(found: Comparison) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["task", "method", "base", "quantity", "value", "low", "high", "runs"])
    for task, method, base, quantity, value, runs in _flat(found):
        ends = [x if math.isfinite(x) else "" for x in value]
        writer.writerow([task, method, base, quantity, *ends, runs])
    return out.getvalue()


def _flat(found: Comparison) -> Iterator[tuple[str, str, str, str, Estimate, int | str]]:
    """One number a line: task (empty: over tasks), method, base, quantity, number, runs.

    Where methods were tried on different tasks, those that a number is over stand for its task.
    """
    for row in found.on_tasks:
        runs = len(row.seeds)
        yield row.task, row.method, "", f"final_{row.metric}", row.final, runs
        yield row.task, row.method, "", f"area_{row.metric}", row.area, runs
        for name in ("seconds", "env_steps"):
            middle, first, last = getattr(row.time_to, name)
            to = f"{name}_to_{row.time_to.score:g}"
            yield row.task, row.method, "", to, Estimate(middle, first, last), row.time_to.reached
    for pair in found.pairs:
        yield pair.task, pair.method, pair.base, "difference", pair.difference, ""
        needed = math.nan if pair.seeds_needed is None else float(pair.seeds_needed)
        number_needed = Estimate(needed, math.nan, math.nan)
        yield pair.task, pair.method, pair.base, "seeds_needed", number_needed, ""
    for whole in found.overall:
        where = "; ".join(whole.tasks) if len(found.families) > 1 else ""
        yield where, whole.method, "", "interquartile_mean", whole.iqm, whole.runs
        yield where, whole.method, "", "optimality_gap", whole.gap, whole.runs
        for threshold, share in zip(found.thresholds, whole.profile, strict=True):
            yield where, whole.method, "", f"share_above_{threshold:.4g}", share, whole.runs
    for beside in found.against:
        yield "", beside.method, beside.base, "probability_of_improvement", beside.improvement, ""
        if beside.gain is not None:
            yield "", beside.method, beside.base, "relative_gain", beside.gain, ""


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {name: _plain(entry) for name, entry in value._asdict().items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value

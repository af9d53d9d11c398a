"""``race bench``."""

import json
import sys
from dataclasses import dataclass

import tyro


@dataclass(frozen=True)
class Bench:
    """Measure speed and memory on this machine; some ten minutes on two idle cores.

    Of the 23 micromanagement maps those with goals are measured, all of them with --only micro.

    Progress goes to standard error. Times on a busy machine mean little; update/*/over_floor, the
    time of an update over that of its matrix products alone, still does.
    """

    only: str | None = None
    """Take only measurements whose name contains this, or fits it as a pattern with * and ?."""
    json: bool = False
    """Print a list of JSON objects instead of a table."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, measures and prints."""
    asked = tyro.cli(Bench, args=arguments, prog="race bench")
    from rich.progress import Progress
    from rich.table import Table

    from race.bench import suite
    from race.cli import streams

    subjects = suite.chosen(suite.subjects(), asked.only)
    console = streams.console(stderr=True)
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("", total=len(subjects))

        def begins(subject: suite.Subject) -> None:
            first = subject.names[0]
            index = subjects.index(subject)
            bar.update(task, completed=index, description=first)
            if not console.is_terminal:
                console.print(f"{index + 1}/{len(subjects)} {first}")

        results = suite.measure(subjects, asked.only, begins)
    if asked.json:
        json.dump([result.to_json() for result in results], sys.stdout, indent=2)
        print()
        return
    table = Table("measurement", "value", "goal", "", box=None)
    for column in table.columns:
        column.no_wrap = True
    for result in results:
        sign = ">=" if result.is_rate else "<="
        goal = "" if result.goal is None else f"{sign} {result.goal:,g}"
        verdict = {None: "", True: "met", False: "not met"}[result.met]
        value = f"{result.value:,.0f}" if result.value >= 1000 else f"{result.value:.3g}"
        table.add_row(result.name, f"{value} {result.unit}", goal, verdict)
    streams.console().print(table)

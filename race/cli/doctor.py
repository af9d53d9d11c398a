"""``race doctor``."""

import sys
from dataclasses import dataclass

import tyro


@dataclass(frozen=True)
class Doctor:
    """Show what is installed, which renderer and accelerator were found, and what mends the rest.

    Exits with 1 if something that race needs is missing.
    """

    python: str | None = None
    """The interpreter with SMAC, for smac/* and smacv2/*, or one to be told what it lacks. None:
    this one."""


def main(arguments: list[str]) -> None:
    """Looks and prints."""
    chosen = tyro.cli(Doctor, args=arguments, prog="race doctor")
    from rich.table import Table
    from rich.text import Text

    from race.cli import streams
    from race.compilation import cache_directory
    from race.doctor import examine

    console = streams.console()
    table = Table("", "what", "found", box=None)
    marks = {
        "ok": Text("ok", "green"),
        "warning": Text("note", "yellow"),
        "missing": Text("missing", "red"),
    }
    findings = []
    with streams.console(stderr=True).status("looking"):
        for finding in examine(cache_directory(), chosen.python):
            findings.append(finding)
            table.add_row(marks[finding.status], finding.name, finding.detail)
    console.print(table)
    remedies = [f for f in findings if f.remedy and f.status != "ok"]
    for finding in remedies:
        remedy = Text.assemble(f"To mend {finding.name}: ", (finding.remedy, "bold"))
        console.print(remedy, soft_wrap=True)
    if any(finding.status == "missing" for finding in findings):
        sys.exit(1)
    console.print("Everything that race needs is here.")

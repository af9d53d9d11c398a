"""``race report``."""

import gc
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Report:
    """Make a page about runs: curves, the tables of `race compare`, what evolution did.

    One file, which needs no network and can be sent to somebody. Needs the extra `report`
    (plotly): pip install 'race-marl[report]'.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DIR...")]
    """Run directories, folders that hold some, or archives (`race archive`, which keeps no
    lineage)."""
    out: Path = Path("report.html")
    """The page: .html."""
    title: str = "race report"
    """Shown at the top."""
    base: str | None = None
    """The method that others are measured against (`race compare --help`)."""
    metric: str = "auto"
    """Quantity of the tables (`race compare --help`)."""
    team: Literal["selected", "marl", "champion", "best"] = "selected"
    """Whose tests the tables are about; the curves can be switched."""
    watch: bool = False
    """Serve the page on this machine while runs go on, instead of writing it. It renews itself."""
    port: int = 8765
    """Where it is served; 0 takes any free port."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, writes or serves the page."""
    chosen = tyro.cli(Report, args=arguments, prog="race report")
    from race.errors import RaceError, RunDirectoryError
    from race.runs.aside import written_aside
    from race.runs.results import load
    from race.viewing.report.content import content_of
    from race.viewing.report.page import page_of
    from race.viewing.report.serving import server

    if not chosen.runs:
        raise RunDirectoryError("Say which runs: race report DIR [DIR ...] --out report.html")
    if chosen.out.suffix != ".html":
        raise RaceError(f"{chosen.out}: the name of a page must end with .html.")

    def make(watched: str = "") -> str:
        # Rows are millions of small objects that all stay: looking among them for garbage takes
        # a third of the time.
        gc.disable()
        try:
            content = content_of(load(chosen.runs), chosen.metric, chosen.team, chosen.base)
        finally:
            gc.enable()
        return page_of(content, title=chosen.title, watched=watched)

    if chosen.watch:
        with server(list(chosen.runs), make, chosen.port) as serving:
            print(
                f"The page is at http://{serving.server_address[0]!s}:{serving.server_port}/ and "
                "renews itself. Ctrl-C ends it.",
                flush=True,
            )
            serving.serve_forever()
        return
    if sys.stderr.isatty():
        print("reading runs ...", file=sys.stderr)
    page = make()
    with written_aside(chosen.out) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(f"Page: {chosen.out} ({chosen.out.stat().st_size / 1e6:.1f} MB)")

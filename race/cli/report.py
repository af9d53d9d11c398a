"""``race report``."""

import gc
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, final

import tyro

from race.cli import streams

if TYPE_CHECKING:
    from rich.console import Console


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
    replays: Annotated[
        Literal["first", "all", "none"] | None,
        tyro.conf.arg(
            metavar="{first,all,none}", help_behavior_hint="(default: first; with --watch none)"
        ),
    ] = None
    """Of runs of battles: an episode of the selected team to step through, of the first seed of
    each method on each task, or of all runs. The first of a map takes some seconds."""
    videos: bool = False
    """Add a video of each run's selected team, under 2 MB each: the newest .mp4 in the run's
    directory, or, where there is none, one made as `race render` does."""
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
    from race.viewing.report.page import page_of
    from race.viewing.report.serving import server

    if not chosen.runs:
        raise RunDirectoryError("Say which runs: race report DIR [DIR ...] --out report.html")
    if chosen.out.suffix != ".html":
        raise RaceError(f"{chosen.out}: the name of a page must end with .html.")
    console = streams.console(stderr=True)
    with _Telling(console) as telling:
        if chosen.videos:
            # mujoco reads what is chosen here when it is imported.
            from race.viewing.rendering import choose_renderer

            telling.tell("looking for a renderer", 0, 1)
            console.print(f"Drawing with: {choose_renderer().reason}", soft_wrap=True)
        from race.viewing.report.content import content_of
        from race.viewing.report.made import Maker

        replays = chosen.replays or ("none" if chosen.watch else "first")
        maker = Maker(replays, chosen.videos, telling.tell)

        def make(watched: str = "") -> str:
            # Rows are millions of small objects that all stay: looking among them for garbage
            # takes as long again, also once they are there.
            gc.disable()
            try:
                telling.tell("reading runs", 0, 1)
                runs = load(chosen.runs)
                gc.freeze()
                gc.enable()
                made = maker.made_of(runs)
                gc.disable()
                telling.tell("making the page", 0, 1)
                content = content_of(runs, chosen.metric, chosen.team, chosen.base, made)
                telling.nothing()
                for remark in content["not_made"] if not watched else ():
                    console.print(remark, soft_wrap=True)
                return page_of(content, title=chosen.title, watched=watched)
            finally:
                gc.enable()
                gc.unfreeze()

        if chosen.watch:
            with server(list(chosen.runs), make, chosen.port) as serving:
                print(
                    f"The page is at http://{serving.server_address[0]!s}:{serving.server_port}/ "
                    "and renews itself. Ctrl-C ends it.",
                    flush=True,
                )
                serving.serve_forever()
            return
        page = make()
    with written_aside(chosen.out) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(f"Page: {chosen.out} ({chosen.out.stat().st_size / 1e6:.1f} MB)")


@final
class _Telling:
    """What is being done, on a terminal a line that goes away again."""

    def __init__(self, console: "Console") -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        self._bar = Progress(
            *(TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn()),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=1)

    def tell(self, what: str, done: int, total: int) -> None:
        """A `race.viewing.report.made.Tell`."""
        self._bar.update(self._task, description=what, completed=done, total=total, visible=True)

    def nothing(self) -> None:
        """Is being done."""
        self._bar.update(self._task, visible=False)

    def __enter__(self) -> "_Telling":
        self._bar.start()
        return self

    def __exit__(self, *ended: object) -> None:
        self._bar.stop()

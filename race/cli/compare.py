"""``race compare``."""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Compare:
    """Say which method is better, and how sure that is.

    Per task and method the final score and the mean score up to it (area under the curve), over
    tasks the interquartile mean, optimality gap, probability of improvement and gain over a base,
    all with 95% intervals over seeds. Methods that were not treated alike are named.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DIR...")]
    """Run directories, folders that hold some, or archives (`race archive`)."""
    base: str | None = None
    """The method that others are measured against, by its name in the table. By default, on each
    task, the gradient learner alone that its methods are built on, such as MATD3."""
    metric: str = "auto"
    """Quantity of the tests: return_mean, win_rate, length_mean. auto: win_rate where there are
    wins to be had, else return_mean."""
    team: Literal["selected", "marl", "champion", "best"] = "selected"
    """Whose tests; methods without a population have the MARL team alone. best is the larger of the
    two test results, as in the paper's figures: biased upwards."""
    normalise: Literal["range", "base", "none"] = "range"
    """How scores of several tasks come to one scale. range: 0 and 1 are the worst and best final
    score of any run on the task; win rates stay. base: 1 is the base's mean. none: as they are."""
    references: Path | None = None
    """A TOML or JSON file that says what is 0 and 1 on each task:
    "mamujoco/Hopper-3x1" = { low = 0, high = 3000 }"""
    score: float | None = None
    """Score for the column of wall times. By default the base's mean final score."""
    strict: bool = False
    """Fail if seeds, budgets, versions or environments are unequal, or a run is left out."""
    format: Literal["text", "markdown", "latex", "csv", "json"] = "text"
    """What is printed."""
    out: tuple[Path, ...] = ()
    """Files to write besides: .txt, .md, .tex, .csv or .json."""
    profile: Path | None = None
    """A figure (.png, .svg, .pdf) of performance profiles: the share of runs above each score."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, compares, prints and writes."""
    chosen = tyro.cli(Compare, args=arguments, prog="race compare")
    from race.errors import RaceError, RunDirectoryError
    from race.runs.aside import written_aside
    from race.runs.results import load
    from race.viewing.comparison import compare
    from race.viewing.scores import scores_of
    from race.viewing.tables import SUFFIXES, written

    if not chosen.runs:
        raise RunDirectoryError("Say which runs to compare: race compare DIR [DIR ...]")
    for file in chosen.out:
        if file.suffix not in SUFFIXES:
            raise RaceError(f"{file}: the name must end with {', '.join(SUFFIXES)}.")
    if chosen.score is not None and not math.isfinite(chosen.score):
        raise RaceError(f"--score is {chosen.score}, but it must be a number.")
    scores = scores_of(load(chosen.runs), chosen.metric, chosen.team)
    if chosen.strict and scores.differences:
        raise RaceError(
            "These runs are not comparable as they are (--strict):\n"
            + "\n".join(f"- {line}" for line in scores.differences)
        )
    found = compare(
        scores, chosen.team, chosen.base, chosen.normalise, chosen.references, chosen.score
    )
    if chosen.profile is not None:
        from race.viewing.profiles import draw_profiles

        draw_profiles(found, chosen.profile)
    for file in chosen.out:
        with written_aside(file) as temporary:
            temporary.write_text(written(found, SUFFIXES[file.suffix]), encoding="utf-8")
    sys.stdout.write(written(found, chosen.format))
    if chosen.format not in ("text", "markdown") and scores.differences:
        print(*(f"Mind: {line}" for line in scores.differences), sep="\n", file=sys.stderr)

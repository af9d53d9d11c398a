"""``race archive``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Archive:
    """Put the results of many runs into one small file.

    Kept are settings, versions, evaluations, and one row of training per evaluation; numbers with
    six digits. Checkpoints are not: a run that is to go on needs its directory. Every command that
    reads results (`race plot`) takes the file like the directories.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DIR...")]
    """Run directories, folders that hold some, or archives to join."""
    out: Path = Path("results.jsonl.gz")
    """The file; its name ends with .jsonl.gz."""
    force: bool = False
    """Replace a file that is there, though it is none of those that are joined."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, writes the archive, and says what is in it."""
    chosen = tyro.cli(Archive, args=arguments, prog="race archive")
    from race.errors import RunDirectoryError
    from race.runs import archive
    from race.runs.results import load
    from race.viewing.curves import refuse_twins

    if not chosen.runs:
        raise RunDirectoryError(
            "Say which runs to keep: race archive DIR [DIR ...] --out results.jsonl.gz"
        )
    joined = {path.resolve() for path in chosen.runs}
    if chosen.out.exists() and chosen.out.resolve() not in joined and not chosen.force:
        raise RunDirectoryError(
            f"{chosen.out} is there already. Name it among the runs to add to it, choose another "
            "--out, or replace it with --force."
        )
    runs = load(chosen.runs)
    refuse_twins(runs)
    archive.write(chosen.out, runs)
    experiments = len({run.experiment for run in runs})
    print(
        f"{chosen.out}: {len(runs)} run{'s' * (len(runs) != 1)} of {experiments} "
        f"experiment{'s' * (experiments != 1)}, {chosen.out.stat().st_size / 1000:,.0f} kB"
    )

"""Results of runs from wherever they are kept: run directories, folders of them, archives."""

from collections.abc import Sequence
from pathlib import Path

from race.errors import RunDirectoryError
from race.runs import archive, checkpoints, metrics
from race.runs import directory as run_directory
from race.runs.directory import RunDirectory
from race.runs.recorded import Recorded


def load(paths: Sequence[Path]) -> list[Recorded]:
    """The runs of some paths; a path that is named or found twice counts once.

    Args:
        paths: run directories, archives, or folders that hold some of either, at any depth.

    Raises:
        RunDirectoryError: for a path that holds no run, or what cannot be read.
    """
    places: dict[Path, Path] = {}
    for path in paths:
        for place in [path] if archive.is_archive(path) else _places_in(path):
            places.setdefault(place.resolve(), place)
    found: list[Recorded] = []
    for place in places.values():
        found += archive.read(place) if archive.is_archive(place) else [of_directory(place)]
    return found


def of_directory(path: Path) -> Recorded:
    """The run in a run directory, which may still be young: then it has no rows.

    Raises:
        RunDirectoryError: if it cannot be read.
    """
    run = RunDirectory(path)
    config, identity = run_directory.open_run(path), run_directory.identity_of(path)
    # Before the rows, which are the newer then and hold all that it knows of.
    kept = checkpoints.metrics_extent(run.checkpoints)
    rows = []
    if run.metrics.exists():
        rows = metrics.read(run.metrics, identity, kept)
    elif kept is not None:
        metrics.check_extent(run.metrics, b"", kept)  # none are there yet, or they are lost
    return Recorded(str(path), config, rows, run_directory.read_metadata(path), path)


def _places_in(path: Path) -> list[Path]:
    if not path.is_dir():
        raise RunDirectoryError(
            f"{path} is not a directory, so it holds no run. Give the directory of a run, a folder "
            f"of runs, or an archive ({archive.SUFFIX})."
        )
    if RunDirectory(path).config.exists():
        return [path]
    inside = [file.parent for file in path.rglob("config.json")]
    inside += [file for file in path.rglob(f"*{archive.SUFFIX}") if archive.is_archive(file)]
    if not inside:
        raise RunDirectoryError(
            f"{path} is not the directory of a run, and holds none: there is no config.json in it, "
            f"nor an archive ({archive.SUFFIX}). Give the directory that `race train` named when "
            "it started."
        )
    return sorted(inside)

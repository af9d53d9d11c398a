"""Files that appear when they are complete, or not at all."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from race.errors import RaceError


@contextlib.contextmanager
def written_aside(path: Path, kind: type[RaceError] = RaceError) -> Iterator[Path]:
    """A temporary name beside ``path``, which becomes ``path`` when the block ends well.

    Raises:
        RaceError: of that kind, if the file cannot be written.
    """
    temporary = path.with_name(f".tmp-{os.getpid()}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise kind(f"{path} cannot be written: {error}.") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()

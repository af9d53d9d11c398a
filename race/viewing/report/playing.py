"""A run's selected team, played for the page: a battle to step through, a video.

Environments and renderers are imported with it: only who shows some needs it.
"""

import base64
import tempfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, final

from race.compilation import use_cache
from race.envs.micro import Battle
from race.envs.micro.recording import Recording
from race.errors import RaceError
from race.runs.recorded import Recorded
from race.teams.trained import Trained, load_trained
from race.viewing.filming import LABELS, battle_of, film, of_battle, write
from race.viewing.progress import rounded
from race.viewing.report.battles import as_numbers, packed

MOST_BYTES = 1_450_000
"""Of a video: two million characters of a page hold so many."""
SEED = 0
TEAM = "selected"


@final
class Player:
    """Plays the team of a run's newest checkpoint, once for all that is made of it."""

    def __init__(self, run: Recorded, tell: Callable[[str, int, int], None]) -> None:
        assert run.place is not None
        self._run, self._place, self._tell = run, run.place, tell

    @cached_property
    def _trained(self) -> Trained:
        use_cache(self._run.config.compute)
        return load_trained(self._place)

    @cached_property
    def _fought(self) -> tuple[Battle, Recording]:
        self._tell(f"battle of {self._run.name}", 0, 1)
        return battle_of(self._trained, TEAM, SEED, 0.0)

    @property
    def _who(self) -> str:
        return LABELS[self._trained.resolve(TEAM)]

    def battle(self) -> dict[str, Any]:
        """A battle: ``who`` fought it, ``seed``, and its numbers, ``packed``.

        Raises:
            RaceError: if it cannot be played.
        """
        numbers = as_numbers(*self._fought)
        return {"who": self._who, "seed": SEED, "packed": packed(numbers)}

    def video(self) -> dict[str, Any]:
        """The newest .mp4 in the run's directory, if it is small enough, else a new one.

        Returns:
            ``told``, what it shows, and ``data``, in base64.

        Raises:
            RaceError: if there is none and none can be made.
        """
        there = sorted(self._place.glob("*.mp4"), key=lambda file: file.stat().st_mtime)
        if there and there[-1].stat().st_size <= MOST_BYTES:
            return _embedded(there[-1], there[-1].name)
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "team.mp4"
            return _embedded(out, self._drawn(out))

    def _drawn(self, out: Path) -> str:
        what = f"video of {self._run.name}"
        self._tell(what, 0, 1)
        if self._run.config.task.startswith("micro/"):
            drawn = of_battle(*self._fought, self._who, small=True)
        else:
            drawn = film(self._trained, TEAM, SEED, None, out)
        done = 0

        def each(frames: int) -> None:
            nonlocal done
            done += frames
            self._tell(what, done, drawn.total)

        write(drawn, out, each, MOST_BYTES)
        size = out.stat().st_size
        if size > MOST_BYTES:
            raise RaceError(
                f"It would take {size / 1e6:.1f} MB, too much for a page. Make a shorter one with "
                "`race render DIR --seconds 5 --out DIR/team.mp4`."
            )
        steps, episode_return, ended = drawn.summary()
        told = (
            f"{self._who}, episode of seed {SEED}: {steps} steps, return {rounded(episode_return)}"
        )
        return told + (f", {ended}" if ended else "")


def _embedded(file: Path, told: str) -> dict[str, Any]:
    return {"told": told, "data": base64.b64encode(file.read_bytes()).decode()}

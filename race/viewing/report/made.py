"""What is made of runs' checkpoints for the page, and of which runs."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, final

from race.errors import RaceError
from race.runs import checkpoints
from race.runs.directory import RunDirectory
from race.runs.recorded import Recorded
from race.viewing import curves
from race.viewing.report.distances import distances_of

Replays = Literal["first", "all", "none"]
Tell = Callable[[str, int, int], None]
"""(what is being made, how much of it is done, of how much)."""


class Made(NamedTuple):
    """What there is beside rows."""

    of_runs: dict[str, dict[str, Any]]
    """By name of the run: ``distances``, ``battle``, ``video``, as far as there are such."""
    remarks: list[str]
    """What could not be made, and why."""


@final
class Maker:
    """Makes it, and what has not changed since only once."""

    def __init__(
        self,
        replays: Replays = "none",
        videos: bool = False,
        tell: Tell = lambda what, done, total: None,
    ) -> None:
        """A maker of what is wanted.

        Args:
            replays: battles to step through, of the first seed of each method on each task, of all
                runs, or none.
            videos: whether each run has a video.
            tell: is told of progress.
        """
        self._replays, self._videos, self._tell = replays, videos, tell
        self._kept: dict[tuple[str, str, str], Any] = {}

    def made_of(self, runs: Sequence[Recorded]) -> Made:
        """All that is wanted of some runs; what cannot be made is told."""
        made = Made({}, [])
        here = [run for run in runs if run.place is not None]
        fought = {run.name for run in self._to_replay(here)}
        for number, run in enumerate(here):
            self._tell("reading checkpoints", number, len(here))
            newest = _newest(run)
            wanted = {
                "distances": run.config.has_population and newest,
                "battle": run.name in fought,
                "video": self._videos,
            }
            kinds = [kind for kind, is_wanted in wanted.items() if is_wanted]
            self._make(run, newest, kinds, made)
        left = len(runs) - len(here)
        if left and (self._videos or any(map(_is_battle, runs))):
            made.remarks.append(
                f"{left} of {len(runs)} runs come from archives, which keep no teams to show."
            )
        return made

    def _make(self, run: Recorded, newest: str, kinds: list[str], made: Made) -> None:
        missing = [kind for kind in kinds if (kind, run.name, newest) not in self._kept]
        makers: dict[str, Callable[[], Any]] = {}
        if "distances" in missing:
            assert run.place is not None
            place = run.place
            makers["distances"] = lambda: distances_of(place)
        if {"battle", "video"} & {*missing}:
            from race.viewing.report.playing import Player  # with all environments

            player = Player(run, self._tell)
            makers |= {"battle": player.battle, "video": player.video}
        for kind in kinds:
            try:
                if kind in missing:
                    self._kept[kind, run.name, newest] = makers[kind]()
            except RaceError as error:
                made.remarks.append(f"{run.name}: no {kind}. {error}")
                continue
            value = self._kept[kind, run.name, newest]
            if value is not None:
                made.of_runs.setdefault(run.name, {})[kind] = value

    def _to_replay(self, runs: Sequence[Recorded]) -> list[Recorded]:
        if self._replays == "none" or not any(map(_is_battle, runs)):
            return []
        if self._replays == "all":
            return [run for run in runs if _is_battle(run)]
        first: dict[tuple[str, str], Recorded] = {}
        named = zip(runs, curves.names_of(runs), strict=True)
        for run, name in sorted(named, key=lambda one: one[0].config.seed):
            if _is_battle(run) and _newest(run):
                first.setdefault((run.config.task, name), run)
        return list(first.values())


def _is_battle(run: Recorded) -> bool:
    return run.config.task.startswith("micro/")


def _newest(run: Recorded) -> str:
    """The name of its newest checkpoint; empty if there is none."""
    assert run.place is not None
    found = checkpoints.newest(RunDirectory(run.place).checkpoints)
    return "" if found is None else found.name

"""Films of trained teams: the right renderer for each kind of task."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from race.envs.micro import Battle, make
from race.envs.micro.recording import Recording, replay
from race.rollouts.discrete import EpisodeRollouts
from race.teams.trained import Trained
from race.types import DiscreteTask, Task
from race.viewing import framing
from race.viewing.rendering import Episode, Renderer, choose_renderer, write_video
from race.viewing.stepwise import DiscreteEpisode

SECONDS = 15.0
"""Of an episode with continuous actions that are shown, unless asked otherwise."""
STEPS_PER_SECOND = 2
"""Of a battle, at the game's "normal" speed."""
LABELS = {"marl": "MARL team", "champion": "champion"}
"""What people are told of teams."""


class Film(NamedTuple):
    """A video to be, and what is said of it once it has been drawn."""

    frames: Iterator[Any]
    total: int
    fps: float
    summary: Callable[[], tuple[int, float, str]]  # steps, return, how it ended


def film(
    trained: Trained,
    team: str,
    seed: int,
    seconds: float | None,
    out: Path,
    renderer: Renderer | None = None,
) -> Film:
    """An episode of a team, to be drawn as its frames are asked for.

    Args:
        trained: the teams of a run.
        team: ``marl``, ``champion`` or ``selected``.
        seed: of the episode.
        seconds: simulated time to show; 0 for the whole episode. None: `SECONDS`, of discrete
            actions the whole episode.
        out: where it will be written, whose ending says how large pictures are.
        renderer: what draws MuJoCo. None: what is found.

    Raises:
        RaceError: if it cannot be played or drawn.
    """
    named = LABELS[trained.resolve(team)]
    small = is_small(out)
    size = framing.SMALL if small else framing.LARGE
    if isinstance(trained.task, Task):
        chosen = choose_renderer() if renderer is None else renderer
        shown = SECONDS if seconds is None else seconds
        played = trained.policy(team)
        return _drawn(Episode(trained.task, played, seed, shown, chosen, named, size))
    shown = seconds or 0.0
    if trained.config.task.startswith("micro/"):
        return _battle(trained, team, seed, shown, small)
    policy = trained.recurrent_policy(team)
    return _drawn(
        DiscreteEpisode(
            trained.task,
            lambda seen: policy(seen.obs, seen.avail_actions),
            seed,
            shown,
            named,
            size,
        )
    )


def is_small(out: Path) -> bool:
    """Whether a file is drawn small: as a .gif, which would grow too large."""
    return out.suffix.lower() == ".gif"


def write(
    drawn: Film,
    out: Path,
    each: Callable[[int], None] = lambda frames: None,
    most_bytes: int | None = None,
) -> int:
    """Plays, draws and writes a film; returns the number of frames.

    Args:
        drawn: the film.
        out: an .mp4 or .gif.
        each: told whenever a frame has been drawn.
        most_bytes: how large an .mp4 may become: the more it shows, the less sharp it is.

    Raises:
        RaceError: if it cannot be played, drawn or written.
    """

    def frames() -> Iterator[Any]:
        for frame in drawn.frames:
            each(1)
            yield frame

    # A second for what is written beside the pictures.
    rate = None if most_bytes is None else 8 * most_bytes / (drawn.total / drawn.fps + 1)
    return write_video(frames(), out, drawn.fps, rate)


def _drawn(episode: Any) -> Film:
    return Film(
        episode.frames(),
        episode.n_frames,
        episode.fps,
        lambda: (episode.steps, episode.episode_return, ""),
    )


def _battle(trained: Trained, team: str, seed: int, seconds: float, small: bool) -> Film:
    name = LABELS[trained.resolve(team)]
    return of_battle(*battle_of(trained, team, seed, seconds), name, small=small)


def battle_of(trained: Trained, team: str, seed: int, seconds: float) -> tuple[Battle, Recording]:
    """A battle of a team, as a map and what happened on it.

    A battle is a function of its seed and the actions, so it can be played twice.

    Args:
        trained: the teams of a run whose task is a battle.
        team: as `film`.
        seed: of the episode.
        seconds: simulated time to play; 0 for the whole battle.

    Raises:
        RaceError: if it cannot be played.
    """
    assert isinstance(trained.task, DiscreteTask)
    name = trained.resolve(team)
    with EpisodeRollouts(trained.config, trained.task) as rollouts:
        actions = rollouts.episode(trained.acting(name), seed)
    if seconds > 0:
        actions = actions[: math.ceil(seconds * STEPS_PER_SECOND)]
    played = make(trained.config.task.removeprefix("micro/"))
    return played, replay(played, actions, seed)


def of_battle(played: Battle, recording: Recording, team: str, *, small: bool) -> Film:
    """A film of a battle that was recorded, in the name of a team; small, it is 960 x 540."""
    from race.envs.micro import render
    from race.envs.micro.canvas import LARGE, SMALL

    ended = recording.verdict or "not finished"
    return Film(
        render.frames(played, recording, SMALL if small else LARGE, team),
        render.n_frames(recording),
        render.FPS,
        lambda: (len(recording.returns), float(recording.returns[-1]), ended),
    )

"""Videos of discrete tasks show the very episode that the team plays."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from race.errors import RenderError
from race.types import DiscreteSpec, DiscreteTask, Observation
from race.viewing.stepwise import DiscreteEpisode


class Dice(gymnasium.Env[Any, Any]):
    """Shows a number of its own chance, which no seed decides; pays who names it. Three steps."""

    metadata = {"render_fps": 5}  # noqa: RUF012
    closed = 0

    def __init__(self, mode: str | None, pictures: bool = True) -> None:
        self.chance, self.pictures = np.random.default_rng(), pictures

    def see(self) -> Any:
        self.number = int(self.chance.integers(200))
        seen = np.full((1, 1), float(self.number))
        return {"obs": seen, "state": seen[0], "avail_actions": np.ones((1, 200))}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.steps = 0
        return self.see(), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        right = float(action[0] == self.number)
        return self.see(), right, False, self.steps == 3, {}

    def render(self) -> Any:
        return np.full((4, 6, 3), self.number, np.uint8) if self.pictures else None

    def close(self) -> None:
        Dice.closed += 1


def task(pictures: bool = True) -> DiscreteTask:
    return DiscreteTask(DiscreteSpec("dice", 1, 1, 1, 200, 9), lambda mode: Dice(mode, pictures))


def test_the_team_sees_what_is_drawn() -> None:
    seen: list[int] = []

    def policy(moment: Observation) -> Any:
        seen.append(int(moment.obs[0, 0]))
        return np.array(seen[-1:], np.int32)

    Dice.closed = 0
    episode = DiscreteEpisode(task(), policy, 3, 0.0)
    frames = [int(frame[400, 640, 0]) for frame in episode.frames()]
    assert frames[:3] == seen
    assert (len(frames), episode.steps, episode.episode_return) == (4, 3, 3.0)
    assert (episode.fps, episode.n_frames, Dice.closed) == (5.0, 10, 1)
    episode = DiscreteEpisode(task(), policy, 3, 0.4)
    assert len(list(episode.frames())) == 3
    assert episode.steps == 2


def test_no_pictures_are_told() -> None:
    episode = DiscreteEpisode(task(pictures=False), lambda moment: np.zeros(1, np.int32), 3, 0.0)
    with pytest.raises(RenderError, match=r"dice drew no picture: render returned None.*Dice.rend"):
        list(episode.frames())

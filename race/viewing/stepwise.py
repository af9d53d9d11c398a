"""Episodes of environments with discrete actions that draw themselves, step by step."""

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import final

from jaxtyping import Int
from numpy import ndarray

from race.envs.checked import CheckedEnv
from race.types import DiscreteTask, Observation
from race.viewing.framing import LARGE, Frame, Headline, Size, framed
from race.viewing.rendering import frames_per_second

STEPS_PER_SECOND = 2.0
"""Where an environment does not say how fast it is to be shown."""


@final
class DiscreteEpisode:
    """One episode, played in the environment that is drawn.

    The team sees what that very environment shows: one with chance of its own, such as
    StarCraft II, would play another episode than a second one did. Iterate over `frames` to play
    it; afterwards `episode_return` and `steps` tell how it went.

    Attributes:
        fps: steps, and so frames, per second.
        n_frames: the most frames it can have.
    """

    def __init__(
        self,
        task: DiscreteTask,
        policy: Callable[[Observation], Int[ndarray, "N"]],
        seed: int,
        seconds: float,
        team: str = "",
        size: Size = LARGE,
    ) -> None:
        """Makes the environment.

        Args:
            task: the task.
            policy: the team's next actions, from what it sees; it begins an episode.
            seed: of the environment's reset.
            seconds: stop after this much time as it is shown; 0 for the whole episode.
            team: what frames call the team.
            size: width and height of a frame in pixels.

        Raises:
            TaskError: if the environment cannot be made.
            RenderError: if it has no pictures.
        """
        self._policy, self._seed, self._size = policy, seed, size
        self._headline = Headline(task.spec.task, team)
        self._env = CheckedEnv(task, render_mode="rgb_array")
        self.fps = frames_per_second(self._env.env, STEPS_PER_SECOND)
        limit = task.spec.episode_limit
        self._most = min(limit, math.ceil(seconds * self.fps)) if seconds > 0 else limit
        self.n_frames = self._most + 1
        self.episode_return = 0.0
        self.steps = 0

    def frames(self) -> Iterator[Frame]:
        """Plays the episode; yields images and closes the environment.

        Raises:
            TaskError: if the environment fails, or hands over what it may not.
            RenderError: if it gives no picture.
        """
        with contextlib.closing(self._env):
            seen = self._env.reset(self._seed)
            yield self._frame()
            for _ in range(self._most):
                assert isinstance(seen, Observation)
                step = self._env.step(self._policy(seen))
                seen = step.seen
                self.episode_return += step.reward
                self.steps += 1
                yield self._frame()
                if step.terminated or step.truncated:
                    return

    def _frame(self) -> Frame:
        picture = self._env.render()
        return framed(picture, self._size, self._headline, self.steps, self.episode_return)

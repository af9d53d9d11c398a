"""Frames of an episode, with whatever can draw on this machine, and video files of them."""

import contextlib
import functools
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple, final, get_args

import imageio
import numpy as np
from numpy.typing import NDArray

from race.envs.checked import CheckedEnv
from race.envs.contract import in_units
from race.errors import RenderError, TaskError
from race.runs.aside import written_aside
from race.types import Task
from race.viewing.framing import LARGE, Color, Frame, Headline, Size, framed, picture_size

Backend = Literal["egl", "osmesa", "glfw", "sketch"]
Policy = Callable[[NDArray[np.float32]], NDArray[np.float32]]

PACKAGES = "apt-get install -y libegl1 libgl1-mesa-dri"
"""What gives a Debian or Ubuntu machine OpenGL without a display."""

_NONE = "disabled"
"""With a backend that it cannot load, or a word that it does not know, mujoco is not imported."""
_MOST_FRAMES_PER_SECOND = 30.0
_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 2'/><geom size='.2' rgba='1 0 0 1'/></worldbody></mujoco>"
)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 32, 32)
renderer.update_scene(data)
assert renderer.render().max() > 0
print("drawn")
"""


class Renderer(NamedTuple):
    """What draws MuJoCo here, and why."""

    backend: Backend
    reason: str


@functools.cache
def choose_renderer() -> Renderer:
    """The first of EGL, OSMesa and, with a display, GLFW that draws; else the built-in one.

    Each is tried in a process of its own, because a broken OpenGL can end the process. A
    ``MUJOCO_GL`` that the user has set is tried alone. What is found is put into ``MUJOCO_GL``,
    which mujoco reads when it is imported: choose before that.
    """
    offered: list[Backend] = ["egl", "osmesa"]
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        offered.append("glfw")
    asked = os.environ.get("MUJOCO_GL", "").lower()
    candidates = [b for b in get_args(Backend)[:-1] if b == asked] if asked else offered
    if not candidates:
        os.environ["MUJOCO_GL"] = _NONE
        return Renderer("sketch", f"the built-in renderer, because MUJOCO_GL is {asked!r}")
    for candidate in candidates:
        if _draws(candidate):
            os.environ["MUJOCO_GL"] = candidate
            return Renderer(candidate, f"OpenGL through {candidate}")
    os.environ["MUJOCO_GL"] = _NONE
    return Renderer(
        "sketch",
        f"no OpenGL ({', '.join(candidates)} tried), so the slower built-in renderer draws; "
        f"to change that: {PACKAGES}",
    )


def _draws(backend: str) -> bool:
    environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
    if backend == "glfw":
        environment.pop("PYOPENGL_PLATFORM")
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE],
            env=environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    except (OSError, subprocess.SubprocessError):
        return False
    return done.returncode == 0 and "drawn" in done.stdout


@final
class Episode:
    """One episode of a team, drawn as it is played.

    Iterate over `frames` to play it; afterwards `episode_return` and `steps` tell how it went.

    Attributes:
        fps: frames per second for playback in real time.
        n_frames: the most frames it can have.
    """

    def __init__(
        self,
        task: Task,
        policy: Policy,
        seed: int,
        seconds: float,
        renderer: Renderer,
        team: str = "",
        size: Size = LARGE,
    ) -> None:
        """Makes the environment.

        Args:
            task: the task.
            policy: maps a state [S] to a joint action [U] in [-1, 1].
            seed: of the environment's reset.
            seconds: stop after this much simulated time; 0 for the whole episode.
            renderer: what draws MuJoCo.
            team: what frames call the team.
            size: width and height of a frame in pixels.

        Raises:
            RenderError: if the environment is not MuJoCo's and cannot draw itself.
        """
        self._task, self._policy, self._seed = task, policy, seed
        self._size = size
        self._env, self._paint, agents = _painter(task, renderer, picture_size(size))
        self._headline = Headline(task.spec.task, team, agents)
        step_seconds = _step_seconds(self._env.env)
        self._stride = math.ceil(1 / step_seconds / _MOST_FRAMES_PER_SECOND - 1e-6)
        self.fps = 1 / step_seconds / self._stride
        limit = task.spec.episode_limit
        self._steps = min(limit, math.ceil(seconds / step_seconds)) if seconds > 0 else limit
        self.n_frames = self._steps // self._stride + 1
        self.episode_return = 0.0
        self.steps = 0

    def frames(self) -> Iterator[NDArray[np.uint8]]:
        """Plays the episode; yields images [height, width, 3] and closes the environment."""
        low = np.array(self._task.spec.action_low, np.float32)
        high = np.array(self._task.spec.action_high, np.float32)
        with contextlib.closing(self._env):
            state: Any = self._env.reset(self._seed)
            yield self._frame()
            for _ in range(self._steps):
                action = np.clip(self._policy(state), -1, 1)
                made = self._env.step(in_units(action, low, high))
                state = made.seen
                self.episode_return += made.reward
                self.steps += 1
                if self.steps % self._stride == 0:
                    yield self._frame()
                if made.terminated or made.truncated:
                    return

    def _frame(self) -> Frame:
        return framed(self._paint(), self._size, self._headline, self.steps, self.episode_return)


class _Painter(NamedTuple):
    env: CheckedEnv
    paint: Callable[[], Frame]
    agents: tuple[Color, ...]
    """Their colours; none where the environment chooses the colours."""


def _painter(task: Task, renderer: Renderer, size: Size) -> _Painter:
    import mujoco

    from race.viewing import limbs, sketch

    env = CheckedEnv(task)
    inner = getattr(env.env, "unwrapped", env.env)
    model, data = (getattr(inner, name, None) for name in ("model", "data"))
    if isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData):
        agents = limbs.paint(model, task.spec)
        if _taken_up(renderer.backend):
            with contextlib.suppress(Exception):  # mujoco took up another backend, or none
                return _Painter(env, _opengl(model, data, size), agents)
        return _Painter(env, lambda: sketch.draw(model, data, size), agents)
    offered = getattr(env.env, "metadata", None) or {}
    with contextlib.suppress(TaskError):  # it is not needed any more
        env.close()
    if "rgb_array" not in offered.get("render_modes", ()):
        raise RenderError(
            f"The environment of {task.spec.task} cannot be drawn: it is not MuJoCo's and offers "
            "no render_mode 'rgb_array'. Add that mode to the environment to make videos of it."
        )
    drawn = CheckedEnv(task, render_mode="rgb_array")
    return _Painter(drawn, drawn.render, ())


def _taken_up(backend: Backend) -> bool:
    """Whether mujoco draws with that: it decides once, when it is imported."""
    import mujoco

    context = getattr(mujoco, "GLContext", None)
    return context is not None and context.__module__ == f"mujoco.{backend}"


def _opengl(model: Any, data: Any, size: Size) -> Callable[[], Frame]:
    """Draws with OpenGL, through the same camera as the built-in renderer."""
    import mujoco

    from race.viewing.camera import focus

    width, height = size
    shown = model.vis.global_
    shown.offwidth, shown.offheight = max(shown.offwidth, width), max(shown.offheight, height)
    opengl = mujoco.Renderer(model, height, width)
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    shown.fovy = focus(model, data).field_of_view
    # A plane collides everywhere but is drawn as large as its size says; 0 stands for endless.
    model.geom_size[model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE), :2] = 0.0

    def scene() -> Frame:
        seen = focus(model, data)
        camera.lookat[:] = seen.target
        camera.distance = seen.distance
        camera.azimuth = math.degrees(math.atan2(-seen.backward[1], -seen.backward[0]))
        camera.elevation = -math.degrees(math.asin(seen.backward[2]))
        opengl.update_scene(data, camera)
        return np.asarray(opengl.render())

    return scene


def _step_seconds(env: Any) -> float:
    seconds = getattr(getattr(env, "unwrapped", env), "dt", None)
    if isinstance(seconds, float) and 0 < seconds < np.inf:
        return seconds
    return 1 / frames_per_second(env, float(_MOST_FRAMES_PER_SECOND))


def frames_per_second(env: Any, otherwise: float) -> float:
    """What an environment says of the speed at which its pictures are to be shown.

    Raises:
        RenderError: if that is no speed.
    """
    said = (getattr(env, "metadata", None) or {}).get("render_fps") or otherwise
    if not isinstance(said, int | float) or not 0 < said < 1e6:
        raise RenderError(
            f"The environment's metadata say render_fps {said!r}. Let it be how many steps are "
            "shown in a second."
        )
    return float(said)


def write_video(
    frames: Iterator[NDArray[np.uint8]],
    path: Path,
    fps: float,
    bits_per_second: float | None = None,
) -> int:
    """Writes an .mp4 (H.264, plays everywhere) or a looping .gif; returns the number of frames.

    The file appears when it is complete.

    Args:
        frames: images [height, width, 3].
        path: the file.
        fps: frames per second.
        bits_per_second: the most that an .mp4 may take of any second; None: what it needs.

    Raises:
        RenderError: for another ending, or if the file cannot be written.
    """
    ending = path.suffix.lower()
    options: dict[str, Any]
    if ending == ".mp4":
        options = {
            "fps": fps,
            "codec": "libx264",
            "pixelformat": "yuv420p",
            "macro_block_size": 2,
            "quality": None,
            # The slowest preset with which one core draws and writes battles as fast as they run.
            "output_params": ["-preset", "superfast", "-crf", "20"],
        }
        if bits_per_second is not None:
            most = f"{int(bits_per_second)}"
            options["output_params"] += ["-maxrate", most, "-bufsize", most]
    elif ending == ".gif":
        options = {"duration": 1000 / fps, "loop": 0}
    else:
        raise RenderError(f"{path} is no video: the name must end with .mp4 or .gif.")
    count = 0
    with written_aside(path, RenderError) as temporary, warnings.catch_warnings():
        # The child becomes ffmpeg at once and touches nothing of JAX.
        warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called")
        with imageio.get_writer(temporary, **options) as writer:
            for frame in frames:
                writer.append_data(frame)
                count += 1
    return count

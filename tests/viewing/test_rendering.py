"""Videos: what draws, what is drawn, and the files."""

import gc
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import imageio.v3 as iio
import mujoco
import numpy as np
import pytest

from race.envs import factorised, make_task
from race.errors import RenderError
from race.viewing import camera, rendering, sketch
from race.viewing.rendering import Episode, Renderer, choose_renderer, write_video

SKETCH = Renderer("sketch", "a test")


@pytest.fixture
def fresh_choice(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    choose_renderer.cache_clear()
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    yield monkeypatch
    choose_renderer.cache_clear()


@pytest.mark.parametrize(
    ("asked", "working", "expected"),
    [
        ("", {"egl", "osmesa"}, "egl"),
        ("", {"osmesa"}, "osmesa"),
        ("", {"glfw"}, "sketch"),  # no display
        ("", set(), "sketch"),
        ("osmesa", {"egl", "osmesa"}, "osmesa"),
        ("osmesa", {"egl"}, "sketch"),
        ("off", {"egl"}, "sketch"),
    ],
)
def test_the_renderer_is_the_first_that_draws(
    fresh_choice: pytest.MonkeyPatch, asked: str, working: set[str], expected: str
) -> None:
    fresh_choice.setenv("MUJOCO_GL", asked)
    fresh_choice.setattr(rendering, "_draws", lambda backend: backend in working)
    assert choose_renderer().backend == expected
    # What does not draw may not even be imported by mujoco.
    assert os.environ["MUJOCO_GL"] == ("disabled" if expected == "sketch" else expected)


def test_a_renderer_that_crashes_or_hangs_does_not_draw(fresh_choice: pytest.MonkeyPatch) -> None:
    def crash(*args: Any, **kwargs: Any) -> Any:
        return subprocess.CompletedProcess(args, -11, stdout="", stderr="")

    def hang(*args: Any, **kwargs: Any) -> Any:
        raise subprocess.TimeoutExpired("python", 60)

    for broken in (crash, hang):
        choose_renderer.cache_clear()
        fresh_choice.setenv("MUJOCO_GL", "")
        fresh_choice.setattr(subprocess, "run", broken)
        chosen = choose_renderer()
        assert chosen.backend == "sketch"
        assert "apt-get install" in chosen.reason


@pytest.mark.parametrize("robot", ["HalfCheetah", "Ant", "Humanoid", "Hopper"])
def test_sketches_show_the_robot_and_follow_it(robot: str) -> None:
    env: Any = gymnasium.make(f"{robot}-v5", disable_env_checker=True).unwrapped
    env.reset(seed=0)
    before = sketch.draw(env.model, env.data)
    assert before.shape == (360, 480, 3)
    empty = sketch.draw(
        mujoco.MjModel.from_xml_string("<mujoco/>"),
        mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>")),
    )
    robot_pixels = (np.abs(before.astype(int) - empty.astype(int)).sum(axis=2) > 60).mean()
    assert robot_pixels > 0.01
    # Ten metres on: the robot is where it was in the image, so the camera went along.
    env.data.qpos[0] += 10.0
    mujoco.mj_forward(env.model, env.data)
    np.testing.assert_allclose(
        camera.focus(env.model, env.data).target[0], env.data.qpos[0], atol=0.6
    )
    # Another pose: another image.
    env.data.qpos[-2:] += 0.7
    mujoco.mj_forward(env.model, env.data)
    after = sketch.draw(env.model, env.data)
    assert np.abs(after.astype(int) - before.astype(int)).max() > 60
    env.close()


def moving(frames: int, size: tuple[int, int] = (64, 48)) -> Iterator[np.ndarray]:
    for i in range(frames):
        frame = np.zeros((size[1], size[0], 3), np.uint8)
        frame[:, 4 * i : 4 * i + 8] = 255
        yield frame


# The reader of imageio's ffmpeg plugin, used by this test alone, leaves its pipes to the collector.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("ending", [".mp4", ".gif"])
def test_videos_hold_their_frames(tmp_path: Path, ending: str) -> None:
    path = tmp_path / "new" / f"team{ending}"
    assert write_video(moving(12), path, 10.0) == 12
    frames = iio.imread(path)
    gc.collect()
    assert frames.shape[:3] == (12, 48, 64)
    brightest = [int(frame[..., 0].astype(int).sum(axis=0).argmax()) for frame in frames]
    assert brightest == sorted(brightest)
    assert brightest[-1] > brightest[0]
    assert list(path.parent.iterdir()) == [path]


def test_bad_videos_are_refused_and_leave_nothing(tmp_path: Path) -> None:
    with pytest.raises(RenderError, match=r"\.mp4 or \.gif"):
        write_video(moving(1), tmp_path / "team.avi", 10.0)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RenderError, match="cannot be written"):
        write_video(moving(1), tmp_path / "file" / "team.gif", 10.0)

    def failing() -> Iterator[np.ndarray]:
        yield from moving(2)
        raise ValueError("the environment broke")

    with pytest.raises(ValueError, match="broke"):
        write_video(failing(), tmp_path / "team.gif", 10.0)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_an_episode_plays_in_real_time_and_counts_its_return(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sketch, "draw", lambda *_, **__: np.zeros((4, 4, 3), np.uint8))
    task = make_task("mamujoco/Hopper-3x1")
    zero = np.zeros(task.spec.joint_action_size, np.float32)
    episode = Episode(task, lambda state: zero, seed=3, seconds=0.2, renderer=SKETCH)
    frames = list(episode.frames())
    # 0.008 s a step: 25 steps in 0.2 s, every fifth drawn (25 frames a second), and the first.
    assert episode.steps == 25
    assert episode.fps == pytest.approx(25.0)
    assert len(frames) == episode.n_frames == 6
    env = task.make(None)
    env.reset(seed=3)
    expected = sum(float(env.step(zero)[1]) for _ in range(25))
    env.close()
    assert episode.episode_return == pytest.approx(expected)


class Drawable(gymnasium.Env[Any, Any]):
    """An environment that draws itself, or not."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode: str | None) -> None:
        self.render_mode = render_mode
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros(1), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return np.zeros(1), 1.0, self.steps == 3, False, {}

    def render(self) -> Any:
        return np.full((40, 40, 3), 50 * self.steps, np.uint8)


def test_environments_that_are_not_mujoco_draw_themselves() -> None:
    task = factorised(
        Drawable, obs_index=((0,),), action_index=((0,),), task="mine", episode_limit=9
    )
    policy = lambda state: np.zeros(1, np.float32)  # noqa: E731
    frames = list(Episode(task, policy, 0, 0.0, SKETCH).frames())
    assert {frame.shape for frame in frames} == {(720, 1280, 3)}
    assert [int(frame[400, 640, 0]) for frame in frames] == [0, 50, 100, 150]

    class Blind(Drawable):
        metadata = {"render_modes": []}  # noqa: RUF012

    blind = factorised(Blind, obs_index=((0,),), action_index=((0,),), task="mine", episode_limit=9)
    with pytest.raises(RenderError, match="rgb_array"):
        Episode(blind, policy, 0, 0.0, SKETCH)

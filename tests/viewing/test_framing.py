"""Frames of videos: a headline over a picture, and robots in the colours of their agents."""

from typing import Any

import mujoco
import numpy as np
import pytest

from race.envs import make_task
from race.viewing import limbs
from race.viewing.framing import LARGE, SMALL, Color, Headline, framed, picture_size


def close_to(frame: Any, color: Color) -> Any:
    return np.abs(frame.astype(int) - np.array(color)).max(axis=-1) <= 3


@pytest.mark.parametrize("size", [LARGE, SMALL])
@pytest.mark.parametrize("shape", [(10, 40), (900, 300), (672, 1280), (1, 1)])
def test_the_picture_is_as_large_as_it_fits_and_keeps_its_shape(
    size: tuple[int, int], shape: tuple[int, int]
) -> None:
    red = np.zeros((*shape, 3), np.uint8)
    red[..., 0] = 255
    frame = framed(red, size, Headline("task", "team"), 3, 1.0)
    assert frame.shape == (size[1], size[0], 3)
    rows, columns = np.nonzero(close_to(frame, (255, 0, 0)))
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    room = picture_size(size)
    assert width == room[0] or height == room[1]
    assert width / height == pytest.approx(shape[1] / shape[0], rel=0.02)
    assert rows.min() >= size[1] - room[1]


@pytest.mark.parametrize("n_agents", [1, 2, 5, 6, 17])
def test_a_headline_fits_and_shows_every_agents_colour(n_agents: int) -> None:
    black = np.zeros((672, 1280, 3), np.uint8)
    colors = limbs.colours(n_agents)
    assert len(set(colors)) == n_agents
    for task in ("t", "mamujoco/" + "M" * 200):
        frame = framed(black, LARGE, Headline(task, "MARL team", colors), 1000, -123456.7)
        bar = frame[: LARGE[1] - picture_size(LARGE)[1]]
        assert all(close_to(bar, color).sum() >= 20 for color in colors)
        assert not frame[len(bar) :].any()
        # The text ends before the agents begin: between them lies a gap.
        first = min(np.nonzero(close_to(bar, color))[1].min() for color in colors)
        written = np.nonzero((bar > 120).any(axis=(0, 2)))[0]
        gaps = np.diff(written[written < first])
        assert gaps.max() >= 8


def test_steps_and_returns_are_shown() -> None:
    black = np.zeros((672, 1280, 3), np.uint8)
    shown = [
        framed(black, LARGE, Headline("task", who), *so_far)
        for who, so_far in (("a", (1, 2.0)), ("b", (1, 2.0)), ("a", (3, 2.0)), ("a", (1, 4.0)))
    ]
    assert all((shown[0] != other).any() for other in shown[1:])


@pytest.mark.parametrize(
    ("task", "expected"),
    [
        ("HalfCheetah-2x3", [{"bthigh", "bshin", "bfoot"}, {"fthigh", "fshin", "ffoot"}]),
        ("Hopper-3x1", [{"thigh"}, {"leg"}, {"foot"}]),
    ],
)
def test_robots_wear_the_colours_of_those_who_move_them(
    task: str, expected: list[set[str]]
) -> None:
    made = make_task(f"mamujoco/{task}")
    env: Any = made.make(None)
    model = env.unwrapped.model
    ground = model.geom_rgba[model.geom_bodyid == 0].copy()
    colors = np.array(limbs.paint(model, made.spec)) / 255
    for agent, bodies in enumerate(expected):
        for name in bodies:
            body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
            worn = model.geom_rgba[model.geom_bodyid == body, :3]
            # Paler or not, the nearest of the agents' colours by what is left without white.
            ratios = (1 - worn[:, None]) @ (1 - colors).T / np.linalg.norm(1 - colors, axis=1)
            assert (ratios[:, 0].argmax(axis=-1) == agent).all(), name
    torso = model.geom_bodyid == mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "torso")
    assert (model.geom_rgba[torso, :3] > 0.8).all()
    assert (model.geom_rgba[model.geom_bodyid == 0] == ground).all()
    env.close()


def test_actuators_that_are_not_the_actions_are_left_alone() -> None:
    spec = make_task("mamujoco/HalfCheetah-2x3").spec
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>"
    )
    before = model.geom_rgba.copy()
    assert limbs.paint(model, spec) == ()
    assert (model.geom_rgba == before).all()

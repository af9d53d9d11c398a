"""Draws a MuJoCo model without OpenGL: rays against capsules, spheres, boxes and the ground.

Slower machines and plain containers have no OpenGL to draw with. A robot of these tasks is a
handful of simple solids, so numpy can cast the rays itself, with shading and a shadow.
"""

import mujoco
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from race.viewing.camera import Camera, camera_of, project, rays_of, visible, window_of
from race.viewing.solids import SHAPES, Solid, hit

Size = tuple[int, int]

_SMALL = 480  # pixels in height: below, each is the mean of four samples
_EDGE = 24  # what neighbouring pixels differ by at an edge that is smoothed, of 255
_LIGHT = np.array([0.35, -0.5, 1.0]) / np.linalg.norm([0.35, -0.5, 1.0])  # towards the light
_SKY_HIGH, _SKY_LOW = np.array([0.55, 0.70, 0.88]), np.array([0.93, 0.95, 0.97])
_TILE_DARK, _TILE_LIGHT = np.array([0.66, 0.70, 0.72]), np.array([0.80, 0.83, 0.84])


def draw(
    model: mujoco.MjModel, data: mujoco.MjData, size: Size = (480, 360)
) -> UInt8[np.ndarray, "h w 3"]:
    """Draws the model as it stands in ``data``; the camera follows a robot that travels.

    Robots that move in a vertical plane are seen from the side, those that move in a horizontal
    plane from above, all others from a corner. Colours are those of the geoms, without materials.
    Shapes other than MuJoCo's basic solids are drawn as the box around them.

    Args:
        model: the compiled model.
        data: its state, with positions up to date (as after a step or ``mj_forward``).
        size: width and height of the image in pixels.
    """
    width, height = size
    fine = 2 if height < _SMALL else 1
    camera = camera_of(model, data, width * fine, height * fine)
    solids = _solids(model, data)
    rays = rays_of(camera.view, camera.width, camera.height)
    ground = _ground_height(model, data)
    image, depth = _background(camera, rays, ground)
    dark = np.zeros(depth.shape, np.bool_)
    for solid in solids:
        _shadow(dark, depth, camera, rays, solid, ground)
    image[dark] *= 0.72
    for solid in solids:
        _paint(image, depth, camera, rays, solid)
    # Strided sums: numpy's mean over short inner axes takes several times as long.
    corners = [image[row::fine, column::fine] for row in range(fine) for column in range(fine)]
    pixels = (np.clip(sum(corners) / len(corners), 0, 1) * 255 + 0.5).astype(np.uint8)
    marks = _distance_marks(camera, ground) if camera.view == "side" else []
    shown = Image.fromarray(pixels)
    if fine == 1:
        _smooth(shown)
    return _mark(shown, [(column / fine, row / fine, text) for column, row, text in marks])


# ---------------------------------------------------------------- what is in the picture


def _solids(model: mujoco.MjModel, data: mujoco.MjData) -> list[Solid]:
    solids = []
    for geom in np.flatnonzero(visible(model)):
        kind = int(model.geom_type[geom])
        if kind in (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD)):
            continue
        turn = data.geom_xmat[geom].reshape(3, 3).copy()
        centre, size = data.geom_xpos[geom].copy(), model.geom_size[geom].copy()
        if kind not in SHAPES:
            centre, size = centre + turn @ model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            kind = int(mujoco.mjtGeom.mjGEOM_BOX)
        colour = model.geom_rgba[geom, :3].astype(np.float64)
        solids.append(Solid(kind, centre, turn, size, float(model.geom_rbound[geom]), colour))
    return solids


def _ground_height(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    if len(planes):
        return float(data.geom_xpos[planes, 2].max())
    rest = mujoco.MjData(model)
    mujoco.mj_kinematics(model, rest)
    return float((rest.geom_xpos[:, 2] - model.geom_rbound).min(initial=0.0))


# ---------------------------------------------------------------- light and colour


def _background(
    camera: Camera, rays: NDArray[np.float32], ground: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The empty scene [h, w, 3] and the distance of the ground at each pixel [h, w] (metres)."""
    image = np.empty(rays.shape, np.float32)
    depth = np.full(rays.shape[:2], np.inf, np.float32)
    above = np.float32(camera.eye[2] - ground)
    # The camera never rolls, so all of a row is sky or all of it is ground.
    slope = rays[:, 0, 2]
    horizon = int((slope >= -1e-4).sum()) if above > 0 else len(slope)
    rise = np.clip(rays[:horizon, :, 2:] * 1.6, 0, 1)
    image[:horizon] = _SKY_LOW + rise * (_SKY_HIGH - _SKY_LOW)
    floor = rays[horizon:]
    far = above / -floor[..., 2]
    depth[horizon:] = far
    tile = _tile(camera)
    x = np.floor((far * floor[..., 0] + np.float32(camera.eye[0])) / np.float32(tile))
    y = np.floor((far * floor[..., 1] + np.float32(camera.eye[1])) / np.float32(tile))
    odd = (x.astype(np.int32) + y.astype(np.int32)) & 1
    # Fog hides the horizon, where the tiles are finer than the pixels.
    clear = np.exp(-((far / np.float32(14 * camera.reach)) ** 2))
    light = odd * clear
    for channel in range(3):
        dark, step = _TILE_DARK - _SKY_LOW, _TILE_LIGHT - _TILE_DARK
        image[horizon:, :, channel] = (
            np.float32(_SKY_LOW[channel])
            + clear * np.float32(dark[channel])
            + light * np.float32(step[channel])
        )
    return image, depth


def _tile(camera: Camera) -> float:
    """Side of a tile in metres: a power of two, near the robot's reach."""
    return float(2.0 ** np.round(np.log2(max(camera.reach * 0.6, 0.05))))


def _shadow(
    dark: NDArray[np.bool_],
    depth: NDArray[np.float32],
    camera: Camera,
    rays: NDArray[np.float32],
    solid: Solid,
    ground: float,
) -> None:
    """Marks, in place, the ground that the solid hides from the light."""
    height = solid.centre[2] - ground
    if height < 0:
        return
    foot = solid.centre - _LIGHT * height / _LIGHT[2]
    window = window_of(camera, foot, solid.bound / _LIGHT[2])
    far = depth[window]
    lit = np.isfinite(far) & ~dark[window]
    points = camera.eye.astype(np.float32) + far[lit][:, None] * rays[window][lit]
    blocked, _ = hit(solid, points, _LIGHT.astype(np.float32))
    dark[window][lit] = np.isfinite(blocked)


def _paint(
    image: NDArray[np.float32],
    depth: NDArray[np.float32],
    camera: Camera,
    rays: NDArray[np.float32],
    solid: Solid,
) -> None:
    """Draws, in place, the solid where it is nearer than what is there."""
    window = window_of(camera, solid.centre, solid.bound)
    directions = rays[window]
    if not directions.size:
        return
    distance, normal = hit(solid, camera.eye, directions)
    near = distance < depth[window]
    facing = normal[near]
    light = np.clip(facing @ _LIGHT, 0, 1)
    rim = np.clip(-np.einsum("pc,pc->p", facing, directions[near]), 0, 1)
    strength = 0.42 + 0.5 * light + 0.16 * rim
    shine = (
        0.25
        * np.clip(
            facing @ ((_LIGHT - camera.forward) / np.linalg.norm(_LIGHT - camera.forward)), 0, 1
        )
        ** 30
    )
    # Dark outlines keep limbs apart that overlap in the picture.
    strength = np.where(rim < 0.25, strength * (0.6 + 1.6 * rim), strength)
    image[window][near] = strength[:, None] * solid.colour + shine[:, None]
    depth[window][near] = distance[near]


def _distance_marks(camera: Camera, ground: float) -> list[tuple[float, float, str]]:
    """Column, row (samples) and text of the metres travelled, in front of the robot."""
    tile = _tile(camera)
    front = camera.eye[1] + 0.62 * (0.0 - camera.eye[1])
    first = int(np.ceil((camera.eye[0] - 3 * camera.reach) / tile))
    marks = []
    for place in range(first, int((camera.eye[0] + 3 * camera.reach) / tile) + 1):
        column, row, _ = project(camera, np.array([place * tile, front, ground]))
        marks.append((column, row, f"{place * tile:g} m"))
    return marks


def _smooth(image: Image.Image) -> None:
    """Softens the steps of edges, in place: cheaper than more samples, and hardly to be told."""
    edges = image.convert("L").filter(ImageFilter.FIND_EDGES)
    image.paste(image.filter(ImageFilter.SMOOTH), mask=edges.point(lambda x: 255 * (x > _EDGE)))


def _mark(image: Image.Image, marks: list[tuple[float, float, str]]) -> NDArray[np.uint8]:
    pen, font = ImageDraw.Draw(image), ImageFont.load_default(max(image.height // 32, 9))
    for column, row, text in marks:
        pen.text((column, row), text, fill=(95, 100, 105), font=font, anchor="mm")
    return np.asarray(image)

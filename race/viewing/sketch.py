"""Draws a MuJoCo model without OpenGL: rays against capsules, spheres, boxes and the ground.

Slower machines and plain containers have no OpenGL to draw with. A robot of these tasks is a
handful of simple solids, so numpy can cast the rays itself, with shading and a shadow.
"""

import colorsys
from functools import lru_cache
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from race.viewing.solids import SHAPES, Solid, hit

Size = tuple[int, int]
View = Literal["side", "top", "corner"]

_OVERSAMPLING = 2
_HALF_ANGLE = np.deg2rad(20.0)  # of the image's shorter side
_LIGHT = np.array([0.35, -0.5, 1.0]) / np.linalg.norm([0.35, -0.5, 1.0])  # towards the light
_SKY_HIGH, _SKY_LOW = np.array([0.55, 0.70, 0.88]), np.array([0.93, 0.95, 0.97])
_TILE_DARK, _TILE_LIGHT = np.array([0.66, 0.70, 0.72]), np.array([0.80, 0.83, 0.84])
_BACKWARDS: dict[View, NDArray[np.float64]] = {  # from the target towards the eye
    "side": np.array([0.0, -1.0, 0.17]),
    "top": np.array([0.0, -0.25, 1.0]),
    "corner": np.array([0.75, -1.0, 0.5]),
}


class _Camera(NamedTuple):
    view: View
    eye: NDArray[np.float64]  # [3]
    right: NDArray[np.float64]  # [3], as up and forward: unit vectors of the image
    up: NDArray[np.float64]
    forward: NDArray[np.float64]
    focal: float  # pixels
    width: int  # pixels, oversampled
    height: int
    reach: float  # metres from the robot's centre to its farthest part, at rest


def draw(
    model: mujoco.MjModel, data: mujoco.MjData, size: Size = (480, 360), caption: str = ""
) -> UInt8[np.ndarray, "h w 3"]:
    """Draws the model as it stands in ``data``; the camera follows a robot that travels.

    Robots that move in a vertical plane are seen from the side, those that move in a horizontal
    plane from above, all others from a corner. The limbs of a robot differ in colour. Shapes
    other than MuJoCo's basic solids are drawn as the box around them.

    Args:
        model: the compiled model.
        data: its state, with positions up to date (as after a step or ``mj_forward``).
        size: width and height of the image in pixels.
        caption: a line of text in the upper left corner.
    """
    width, height = size
    camera = _camera(model, data, width * _OVERSAMPLING, height * _OVERSAMPLING)
    solids = _solids(model, data)
    rays = _rays(camera.view, camera.width, camera.height)
    ground = _ground_height(model, data)
    image, depth = _background(camera, rays, ground)
    dark = np.zeros(depth.shape, np.bool_)
    for solid in solids:
        _shadow(dark, depth, camera, rays, solid, ground)
    image[dark] *= 0.72
    for solid in solids:
        _paint(image, depth, camera, rays, solid)
    # Strided sums: numpy's mean over short inner axes takes several times as long.
    corners = [
        image[row::_OVERSAMPLING, column::_OVERSAMPLING]
        for row in range(_OVERSAMPLING)
        for column in range(_OVERSAMPLING)
    ]
    pixels = (np.clip(sum(corners) / len(corners), 0, 1) * 255 + 0.5).astype(np.uint8)
    marks = _distance_marks(camera, ground) if camera.view == "side" else []
    return _write(pixels, marks, caption)


def with_caption(frame: UInt8[np.ndarray, "h w 3"], caption: str) -> UInt8[np.ndarray, "h w 3"]:
    """A copy of the frame with a line of text in the upper left corner."""
    return _write(frame, [], caption)


# ---------------------------------------------------------------- camera


class Focus(NamedTuple):
    """Where to look from, so that the robot fills the image and stays in it."""

    view: View
    target: NDArray[np.float64]  # [3], metres
    reach: float  # metres from the robot's centre to its farthest part, at rest
    backward: NDArray[np.float64]  # [3], unit vector from the target towards the eye
    distance: float  # metres from the target to the eye
    field_of_view: float  # degrees, of the image's shorter side


def focus(model: mujoco.MjModel, data: mujoco.MjData) -> Focus:
    """What a camera that follows the robot looks at."""
    rest = mujoco.MjData(model)
    mujoco.mj_kinematics(model, rest)
    mujoco.mj_comPos(model, rest)
    moving = _moving_geoms(model)
    places = rest.geom_xpos[moving]
    bounds = model.geom_rbound[moving]
    centre = (places.min(0) + places.max(0)) / 2 if len(places) else np.array(model.stat.center)
    reach = float((np.linalg.norm(places - centre, axis=1) + bounds).max(initial=0.3))
    travellers = _travellers(model)
    target = centre.copy()
    if travellers:
        shift = (data.subtree_com[travellers] - rest.subtree_com[travellers]).mean(0)
        # Half of the height only, so that a jump and a fall still show.
        target += shift * np.array([1.0, 1.0, 0.5])
    view = _view(model)
    backward = _BACKWARDS[view] / np.linalg.norm(_BACKWARDS[view])
    distance = float(1.25 * reach / np.tan(_HALF_ANGLE))
    return Focus(view, target, reach, backward, distance, float(np.rad2deg(2 * _HALF_ANGLE)))


def _camera(model: mujoco.MjModel, data: mujoco.MjData, width: int, height: int) -> _Camera:
    view, target, reach, backward, distance, _ = focus(model, data)
    right, up, forward = _axes(view)
    eye = target + distance * backward
    return _Camera(view, eye, right, up, forward, _focal(width, height), width, height, reach)


def _axes(view: View) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The image's right and up, and the direction of view: unit vectors."""
    backward = _BACKWARDS[view] / np.linalg.norm(_BACKWARDS[view])
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    return right, np.cross(backward, right), -backward


def _focal(width: int, height: int) -> float:
    return min(width, height) / 2 / float(np.tan(_HALF_ANGLE))


def _view(model: mujoco.MjModel) -> View:
    hinges = model.jnt_axis[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]
    loose = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)).any()
    if len(hinges) and not loose:
        axis = np.abs(hinges)
        if (axis[:, 1] > 0.99).all():
            return "side"
        if (axis[:, 2] > 0.99).all():
            return "top"
    return "corner"


def _travellers(model: mujoco.MjModel) -> list[int]:
    """Bodies on the world that can go anywhere: the roots of robots, not the base of an arm."""
    # As numbers: numpy's integers do not equal the members of mujoco's enumerations.
    travelling = (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    if not model.njnt or int(model.jnt_type[0]) not in travelling:
        return []
    return sorted(
        {
            int(body)
            for body, kind in zip(model.jnt_bodyid, model.jnt_type, strict=True)
            if int(kind) in travelling and model.body_parentid[body] == 0
        }
    )


def _moving_geoms(model: mujoco.MjModel) -> NDArray[np.int64]:
    moves = model.body_weldid[model.geom_bodyid] != 0
    return np.flatnonzero(moves & _visible(model))


def _visible(model: mujoco.MjModel) -> NDArray[np.bool_]:
    return (model.geom_group < 3) & (model.geom_rgba[:, 3] > 0)


@lru_cache(maxsize=2)
def _rays(view: View, width: int, height: int) -> NDArray[np.float32]:
    """Unit directions through the pixels' centres, [h, w, 3]: the camera moves, never turns."""
    right, up, forward = _axes(view)
    focal = _focal(width, height)
    x = (np.arange(width) + 0.5 - width / 2) / focal
    y = (height / 2 - np.arange(height) - 0.5) / focal
    rays = forward + x[None, :, None] * right + y[:, None, None] * up
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    rays.flags.writeable = False
    return rays


def _project(camera: _Camera, point: NDArray[np.float64]) -> tuple[float, float, float]:
    """Column, row (pixels, oversampled) and distance along the view (metres) of a point."""
    offset = point - camera.eye
    far = max(float(offset @ camera.forward), 1e-3)
    return (
        camera.width / 2 + camera.focal * float(offset @ camera.right) / far,
        camera.height / 2 - camera.focal * float(offset @ camera.up) / far,
        far,
    )


def _window(camera: _Camera, centre: NDArray[np.float64], bound: float) -> tuple[slice, slice]:
    """The rows and columns that a ball can cover."""
    column, row, far = _project(camera, centre)
    # Near the eye a ball covers more than its radius over its distance.
    half = camera.focal * bound / max(far - bound, 0.05) + 1
    return (
        slice(
            int(np.clip(row - half, 0, camera.height)),
            int(np.clip(row + half + 1, 0, camera.height)),
        ),
        slice(
            int(np.clip(column - half, 0, camera.width)),
            int(np.clip(column + half + 1, 0, camera.width)),
        ),
    )


# ---------------------------------------------------------------- what is in the picture


def _solids(model: mujoco.MjModel, data: mujoco.MjData) -> list[Solid]:
    limbs = _limb_colours(model)
    solids = []
    for geom in np.flatnonzero(_visible(model)):
        kind = int(model.geom_type[geom])
        if kind in (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD)):
            continue
        body = int(model.geom_bodyid[geom])
        turn = data.geom_xmat[geom].reshape(3, 3).copy()
        centre, size = data.geom_xpos[geom].copy(), model.geom_size[geom].copy()
        if kind not in SHAPES:
            centre, size = centre + turn @ model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            kind = int(mujoco.mjtGeom.mjGEOM_BOX)
        colour = limbs.get(body, model.geom_rgba[geom, :3].astype(np.float64))
        solids.append(Solid(kind, centre, turn, size, float(model.geom_rbound[geom]), colour))
    return solids


def _limb_colours(model: mujoco.MjModel) -> dict[int, NDArray[np.float64]]:
    """A colour for each body that moves: one hue per limb, paler towards its end."""
    parents = model.body_parentid
    moving = [b for b in range(1, model.nbody) if model.body_weldid[b] != 0]
    children: dict[int, int] = {}
    for body in moving:
        children[int(parents[body])] = children.get(int(parents[body]), 0) + 1
    limb: dict[int, int] = {}
    depth: dict[int, int] = {}
    n_limbs = 0
    for body in moving:
        parent = int(parents[body])
        if parent not in limb:
            limb[body], depth[body] = 0, 0
        elif limb[parent] == 0 or children[parent] > 1:
            n_limbs += 1
            limb[body], depth[body] = n_limbs, 0
        else:
            limb[body], depth[body] = limb[parent], depth[parent] + 1
    colours = {}
    for body in moving:
        if limb[body] == 0:
            colours[body] = np.array([0.90, 0.88, 0.84])
        else:
            # Steps of the golden ratio keep neighbouring limbs apart in hue.
            hue = (0.02 + 0.618 * (limb[body] - 1)) % 1.0
            saturation = max(0.72 - 0.13 * depth[body], 0.3)
            colours[body] = np.array(colorsys.hsv_to_rgb(hue, saturation, 0.88))
    return colours


def _ground_height(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    if len(planes):
        return float(data.geom_xpos[planes, 2].max())
    rest = mujoco.MjData(model)
    mujoco.mj_kinematics(model, rest)
    return float((rest.geom_xpos[:, 2] - model.geom_rbound).min(initial=0.0))


# ---------------------------------------------------------------- light and colour


def _background(
    camera: _Camera, rays: NDArray[np.float32], ground: float
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


def _tile(camera: _Camera) -> float:
    """Side of a tile in metres: a power of two, near the robot's reach."""
    return float(2.0 ** np.round(np.log2(max(camera.reach * 0.6, 0.05))))


def _shadow(
    dark: NDArray[np.bool_],
    depth: NDArray[np.float32],
    camera: _Camera,
    rays: NDArray[np.float32],
    solid: Solid,
    ground: float,
) -> None:
    """Marks, in place, the ground that the solid hides from the light."""
    height = solid.centre[2] - ground
    if height < 0:
        return
    foot = solid.centre - _LIGHT * height / _LIGHT[2]
    window = _window(camera, foot, solid.bound / _LIGHT[2])
    far = depth[window]
    lit = np.isfinite(far) & ~dark[window]
    points = camera.eye.astype(np.float32) + far[lit][:, None] * rays[window][lit]
    blocked, _ = hit(solid, points, _LIGHT.astype(np.float32))
    dark[window][lit] = np.isfinite(blocked)


def _paint(
    image: NDArray[np.float32],
    depth: NDArray[np.float32],
    camera: _Camera,
    rays: NDArray[np.float32],
    solid: Solid,
) -> None:
    """Draws, in place, the solid where it is nearer than what is there."""
    window = _window(camera, solid.centre, solid.bound)
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


def _distance_marks(camera: _Camera, ground: float) -> list[tuple[float, float, str]]:
    """Column, row and text of the metres travelled, along the ground in front of the robot."""
    tile = _tile(camera)
    front = camera.eye[1] + 0.62 * (0.0 - camera.eye[1])
    first = int(np.ceil((camera.eye[0] - 3 * camera.reach) / tile))
    marks = []
    for place in range(first, int((camera.eye[0] + 3 * camera.reach) / tile) + 1):
        column, row, _ = _project(camera, np.array([place * tile, front, ground]))
        marks.append((column / _OVERSAMPLING, row / _OVERSAMPLING, f"{place * tile:g} m"))
    return marks


def _write(
    frame: NDArray[np.uint8], marks: list[tuple[float, float, str]], caption: str
) -> NDArray[np.uint8]:
    image = Image.fromarray(frame)
    pen = ImageDraw.Draw(image)
    height = image.height
    small = ImageFont.load_default(max(height // 32, 9))
    for column, row, text in marks:
        pen.text((column, row), text, fill=(95, 100, 105), font=small, anchor="mm")
    if caption:
        font = ImageFont.load_default(max(height // 24, 10))
        margin = max(height // 45, 4)
        left, top, right, bottom = pen.textbbox((margin, margin), caption, font=font)
        pen.rectangle((left - 4, top - 3, right + 4, bottom + 3), fill=(40, 44, 52))
        pen.text((margin, margin), caption, fill=(255, 255, 255), font=font)
    return np.asarray(image)

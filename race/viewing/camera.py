"""Where a robot is looked at from, and how points of its world come onto the picture."""

from functools import lru_cache
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

View = Literal["side", "top", "corner"]

_HALF_ANGLE = np.deg2rad(20.0)  # of the image's shorter side
_BACKWARDS: dict[View, NDArray[np.float64]] = {  # from the target towards the eye
    "side": np.array([0.0, -1.0, 0.17]),
    "top": np.array([0.0, -0.25, 1.0]),
    "corner": np.array([0.75, -1.0, 0.5]),
}


class Camera(NamedTuple):
    """An eye that follows a robot; lengths of the picture in samples, of which pixels are made."""

    view: View
    eye: NDArray[np.float64]  # [3]
    right: NDArray[np.float64]  # [3], as up and forward: unit vectors of the image
    up: NDArray[np.float64]
    forward: NDArray[np.float64]
    focal: float
    width: int
    height: int
    reach: float  # metres from the robot's centre to its farthest part, at rest


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


def camera_of(model: mujoco.MjModel, data: mujoco.MjData, width: int, height: int) -> Camera:
    """The camera of a picture of so many samples across and up."""
    view, target, reach, backward, distance, _ = focus(model, data)
    right, up, forward = _axes(view)
    eye = target + distance * backward
    return Camera(view, eye, right, up, forward, _focal(width, height), width, height, reach)


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
    return np.flatnonzero(moves & visible(model))


def visible(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Which geoms are to be seen: the first groups, and nothing that is transparent."""
    return (model.geom_group < 3) & (model.geom_rgba[:, 3] > 0)


@lru_cache(maxsize=2)
def rays_of(view: View, width: int, height: int) -> NDArray[np.float32]:
    """Unit directions through the pixels' centres, [h, w, 3]: the camera moves, never turns."""
    right, up, forward = _axes(view)
    focal = _focal(width, height)
    x = (np.arange(width) + 0.5 - width / 2) / focal
    y = (height / 2 - np.arange(height) - 0.5) / focal
    rays = forward + x[None, :, None] * right + y[:, None, None] * up
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    rays.flags.writeable = False
    return rays


def project(camera: Camera, point: NDArray[np.float64]) -> tuple[float, float, float]:
    """Column, row (samples) and distance along the view (metres) of a point."""
    offset = point - camera.eye
    far = max(float(offset @ camera.forward), 1e-3)
    return (
        camera.width / 2 + camera.focal * float(offset @ camera.right) / far,
        camera.height / 2 - camera.focal * float(offset @ camera.up) / far,
        far,
    )


def window_of(camera: Camera, centre: NDArray[np.float64], bound: float) -> tuple[slice, slice]:
    """The rows and columns that a ball can cover."""
    column, row, far = project(camera, centre)
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

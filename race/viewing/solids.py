"""Rays against MuJoCo's basic solids: sphere, capsule, cylinder, ellipsoid, box."""

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray


class Solid(NamedTuple):
    """A geom of a model, placed in the world."""

    kind: int  # mujoco.mjtGeom
    centre: NDArray[np.float64]  # [3]
    turn: NDArray[np.float64]  # [3, 3], from the solid's frame to the world's
    size: NDArray[np.float64]  # [3]
    bound: float  # radius of a ball around the centre that holds the solid
    colour: NDArray[np.float64]  # [3]


def hit(
    solid: Solid, origin: NDArray[Any], direction: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distance to the solid along rays and its normal there; distance inf where a ray misses.

    ``origin`` and ``direction`` broadcast against each other, [..., 3]; results are [...] and
    [..., 3].
    """
    o = (origin - solid.centre) @ solid.turn
    d = direction @ solid.turn
    o, d = np.broadcast_arrays(o, d)
    distance, normal = SHAPES[solid.kind](o, d, solid.size)
    return distance, normal @ solid.turn.T


def _ball(o: Any, d: Any, radius: float) -> Any:
    b = (o * d).sum(-1)
    inside = b * b - (o * o).sum(-1) + radius * radius
    t = -b - np.sqrt(np.maximum(inside, 0))
    return np.where((inside >= 0) & (t > 0), t, np.inf)


def _tube(o: Any, d: Any, radius: float, half: float) -> Any:
    """The side of a cylinder along z."""
    a = np.maximum((d[..., :2] ** 2).sum(-1), 1e-12)
    b = (o[..., :2] * d[..., :2]).sum(-1)
    inside = b * b - a * ((o[..., :2] ** 2).sum(-1) - radius * radius)
    t = (-b - np.sqrt(np.maximum(inside, 0))) / a
    on = np.abs(o[..., 2] + t * d[..., 2]) <= half
    return np.where((inside >= 0) & (t > 0) & on, t, np.inf)


def _at(o: Any, d: Any, t: Any) -> Any:
    return o + np.where(np.isfinite(t), t, 0)[..., None] * d


def _hit_sphere(o: Any, d: Any, size: Any) -> Any:
    t = _ball(o, d, size[0])
    return t, _at(o, d, t) / size[0]


def _hit_capsule(o: Any, d: Any, size: Any) -> Any:
    radius, half = size[0], size[1]
    end = np.array([0, 0, half])
    t = np.minimum(_tube(o, d, radius, half), _ball(o - end, d, radius))
    t = np.minimum(t, _ball(o + end, d, radius))
    point = _at(o, d, t)
    axis = np.clip(point[..., 2], -half, half)
    point[..., 2] -= axis
    return t, point / radius


def _hit_cylinder(o: Any, d: Any, size: Any) -> Any:
    radius, half = size[0], size[1]
    side = _tube(o, d, radius, half)
    slope = np.where(np.abs(d[..., 2]) < 1e-9, 1e-9, d[..., 2])
    cap = (-np.sign(slope) * half - o[..., 2]) / slope
    on = ((o[..., :2] + cap[..., None] * d[..., :2]) ** 2).sum(-1) <= radius * radius
    cap = np.where(on & (cap > 0), cap, np.inf)
    t = np.minimum(side, cap)
    normal = _at(o, d, t) / radius
    normal[..., 2] = 0
    normal[cap < side] = 0
    normal[..., 2] = np.where(cap < side, -np.sign(slope), 0)
    return t, normal


def _hit_ellipsoid(o: Any, d: Any, size: Any) -> Any:
    # In units of the half axes it is a ball; there, directions are no longer of unit length.
    scaled = d / size
    length = np.sqrt((scaled**2).sum(-1))
    t = _ball(o / size, scaled / length[..., None], 1.0) / length
    normal = _at(o, d, t) / size**2
    return t, normal / np.maximum(np.sqrt((normal**2).sum(-1)), 1e-12)[..., None]


def _hit_box(o: Any, d: Any, size: Any) -> Any:
    slope = np.where(np.abs(d) < 1e-9, 1e-9, d)
    enter = (-np.sign(slope) * size - o) / slope
    leave = (np.sign(slope) * size - o) / slope
    t = enter.max(-1)
    t = np.where((t <= leave.min(-1)) & (t > 0), t, np.inf)
    face = np.eye(3)[enter.argmax(-1)]
    return t, -face * np.sign(slope)


# The kinds of geoms that `hit` knows.
SHAPES: dict[int, Any] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): _hit_sphere,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): _hit_capsule,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): _hit_cylinder,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): _hit_ellipsoid,
    int(mujoco.mjtGeom.mjGEOM_BOX): _hit_box,
}

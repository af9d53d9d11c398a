"""Which parts of a robot each agent moves, shown by their colours."""

import colorsys
from typing import Final

import mujoco
import numpy as np

from race.types import EnvSpec
from race.viewing.framing import Color

_FIRST: Final = ((217, 72, 60), (48, 92, 205), (238, 160, 32), (20, 150, 110), (196, 84, 186))
_NOBODYS: Final = (229, 224, 214)
_PALER: Final = 0.16
"""How much nearer to white each further joint of a limb is, so that parts keep apart."""
_PALEST: Final = 0.5


def colours(n_agents: int) -> tuple[Color, ...]:
    """A colour for each agent: easy to tell apart for a handful, hues round the circle beyond."""
    if n_agents <= len(_FIRST):
        return _FIRST[:n_agents]
    shades = [
        colorsys.hsv_to_rgb(k / n_agents, 0.75, 0.72 + 0.2 * (k % 2)) for k in range(n_agents)
    ]
    return tuple((round(255 * r), round(255 * g), round(255 * b)) for r, g, b in shades)


def paint(model: mujoco.MjModel, spec: EnvSpec) -> tuple[Color, ...]:
    """Gives the parts of a robot, in place, the colours of the agents that move them.

    An agent moves the bodies whose joints its actuators turn, and what is fixed to them. A body
    that several agents move has the colour of the first; parts that nobody moves are pale.

    Args:
        model: the compiled model, whose actuators are the entries of the joint action.
        spec: who controls which entry.

    Returns:
        The agents' colours; none, with the model as it was, where the actuators are not the
        entries of the joint action.
    """
    if model.nu != spec.joint_action_size:
        return ()
    chosen = colours(spec.n_agents)
    owner = _owners(model, spec)
    depth = _depths(model, owner)
    for geom in range(model.ngeom):
        body = int(model.body_weldid[model.geom_bodyid[geom]])
        if body == 0:
            continue  # the ground, walls, what does not move
        color = np.array(chosen[owner[body]] if body in owner else _NOBODYS) / 255
        paler = min(_PALER * depth.get(body, 0), _PALEST)
        model.geom_rgba[geom, :3] = color + paler * (1 - color)
        model.geom_matid[geom] = -1
    return chosen


def _owners(model: mujoco.MjModel, spec: EnvSpec) -> dict[int, int]:
    """The agent of each body that one moves."""
    turning = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    owner: dict[int, int] = {}
    for agent, entries in enumerate(spec.action_index):
        for actuator in entries:
            if int(model.actuator_trntype[actuator]) in turning:
                body = int(model.jnt_bodyid[model.actuator_trnid[actuator, 0]])
                owner.setdefault(int(model.body_weldid[body]), agent)
    return owner


def _depths(model: mujoco.MjModel, owner: dict[int, int]) -> dict[int, int]:
    """How many bodies of the same agent lie between a body and the nearest other one."""
    depth: dict[int, int] = {}
    for body in sorted(owner):  # parents come first
        parent = int(model.body_weldid[model.body_parentid[body]])
        depth[body] = depth[parent] + 1 if owner.get(parent) == owner[body] else 0
    return depth

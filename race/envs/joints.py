"""Which joints of a robot belong to whom, by the robot's model where a table is wrong.

gymnasium-robotics keeps tables of a robot's joints: the address of each in positions and
velocities, and the actuator that moves it. For some robots these do not belong together, so that an
agent would observe joints that it does not move, or none of its own.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any

Parts = Sequence[tuple[Any, ...]]
"""For each agent its joints, the library's nodes."""


def factorization(scenario: str, partition: str, obsk: int, model: Any) -> dict[str, Any] | None:
    """The library's parts, edges and globals of a robot, put right by its model.

    Args:
        scenario: the robot.
        partition: who moves what, in the library's spelling.
        obsk: distance up to which joints are observed.
        model: the robot's `mujoco.MjModel`.

    Returns:
        What the library takes as ``agent_factorization``; None where its own shows every agent the
        right joints, whatever their order (Humanoid's has two of one agent's crosswise).
    """
    from gymnasium_robotics.envs.multiagent_mujoco.obsk import get_parts_and_edges

    tables = get_parts_and_edges(scenario, partition)
    parts, edges, whole = tables
    _merge_copies(parts, edges)
    before = _seen(parts, edges, obsk, model)
    nodes = [node for part in parts for node in part]
    names = Counter(node.label for node in nodes)  # two joints of Pusher have the same
    for node in nodes:
        _put_right(node, _joint_of(node, names, model), model)
    if before == _seen(parts, edges, obsk, model):
        return None
    return {"partition": parts, "edges": edges, "globals": whole}


def _merge_copies(parts: Parts, edges: Sequence[Any]) -> None:
    """Edges of ManySegmentAnt name copies of joints, which no agent owns: puts the joints there."""
    owned = {id(node) for part in parts for node in part}
    named = {(node.label, node.act_ids): node for part in parts for node in part}
    for edge in edges:
        edge.nodes = {
            node if id(node) in owned else named.get((node.label, node.act_ids), node)
            for node in edge.nodes
        }


def _joint_of(node: Any, names: Counter[str], model: Any) -> int:
    """The joint of that name, if an actuator moves it; else the joint that the actuator moves."""
    import mujoco  # not before a renderer has been chosen, which it looks for when it is imported

    named = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, node.label)
    moved = model.actuator_trnid[:, 0].tolist()
    return named if named in moved and names[node.label] == 1 else int(moved[node.act_ids])


def _put_right(node: Any, joint: int, model: Any) -> None:
    node.act_ids = model.actuator_trnid[:, 0].tolist().index(joint)
    node.qpos_ids, node.qvel_ids = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])


def _seen(parts: Parts, edges: Sequence[Any], obsk: int, model: Any) -> list[list[set[int]]]:
    """For each agent and distance, the addresses of the joints there; and those that it moves."""
    from gymnasium_robotics.envs.multiagent_mujoco.obsk import get_joints_at_kdist

    found = []
    for part in parts:
        near = get_joints_at_kdist(part, edges, obsk)
        moved = {node.act_ids for node in part}
        distances = [{node.qpos_ids % model.nq for node in near[k]} for k in range(obsk + 1)]
        found.append([moved, *distances])
    return found

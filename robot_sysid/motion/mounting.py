"""The ground that an arm is mounted on, which a model seldom has."""

from __future__ import annotations

import mujoco
import numpy as np

from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.model.bodies import count_moving_joints
from robot_sysid.model.stated import GROUND_TYPES
from robot_sysid.motion.planes import Planes
from robot_sysid.records import Array, HalfSpace, RobotModel
from robot_sysid.wording import option_name

ON_GROUND = 1e-5
"""Height up to which a body stands on the ground, not above it [m]: a hundredth of what is ever
said of a distance, and more than rounding."""


def mounting_plane(robot: RobotModel, start_pose: Array) -> HalfSpace | None:
    """Return the space above the ground that the arm is mounted on, for the moving bodies above it.

    The ground's height is the lowest of the origin of the body that carries the arm and of
    everything that is fixed to that body (its meshes where it has any, as collision geometry may be
    rough): the foot of a pedestal is on the ground. None without gravity, where the model has a
    level plane, or ground of any form, that the arm can touch, or where more of the arm than its
    first link is below that height: such an arm hangs, or stands at an edge.

    Args:
        robot: the arm.
        start_pose: (n,) joint positions in which the arm is looked at [rad or m].
    """
    model = robot.mj_model
    down = np.array(model.opt.gravity, dtype=float)
    is_static = model.body_weldid[model.geom_bodyid] == 0
    is_solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    is_ground = np.isin(model.geom_type, GROUND_TYPES)
    if np.any(is_static & is_solid & is_ground) or not np.any(down):
        return None
    up = -down / np.linalg.norm(down)
    qpos = robot.reference_qpos.copy()
    qpos[robot.qpos_index] = start_pose
    data = data_at_pose(model, qpos)
    link_of_body = count_moving_joints(robot)
    # The parent of the first body that the arm moves.
    moving = np.flatnonzero(link_of_body)
    carrier = model.body_parentid[moving[0]]
    is_fixed = model.body_weldid[model.geom_bodyid] == model.body_weldid[carrier]
    is_mesh = is_fixed & (model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH))
    counts = is_mesh if np.any(is_mesh) else is_fixed
    height = up @ data.xpos[carrier]
    # How deep what is fixed reaches below the carrier's origin.
    fixed = Planes(model, model.geom_bodyid[counts], [(up, height)], is_part=counts)
    height -= np.max(fixed.depths(data), initial=0.0)
    planes = Planes(model, moving, [(up, height)], margin=ON_GROUND)
    is_below = np.isin(planes.bodies, planes.near(data).body)
    if np.any(link_of_body[planes.bodies[is_below]] > 1):
        return None
    above = tuple(planes.bodies[~is_below].tolist())
    # Adding zero turns -0.0 into 0.0.
    lifts = option_name("below_base")
    millimetres = round(1e3 * height)
    label = (
        f"the plane that the arm is mounted on, at a height of {millimetres} mm "
        f"({lifts} lifts it)"
    )
    return HalfSpace(up, height, clearance=0.0, bodies=above, label=label)

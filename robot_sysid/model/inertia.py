"""Inertial parameters of compiled MuJoCo bodies, alone and together with what hangs on them."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.kinematics import subtree
from robot_sysid.model.chain import body_label
from robot_sysid.records import Array, SubtreeBody


def body_theta(mj_model: Any, body_id: int) -> Array:
    """Return theta (10,) of one compiled body in its own frame, inertia about its origin."""
    mass, com = float(mj_model.body_mass[body_id]), mj_model.body_ipos[body_id]
    return spatial.theta_from_com(mass, com, inertia_about_com(mj_model, body_id))


def inertia_about_com(mj_model: Any, body_id: int) -> Array:
    """Return the inertia (3, 3) of one compiled body about its centre of mass, in body axes."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, mj_model.body_iquat[body_id])
    axes = flat.reshape(3, 3)
    return axes @ np.diag(mj_model.body_inertia[body_id]) @ axes.T


def subtree_bodies(mj_model: Any, qpos: Array, body_id: int) -> tuple[SubtreeBody, ...]:
    """Return a body and everything below it, expressed in that body's frame.

    Args:
        mj_model: compiled model.
        qpos: (nq,) configuration.
        body_id: top of the subtree.
    """
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(mj_model, data)
    top_rotation = data.xmat[body_id].reshape(3, 3)
    bodies: dict[int, SubtreeBody] = {}
    for i in subtree(mj_model, body_id):
        rotation = top_rotation.T @ data.xmat[i].reshape(3, 3)
        translation = top_rotation.T @ (data.xpos[i] - data.xpos[body_id])
        own = body_theta(mj_model, i)
        theta = own if i == body_id else spatial.transform_theta(own, rotation, translation)
        parent = bodies.get(int(mj_model.body_parentid[i]))
        welded = parent is None or (parent.welded and mj_model.body_jntnum[i] == 0)
        bodies[i] = SubtreeBody(i, body_label(mj_model, i), theta, bool(welded))
    return tuple(bodies.values())


def composite_theta(mj_model: Any, qpos: Array, body_id: int) -> Array:
    """Return theta (10,) of a body together with everything below it, held at ``qpos``.

    Expressed in the body's own frame, inertia about its origin.
    """
    return np.sum([body.theta for body in subtree_bodies(mj_model, qpos, body_id)], axis=0)


def link_reach(mj_model: Any, qpos: Array, body_id: int) -> float:
    """Return how far a body and all below it, held at ``qpos``, reach from its origin [m].

    The farthest point of its geoms' bounding spheres, and at least the length of the uniform rod
    whose mass is as far from its end.
    """
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(mj_model, data)
    geoms = np.isin(mj_model.geom_bodyid, subtree(mj_model, body_id))
    away = np.linalg.norm(data.geom_xpos[geoms] - data.xpos[body_id], axis=1)
    spheres = away + mj_model.geom_rbound[geoms]
    rod = np.sqrt(3.0) * spatial.characteristic_length(composite_theta(mj_model, qpos, body_id))
    return float(max(rod, np.max(spheres, initial=0.0)))

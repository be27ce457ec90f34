"""Inertial parameters of compiled MuJoCo bodies, alone, with what hangs on them, and as links."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.inverse_dynamics import data_at_pose, subtree
from robot_sysid.model.chain import body_label
from robot_sysid.records import ArmLink, Array, SubtreeBody


def body_theta(mj_model: Any, body_id: int) -> Array:
    """Return theta (10,) of one compiled body in its own frame, inertia about its origin."""
    mass = float(mj_model.body_mass[body_id])
    com = mj_model.body_ipos[body_id]
    return spatial.theta_from_com(mass, com, inertia_about_com(mj_model, body_id))


def inertia_about_com(mj_model: Any, body_id: int) -> Array:
    """Return the inertia (3, 3) of one compiled body about its centre of mass, in body axes."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, mj_model.body_iquat[body_id])
    axes = flat.reshape(3, 3)
    return axes @ np.diag(mj_model.body_inertia[body_id]) @ axes.T


def subtree_bodies(
    mj_model: Any, qpos: Array, body_id: int, excluded: Collection[int] = ()
) -> tuple[SubtreeBody, ...]:
    """Return a body and all below it but the excluded ones, held at ``qpos`` (nq,).

    Their theta are in the frame of the first body, which ``body_id`` names.
    """
    data = data_at_pose(mj_model, qpos)
    axes = data.xmat[body_id].reshape(3, 3)
    bodies: dict[int, SubtreeBody] = {}
    for i in subtree(mj_model, body_id):
        if i in excluded:
            continue
        theta = body_theta(mj_model, i)
        if i != body_id:
            rotation = axes.T @ data.xmat[i].reshape(3, 3)
            translation = axes.T @ (data.xpos[i] - data.xpos[body_id])
            theta = spatial.transform_theta(theta, rotation, translation)
        parent = bodies.get(int(mj_model.body_parentid[i]))
        is_jointless = bool(mj_model.body_jntnum[i] == 0)
        is_welded = parent is None or (parent.welded and is_jointless)
        bodies[i] = SubtreeBody(i, body_label(mj_model, i), theta, is_welded)
    return tuple(bodies.values())


def composite_theta(mj_model: Any, qpos: Array, body_id: int) -> Array:
    """Return theta (10,), in its own frame, of a body with everything below it, at ``qpos``."""
    bodies = subtree_bodies(mj_model, qpos, body_id)
    return np.sum([body.theta for body in bodies], axis=0)


def link_reach(mj_model: Any, qpos: Array, body_id: int) -> float:
    """Return how far a body and all below it, held at ``qpos``, reach from its origin [m].

    The farthest point of its geoms' bounding spheres, and at least the length of the uniform rod
    whose mass is as far from its end.
    """
    data = data_at_pose(mj_model, qpos)
    geoms = np.isin(mj_model.geom_bodyid, subtree(mj_model, body_id))
    distances = np.linalg.norm(data.geom_xpos[geoms] - data.xpos[body_id], axis=1)
    spheres = distances + mj_model.geom_rbound[geoms]
    theta = composite_theta(mj_model, qpos, body_id)
    rod = np.sqrt(3.0) * spatial.characteristic_length(theta)
    return float(max(rod, np.max(spheres, initial=0.0)))


def arm_links(mj_model: Any, qpos: Array, chain: Sequence[int]) -> tuple[ArmLink, ...]:
    """Return one link per chain joint, base to terminal.

    A link is the body that the joint moves with all that hangs on it, apart from the bodies that a
    later chain joint moves. Where several joints move one body, all but the last have a link
    without mass. Joints outside the chain (ids, base to terminal) are held at ``qpos`` (nq,).
    """
    data = data_at_pose(mj_model, qpos)
    mujoco.mj_comPos(mj_model, data)
    body_ids = [int(mj_model.jnt_bodyid[joint]) for joint in chain]
    links = []
    # Pose of the previous link.
    axes = np.eye(3)
    origin = np.zeros(3)
    jacobian = np.zeros((2, 3, mj_model.nv))
    for index, body_id in enumerate(body_ids):
        new_axes = data.xmat[body_id].reshape(3, 3)
        new_origin = data.xpos[body_id]
        mujoco.mj_jacBody(mj_model, data, jacobian[1], jacobian[0], body_id)
        dof = int(mj_model.jnt_dofadr[chain[index]])
        # Rotation of the joint's axis, then translation, in world axes.
        turn, slide = jacobian[..., dof]
        bodies = link_bodies(mj_model, qpos, body_id, body_ids[index + 1 :])
        links.append(
            ArmLink(
                body_id=body_id,
                body_name=body_label(mj_model, body_id),
                screw=np.concatenate([new_axes.T @ turn, new_axes.T @ slide]),
                rotation=axes.T @ new_axes,
                translation=axes.T @ (new_origin - origin),
                theta=np.sum([np.zeros(10), *(body.theta for body in bodies)], axis=0),
            )
        )
        axes = new_axes
        origin = new_origin
    return tuple(links)


def link_bodies(
    mj_model: Any, qpos: Array, body_id: int, later_bodies: Sequence[int]
) -> tuple[SubtreeBody, ...]:
    """Return the bodies of the link of a joint's body, that one first, at ``qpos`` (nq,).

    ``later_bodies``: ids of the bodies that later chain joints move; no bodies are returned where
    ``body_id`` is one of them.
    """
    if body_id in later_bodies:
        return ()
    excluded = set(subtree(mj_model, later_bodies[0])) if later_bodies else ()
    return subtree_bodies(mj_model, qpos, body_id, excluded)

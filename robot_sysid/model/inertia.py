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
    mj_model: Any, qpos: Array, body_id: int, without: Collection[int] = ()
) -> tuple[SubtreeBody, ...]:
    """Return a body and all below it but some, held at ``qpos`` (nq,), in that body's frame."""
    data = data_at_pose(mj_model, qpos)
    top_rotation = data.xmat[body_id].reshape(3, 3)
    bodies: dict[int, SubtreeBody] = {}
    for i in subtree(mj_model, body_id):
        if i in without:
            continue
        rotation = top_rotation.T @ data.xmat[i].reshape(3, 3)
        translation = top_rotation.T @ (data.xpos[i] - data.xpos[body_id])
        own = body_theta(mj_model, i)
        theta = (
            own if i == body_id else spatial.transform_theta(own, rotation, translation)
        )
        parent = bodies.get(int(mj_model.body_parentid[i]))
        welded = parent is None or (parent.welded and mj_model.body_jntnum[i] == 0)
        bodies[i] = SubtreeBody(i, body_label(mj_model, i), theta, bool(welded))
    return tuple(bodies.values())


def composite_theta(mj_model: Any, qpos: Array, body_id: int) -> Array:
    """Return theta (10,), in its own frame, of a body with everything below it, at ``qpos``."""
    return np.sum(
        [body.theta for body in subtree_bodies(mj_model, qpos, body_id)], axis=0
    )


def link_reach(mj_model: Any, qpos: Array, body_id: int) -> float:
    """Return how far a body and all below it, held at ``qpos``, reach from its origin [m].

    The farthest point of its geoms' bounding spheres, and at least the length of the uniform rod
    whose mass is as far from its end.
    """
    data = data_at_pose(mj_model, qpos)
    geoms = np.isin(mj_model.geom_bodyid, subtree(mj_model, body_id))
    away = np.linalg.norm(data.geom_xpos[geoms] - data.xpos[body_id], axis=1)
    spheres = away + mj_model.geom_rbound[geoms]
    rod = np.sqrt(3.0) * spatial.characteristic_length(
        composite_theta(mj_model, qpos, body_id)
    )
    return float(max(rod, np.max(spheres, initial=0.0)))


def arm_links(mj_model: Any, qpos: Array, chain: Sequence[int]) -> tuple[ArmLink, ...]:
    """Return one link per chain joint, base to terminal.

    A link is the body that the joint moves with all that hangs on it, apart from what a later chain
    joint moves. Where several joints move one body, all but the last have a link without mass.
    Joints outside the chain (ids, base to terminal) are held at ``qpos`` (nq,).
    """
    data = data_at_pose(mj_model, qpos)
    mujoco.mj_comPos(mj_model, data)
    bodies = [int(mj_model.jnt_bodyid[joint]) for joint in chain]
    links = []
    before = np.eye(3)
    origin = np.zeros(3)
    turn, slide = np.zeros((2, 3, mj_model.nv))
    for index, body in enumerate(bodies):
        here = data.xmat[body].reshape(3, 3)
        place = data.xpos[body]
        mujoco.mj_jacBody(mj_model, data, slide, turn, body)
        column = np.array([turn, slide])[..., int(mj_model.jnt_dofadr[chain[index]])]
        # Without what later chain joints move.
        own = link_bodies(mj_model, qpos, body, bodies[index + 1 :])
        links.append(
            ArmLink(
                body_id=body,
                body_name=body_label(mj_model, body),
                screw=np.concatenate([here.T @ part for part in column]),
                rotation=before.T @ here,
                translation=before.T @ (place - origin),
                theta=np.sum([np.zeros(10), *(part.theta for part in own)], axis=0),
            )
        )
        before = here
        origin = place
    return tuple(links)


def link_bodies(
    mj_model: Any, qpos: Array, body: int, later: Sequence[int]
) -> tuple[SubtreeBody, ...]:
    """Return the bodies that make the link of a joint's body, that one first, at ``qpos`` (nq,);
    none where ``later``, the bodies that later chain joints move, has it.
    """
    if body in later:
        return ()
    return subtree_bodies(
        mj_model, qpos, body, set(subtree(mj_model, later[0]) if later else ())
    )

"""The arm's links: how each one moves on the one before it, and what it weighs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics.kinematics import subtree
from robot_sysid.model.chain import body_label
from robot_sysid.model.inertia import subtree_bodies
from robot_sysid.records import ArmLink, Array, SubtreeBody


def arm_links(mj_model: Any, qpos: Array, chain: Sequence[int]) -> tuple[ArmLink, ...]:
    """Return one link per chain joint, base to terminal.

    A link is the body that the joint moves with all that hangs on it, apart from what a later chain
    joint moves. Where several joints move one body, all but the last have a link without mass.

    Args:
        mj_model: compiled model.
        qpos: (nq,) reference configuration, at which joints outside the chain are held.
        chain: joint ids, base to terminal.
    """
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(mj_model, data)
    mujoco.mj_comPos(mj_model, data)
    bodies = [int(mj_model.jnt_bodyid[joint]) for joint in chain]
    rotations = [np.eye(3), *(data.xmat[body].reshape(3, 3).copy() for body in bodies)]
    places = [np.zeros(3), *(data.xpos[body].copy() for body in bodies)]
    links = []
    for index, (joint, body) in enumerate(zip(chain, bodies)):
        before, here = rotations[index], rotations[index + 1]
        links.append(
            ArmLink(
                body_id=body,
                body_name=body_label(mj_model, body),
                screw=_screw(mj_model, data, joint, here),
                rotation=before.T @ here,
                translation=before.T @ (places[index + 1] - places[index]),
                theta=_own_theta(mj_model, qpos, body, bodies[index + 1 :]),
            )
        )
    return tuple(links)


def _screw(mj_model: Any, data: Any, joint: int, rotation: Array) -> Array:
    """Return the body Jacobian's column of a joint at its own body (6,): [omega, v]."""
    turn, slide = np.zeros((2, 3, mj_model.nv))
    mujoco.mj_jacBody(mj_model, data, slide, turn, int(mj_model.jnt_bodyid[joint]))
    dof = int(mj_model.jnt_dofadr[joint])
    return np.concatenate((rotation.T @ turn[:, dof], rotation.T @ slide[:, dof]))


def link_bodies(
    mj_model: Any, qpos: Array, body: int, later: Sequence[int]
) -> tuple[SubtreeBody, ...]:
    """Return the bodies that make a link, the link's own body first; none where ``later`` has it.

    Args:
        mj_model: compiled model.
        qpos: (nq,) configuration.
        body: the body that the link's joint moves.
        later: the bodies that later chain joints move.
    """
    if body in later:
        return ()
    carried = set(subtree(mj_model, later[0])) if later else set()
    bodies = subtree_bodies(mj_model, qpos, body)
    return tuple(part for part in bodies if part.body_id not in carried)


def _own_theta(mj_model: Any, qpos: Array, body: int, later: Sequence[int]) -> Array:
    """Return theta (10,) of a link without what later chain joints move, in its body's frame."""
    own = [part.theta for part in link_bodies(mj_model, qpos, body, later)]
    return np.asarray(np.sum(own, axis=0)) if own else np.zeros(10)

"""What a motion does to an arm, by MuJoCo alone: tests hold the package's own limits against it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from robot_sysid.trajectory import motion_chunks


@dataclass(frozen=True)
class Peaks:
    """Extremes of a motion.

    Attributes:
        lowest, highest: (n,) positions.
        velocity, acceleration, torque: (n,) largest absolute values.
    """

    lowest: np.ndarray
    highest: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    torque: np.ndarray


def peaks(robot, plan, rate=500.0):
    """Extremes of a plan, torques by MuJoCo's inverse dynamics with Coulomb's law on top."""
    motions = list(motion_chunks(plan, rate))
    q, qd, qdd = (
        np.vstack([getattr(m, name) for m in motions]) for name in ("q", "qd", "qdd")
    )
    torque = np.max([np.abs(one) for one in _torques(robot, q, qd, qdd)], axis=0)
    largest = (np.max(np.abs(value), axis=0) for value in (qd, qdd))
    return Peaks(np.min(q, axis=0), np.max(q, axis=0), *largest, torque)


def _torques(robot, q, qd, qdd):
    model = robot.mj_model
    data = mujoco.MjData(model)
    flags = model.opt.disableflags
    for name in ("CONTACT", "LIMIT", "EQUALITY", "FRICTIONLOSS", "ACTUATION"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    try:
        for row in zip(q, qd, qdd):
            data.qpos[:] = robot.reference_qpos
            for target, index, value in zip(
                (data.qpos, data.qvel, data.qacc),
                (robot.qpos_index, robot.dof_index, robot.dof_index),
                row,
            ):
                target[index] = value
            mujoco.mj_inverse(model, data)
            yield data.qfrc_inverse[robot.dof_index] + robot.friction.coulomb * np.sign(
                row[1]
            )
    finally:
        model.opt.disableflags = flags


def distance_to_plane(robot, plan, plane, first_body, rate=500.0):
    """Least distance of the capsules of a body and all it carries from N x = OFFSET, on its side.

    Args:
        robot: an arm whose solid parts are capsules.
        plan: its motion.
        plane: (nx, ny, nz, offset).
        first_body: name of the body.
        rate: samples per second.
    """
    model = robot.mj_model
    data = mujoco.MjData(model)
    capsules = _capsules(model, model.body(first_body).id)
    length = np.linalg.norm(plane[:3])
    normal = np.array(plane[:3]) / length
    offset = plane[3] / length
    least = np.inf
    for motion in motion_chunks(plan, rate):
        for q in motion.q:
            data.qpos[:] = robot.reference_qpos
            data.qpos[robot.qpos_index] = q
            mujoco.mj_kinematics(model, data)
            for geom in capsules:
                radius, half = model.geom_size[geom, :2]
                axis = half * data.geom_xmat[geom].reshape(3, 3)[:, 2]
                ends = data.geom_xpos[geom] + np.array([axis, -axis])
                least = min(least, np.min(ends @ normal) - radius - offset)
    return float(least)


def fastest_point(robot, plan, body, rate=500.0):
    """Largest speed of any point of a body that is a capsule, by differences of its surface.

    Args:
        robot, plan, rate: as above.
        body: name.
    """
    model = robot.mj_model
    data = mujoco.MjData(model)
    (geom,) = _capsules(model, model.body(body).id)
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    ball = [
        [np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)]
        for a in angles
        for b in np.linspace(0.0, np.pi, 13)
    ]
    radius, half = model.geom_size[geom, :2]
    surface = np.vstack(
        [radius * np.array(ball) + [0.0, 0.0, s * half] for s in (-1.0, 1.0)]
    )
    previous = None
    fastest = 0.0
    for motion in motion_chunks(plan, rate):
        for q in motion.q:
            data.qpos[robot.qpos_index] = q
            mujoco.mj_kinematics(model, data)
            current = (
                data.geom_xpos[geom] + surface @ data.geom_xmat[geom].reshape(3, 3).T
            )
            if previous is not None:
                fastest = max(
                    fastest, rate * np.max(np.linalg.norm(current - previous, axis=1))
                )
            previous = current
    return float(fastest)


def nearest(robot, plan, rate=500.0):
    """Smallest distance of any two geoms that collide and move against each other, by MuJoCo.

    Bodies with one joint between them are left out.
    """
    model = robot.mj_model
    least = np.inf
    data = mujoco.MjData(model)
    joints = [_joints_above(model, b) for b in range(model.nbody)]
    pairs = [
        (a, b)
        for a in range(model.ngeom)
        for b in range(a)
        if _collide(model, a, b)
        and len(joints[model.geom_bodyid[a]] ^ joints[model.geom_bodyid[b]]) > 1
    ]
    for motion in motion_chunks(plan, rate):
        for q in motion.q:
            data.qpos[robot.qpos_index] = q
            mujoco.mj_kinematics(model, data)
            distances = (
                mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a, b in pairs
            )
            least = min(least, *distances)
    return float(least)


def _collide(model, a, b):
    masks = model.geom_contype, model.geom_conaffinity
    return bool(masks[0][a] & masks[1][b] | masks[0][b] & masks[1][a])


def _joints_above(model, body):
    return frozenset(
        j for j in range(model.njnt) if model.jnt_bodyid[j] in _ancestors(model, body)
    )


def _capsules(model, body):
    carried = [b for b in range(model.nbody) if body in _ancestors(model, b)]
    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in carried]
    assert all(model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE for g in geoms)
    return geoms


def _ancestors(model, body):
    ancestors = [body]
    while body:
        body = int(model.body_parentid[body])
        ancestors.append(body)
    return ancestors

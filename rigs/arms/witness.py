"""What a motion does to an arm, by MuJoCo alone: tests hold the package's own limits against it."""

from __future__ import annotations

import copy
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
    motions = [np.stack((m.q, m.qd, m.qdd)) for m in motion_chunks(plan, rate)]
    q, qd, qdd = np.concatenate(motions, axis=1)
    torque = list(_torques(robot, q, qd, qdd))
    largest = [np.max(np.abs(values), axis=0) for values in (qd, qdd, torque)]
    return Peaks(np.min(q, axis=0), np.max(q, axis=0), *largest)


def _torques(robot, q, qd, qdd):
    """Yield the torques (n,) of each row of a motion (N, n), by MuJoCo's inverse dynamics."""
    model = copy.copy(robot.mj_model)
    for name in ("CONTACT", "LIMIT", "EQUALITY", "FRICTIONLOSS", "ACTUATION"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    data = mujoco.MjData(model)
    for k in range(len(q)):
        data.qpos[:] = robot.reference_qpos
        data.qpos[robot.qpos_index] = q[k]
        data.qvel[robot.dof_index] = qd[k]
        data.qacc[robot.dof_index] = qdd[k]
        mujoco.mj_inverse(model, data)
        dry = robot.friction.coulomb * np.sign(qd[k])
        yield data.qfrc_inverse[robot.dof_index] + dry


def _poses(robot, plan, rate):
    """Yield MuJoCo's data, the same each time, in the arm's pose at each instant of a plan."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.reference_qpos
    for motion in motion_chunks(plan, rate):
        for q in motion.q:
            data.qpos[robot.qpos_index] = q
            mujoco.mj_kinematics(robot.mj_model, data)
            yield data


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
    capsules = _capsules(model, model.body(first_body).id)
    length = np.linalg.norm(plane[:3])
    normal = np.array(plane[:3]) / length
    offset = plane[3] / length
    least = np.inf
    for data in _poses(robot, plan, rate):
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
    (geom,) = _capsules(model, model.body(body).id)
    longitude = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    a, b = map(np.ravel, np.meshgrid(longitude, np.linspace(0.0, np.pi, 13)))
    ball = np.stack((np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)), axis=1)
    radius, half = model.geom_size[geom, :2]
    end = np.array([0.0, 0.0, half])
    surface = np.vstack((radius * ball - end, radius * ball + end))
    previous = None
    fastest = 0.0
    for data in _poses(robot, plan, rate):
        rotation = data.geom_xmat[geom].reshape(3, 3)
        current = data.geom_xpos[geom] + surface @ rotation.T
        if previous is not None:
            moved = np.linalg.norm(current - previous, axis=1)
            fastest = max(fastest, rate * np.max(moved))
        previous = current
    return float(fastest)


def new_contacts(robot, plan, rate=500.0):
    """Return the pairs of bodies that touch along a plan, move against each other, and do not touch
    in the arm's pose at rest.
    """
    model = robot.mj_model
    at_rest = mujoco.MjData(model)
    at_rest.qpos[:] = robot.reference_qpos
    mujoco.mj_kinematics(model, at_rest)
    resting = touching_pairs(model, at_rest)
    found = set()
    for data in _poses(robot, plan, rate):
        found |= touching_pairs(model, data)
    return found - resting


def touching_pairs(model, data):
    """Return the pairs of body ids that touch and move against each other, frames being known."""
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    pairs = set()
    for geoms, distance in zip(data.contact.geom, data.contact.dist):
        pair = tuple(sorted(model.geom_bodyid[geoms].tolist()))
        joints = [_joints_above(model, body) for body in pair]
        if distance <= 0.0 and joints[0] != joints[1]:
            pairs.add(pair)
    return pairs


def _joints_above(model, body):
    """Return the ids of the joints that move a body."""
    return set(np.flatnonzero(np.isin(model.jnt_bodyid, _ancestors(model, body))))


def _capsules(model, body):
    """Return the geoms of a body and of all that it carries, which have to be capsules."""
    carried = [b for b in range(model.nbody) if body in _ancestors(model, b)]
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, carried))
    assert np.all(model.geom_type[geoms] == int(mujoco.mjtGeom.mjGEOM_CAPSULE))
    return geoms


def _ancestors(model, body):
    """Return the ids of a body and of those that carry it, up to the world."""
    ancestors = [body]
    while ancestors[-1]:
        ancestors.append(int(model.body_parentid[ancestors[-1]]))
    return ancestors

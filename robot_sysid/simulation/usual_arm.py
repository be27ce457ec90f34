"""An arm as arms are beside their models: for rehearsals of which nobody says what the arm is.

A rehearsal on an arm exactly like its model shows nothing of what a real one will do: its model
carries it to the last digit, and nothing rubs. Drawn here are links, rotors and friction that are
as far from the model as they usually are (``records/usual_errors``); joints, ranges and gravity are
the model's. The same generator draws the same arm, whatever is played on it.

Masses, moments of inertia and rotors are multiplied by log-normal factors, and centres of mass are
moved: so a body that can exist stays one. Each joint rubs as much as it does with a usual gear of
its motor, and at least as much as its model says: the friction that a file states was seen in some
arm, while none stated means that nobody looked. What a file states is a usual change of friction
off as well.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import mujoco
import numpy as np

from robot_sysid import spatial
from robot_sysid.dynamics.friction import POLYNOMIAL
from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.mjcf.inertial import sum_theta
from robot_sysid.model.bodies import pose_in, write_body
from robot_sysid.records import ArmLink, Array, JointFriction, RobotModel
from robot_sysid.records.usual_errors import (
    DRY_FRICTION,
    FRICTION_CHANGE,
    FRICTION_SPREAD,
    LINK,
    ROTOR,
    USUAL_SCALES,
    VISCOUS_FRICTION,
)

# Usual errors of a link's mass, of its centre of mass over its size, and of its inertia. That of
# its inertia is twice LINK, times its scale.
_MASS, _CENTRE, _INERTIA = np.array([LINK, LINK, 2.0 * LINK]) * USUAL_SCALES / 100.0


def usual_arm(
    robot: RobotModel, rated_torque: Array, rng: np.random.Generator
) -> RobotModel:
    """Return an arm that is as far from its model as arms usually are.

    Args:
        robot: the arm as its model says, which stays as it is.
        rated_torque: (n,) torque that each joint's motor can hold for long [N m], which says how
            large its gear is, and so how much that rubs.
        rng: draws what is wrong.
    """
    n = robot.n_joints
    links = tuple(_usual_link(link, rng) for link in robot.links)
    mj_model = copy.copy(robot.mj_model)
    data = data_at_pose(mj_model, robot.reference_qpos)
    for link in links:
        for body in link.bodies:
            # The link's frame, in which its bodies are stated, as seen in the body's own.
            pose = pose_in(data.body(link.body_id), data.body(body.body_id))
            if body.theta[0] > 0.0:
                theta = spatial.transform_theta(body.theta, *pose)
                write_body(mj_model, body.body_id, theta)
    mj_model.dof_armature[robot.dof_index] *= np.exp(
        ROTOR / 100.0 * rng.standard_normal(n)
    )
    mujoco.mj_setConst(mj_model, mujoco.MjData(mj_model))
    friction = _usual_friction(robot.friction, rated_torque, rng)
    # A curve keeps its shape: with another linear part alone, friction would fall, or drive.
    for term in POLYNOMIAL:
        stated = np.maximum(robot.friction.viscous, 1e-300)
        scaled = term.stated_value(robot) * friction.viscous / stated
        if np.any(scaled):
            mj_model.dof_dampingpoly[robot.dof_index, term.entry] = scaled
    return replace(robot, mj_model=mj_model, links=links, friction=friction)


def _usual_link(link: ArmLink, rng: np.random.Generator) -> ArmLink:
    """Return a link whose mass, centre of mass and inertia are as far off as usual."""
    mass_factor = np.exp(_MASS * rng.standard_normal())
    inertia_factor = np.exp(_INERTIA * rng.standard_normal())
    shift = _CENTRE * link.size * rng.standard_normal(3)
    bodies = []
    for body in link.bodies:
        mass, com, inertia = spatial.com_from_theta(body.theta)
        theta = body.theta
        if mass > 0.0:
            theta = spatial.theta_from_com(
                mass_factor * mass, com + shift, mass_factor * inertia_factor * inertia
            )
        bodies.append(replace(body, theta=theta))
    if not bodies:
        return link
    total = sum_theta(bodies)
    return replace(link, theta=total, reference=total, bodies=tuple(bodies))


def _usual_friction(
    stated: JointFriction, rated_torque: Array, rng: np.random.Generator
) -> JointFriction:
    """Return the friction of joints of which a file states some, or none."""
    n = len(rated_torque)
    shares = np.array([DRY_FRICTION, VISCOUS_FRICTION])[:, None] / 100.0
    drawn = (
        shares * rated_torque * np.exp(FRICTION_SPREAD * rng.standard_normal((2, n)))
    )
    change = np.exp(FRICTION_CHANGE * rng.standard_normal((2, n)))
    known = change * np.stack([stated.coulomb, stated.viscous])
    coulomb, viscous = np.maximum(known, drawn)
    return replace(stated, coulomb=coulomb, viscous=viscous)

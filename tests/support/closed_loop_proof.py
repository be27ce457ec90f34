"""A plant that differs from the model, its closed-loop log, and what identification makes of it.

Shared by the tests and the accuracy benchmark. The log holds positions and torques only; velocities
and accelerations come from differences of the positions, so nothing of the simulation's own
knowledge reaches the estimate.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from robot_sysid.dynamics.equations import Equations
from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.estimation.algebra.least_squares import InformationAccumulator
from robot_sysid.model.bodies import composite_theta
from robot_sysid.records import InertialParameters, JointFriction, Measurement
from robot_sysid.signals.filters import REACH, first_derivative, second_derivative
from robot_sysid.signals.resampling import join_measurements, slice_samples
from robot_sysid.simulator import ArmTorque
from robot_sysid.solver import identify_parameters
from robot_sysid.trajectory import generate_excitation_trajectory
from tests.support.closed_loop import ClosedLoop

TERMS = ("coulomb", "viscous", "offset", "armature")


def plant_from(
    robot, armature=0.1, coulomb=0.4, viscous=0.1, payload=1.4, time_step=0.002
):
    """The robot with MuJoCo friction and armature in every joint and a heavier terminal link."""
    model = copy.copy(robot.mj_model)
    chain = robot.dof_index
    model.dof_armature[chain] = armature
    model.dof_frictionloss[chain] = coulomb
    model.dof_damping[chain] = viscous
    model.body_mass[robot.body_id] *= payload
    model.body_inertia[robot.body_id] *= payload
    model.opt.timestep = time_step
    # The ramp of MuJoCo's dry friction follows from inertias that are stored with the model.
    mujoco.mj_setConst(model, mujoco.MjData(model))
    theta = composite_theta(model, robot.reference_qpos, robot.body_id)
    return replace(
        robot,
        mj_model=model,
        prior=InertialParameters(theta),
        friction=JointFriction(model.dof_frictionloss[chain], model.dof_damping[chain]),
    )


def excitation(robot, seed=1, duration=15.0):
    """A random trajectory within the robot's limits."""
    rng = np.random.default_rng(seed)
    return generate_excitation_trajectory(robot, rng, duration, ArmTorque(robot))[0]


def ramp_torque(ramp, qd, qdd):
    """The dry friction torques (N, n) that MuJoCo's ramps oppose to a motion (N, n)."""
    return np.clip(ramp.inertia * (qdd + ramp.rate * qd), -ramp.coulomb, ramp.coulomb)


def record_run(loop):
    """The log of the whole run as one measurement."""
    return join_measurements(loop.run())


def differentiate_log(log, sample_rate):
    """The log without its first and last four samples, motion from its positions alone."""
    qd = first_derivative(log.q, sample_rate)
    qdd = second_derivative(log.q, sample_rate)
    inner = slice_samples(log, REACH, len(log) - REACH)
    return Measurement(inner.time, inner.q, qd, inner.tau, qdd)


def identify_log(robot, log, deadband, terms=TERMS):
    """Estimate of the terminal link and of every joint's friction; slow rows are left out."""
    equations = Equations(robot, "chain", (FrictionModel(terms),) * robot.n_joints)
    names = equations.names, equations.joints
    accumulator = InformationAccumulator(*names, equations.columns)
    is_fast = np.abs(log.qd) > deadband
    for index, (rows, tau) in enumerate(equations.rows(log)):
        fast = is_fast[:, index]
        accumulator.add(index, rows[fast], tau[fast])
    return identify_parameters(accumulator.result(), equations.prior)


@dataclass(frozen=True)
class Errors:
    """Relative errors of one identification; friction is the worst joint's."""

    mass: float
    com: float
    coulomb: float
    viscous: float
    armature: float


def errors_of(estimate, plant):
    """How far an estimate is from the plant."""
    truth = {
        "coulomb": plant.friction.coulomb,
        "viscous": plant.friction.viscous,
        "armature": plant.armature,
    }
    worst = []
    for term, true_values in truth.items():
        values = [estimate.value(f"{term}[{joint}]") for joint in plant.joint_names]
        worst.append(np.max(np.abs(values / true_values - 1.0)))
    mass = abs(estimate.inertial.mass / plant.prior.mass - 1.0)
    com = float(np.linalg.norm(estimate.inertial.com - plant.prior.com))
    return Errors(mass, com, *worst)


def proof_run(robot, plan, sample_rate=1000.0, **plant_options):
    """(errors with the ramp masked out, log as run, closed loop) of one plant."""
    plant = plant_from(robot, **plant_options)
    loop = ClosedLoop(plant, plan, sample_rate)
    log = differentiate_log(record_run(loop), sample_rate)
    estimate = identify_log(robot, log, 1.02 * loop.ramp_use.ramp_speed)
    return errors_of(estimate, plant), log, loop

"""Logs of a small arm whose truth is known, for tests of everything that reads measured data."""

import numpy as np

from rigs.arms import small_arms
from robot_sysid.records import join_recordings
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.simulation.plant import plant_measurements
from robot_sysid.trajectory import generate_excitation_trajectory

RATE = 200.0
DURATION = 10.0
JOINT = 'range="-2 2" frictionloss=".3" damping=".2" armature=".05"'
XML = small_arms.serial_arm(joint=JOINT)
"""The arm that makes the logs."""
CUTOFF = 8.0


def true_arm():
    """Return the RobotModel of the arm that makes the logs."""
    return small_arms.robot_of(XML)


def guess_model(robot, scale=0.6):
    """Return the arm with a scaled prior of the terminal link and without friction."""
    model = small_arms.compile_xml(XML)
    theta = scale * robot.prior.theta
    small_arms.write_body(model, robot.body_id, theta)
    model.dof_frictionloss[:] = 0.0
    model.dof_damping[:] = 0.0
    return small_arms.robot_of(model)


def plan_of(robot, seed=1, duration=DURATION):
    """Return a random trajectory on which every joint moves widely."""
    rng = np.random.default_rng(seed)
    plan = generate_excitation_trajectory(robot, rng, duration)
    return plan.scale_amplitudes(np.array([3.0, 3.0, 1.0]))


def log_of(plant, plan=None, seed=1, rate=RATE, **sensors):
    """Return the simulated sensor readings of an arm along a trajectory."""
    options = SimulatedArmOptions(**sensors)
    rng = np.random.default_rng(seed)
    return join_recordings(
        plant_measurements(plant, plan or plan_of(plant), options, rate, rng)
    )


def seeded_log(plant, seed, duration=DURATION, **sensors):
    """Return a simulated log whose motion and noise both follow from a seed."""
    return log_of(plant, plan_of(plant, seed, duration), seed, **sensors)

"""The simulated arm: MuJoCo's inverse dynamics plus Coulomb and viscous friction."""

import copy

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.small_arms import SEEDS, robot_of, seeded_motion
from rigs.files.refusals import refused
from robot_sysid.errors import SimulationError
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks

NAMES = ("seven", "dry friction", "springs")
PLAIN = {name: robot_of(small_arms.MODELS[name]) for name in NAMES}


def simulated(robot, motion):
    (measurement,) = simulate_inverse(robot, [motion])
    return measurement


@given(st.sampled_from(sorted(PLAIN)), SEEDS)
def test_friction_is_coulomb_and_viscous_with_the_models_coefficients(name, seed):
    robot = PLAIN[name]
    motion = seeded_motion(seed, robot.n_joints, 5)
    model = copy.copy(robot.mj_model)
    friction = model.dof_frictionloss * np.sign(motion.qd)
    friction += model.dof_damping * motion.qd
    assert np.max(np.abs(friction)) > 0.0
    model.dof_frictionloss[:] = model.dof_damping[:] = 0.0
    smooth = simulated(robot_of(model), motion).tau
    rigid = simulated(robot, motion).tau - friction
    tolerance = 1e-13 * np.max(np.abs(smooth))
    assert_allclose(rigid, smooth, rtol=0.0, atol=tolerance)


def test_contacts_and_joint_limits_do_not_push():
    """A motion through the floor and past the limits takes no more than one in free space."""
    free = small_arms.serial_arm(("0 0 1", "0 1 0", "1 0 0"), joint="")
    wall = '<geom type="plane" size="5 5 1" pos="0 0 5"/>'
    boxed = small_arms.serial_arm(("0 0 1", "0 1 0", "1 0 0"), joint='range="-.1 .1"')
    tip = '<geom size=".1" mass="0"/></body></body></body>'
    boxed = boxed.replace("</body></body></body>", tip).replace(
        "<worldbody>", f"<worldbody>{wall}"
    )
    motion = seeded_motion(2, 3, 5)
    expected = simulated(robot_of(free), motion).tau
    tau = simulated(robot_of(boxed), motion).tau
    assert_allclose(tau, expected, rtol=1e-12)


def test_a_torque_that_is_not_finite_stops_the_run_with_time_joint_and_cause():
    robot = robot_of(small_arms.SEVEN)
    robot.mj_model.body_mass[robot.body_id] = np.nan
    plan = generate_excitation_trajectory(robot, np.random.default_rng(0), 2.0)
    message = r"joint joint\d .* at \d\.\d{3} s.*<inertial>"
    with refused(message, SimulationError):
        list(simulate_inverse(robot, motion_chunks(plan, 100.0)))

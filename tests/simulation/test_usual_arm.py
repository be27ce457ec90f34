"""The arm of a rehearsal: another one than the model's, that could exist, and always the same."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given

from rigs.arms import small_arms
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics, LinkDynamics
from robot_sysid.model.bodies import body_theta
from robot_sysid.records import Motion
from robot_sysid.simulation.usual_arm import usual_arm

RATED = np.array([20.0, 9.0, 3.0])
MODEL = small_arms.serial_arm(
    tip=small_arms.fingers(), joint='range="-2.5 2.5" armature=".1"'
)


@pytest.fixture(scope="module")
def robot():
    return small_arms.robot_of(MODEL, "joint2")


def draw(robot, seed):
    return usual_arm(robot, RATED, np.random.default_rng(seed))


@given(seed=small_arms.SEEDS)
def test_every_drawn_body_can_exist_and_rubs(robot, seed):
    arm = draw(robot, seed)
    for body in range(1, robot.mj_model.nbody):
        theta = body_theta(arm.mj_model, body)
        pseudo_inertia = spatial.pseudo_inertia(theta)
        assert np.linalg.eigvalsh(pseudo_inertia)[0] > 0.0
    assert np.all(arm.friction.coulomb > 0.0) and np.all(arm.friction.viscous > 0.0)
    assert np.all(arm.armature != robot.armature)


@given(seed=small_arms.SEEDS)
def test_its_compiled_model_is_that_of_its_links(robot, seed):
    """MuJoCo's torque of the drawn arm is that of its links and rotors."""
    arm = draw(robot, seed)
    rng = np.random.default_rng(seed)
    motion = Motion(np.zeros(4), *rng.uniform(-1.0, 1.0, (3, 4, 3)))
    thetas = np.stack([link.theta for link in arm.links])
    moved = LinkDynamics(arm).motion(motion.q, motion.qd, motion.qdd)
    expected = moved.torque(thetas) + arm.armature * motion.qdd
    torque = ArmDynamics(arm).torque(motion.q, motion.qd, motion.qdd)
    np.testing.assert_allclose(torque, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_sizes_are_usual_ones_over_many_arms(robot):
    factors = []
    dry = []
    for seed in range(400):
        arm = draw(robot, seed)
        masses = [link.theta[0] for link in arm.links]
        factors.append(np.log(masses / np.array([k.theta[0] for k in robot.links])))
        dry.append(arm.friction.coulomb / RATED)
    # 17.5 %, 2.5 % of rated torque, each to four standard errors of its estimate.
    assert np.std(factors) == pytest.approx(0.175, abs=0.015)
    assert np.median(dry) == pytest.approx(0.025, abs=0.0025)


def test_the_same_seed_draws_the_same_arm_and_leaves_the_model(robot):
    before = mujoco.MjModel.from_xml_string(MODEL)
    one = draw(robot, 3)
    other = draw(robot, 3)
    np.testing.assert_array_equal(one.mj_model.body_mass, other.mj_model.body_mass)
    np.testing.assert_array_equal(one.friction.coulomb, other.friction.coulomb)
    np.testing.assert_array_equal(robot.mj_model.body_mass, before.body_mass)
    np.testing.assert_array_equal(robot.mj_model.dof_armature, before.dof_armature)


def test_friction_that_the_file_knows_stays_at_about_its_size():
    """What it has more than usual is that of this arm; a usual change of friction is left to it."""
    joint = 'range="-2.5 2.5" frictionloss="20" damping="30"'
    robot = small_arms.robot_of(small_arms.serial_arm(joint=joint))
    arm = draw(robot, 0)
    assert np.all(arm.friction.coulomb != 20.0)
    np.testing.assert_allclose(arm.friction.coulomb, 20.0, rtol=0.5)
    np.testing.assert_allclose(arm.friction.viscous, 30.0, rtol=0.5)

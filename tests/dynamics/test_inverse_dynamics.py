"""The torque of all links equals MuJoCo's inverse dynamics, whatever is added to rigid bodies; its
slopes by tilt and encoder zeros equal differences.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms import small_arms
from rigs.arms.small_arms import (
    SEEDS,
    random_chain,
    random_motion,
    random_theta,
    rigid_bodies,
    robot_of,
)
from robot_sysid.dynamics.inverse_dynamics import (
    ArmDynamics,
    BeyondRigidBodies,
    LinkDynamics,
    has_only_armature,
    tilt_axes,
    turn_gravity,
)
from robot_sysid.errors import InputError
from robot_sysid.model.bodies import body_theta

SAMPLES = 4


def assert_reproduces(robot, theta, motion):
    """Check tau_rest + Y theta' = inverse dynamics of the model with theta' written into it."""
    model, composite = small_arms.with_link(robot, theta)
    rows, other_torque = small_arms.rows_and_rest(robot, motion)
    link = rows @ composite
    actual = ArmDynamics(robot, model).torque(*motion)
    # 1e-9 of the link's own torque; beside it only the rounding errors of terms that cancel:
    # what the rest weighs, and what the link's mass would take one metre away from the axis.
    _, qd, qdd = motion
    metre_away = composite[0] * (10.0 + np.max(np.abs(qdd)) + np.max(qd**2))
    rounding = 1e-13 * (np.max(np.abs(actual)) + metre_away)
    tolerance = 1e-9 * np.max(np.abs(link)) + rounding
    assert_allclose(other_torque + link, actual, rtol=0.0, atol=tolerance)


@given(random_chain(), rigid_bodies(), SEEDS)
def test_link_and_other_bodies_give_mujocos_torque_on_any_chain(xml, theta, seed):
    robot = robot_of(xml)
    motion = random_motion(default_rng(seed), robot.n_joints, SAMPLES)
    assert_reproduces(robot, theta, motion)
    assert_equals_mujoco(robot, motion)


@pytest.mark.parametrize("name", [*small_arms.MODELS, *small_arms.NEWER_MODELS])
def test_link_and_other_bodies_give_mujocos_torque(name):
    try:
        robot = robot_of({**small_arms.MODELS, **small_arms.NEWER_MODELS}[name])
    except ValueError:
        pytest.skip("this MuJoCo does not know the attribute")
    rng = default_rng(0)
    for _ in range(3):
        motion = random_motion(rng, robot.n_joints, SAMPLES)
        assert_reproduces(robot, random_theta(rng, 10.0 ** rng.uniform(-2, 1)), motion)
    if name in small_arms.MODELS:
        assert_equals_mujoco(robot, motion)
    if name in small_arms.NEWER_MODELS:
        # Rotors and damping of actuators are in the joints.
        is_in_joints = name == "actuator armature"
        assert has_only_armature(robot.mj_model) == is_in_joints


def test_the_users_model_is_not_changed():
    robot = robot_of(small_arms.COUPLED_FINGERS)
    masses = robot.mj_model.body_mass.copy()
    flags = robot.mj_model.opt.disableflags
    motion = random_motion(default_rng(0), robot.n_joints, 2)
    small_arms.rows_and_rest(robot, motion)
    ArmDynamics(robot).torque(*motion)
    assert_array_equal(robot.mj_model.body_mass, masses)
    assert robot.mj_model.opt.disableflags == flags


def plain_torque(xml, motion):
    """Return the torque (N, n) of an arm, of rigid bodies, springs and armature."""
    return ArmDynamics(robot_of(xml)).torque(*motion)


@pytest.mark.parametrize(
    "name",
    [
        "gravity compensated",
        "in water",
        "dry friction",
        "equality on chain",
        "discrete inverse",
    ],
)
def test_torque_is_that_of_the_rigid_bodies_alone(name):
    motion = random_motion(default_rng(1), 3, 20)
    expected = plain_torque(small_arms.THREE, motion)
    assert_allclose(plain_torque(small_arms.MODELS[name], motion), expected, rtol=1e-12)


@pytest.mark.parametrize("first", [True, False])
def test_a_branch_may_stand_in_front_of_the_link_or_behind_it(first):
    """In front, the branch splits the chain's addresses into two ranges."""
    branch = small_arms.link(small_arms.hinge("side", small_arms.Y))
    bodies = [
        small_arms.link(
            small_arms.hinge("joint1", small_arms.X), inertial=small_arms.TIP
        ),
        branch,
    ]
    inside = "".join(bodies[::-1] if first else bodies)
    robot = robot_of(
        small_arms.world(
            small_arms.link(small_arms.hinge("joint0", small_arms.Z), inside)
        ),
        "joint1",
    )
    assert list(robot.dof_index) == ([0, 2] if first else [0, 1])
    motion = random_motion(default_rng(7), 2, SAMPLES)
    assert_reproduces(robot, body_theta(robot.mj_model, robot.body_id), motion)


def test_held_joints_stay_at_the_home_keyframe():
    robot = robot_of(small_arms.HOME_KEYFRAME)
    motion = random_motion(default_rng(4), robot.n_joints, SAMPLES)
    closed = np.zeros(6)
    wide = np.append(closed[:4], [0.03, 0.01])
    theta = small_arms.composite_theta(robot.mj_model, wide, 4)
    assert (
        np.max(np.abs(theta - small_arms.composite_theta(robot.mj_model, closed, 4)))
        > 1e-4
    )
    assert_allclose(robot.prior.theta, theta, rtol=1e-14)
    assert_reproduces(robot, body_theta(robot.mj_model, robot.body_id), motion)


def test_springs_and_armature_stay_in_the_torque():
    motion = random_motion(default_rng(2), 3, 20)
    rigid = plain_torque(small_arms.THREE, motion)
    springs = plain_torque(small_arms.SPRINGS, motion) - rigid
    assert_allclose(springs, 30.0 * (motion[0] - 0.7), rtol=1e-10, atol=1e-10)
    armature = plain_torque(small_arms.ARMATURE, motion) - rigid
    assert_allclose(armature, 0.3 * motion[2], rtol=1e-10, atol=1e-10)


# --- the motion of all links, by a formula of our own -------------------------------------------


def assert_equals_mujoco(robot, motion):
    """Check the torque of all links and their regressor columns against MuJoCo."""
    thetas = robot.thetas
    links = LinkDynamics(robot).motion(*motion)
    total = ArmDynamics(robot).torque(*motion)
    actual = total - BeyondRigidBodies(robot).torque(*motion)
    tolerance = 1e-11 * np.max(np.abs(actual)) + 1e-13
    assert_allclose(links.torque(thetas), actual, rtol=0.0, atol=tolerance)
    columns = links.columns(range(robot.n_joints)) @ thetas.ravel()
    assert_allclose(columns, actual, rtol=0.0, atol=tolerance)


# --- tilt of gravity, zeros of encoders, and parts of a motion ------------------------------------

ANGLES = st.floats(-0.3, 0.3)


@given(SEEDS, ANGLES, ANGLES)
def test_turning_keeps_the_strength_and_turns_by_the_angle(seed, first, second):
    down = 9.81 * default_rng(seed).normal(size=3)
    turned = turn_gravity(down, np.array([first, second]))
    assert_allclose(np.linalg.norm(turned), np.linalg.norm(down), rtol=1e-12)
    # Both axes are perpendicular to gravity, so the whole turn shows.
    sine = np.linalg.norm(np.cross(down, turned)) / (down @ down)
    assert_allclose(sine, np.sin(np.hypot(first, second)), rtol=0.0, atol=1e-12)


def test_without_gravity_there_is_no_tilt():
    with pytest.raises(InputError, match="no gravity against which"):
        tilt_axes(np.zeros(3))


@given(random_chain(), SEEDS)
def test_slopes_by_positions_equal_differences(xml, seed):
    robot = robot_of(xml)
    rng = default_rng(seed)
    step = 1e-5
    q, qd, qdd = random_motion(rng, robot.n_joints, 5)
    thetas = robot.thetas
    dynamics = LinkDynamics(robot)
    offsets = step * np.eye(robot.n_joints)
    torques = []
    for offset in (*-offsets, *offsets):
        torques.append(dynamics.motion(q + offset, qd, qdd).torque(thetas))
    below, above = np.split(np.stack(torques, axis=-1), 2, axis=-1)
    slopes = dynamics.motion(q, qd, qdd).slopes(thetas, qd)
    rounding = 1e-9 * np.max(np.abs(above), initial=1.0)
    assert_allclose(slopes, (above - below) / (2.0 * step), rtol=1e-6, atol=rounding)


@given(random_chain(), SEEDS)
def test_the_gradient_of_weighted_columns_equals_differences(xml, seed):
    """Of the columns of some links, by positions, speeds and accelerations."""
    robot = robot_of(xml)
    rng = default_rng(seed)
    motion, direction = rng.normal(size=(2, 3, SAMPLES, robot.n_joints))
    links = [*range(0, robot.n_joints, 2)]
    dynamics = LinkDynamics(robot)
    weights = rng.normal(size=(robot.n_joints, 10 * len(links), SAMPLES))

    def weighted_sum(at):
        columns = dynamics.motion(*at).columns(links)
        return np.vdot(columns.transpose(1, 2, 0), weights)

    gradient = dynamics.motion(*motion).weighted_gradient(links, weights, motion[1])
    ahead, behind = (weighted_sum(motion + s * direction) for s in (1e-5, -1e-5))
    scale = np.sum(np.abs(gradient * direction))
    difference = (ahead - behind) / 2e-5
    assert abs(np.vdot(gradient, direction) - difference) < 1e-7 * scale + 1e-6


@given(angle=st.floats(-3.0, 3.0))
def test_the_weight_of_a_pendulum_grows_by_its_sine_as_it_sinks(angle):
    """m g l cos(q) of a link at q above the level; none where it hangs below it."""
    robot = small_arms.robot_of(small_arms.serial_arm((small_arms.Y,)))
    arm = ArmDynamics(robot)
    still = np.zeros((1, 1))
    angles = np.linspace(-np.pi, np.pi, 721)[:, None]
    largest = np.max(np.abs(arm.torque(angles, 0.0 * angles, 0.0 * angles)))
    quarter = np.full((1, 1), angle + np.pi / 2)
    across = arm.torque(quarter, still, still)[0, 0]
    (slope,) = arm.weight_slopes(np.array([[angle]]))
    assert_allclose(slope, max(-across, 0.0), atol=1e-4 * largest)

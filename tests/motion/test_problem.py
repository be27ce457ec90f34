"""Limits of joints and of space, and the tool's speed and load."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.excitation_arms import TUBES, make_problem, robot
from rigs.arms.small_arms import SEEDS, robot_of, seeded_motion
from rigs.files import urdf
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import InputError
from robot_sysid.motion import LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Limits
from robot_sysid.records.option_fields import TOP_FREQUENCY_HZ


def limited_arm(lower=-2.0, upper=2.0, velocity=1.0, torque=np.inf):
    """Return an arm of three joints with equal limits [rad, rad/s, N m]."""
    limits = Limits(np.full(3, lower), upper, velocity, torque=torque)
    return replace(robot_of(small_arms.THREE), limits=limits)


def build(arm, *arguments, **changes):
    """Return the problem of an arm; changes are limits, arguments those of build_problem."""
    return build_problem(arm, LimitOptions(**changes), *arguments)


def test_limits_are_those_of_the_model_less_margins():
    problem = build(limited_arm(torque=100.0))
    assert np.allclose(problem.limits.lower, -2.0 + 0.02 * 4.0)
    assert np.allclose(problem.limits.upper, 2.0 - 0.02 * 4.0)
    assert np.allclose(problem.limits.velocity, 1.0)
    assert np.allclose(problem.limits.torque, 95.0)
    assert np.allclose(problem.limits.acceleration, 2.0 * np.pi * TOP_FREQUENCY_HZ)


def test_a_reference_beyond_a_limit_is_moved_to_it_and_noted():
    problem = build(limited_arm(lower=0.5))
    assert np.allclose(problem.rest, 1.25 - 0.99 * (0.75 - 0.02 * 1.5))
    assert any(
        "position limit of joint0, joint1, joint2;" in note for note in problem.notes
    )


@pytest.mark.parametrize("effort", ['effort="0"', ""])
def test_an_effort_of_zero_is_no_torque_limit_and_that_is_said(arm_file, effort):
    """Neither is none at all, and an option or another source may state one."""
    text = urdf.robot(urdf.serial({"arm": urdf.inertial(), "tip": urdf.inertial()}))
    path = arm_file(text.replace('effort="10"', effort, 1), "arm.urdf")
    robot = load_robot_model(path)
    assert np.array_equal(robot.limits.torque, [np.inf, 10.0])
    contacts, torques = build_problem(robot, LimitOptions()).missing_limits
    assert torques.startswith("no torque limit of base_arm is known: ")
    limited = build_problem(robot, LimitOptions(max_torque=(5.0,)))
    assert [*limited.missing_limits] == [contacts]


def test_without_a_band_only_an_option_limits_accelerations():
    arm = robot(small_arms.SLIDE_IN_CHAIN)
    free = build(arm, "chain", 0.3, False)
    assert np.all(np.isinf(free.limits.acceleration))
    limited = build(arm, "chain", 0.3, False, max_acceleration=3.0)
    expected = np.where(arm.is_slide, np.inf, 3.0)
    assert np.array_equal(limited.limits.acceleration, expected)


@given(SEEDS)
def test_no_point_of_the_tool_exceeds_its_speed(seed):
    """Points of the last tube, by v + w x p; nor is the stated speed much larger."""
    problem = make_problem(TUBES)
    motion = seeded_motion(seed, 4, 6)
    links = problem.dynamics.motion(motion.q, motion.qd, motion.qdd)
    w, v = np.split(links.velocity[-1].T[:, None], 2, axis=2)
    rng = default_rng(seed)
    away = rng.normal(size=(200, 3))
    away *= 0.03 / np.linalg.norm(away, axis=1, keepdims=True)
    points = away + np.outer(rng.choice((0.04, 0.2), size=200), [0.0, 0.0, 1.0])
    speeds = np.linalg.norm(v + np.cross(w, points), axis=2)
    stated = problem.signals(motion)[:, -1]
    assert np.all(speeds <= stated[:, None] + 1e-12)
    assert np.all(stated <= np.max(speeds, axis=1) + 0.05 * np.linalg.norm(w, axis=2).T)


SEVEN = make_problem(small_arms.SEVEN)


def loaded_torque(motion, mass):
    """Return the torque (N, 7) of SEVEN with a point mass [kg] at the tip of its tool."""
    per_kilogram = SEVEN.torque_per_kilogram(SEVEN.links_motion(motion))
    return SEVEN.torque(motion) + mass * per_kilogram


@given(SEEDS, st.floats(0.1, 5.0))
def test_the_torque_of_a_load_equals_that_of_a_loaded_arm(seed, mass):
    arm = robot(small_arms.SEVEN)
    motion = seeded_motion(seed, 7, 6)
    # The farthest corner of the tool's box.
    tip = SEVEN.tool[np.argmax(np.linalg.norm(SEVEN.tool, axis=1))]
    load = spatial.theta_from_com(mass, tip, np.zeros((3, 3)))
    model = copy.copy(arm.mj_model)
    small_arms.write_body(model, arm.body_id, arm.prior.theta + load)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    expected = ArmDynamics(robot_of(model))(motion)
    assert_allclose(loaded_torque(motion, mass), expected, rtol=1e-7, atol=1e-7)


@given(SEEDS, st.floats(0.0, 3.0))
def test_the_torque_with_a_reserve_covers_every_load_up_to_it(seed, mass):
    motion = seeded_motion(seed, 7, 6)
    reserved = np.abs(replace(SEVEN, reserve=3.0).torque(motion))
    assert np.all(np.abs(loaded_torque(motion, mass)) <= reserved + 1e-12)


def test_a_workspace_that_the_link_exceeds_at_rest_is_refused():
    box = (-1.0, 1.0, -1.0, 1.0, 0.0, 1.0)
    message = "body link3 is 230 mm beyond the workspace's zmax = 1 m"
    with pytest.raises(InputError, match=message):
        make_problem(TUBES, workspace=box)


BLOCK = '<geom type="box" size=".1 .1 .4" pos="0 0 -.4"/>'
FLOOR = '<geom type="plane" size="2 2 .1" pos="0 0 -.5"/>'


@pytest.mark.parametrize(
    ("model", "limits", "lowest"),
    [
        (TUBES, {}, 0.0),
        (TUBES, {"below_base": True}, None),
        (TUBES.replace("<worldbody>", f"<worldbody>{BLOCK}"), {}, -0.8),
        (TUBES.replace("<worldbody>", f"<worldbody>{FLOOR}"), {}, None),
        (TUBES.replace("<option ", '<option gravity="0 0 9.81" '), {}, None),
    ],
    ids=["usual", "lifted", "pedestal", "floor", "hanging"],
)
def test_bodies_stay_above_the_support_of_an_arm_that_does_not_hang(
    model, limits, lowest
):
    arm = robot(model)
    half_spaces = build_problem(arm, LimitOptions(**limits)).limits.spaces
    assert len(half_spaces) == (lowest is not None)
    for half_space in half_spaces:
        assert half_space.offset == pytest.approx(lowest)
        assert len(half_space.bodies) == arm.n_joints


def torque_variance(problem, motion):
    """Return the variance (N, n) of torques that independent errors of the links cause."""
    links = problem.links_motion(motion)
    variance = np.zeros_like(motion.q)
    for error in problem.link_errors.T:
        thetas = np.zeros((problem.n_joints, 10))
        thetas[sorted(problem.links, reverse=True)] = error.reshape(-1, 10)
        variance += links.torque(thetas) ** 2
    return variance


@given(SEEDS, st.floats(1.0, 20.0))
def test_the_torque_reserve_is_two_deviations_of_the_link_errors(seed, uncertainty):
    """A joint without a torque limit needs no reserve."""
    arm = limited_arm(torque=100.0)
    arm.limits.torque[1] = np.inf
    problem = build_problem(arm, LimitOptions(), link_uncertainty=uncertainty)
    motion = seeded_motion(seed, 3, 5)
    reserve = 2.0 * np.sqrt(torque_variance(problem, motion)) * [1.0, 0.0, 1.0]
    assert np.allclose(problem.torque_reserve(problem.links_motion(motion)), reserve)
    needed = np.abs(problem.arm_torque(motion)) + reserve
    assert np.allclose(np.abs(problem.torque(motion)), needed)

"""What a model of the arm says to a motor trajectory."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.arms import small_arms
from rigs.motors.damiao_rig import rest_to_rest, swing, trajectory_of
from robot_sysid.damiao.checks.model import (
    common_torque_factor,
    contact_checks,
    torque_checks,
    transfer_checks,
)
from robot_sysid.damiao.checks.preflight import plan_checks
from robot_sysid.damiao.execution import NO_LIMITS
from robot_sysid.damiao.settings import Plan, PlaySettings
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.motion.problem import build_problem
from robot_sysid.records import Limits, Motion
from robot_sysid.records.messages import Level

# Wide frames, so that the export clamps nothing.
MOTOR = "DM10010L"
JOINTS = ("joint0", "joint1", "joint2")
# Beside the limit by more than rounding makes.
INSIDE = st.floats(0.05, 0.98)
BEYOND = st.floats(1.02, 2.5)
SHARES = INSIDE | BEYOND
RATES = st.sampled_from([100.0, 123.4, 250.0, 300.0, 1000.0])
SPEEDS = st.floats(0.2, 1.0)
WHAT = ("position", "velocity", "torque")


@pytest.fixture(scope="module")
def arm():
    return small_arms.robot_of(small_arms.THREE, max_velocity=np.inf)


def limited_robot(arm, share, peaks):
    """The arm with limits (3, n) that peaks of position, velocity and torque are a share of."""
    position, velocity, torque = np.array(peaks) / share
    return replace(arm, limits=Limits(-position, position, velocity, torque=torque))


def check_trajectory(motion, speed, robot, limits=NO_LIMITS):
    """What a model says to a motion played at a share of its speed."""
    types = [MOTOR] * motion[1].shape[1]
    played = trajectory_of(motion, *types, names=robot.joint_names)
    plan = Plan(played, PlaySettings(speed=speed), model_limits=robot.limits)
    checks = [*plan_checks(plan), *contact_checks(plan, build_problem(robot, limits))]
    stops = [check for check in checks if check.level != Level.SAYS]
    return [check for check in stops if "the model's" in check.text]


def limit_findings(checks):
    """(joint, limit) of each stop, of which all findings are."""
    checks = list(checks)
    # Behind the semicolon stands a command.
    stops = [
        check.text.partition(";")[0] for check in checks if check.level == Level.REFUSES
    ]
    excesses = []
    for text, joint, quantity in itertools.product(stops, JOINTS, WHAT):
        if joint in text and f"{quantity} " in text:
            excesses.append((joint, quantity))
    assert len(excesses) == len(stops) == len(checks), stops
    return set(excesses)


def peaks_of(motion):
    return [np.abs(signal).max(axis=0) for signal in motion[1:]]


@given(
    rows=st.integers(3, 12),
    rate=RATES,
    speed=SPEEDS,
    share=st.lists(SHARES, min_size=9, max_size=9),
    seed=small_arms.SEEDS,
)
def test_every_row_counts_however_short_its_peak(arm, rows, rate, speed, share, seed):
    """Feed-forward torques and stated velocities of any shape, around an arm that stands still."""
    share = np.reshape(share, (3, 3))
    rng = np.random.default_rng(seed)
    q = np.broadcast_to(rng.uniform(0.5, 1.0, 3), (rows, 3))
    qd, tau = rng.uniform(-5.0, 5.0, (2, rows, 3))
    motion = np.arange(rows) / rate, q, qd, tau
    position, velocity, torque = peaks_of(motion)
    robot = limited_robot(arm, share, (position, speed * velocity, torque))
    expected = {(JOINTS[j], WHAT[i]) for i, j in np.argwhere(share > 1.0)}
    assert limit_findings(check_trajectory(motion, speed, robot)) == expected


@given(speed=SPEEDS, share=SHARES, rate=st.sampled_from([100.0, 250.0, 1000.0]))
def test_what_the_positions_do_counts_also_where_the_file_states_no_velocity(
    arm, speed, share, rate
):
    """Four printed decimals of a position are left to it: 1e-4 rad between two rows."""
    time, q, qd, tau = swing(3, duration=0.5, rate=rate, amplitude=2.0)
    steepest = (np.abs(np.diff(q, axis=0)).max(axis=0) - 1e-4) * rate * speed
    robot = replace(arm, limits=Limits(velocity=steepest / share))
    excesses = limit_findings(check_trajectory((time, q, 0 * qd, tau), speed, robot))
    assert excesses == (
        {(joint, "velocity") for joint in JOINTS} if share > 1.0 else set()
    )


# --- torque -------------------------------------------------------------------------------------


def with_its_torque(arm, seed, factor=1.0):
    """A swing about a random place with the torque that the arm needs."""
    scale = np.random.default_rng(seed).uniform(0.5, 1.0, 3)
    time, q, qd, _ = swing(3, duration=2.0, rate=100.0)
    motion = Motion(time, q + scale, qd, np.gradient(qd, time, axis=0))
    return time, q + scale, qd, factor * ArmDynamics(arm)(motion)


def refusals(arm, motion, **settings):
    plan = Plan(trajectory_of(motion), PlaySettings(**settings))
    findings = torque_checks(plan, arm)
    return [check.text for check in findings if check.level != Level.SAYS]


@given(seed=small_arms.SEEDS, speed=SPEEDS, factor=st.floats(0.5, 1.5))
def test_the_torque_of_the_motion_is_let_pass_also_where_the_load_is_another(
    arm, seed, speed, factor
):
    assert refusals(arm, with_its_torque(arm, seed, factor), speed=speed) == []


@pytest.mark.parametrize("factor", [-1.0, 0.0, 3.0])
def test_another_torque_than_the_motion_needs_is_refused(arm, factor):
    motion = with_its_torque(arm, 0)
    loaded = int(np.argmax(np.abs(motion[3]).mean(axis=0)))
    motion[3][:, loaded] *= factor
    (texts,) = refusals(arm, motion)
    assert f"motor {loaded + 1}: " in texts and "that of another motion" in texts


@pytest.mark.parametrize("factor", [0.5, 0.62, 0.7, 1.0, 1.4, 1.6, 2.0])
def test_a_factor_of_all_loaded_joints_is_found_beyond_a_half(factor):
    """Two loaded joints with torques a tenth off, and one that carries nothing."""
    needed = np.sin(np.arange(200)[:, None] * [0.02, 0.03, 0.05]) * [20.0, 8.0, 0.1]
    file = factor * needed * [1.1, 0.9, 3.0]
    found = common_torque_factor(file, needed, np.ones(3))
    assert found == (None if factor <= 1.5 else pytest.approx(factor, rel=0.01))


def test_a_load_that_doubles_the_torque_of_one_joint_is_no_common_factor(arm):
    motion = with_its_torque(arm, 0)
    motion[3][:, 1] *= 1.7
    assert refusals(arm, motion) == []


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_a_fifth_of_a_second_at_the_peak_is_refused_by_model(arm, joint):
    time, q, qd, tau = with_its_torque(arm, 0)
    tau[60:80, joint] = 27.0
    texts = refusals(arm, (time, q, qd, tau))
    bursts = [text for text in texts if "the torque in the file is 27 N·m" in text]
    assert len(bursts) == 1 and bursts[0].startswith(f"motor {joint + 1}: ")


def test_a_ripple_that_no_motor_follows_is_refused(arm):
    """0.15 rad at 10 Hz: 9 rad/s, and 592 rad/s^2."""
    time, q, qd, tau = with_its_torque(arm, 0)
    wave = 2 * np.pi * 10
    q[:, 0] += 0.15 * (1 - np.cos(wave * time))
    qd[:, 0] += 0.15 * wave * np.sin(wave * time)
    first = refusals(arm, (time, q, qd, tau))[0]
    assert re.search(
        "N·m is beyond what its motor can do, 27, at .* cannot follow", first
    )
    slow = refusals(arm, (time, q, qd, tau), speed=0.1)
    assert not any("its motor can do" in text for text in slow)


# --- contact ------------------------------------------------------------------------------------

WALL = small_arms.world(
    '<body name="arm"><inertial pos="0 0 .1" mass="1" diaginertia=".01 .01 .01"/>'
    '<joint name="shoulder" axis="0 0 1" range="-3 3"/><geom size=".02" pos=".5 0 0"/></body>'
    '<body name="wall"><geom type="box" size=".02 .02 .02" pos="0 .5 0"/></body>'
)


def turn(angle):
    """From zero to an angle and back, one hinge; velocities are stated as zero."""
    time, q, *_ = rest_to_rest(np.array([angle]), 1, 1.0, 50.0)
    return time, q, 0 * q, 0 * q


@given(angle=st.floats(-2.5, 1.4) | st.floats(1.6, 2.5), speed=SPEEDS)
def test_a_wall_on_the_way_is_found_even_where_the_file_states_no_velocity(
    angle, speed
):
    """The wall stands at a right angle; ball and box touch within 0.1 rad of it."""
    robot = small_arms.robot_of(WALL, max_velocity=np.inf)
    checks = check_trajectory(turn(angle), speed, robot)
    assert [check.level for check in checks] == [Level.REFUSES] * (angle > np.pi / 2)
    assert all("wall" in check.text and "arm" in check.text for check in checks)


@given(angle=st.floats(-2.9, 1.4) | st.floats(1.7, 2.9))
def test_each_way_is_compared_too(angle):
    robot = small_arms.robot_of(WALL, max_velocity=np.inf)
    ends = np.zeros(1), np.array([angle])
    problem = build_problem(robot, NO_LIMITS)
    stops = [check.text for check in transfer_checks(problem, *ends)]
    assert ["wall" in text for text in stops] == [True] * (angle > 1.5)

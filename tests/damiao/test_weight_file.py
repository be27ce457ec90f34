"""What carries the arm at any speed: by the model, and by the file beside a trajectory."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.arms import small_arms
from rigs.motors.damiao_rig import swing, trajectory_file, trajectory_of
from robot_sysid.damiao.checks.model import torque_checks, with_weight_of
from robot_sysid.damiao.checks.preflight import limit_checks, weight_checks
from robot_sysid.damiao.execution import MotorRun, RunOptions
from robot_sysid.damiao.settings import Plan
from robot_sysid.damiao.trajectory import read_damiao_trajectory
from robot_sysid.damiao.weight_file import export_weight, weight_path
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import InputError
from robot_sysid.records import Limits, Motion
from robot_sysid.records.file_access import DAMIAO_NAME, DAMIAO_WEIGHT_NAME, file_sha256
from robot_sysid.records.messages import Level

MOTION = swing(2, duration=0.4)
"""A motion of two joints whose torques are not those of any model."""
TENDON = (
    '<tendon><fixed damping="0.5" stiffness="1"><joint joint="joint0" coef="1"/>'
    '<joint joint="joint1" coef="0.5"/></fixed></tendon>'
)
SLOPE = np.array([0.0, 31.25])
"""By how much the weight of MOTION's joints grows as they sink [N m/rad]."""
DAMPED = small_arms.serial_arm((small_arms.Z, small_arms.Y), extra=TENDON).replace(
    "<joint name",
    '<joint damping="0.7" frictionloss="0.3" stiffness="2" armature="0.1" name',
)
"""Two joints with springs, rotors, friction and a damped tendon; the second carries weight."""


@pytest.fixture
def robot():
    return small_arms.robot_of(DAMPED)


def with_file(folder, weight, inertia, sha256=None):
    """Write MOTION and a weight beside it, and return the trajectory that is read from them."""
    path = trajectory_file(folder, MOTION).path
    with open(weight_path(path), "w", encoding="utf-8") as file:
        chunks = [(MOTION[0], weight, inertia)]
        export_weight(chunks, SLOPE, sha256 or file_sha256(path), file)
    return read_damiao_trajectory(path)


@given(speed=st.floats(0.05, 1.0), row=st.integers(0, 100))
def test_what_is_needed_is_the_models_torque_without_friction(speed, row):
    """Its friction and damping act on no torque that is fed, at any speed."""
    robot = small_arms.robot_of(DAMPED)
    smooth = small_arms.robot_of(re.sub('(damping|frictionloss)="[^"]*"', "", DAMPED))
    trajectory = with_weight_of(robot, trajectory_of(MOTION))
    q, qd, qdd = (s[[row]] for s in (trajectory.q, trajectory.qd, trajectory.qdd))
    played = Motion(np.zeros(1), q, speed * qd, speed**2 * qdd)
    resting = Motion(np.zeros(1), q, 0.0 * qd, 0.0 * qd)
    torque, weight, _ = trajectory.needed_torque(trajectory.time[row], speed)
    arm = ArmDynamics(smooth)
    np.testing.assert_allclose(torque, arm(played)[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(weight, arm(resting)[0], rtol=1e-9, atol=1e-9)
    assert np.all(smooth.friction.viscous == 0.0) and np.all(robot.friction.viscous > 0)


def test_the_torque_lies_on_straight_lines_and_holds_beyond_the_ends(robot):
    trajectory = with_weight_of(robot, trajectory_of(MOTION))
    between = 0.5 * (trajectory.time[7] + trajectory.time[8])
    ends = [trajectory.needed_torque(trajectory.time[row], 0.5)[0] for row in (7, 8)]
    np.testing.assert_allclose(
        trajectory.needed_torque(between, 0.5)[0], np.mean(ends, 0)
    )
    first = trajectory.needed_torque(0.0, 0.5)[0]
    np.testing.assert_array_equal(trajectory.needed_torque(-1.0, 0.5)[0], first)
    rows = [trajectory.needed_torque(time, 0.5)[0] for time in trajectory.time]
    np.testing.assert_allclose(trajectory.at_speed(0.5).tau, rows)


def test_without_a_weight_the_files_torque_is_fed():
    trajectory = trajectory_of(MOTION)
    torque, weight, _ = trajectory.needed_torque(trajectory.time[9], 0.3)
    np.testing.assert_array_equal(torque, trajectory.tau[9])
    assert np.all(np.isnan(weight))
    assert trajectory.at_speed(0.3) is trajectory


def test_a_weight_is_read_from_beside_its_trajectory(tmp_path):
    weight = np.cos(MOTION[1])
    inertia = -2.0 * MOTION[2]
    trajectory = with_file(tmp_path, weight, inertia)
    np.testing.assert_allclose(trajectory.weight, weight, rtol=0.0, atol=5.1e-5)
    np.testing.assert_allclose(trajectory.inertia, inertia, rtol=0.0, atol=5.1e-5)
    np.testing.assert_allclose(trajectory.weight_slope, SLOPE)
    assert trajectory.foreign_weight is None
    assert weight_path(DAMIAO_NAME).name == DAMIAO_WEIGHT_NAME


def test_the_weight_of_another_trajectory_is_never_used(tmp_path):
    weight = np.ones_like(MOTION[1])
    assert with_file(tmp_path, weight, weight).weight is not None
    path = tmp_path / DAMIAO_NAME
    path.write_text(path.read_text().replace("0.0000", "0.0001", 1))
    trajectory = read_damiao_trajectory(path)
    assert trajectory.weight is None
    assert trajectory.foreign_weight == weight_path(path)
    texts = [remark.text for remark in weight_checks(trajectory, 0.3)]
    assert "was written with another trajectory" in texts[0]
    assert "what carries the arm is not known at this speed" in texts[1]
    # At full speed the file's own torque is the right one.
    assert len([*weight_checks(trajectory, 1.0)]) == 1
    weight_path(path).write_text("something else")
    assert read_damiao_trajectory(path).foreign_weight == weight_path(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("weight_slope=0.00,", "weight_slope="), "line 2: expected weight_slope"),
        (("j1_inertia", "j1_weight"), "line 3: expected the columns"),
        (("0.396000", "x"), "below line 3: could not convert"),
        (("0.396000", "nan"), "expected 101 rows of 5 finite numbers"),
        (("\n0.400000,1.0000,1.0000,1.0000,1.0000", ""), "expected 101 rows"),
    ],
)
def test_a_weight_that_is_damaged_is_refused(change, message, tmp_path):
    weight = np.ones_like(MOTION[1])
    path = weight_path(with_file(tmp_path, weight, weight).path)
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(InputError, match=message):
        read_damiao_trajectory(tmp_path / DAMIAO_NAME)


def test_a_weight_that_is_not_finite_is_not_written(tmp_path):
    weight = np.full_like(MOTION[1], np.nan)
    with pytest.raises(InputError, match="not finite"):
        with_file(tmp_path, weight, weight)


def test_what_is_fed_is_held_against_limits(tmp_path):
    """The torque of the file is within the motors' reach; that of its weight is not."""
    weight = np.full_like(MOTION[1], 90.0)
    trajectory = with_file(tmp_path, weight, 0.0 * weight)
    limits = Limits(torque=np.full(2, 50.0))
    stated = [(limits, "a limit", "a remedy", Level.REFUSES)]
    remarks = [*limit_checks(trajectory, 0.5, stated)]
    assert len(remarks) == 2 and "torque 90 N·m is beyond" in remarks[0].text


@pytest.mark.parametrize(("share", "is_said"), [(1.1, False), (1.4, True), (0.6, True)])
def test_a_file_of_another_model_is_said_but_played(share, is_said):
    robot = small_arms.robot_of(small_arms.serial_arm((small_arms.Y, small_arms.Y)))
    time, q, qd, _ = MOTION
    trajectory = trajectory_of((time, q + 1.0, qd, q), "DM4310", "DM4310")
    needed = with_weight_of(robot, trajectory)
    tau = share * ArmDynamics(robot)(Motion(time, q + 1.0, qd, needed.qdd))
    assert np.sqrt(np.mean(tau**2, axis=0))[0] > 2.0
    played = trajectory_of((time, q + 1.0, qd, tau), "DM4310", "DM4310")
    remarks = [*torque_checks(Plan(played), robot)]
    said = [remark for remark in remarks if "needs is fed" in remark.text]
    assert bool(said) == is_said
    assert all(remark.level is Level.SAYS for remark in said)


def test_a_run_takes_the_models_weight_or_that_beside_its_file(tmp_path, arm_file):
    weight = np.ones_like(MOTION[1])
    path = with_file(tmp_path, weight, weight).path
    run = MotorRun(RunOptions.of({"trajectory": path}))
    np.testing.assert_array_equal(run.plan().trajectory.weight, weight)
    model = arm_file(DAMPED)
    options = RunOptions.of({"trajectory": path, "model": model})
    planned = MotorRun(options).plan().trajectory
    expected = with_weight_of(small_arms.robot_of(DAMPED), planned)
    np.testing.assert_allclose(planned.weight, expected.weight)
    values = {"trajectory": path, "record": weight_path(path), "overwrite": True}
    with pytest.raises(InputError, match="would overwrite a file that is read"):
        MotorRun(RunOptions.of(values)).plan()

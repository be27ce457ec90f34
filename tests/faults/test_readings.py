"""Other readings of a log: what may blame a joint; gears, and motors that turn two joints."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.faults.plausibility import structural
from robot_sysid.faults.reading_search import ReadingSearch, gain_between, is_own
from robot_sysid.faults.readings import Mistake, Reading, gear_of, turned_signs
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.messages import Level
from tests.faults.conftest import fit_of, found_in

QUESTION = Question(EstimationOptions())


def sign_of(robot, joint):
    """Return the reading in which the torque of one joint is turned."""
    (mistake,) = (
        each
        for each in turned_signs(robot, [joint])
        if np.all(np.diag(each.reading.position) > 0.0)
        and np.sum(np.diag(each.reading.torque) < 0.0) == 1
    )
    return mistake.reading


@pytest.mark.parametrize("blamed", range(4))
def test_what_another_joint_gains_alone_blames_no_joint(right, blamed):
    """Friction of a wrist, which no term has, is followed by a false sign of any other joint."""
    reading = sign_of(right.arm.robot, blamed)
    for gaining in range(4):
        share = np.where(np.arange(4) == gaining, 0.2, 1.0)
        after = replace(right, noise=share * right.noise)
        assert is_own(right, after, reading) is (gaining == blamed)


def test_what_is_less_than_friction_leaves_blames_no_joint(right):
    """Unless several joints gain, or nearly all of it goes."""
    reading = sign_of(right.arm.robot, 1)
    own = np.arange(4) == 1
    # As friction of a real joint is, in rows that tell little apart.
    right = replace(right, correlation=0.1 * right.sums.row_counts)
    assert right.noise[1] < structural(right)[1]
    for share, is_blamed in ((0.5, False), (0.3, True)):
        after = replace(right, noise=np.where(own, share, 1.0) * right.noise)
        assert is_own(right, after, reading) is is_blamed
    every = replace(right, noise=0.5 * right.noise)
    assert is_own(right, every, reading)


@pytest.mark.parametrize("factor", [1e-3, 7.0])
def test_what_friction_leaves_is_in_the_unit_of_the_torque(four_joints, right, factor):
    scaled = fit_of(four_joints, tau=factor * four_joints.log.tau)
    np.testing.assert_allclose(structural(scaled), factor * structural(right), rtol=0.2)


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_a_log_is_no_likelier_because_its_torques_are_smaller(right, factor):
    """Noise of torques that are multiplied is that of the recorded ones."""
    reading = Reading.with_torque_times(np.full(4, factor))
    scaled = replace(right, noise=factor * right.noise)
    assert gain_between(right, scaled, reading) == pytest.approx(0.0, abs=1e-9)
    search = ReadingSearch(right)
    # What is left is not scaled: a right log is likelier as it is.
    mistake = Mistake(FaultName.TORQUE_SCALE, "", reading)
    assert search.score([mistake], 1e-3) < search.score([], 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("is_of_motor", [False, True])
@pytest.mark.parametrize("factor", [2.2, 0.4])
def test_a_gear_is_found_with_its_ratio(four_joints, factor, is_of_motor):
    """Read with the true ratio, the log would be right."""
    true = gear_of(four_joints.robot, 1, factor, is_of_motor).reading
    log = four_joints.log
    q = log.q @ np.linalg.inv(true.position).T
    tau = log.tau @ np.linalg.inv(true.torque).T
    (found,) = found_in(four_joints, q=q, qd=None, tau=tau)
    assert found.about is FaultName.ANGLE_UNIT and found.level is Level.REFUSES
    assert ("its torque" in found.text) is is_of_motor
    read = float(re.search("joint1 reads ([0-9.]+) times", found.text)[1])
    assert read == pytest.approx(1.0 / factor, rel=0.05)
    assert found.correction is not None


@pytest.mark.slow
@pytest.mark.parametrize("turns", [[[1.0, 0.0], [1.0, 1.0]], [[1.0, 1.0], [1.0, -1.0]]])
def test_motors_that_turn_two_joints_are_named_with_them(four_joints, turns):
    """Two motors of a differential, or one that turns with the joint before it."""
    log = four_joints.log
    motors = np.eye(4)
    motors[1:3, 1:3] = turns
    q = log.q @ motors.T
    tau = log.tau @ np.linalg.inv(motors)
    (found,) = found_in(four_joints, q=q, qd=None, tau=tau)
    assert found.about is FaultName.COUPLING and found.level is Level.REFUSES
    assert "joints joint1 and joint2" in found.text
    # No line of a columns file makes one column of two.
    assert found.correction is None


def test_torque_without_noise_is_doubted_and_any_sensors_is_not(four_joints):
    """Its friction is a formula as well; a simulation looks the same, and may be accepted."""
    friction = 0.3 * np.sign(four_joints.motion.qd) + 0.2 * four_joints.motion.qd
    exact = four_joints.rigid + friction
    (found,) = found_in(four_joints, tau=exact)
    assert (found.about, found.level) == (FaultName.COMPUTED, Level.DOUBTS)
    noise = np.random.default_rng(0).normal(size=exact.shape)
    size = 0.005 * np.sqrt(np.mean(exact**2, axis=0))
    assert found_in(four_joints, tau=exact + size * noise) == ()

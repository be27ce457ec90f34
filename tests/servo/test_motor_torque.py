"""Gains by torques that logs have beside their commands: which are used, and how well they tell."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter

import robot_sysid.records.usual_errors as usual_errors
from rigs.arms.servo_fits import servo_fit
from rigs.arms.small_arms import robot_of
from rigs.logs import servo_logs
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.records import Recording
from robot_sysid.records.messages import Progress
from robot_sysid.records.servo_setting import parse_servo_setting
from robot_sysid.servo.fit import fit_servos, likely_gains
from robot_sysid.servo.loop import low_pass_motion
from robot_sysid.servo.motor_torque import TorqueFault, TorqueGains, gains_by_torque
from robot_sysid.servo.played_fit import Searched, Solved
from robot_sysid.servo.unknowns import DEVIATIONS, NAMES, column, numbers_at

ARM = """<mujoco><worldbody><body>
<joint name="lift" axis="0 1 0" range="-2 2" damping=".1"/>
<inertial pos=".1 0 .02" mass="{lift}" diaginertia="2e-4 5e-4 5e-4"/>
<body pos=".15 0 0"><joint name="elbow" axis="0 1 0" range="-2 2" damping=".1"/>
<inertial pos=".05 0 0" mass="{elbow}" diaginertia="1e-4 2e-4 2e-4"/></body></body></worldbody>
<actuator><position joint="lift" kp="17.8"/><position joint="elbow" kp="17.8"/></actuator>
</mujoco>"""
GAINS = [14.0, 12.0]
TRUTH = servo_logs.servos([GAINS, [0.5, 0.4], [0.06, 0.05], [0.025, 0.03]], 0.035, 3.0)
GAIN = column("gain")


def arm(share=1.0):
    """An arm whose links have a share of their mass."""
    return robot_of(ARM.format(lift=0.4 * share, elbow=0.2 * share))


@pytest.fixture(scope="module")
def piece():
    """A log of the true arm, with the torques of its motors and 2 % of noise in them."""
    time, command = servo_logs.sines_and_steps(8.0)
    command = 1.5 * command
    q = servo_logs.positions(arm(), time, command, TRUTH, steps=40)
    torque = servo_logs.motor_torques(arm(), time, command, TRUTH, steps=40)
    noise = np.random.default_rng(1).normal(size=torque.shape)
    torque = torque + 0.02 * np.std(torque, axis=0) * noise + 0.05
    return Recording(time, q, None, command - q, command=command, motor_torque=torque)


def gains(piece, torque, pieces=(), links_off=1.0):
    """The gains by a torque that the log has in place of its own; all else is known."""
    robot = arm()
    fit = servo_fit(robot, gain=GAINS, torque_limit=3.0, command_delay=0.035)
    x = fit.x.copy()
    x[:, GAIN] += np.log(links_off) / DEVIATIONS[GAIN]
    error = np.full_like(x, 0.01)
    logs = [replace(piece, motor_torque=torque), *pieces]
    return gains_by_torque(robot, logs, np.arange(2), likely_gains(robot), x, error)


def found(by_torque):
    """Gains [N m/rad] and their relative errors."""
    return (
        17.8 * numbers_at(_columns(by_torque.x))[:, GAIN],
        DEVIATIONS[GAIN] * by_torque.error,
    )


def _columns(x):
    table = np.zeros((len(x), len(NAMES)))
    table[:, GAIN] = x
    return table


# --- what a torque tells -------------------------------------------------------------------------


@pytest.mark.parametrize("links_off", [0.8, 1.0, 1.25])
def test_a_gain_is_that_of_the_torque_whatever_the_links_weigh(piece, links_off):
    """Also with an offset; its error is that of the torque constant."""
    by_torque = gains(piece, piece.motor_torque, links_off=links_off)
    numbers, errors = found(by_torque)
    assert by_torque.faults == (None, None)
    assert_allclose(numbers, GAINS, rtol=0.02)
    assert_allclose(errors, usual_errors.TORQUE_FROM_CURRENT, rtol=0.05)


def test_a_torque_that_reads_more_makes_the_gain_more(piece):
    numbers, _ = found(gains(piece, piece.motor_torque))
    more, _ = found(gains(piece, 1.2 * piece.motor_torque))
    assert_allclose(more, 1.2 * numbers, rtol=1e-9)


def test_noise_makes_the_gain_less_sure(piece):
    rng = np.random.default_rng(2)
    before = np.zeros(2)
    for share in (0.3, 1.0):
        noise = share * np.std(piece.motor_torque, axis=0) * rng.normal(size=(400, 2))
        numbers, errors = found(gains(piece, piece.motor_torque + noise))
        assert np.all(errors > before)
        assert np.all(np.abs(np.log(numbers / GAINS)) < 3.0 * errors)
        before = errors


@pytest.mark.parametrize(
    "read",
    [
        lambda torque: np.vstack((torque[:1], torque[:1], torque[:-2])),
        lambda torque: lfilter([0.25], [1.0, -0.75], torque, axis=0),
    ],
    ids=["late by 40 ms", "averaged over 60 ms"],
)
def test_a_torque_may_be_late_or_averaged(piece, read):
    numbers, errors = found(gains(piece, read(piece.motor_torque)))
    assert_allclose(numbers, GAINS, rtol=0.05)
    assert np.all(errors < 0.35)


def test_back_emf_in_a_current_is_no_gain(piece):
    _, qd, _ = low_pass_motion(piece)
    numbers, _ = found(gains(piece, piece.motor_torque - 0.25 * qd))
    assert_allclose(numbers, GAINS, rtol=0.03)


def test_a_log_of_another_register_has_the_gain_of_the_first_one(piece):
    """Half as much register: the same torque is one of twice the gain in the first recording."""
    first = replace(piece, motor_torque=None, setting=parse_servo_setting("kp=400"))
    other = replace(piece, setting=parse_servo_setting("kp=200"))
    robot = arm()
    fit = servo_fit(robot, gain=[28.0, 24.0], torque_limit=3.0, command_delay=0.035)
    by_torque = gains_by_torque(
        robot,
        [first, other],
        np.arange(2),
        likely_gains(robot),
        fit.x,
        np.full_like(fit.x, 0.01),
    )
    numbers, _ = found(by_torque)
    assert_allclose(numbers, [28.0, 24.0], rtol=0.02)


def test_logs_without_torques_say_nothing(piece):
    assert gains(piece, None) is None


# --- what is none --------------------------------------------------------------------------------


def weight(piece):
    """The torque of the model's links."""
    return LinkDynamics(arm()).motion(*low_pass_motion(piece)).torque(arm().thetas)


WRONG = {
    "swapped joints": (lambda piece: piece.motor_torque[:, ::-1], {TorqueFault.APART}),
    "sign": (lambda piece: -piece.motor_torque, {TorqueFault.APART}),
    "size alone": (lambda piece: np.abs(piece.motor_torque), {TorqueFault.APART}),
    "noise": (
        lambda piece: np.random.default_rng(3).normal(size=piece.q.shape),
        {TorqueFault.APART},
    ),
    "positions": (lambda piece: piece.q, {TorqueFault.APART}),
    "milliamperes": (
        lambda piece: 1000.0 * piece.motor_torque,
        {TorqueFault.OTHER_SIZE},
    ),
    "three times": (lambda piece: 3.0 * piece.motor_torque, {TorqueFault.OTHER_SIZE}),
    "zeros": (lambda piece: 0.0 * piece.q, {TorqueFault.ZERO}),
    "commanded effort": (
        lambda piece: np.round(GAINS * (piece.command - piece.q), 3),
        {TorqueFault.COMPUTED},
    ),
    "the model's torque": (weight, {TorqueFault.COMPUTED, TorqueFault.APART}),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_torque_of_the_motor_is_not_used(piece, name):
    make, faults = WRONG[name]
    by_torque = gains(piece, make(piece))
    assert not np.any(by_torque.is_used)
    assert {*by_torque.faults} <= faults
    notes = [*by_torque.notes]
    assert len(notes) == len({*by_torque.faults})
    assert all("not used" in note for note in notes)
    # And nothing else changes by it.
    solved = solved_of(np.eye(len(NAMES) + 1), np.zeros(2))
    same = by_torque.weigh_into(solved)
    assert_array_equal(same.at.x, solved.at.x)
    assert_array_equal(same.covariance, solved.covariance)
    mean = np.full((2, len(NAMES)), 0.3)
    known = by_torque.beside(mean, 0.7 + mean)
    assert_array_equal(known, (mean[:, GAIN], 0.7 + mean[:, GAIN]))


def test_joints_are_judged_one_by_one(piece):
    torque = piece.motor_torque * [1.0, 1000.0]
    by_torque = gains(piece, torque)
    assert by_torque.faults == (None, TorqueFault.OTHER_SIZE)
    used, refused = by_torque.notes
    assert "by themselves lift ± 10 %" in used and "elbow" not in used
    assert "torques of elbow are not used" in refused and "unit" in refused


def test_what_computes_most_torques_computes_the_rest(piece):
    """A log that copies the position error of one joint of two has measured neither."""
    torque = piece.motor_torque.copy()
    torque[:, 0] = 14.0 * (piece.command - piece.q)[:, 0]
    by_torque = gains(piece, torque)
    assert by_torque.faults == (TorqueFault.COMPUTED, TorqueFault.COMPUTED)
    assert not np.any(by_torque.is_used)
    (note,) = by_torque.notes
    assert "lift, elbow are not used" in note


def test_a_joint_without_weight_has_the_unit_of_the_others(piece):
    """Its own links would not show that it is off by three."""
    robot = arm()
    fit = servo_fit(robot, gain=GAINS, torque_limit=3.0, command_delay=0.035)
    error = np.full_like(fit.x, 0.01)
    error[1, GAIN] = 0.5
    likely = likely_gains(robot)
    for factors, faults in {
        (1.0, 3.0): (None, None),
        (3.0, 3.0): (TorqueFault.OTHER_SIZE, TorqueFault.OTHER_SIZE),
    }.items():
        log = replace(piece, motor_torque=factors * piece.motor_torque)
        found = gains_by_torque(robot, [log], np.arange(2), likely, fit.x, error)
        assert found.faults == faults


# --- how it is weighed ---------------------------------------------------------------------------


def solved_of(covariance, gain):
    """What a search of two joints found, whose only link error goes with the gain."""
    x = np.zeros((2, len(NAMES)))
    x[:, GAIN] = gain
    at = Searched(x, np.zeros((2, 1)), np.zeros((2, 0)))
    return Solved(at, np.ones(2), np.ones(2), np.stack((covariance, covariance)))


def test_a_measurement_is_weighed_by_its_precision():
    """Gain and links change together, as the data shows their ratio; other numbers stay."""
    covariance = np.eye(len(NAMES) + 1)
    covariance[GAIN, GAIN] = 0.04 + 1e-4
    covariance[-1, -1] = 0.04
    covariance[GAIN, -1] = covariance[-1, GAIN] = 0.04
    known = TorqueGains(
        ("a", "b"), np.full(2, 0.5), np.array([0.1, np.inf]), (None, None)
    )
    weighed = known.weigh_into(solved_of(covariance, np.full(2, 0.2)))
    precision = 1.0 / 0.0401 + 1.0 / 0.01
    mean = (0.2 / 0.0401 + 0.5 / 0.01) / precision
    assert_allclose(weighed.at.x[:, GAIN], [mean, 0.2])
    assert_allclose(weighed.covariance[:, GAIN, GAIN], [1.0 / precision, 0.0401])
    ratio = weighed.at.links[0, 0] / (weighed.at.x[0, GAIN] - 0.2)
    assert ratio == pytest.approx(0.04 / 0.0401)
    others = np.delete(weighed.at.x, GAIN, axis=1)
    assert not np.any(others)
    direct = np.linalg.inv(
        np.linalg.inv(covariance)
        + 100.0 * np.outer(*[np.eye(len(covariance))[GAIN]] * 2)
    )
    assert_allclose(weighed.covariance[0], direct, atol=1e-12)


def test_what_is_known_before_is_weighed_alike():
    known = TorqueGains(("a",), np.array([0.5]), np.array([0.1]), (None,))
    mean = np.full((1, len(NAMES)), 0.2)
    middle, deviation = known.beside(mean, 0.0 * mean + 0.2)
    assert_allclose(middle, (0.2 * 25.0 + 0.5 * 100.0) / 125.0)
    assert_allclose(deviation, 125.0**-0.5)


@pytest.mark.slow
def test_a_torque_narrows_the_gain_of_links_that_are_off(piece):
    """By a fifth; a torque that is none leaves all numbers as they are without it."""
    robot = arm(1.2)
    fits = {
        name: fit_servos(robot, [replace(piece, motor_torque=torque)], Progress())
        for name, torque in {
            "none": None,
            "right": piece.motor_torque,
            "swapped": piece.motor_torque[:, ::-1],
        }.items()
    }
    without, right, swapped = fits.values()
    scale = DEVIATIONS[GAIN]
    errors = {
        name: scale * np.sqrt(fit.covariance[:, GAIN, GAIN])
        for name, fit in fits.items()
    }
    assert np.all(errors["right"] < 0.8 * errors["none"])
    assert np.all(errors["right"] < 0.11)
    off = np.log(right.over_gain[:, GAIN] / GAINS)
    assert np.all(np.abs(off) < 3.0 * errors["right"])
    off_without = np.log(without.over_gain[:, GAIN] / GAINS)
    assert np.all(np.abs(off) < 0.6 * np.abs(off_without))
    # What the file holds is as it plays with the file's links.
    assert_allclose(right.in_file.numbers, without.in_file.numbers, rtol=0.02)
    for name in ("x", "covariance", "given_links", "mean", "deviation", "held_x"):
        assert_array_equal(getattr(swapped, name), getattr(without, name))
    assert_array_equal(swapped.in_file.numbers, without.in_file.numbers)
    # The fit of the whole log goes on with it.
    whole = fit_servos(robot, [piece], Progress(), right)
    assert whole.by_torque is not None
    assert_allclose(whole.by_torque.x, right.by_torque.x, rtol=1e-3)
    assert np.all(scale * np.sqrt(whole.covariance[:, GAIN, GAIN]) < 0.11)

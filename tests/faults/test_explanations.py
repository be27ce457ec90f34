"""Explanations of wrong logs: each fault is named, and its remedy puts the log right."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rigs.arms.drawn_models import drawn_model
from rigs.arms.small_arms import robot_of
from rigs.arms.wrong_arms import link_torque, resting_torque, truth_of
from robot_sysid.dynamics.inverse_dynamics import gravity_vector, turn_gravity
from robot_sysid.records.messages import Level
from tests.faults.conftest import findings_of, found_in, slow


def of_joint(torque, joint):
    """Return the torque (N, 4) of a torque (N,) at one joint."""
    return np.outer(torque, np.arange(4) == joint)


def delay_joint(truth, joint):
    """Return the torque (N, 4) of the log with one joint late by 60 ms."""
    tau = truth.log.tau.copy()
    tau[15:, joint] = tau[:-15, joint]
    return tau


def hum(truth, joint):
    """Return a sine (N, 4) of a sixth of one joint's torque."""
    size = 0.15 * np.sqrt(np.mean(truth.rigid[:, joint] ** 2))
    return of_joint(size * np.sin(3.8 * truth.log.time), joint)


def spring(truth, joint):
    """Return the torque (N, 4) of a spring at one joint."""
    q = truth.log.q[:, joint]
    stiffness = 0.5 * np.std(truth.rigid[:, joint]) / np.std(q)
    return of_joint(stiffness * (q - 0.4), joint)


def weight(truth, gravity):
    """Return the torque (N, 4) of all links at rest under a gravity (3,) [m/s^2]."""
    gravity = np.array(gravity)
    return resting_torque(truth.robot, truth.motion.q, truth.arm.thetas, gravity)


def tilt(truth, angles):
    """Return the torque (N, 4) of a base that is turned by angles about x and y [rad]."""
    down = turn_gravity(gravity_vector(truth.robot), np.array(angles))
    return weight(truth, down) - truth.still


def pull(truth, force):
    """Return the torque (N, 4) of a force (3,) at the last link's origin [N]."""
    unit_mass = np.zeros((4, 10))
    unit_mass[-1, 0] = 1.0
    return resting_torque(truth.robot, truth.motion.q, unit_mass, np.array(force))


def late_payload(truth, instant=6.3):
    """Return the torque (N, 4) of 80 % of the last link, added at an instant [s]."""
    thetas = np.zeros((4, 10))
    thetas[-1] = 0.8 * truth.theta
    torque = link_torque(truth.robot, truth.motion, thetas)
    return torque * (truth.log.time > instant)[:, None]


TORQUES = {
    "tilt & contact: torque of joint joint1 hums: a sine of": lambda t: (
        t.log.tau + tilt(t, (0.07, -0.05)) + hum(t, 1)
    ),
    "payload-step: the last link carries & crosstalk: the torque of joint joint2 holds": (
        lambda t: t.log.tau + late_payload(t) + of_joint(0.3 * t.rigid[:, 1], 2)
    ),
    "force: a constant force of & delay: torque of joint joint2 is": lambda t: (
        delay_joint(t, 2) + pull(t, (4.0, 3.0, 0.0))
    ),
    "force: at joint joint2 a torque follows & torque-scale: the torque scale of all joints "
    "rises by": lambda t: t.log.tau * (1.0 + 0.03 * t.log.time)[:, None] + spring(t, 2),
    "force: of the links' weight is missing": lambda t: t.log.tau - 0.6 * t.still,
    "gravity": lambda t: t.log.tau - t.rigid,
    "torque-scale: multiply the masses": lambda t: 4.0 * t.log.tau,
    # Of N·cm and ozf·in the error leaves both.
    "torque-unit: motor currents or counts": lambda t: 100.0 * t.log.tau,
    "torque-scale: torque of joint joint3 alone reads": lambda t: (
        t.log.tau * [1.0, 1.0, 1.0, 1e3]
    ),
    "torque-scale: torque of joint joint1 reads": lambda t: (
        t.log.tau * [1.0, 0.5, 1.0, 1.0]
    ),
    "computed": lambda t: t.rigid,
    "sign": lambda t: t.log.tau * [1.0, -1.0, 1.0, 1.0],
    "delay": lambda t: np.roll(t.log.tau, 10, axis=0),
}
"""Names of checks and their messages to a torque (N, 4) for which they have to come; for all
faults, on public arms, see benchmarks/trust/confusion.py."""
CLOCK = "clock: too long, or a balancer carries a part of the weight"
HALVED = "clock: time in the log is 0.5 times as long as it was"
DOUBLED = "clock: time in the log is 2 times as long as it was"
RADIANS = "angle-unit: positions look like radians that were taken for degrees"
GEAR = "angle-unit: joint joint1 reads 0.5"
SAMPLES = {
    GEAR: lambda log: {"q": log.q * [1.0, 0.5, 1.0, 1.0], "qd": None},
    "order": lambda log: {
        name: vars(log)[name][:, ::-1] for name in ("q", "qd", "tau")
    },
    "angle-unit": lambda log: {"q": np.degrees(log.q), "qd": np.degrees(log.qd)},
    "zero": lambda log: {"q": log.q + [0.0, 0.15, 0.0, 0.0]},
    "clock: the clock drifts": lambda log: {
        "time": log.time * (1.0 + 0.008 * log.time),
        "qd": None,
    },
    CLOCK: lambda log: {"time": 1.3 * log.time, "qd": None},
    HALVED: lambda log: {"time": 0.5 * log.time, "qd": None},
    DOUBLED: lambda log: {"time": 2.0 * log.time, "qd": None},
    "clock: by the recorded velocities": lambda log: {"time": 1.15 * log.time},
}
"""Name of a check and its message to the samples of a log for which it has to come."""


@pytest.fixture(scope="module")
def check(four_joints):
    """Return a function of a fault that returns (log with the fault, its findings), run once.

    The torques were divided by two already, which advised scales have to include.
    """

    @cache
    def check_fault(fault):
        if fault in TORQUES:
            samples = {"tau": TORQUES[fault](four_joints)}
        else:
            samples = SAMPLES[fault](four_joints.log)
        log = replace(four_joints.log, **samples)
        return log, findings_of(four_joints.robot, log, divided=2.0)

    return check_fault


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("faults", [*TORQUES, *SAMPLES])
def test_faults_are_called_by_their_names(check, faults):
    _, findings = check(faults)
    for fault in faults.split(" & "):
        name, _, message = fault.partition(": ")
        named = [f for f in findings if f.about == name and message in f.sentence]
        assert named, findings


@pytest.mark.slow
def test_torque_without_weight_is_no_mounting_on_a_wall(four_joints):
    (finding,) = found_in(four_joints, tau=four_joints.log.tau - four_joints.still)
    assert finding.about == "gravity"


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("share", ["still", "rigid"])
@pytest.mark.parametrize(
    ("arm", "columns"),
    [
        ("ur10e", ("actual_current with --torque-constants",)),
        ("fr3_on_ur5e", ("tau_J, and not", "actual_current with")),
        ("arm", ("measured joint torque", "motor current")),
    ],
)
def test_torque_without_weight_ends_with_the_column_to_record(
    four_joints, arm, columns, share
):
    """What the arm's controller calls it, of an arm of any other maker what it is."""
    robot = replace(four_joints.robot, path=Path(arm, "model.xml").absolute())
    tau = four_joints.log.tau - getattr(four_joints, share)
    found = findings_of(robot, replace(four_joints.log, tau=tau))
    (finding,) = (each for each in found if each.about == "gravity")
    assert finding.level is Level.REFUSES
    assert all(column in finding.remedy for column in columns), finding


def number_after(phrase, text):
    """Return the number that follows a phrase in a text."""
    return float(re.search(re.escape(phrase) + " ([0-9.e-]+)", text)[1])


def correct_torques(log, finding):
    """Return a log with its torques corrected as the finding says."""
    order, factors = zip(*finding.correction.torque)
    return replace(log, tau=log.tau[:, list(order)] * factors)


@pytest.mark.slow
@pytest.mark.parametrize("instant", [5.4, 7.64, *slow(5.96, 6.52, 7.08)])
def test_a_change_of_load_is_within_its_error_at_any_instant(four_joints, instant):
    """The instant need not be that of a row, of which there are a few per second."""
    tau = four_joints.log.tau + late_payload(four_joints, instant)
    findings = found_in(four_joints, tau=tau)
    (text,) = (found.text for found in findings if found.about == "payload-step")
    mass, error = map(float, re.search("carries (.*) ± (.*) kg more", text).groups())
    true_mass = 0.8 * four_joints.theta[0]
    assert abs(mass - true_mass) < 2.0 * error < 0.2 * true_mass
    assert number_after("from about", text) == pytest.approx(instant, abs=0.1)


def correct_positions(log, finding):
    """Return a log with its positions corrected as the finding says."""
    order, factors = zip(*finding.correction.position)
    return replace(log, q=log.q[:, list(order)] * factors)


def with_right_time(log, finding):
    """Return a log whose time is scaled as the finding says."""
    return replace(log, time=number_after("time =", finding.remedy) * log.time)


REMEDIES = {
    CLOCK: with_right_time,
    HALVED: with_right_time,
    DOUBLED: with_right_time,
    "torque-scale: torque of joint joint1 reads": lambda log, finding: replace(
        log,
        tau=log.tau / (0.5 * np.array(finding.options[0][1].split(","), dtype=float)),
    ),
    GEAR: correct_positions,
    "sign": correct_torques,
    "angle-unit": lambda log, _: replace(
        log, q=np.radians(log.q), qd=np.radians(log.qd)
    ),
    "torque-scale: multiply the masses": lambda log, finding: replace(
        # Torques were divided by two already.
        log,
        tau=log.tau / (0.5 * float(finding.options[1][1].partition("+-")[0])),
    ),
}
"""Fault to the log that its finding advises."""


@pytest.mark.slow
@pytest.mark.parametrize("fault", REMEDIES)
def test_the_advised_remedy_puts_the_log_right(check, four_joints, fault):
    log, findings = check(fault)
    named = next(each for each in findings if fault.startswith(each.about))
    remedied = REMEDIES[fault](log, named)
    assert findings_of(four_joints.robot, remedied) == ()
    # A log that is as wrong the other way may be found right: links hide it.
    assert remedied.time == pytest.approx(four_joints.log.time, rel=0.06)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "scale", "pull"), [(5, 0.12, 0.0), (1, 0.0, 0.5)])
def test_torque_scales_or_a_tilted_base_are_no_fault_of_the_clock(
    four_joints, seed, scale, pull
):
    """Deviations that the prior allows must not pass for another fault; pull in m/s^2."""
    truth = truth_of(four_joints.robot, seed)
    torque = weight(truth, [pull, 0.6 * pull, 0.0])
    scales = 1.0 + scale * np.array([1.0, -1.0, 1.0, -1.0])
    findings = found_in(truth, tau=(truth.log.tau + torque) * scales)
    assert {finding.about for finding in findings} <= {"torque-scale", "tilt"}, findings


@cache
def drawn_log(seed):
    """Return (model, log) of an arm that is drawn at random, its links off by a tenth."""
    robot = robot_of(drawn_model(np.random.default_rng(seed)))
    return robot, replace(truth_of(robot, seed, 0.1).log, qd=None)


OTHERWISE = {
    DOUBLED: lambda log: {"time": 2.0 * log.time},
    HALVED: lambda log: {"time": 0.5 * log.time},
    RADIANS: lambda log: {"q": np.radians(log.q)},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        (2, DOUBLED),
        *slow((3, HALVED), (3, DOUBLED), (2, HALVED), (2, RADIANS), (3, RADIANS)),
    ],
)
def test_a_wrong_time_or_unit_shows_in_an_arm_whose_links_take_it_up(case):
    """Such a log fits: most joints hardly have inertia, or weight, of which it would take away."""
    seed, name = case
    robot, log = drawn_log(seed)
    assert findings_of(robot, log) == ()
    (found,) = findings_of(robot, replace(log, **OTHERWISE[name](log)))
    assert f"{found.about}: {found.text}".startswith(name)

"""Explanations of wrong logs: each fault is named, and its remedy puts the log right."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.diagnosis.log_checks import check_against_model
from robot_sysid.dynamics.newton_euler import (
    LinkDynamics,
    gravity_vector,
    turn_gravity,
    with_gravity,
)
from robot_sysid.estimation.question import EstimationOptions
from tests.support import arms
from tests.support.wrong_logs import truth_of

AXES = (arms.Z, arms.Y, arms.Y, arms.X)
JOINT = 'range="-2.5 2.5" frictionloss=".4" damping=".2"'
ROBOT = arms.robot_of(arms.serial_arm(AXES, joint=JOINT))


@pytest.fixture(scope="module")
def four_joints():
    """Return a correct log of an arm of four joints and its truth."""
    return truth_of(ROBOT, 4)


def with_contact(truth):
    """Return the torque with half a second of contact."""
    is_touching = (truth.log.time > 5.0) & (truth.log.time < 5.5)
    size = 0.7 * np.max(np.abs(truth.rigid), axis=0)
    return truth.log.tau + np.outer(is_touching, size)


def with_late_joint(truth, joint):
    """Return the torque with one joint late by 60 ms."""
    tau = truth.log.tau.copy()
    tau[15:, joint] = tau[:-15, joint]
    return tau


def hum(truth, joint):
    """Return a sine of a sixth of one joint's torque (K, n)."""
    size = 0.15 * np.sqrt(np.mean(truth.rigid[:, joint] ** 2))
    return np.outer(size * np.sin(3.8 * truth.log.time), np.arange(4) == joint)


def true_links(truth):
    return np.array([*(link.theta for link in ROBOT.links[:-1]), truth.theta])


def resting_torque(robot, q, thetas, *gravity):
    """Return the torque (K, n) of bodies (n, 10) at rest at positions (K, n)."""
    zero = np.zeros_like(q)
    return LinkDynamics(robot, *gravity).motion(q, zero, zero).torque(thetas)


def tilted_weight(truth, angles):
    """Return the torque (K, n) at rest under a gravity turned by angles about x and y [rad]."""
    down = turn_gravity(gravity_vector(ROBOT), np.array(angles))
    robot = with_gravity(ROBOT, down)
    return resting_torque(robot, truth.log.q, true_links(truth))


def pull(truth, force):
    """Return the torque (K, n) of a force [N] at the last link's origin."""
    unit_mass = np.zeros((4, 10))
    unit_mass[-1, 0] = 1.0
    return resting_torque(ROBOT, truth.log.q, unit_mass, np.array(force))


def spring(truth, joint):
    """Return the torque (K, n) of a spring at one joint."""
    q = truth.log.q
    stiffness = 0.5 * np.std(truth.rigid[:, joint]) / np.std(q[:, joint])
    return stiffness * (q[:, [joint]] - 0.4) * (np.arange(4) == joint)


def late_payload(truth, share):
    """Return the torque (K, n) of a share of the last link that is added halfway."""
    log = truth.log
    thetas = np.zeros((4, 10))
    thetas[-1] = share * truth.theta
    qd = np.gradient(log.q, log.time, axis=0)
    qdd = np.gradient(log.qd, log.time, axis=0)
    torque = LinkDynamics(ROBOT).motion(log.q, qd, qdd).torque(thetas)
    return torque * (log.time > 6.3)[:, None]


FAULTS = {
    "tilt": lambda t: {"tau": t.log.tau + tilted_weight(t, (0.07, -0.05)) - t.still},
    "payload-step: the last link carries": lambda t: {
        "tau": t.log.tau + late_payload(t, 0.8)
    },
    "force: a constant force of": lambda t: {
        "tau": t.log.tau + pull(t, (4.0, 3.0, 0.0))
    },
    "force: at joint joint1 a torque follows": lambda t: {
        "tau": t.log.tau + spring(t, 1)
    },
    "gravity: of the links' weight is missing": lambda t: {
        "tau": t.log.tau - 0.6 * t.still
    },
    "torque-scale: changes its scale by": lambda t: {
        "tau": t.log.tau * (1.0 + 0.03 * t.log.time)[:, None]
    },
    "crosstalk: the torque of joint joint2 holds": lambda t: {
        "tau": t.log.tau + 0.3 * t.rigid[:, [1]] * [0.0, 0.0, 1.0, 0.0]
    },
    "torque-scale": lambda t: {"tau": t.log.tau / 101.0},
    "gravity": lambda t: {"tau": t.log.tau - t.still},
    "computed": lambda t: {"tau": t.rigid},
    "sign": lambda t: {"tau": t.log.tau * [1.0, -1.0, 1.0, 1.0]},
    "order": lambda t: {
        name: getattr(t.log, name)[:, ::-1] for name in ("q", "qd", "tau")
    },
    "angle-unit": lambda t: {"q": np.degrees(t.log.q), "qd": np.degrees(t.log.qd)},
    "zero": lambda t: {"q": t.log.q + [0.0, 0.2, 0.0, 0.0]},
    "contact": lambda t: {"tau": with_contact(t)},
    "delay": lambda t: {"tau": np.roll(t.log.tau, 10, axis=0)},
    "delay: torque of joint joint2 alone": lambda t: {"tau": with_late_joint(t, 2)},
    "contact: torque of joint joint1 hums: a sine of 0.6": lambda t: {
        "tau": t.log.tau + hum(t, 1)
    },
    "torque-scale: torque of joint joint3 alone reads": lambda t: {
        "tau": t.log.tau * [1, 1, 1, 1e3]
    },
    "clock: by inertia beside gravity, the clock drifts": lambda t: {
        "time": t.log.time * (1.0 + 0.008 * t.log.time),
        "qd": None,
    },
    "clock: by inertia beside gravity, time in": lambda t: {
        "time": 1.3 * t.log.time,
        "qd": None,
    },
    "clock: by the recorded velocities, time in": lambda t: {"time": 1.15 * t.log.time},
}
"""Name of a check and its message to a fault of a log that it has to name; for all faults, on
public arms, see benchmarks/confusion.py."""


@pytest.mark.parametrize(("fault", "spoil"), FAULTS.items())
def test_a_fault_is_called_by_its_name(four_joints, fault, spoil):
    log = replace(four_joints.log, **spoil(four_joints))
    findings = check_against_model(ROBOT, [log])
    name, _, message = fault.partition(": ")
    messages = [finding.text for finding in findings if finding.name == name]
    assert any(message in text for text in messages), findings


def relabel(log, text):
    """Return a log as the columns file that a text names makes it."""
    scale = re.search(r"time = ([0-9.]+) \* TITLE", text)
    if scale:
        return replace(log, time=float(scale[1]) * log.time)
    signs = np.where([f"torque.joint{j} = -TITLE" in text for j in range(4)], -1.0, 1.0)
    return replace(log, tau=log.tau * signs)


REMEDIES = {
    "clock": lambda log, text: (relabel(log, text), EstimationOptions()),
    "sign": lambda log, text: (relabel(log, text), EstimationOptions()),
    "tilt": lambda log, text: (log, EstimationOptions(tilt="auto")),
    "delay": lambda log, text: (log, EstimationOptions(delay="auto")),
    "angle-unit": lambda log, text: (
        replace(log, q=np.radians(log.q), qd=np.radians(log.qd)),
        EstimationOptions(),
    ),
    "torque-scale": lambda log, text: (
        replace(
            log, tau=log.tau / float(re.search("reads ([0-9.e-]+) times", text)[1])
        ),
        EstimationOptions(),
    ),
}
"""Name of a check to the log and the options that its message advises."""


@pytest.mark.parametrize("name", REMEDIES)
def test_the_advised_remedy_puts_the_log_right(four_joints, name):
    spoil = {**FAULTS, "clock": lambda t: {"time": 1.3 * t.log.time, "qd": None}}[name]
    wrong = replace(four_joints.log, **spoil(four_joints))
    findings = check_against_model(ROBOT, [wrong])
    (text, *_) = [finding.text for finding in findings if finding.name == name]
    log, options = REMEDIES[name](wrong, text)
    assert check_against_model(ROBOT, [log], options) == ()


@pytest.mark.parametrize(("seed", "scale", "pull"), [(5, 0.12, 0.0), (1, 0.0, 0.5)])
def test_torque_scales_or_a_tilted_base_are_no_fault_of_the_clock(seed, scale, pull):
    """Deviations that the prior allows must not pass for another fault; pull in m/s^2."""
    truth = truth_of(ROBOT, seed)
    gravity = np.array([pull, 0.6 * pull, 0.0])
    torque = resting_torque(ROBOT, truth.log.q, true_links(truth), gravity)
    scales = 1.0 + scale * np.array([1.0, -1.0, 1.0, -1.0])
    log = replace(truth.log, tau=(truth.log.tau + torque) * scales)
    findings = check_against_model(ROBOT, [log])
    assert {finding.name for finding in findings} <= {"torque-scale", "tilt"}, findings


@pytest.mark.parametrize("divided", [[2.0] * 5, [2.0, 3.0, 4.0, 5.0, 6.0]])
def test_the_advised_scale_includes_the_applied_one(truth, divided):
    log = replace(truth.log, tau=1e3 * truth.log.tau)
    scales = []
    for applied in (None, divided):
        text = check_against_model(truth.robot, [log], divided=applied)[0].text
        numbers = re.search(r"--torque-scale ([0-9.e+,]+)", text)[1].split(",")
        scales.append([float(number) for number in numbers])
    (scale,), scales_with_applied = scales
    assert_allclose(scales_with_applied, scale * np.unique(divided), rtol=0.01)

"""Faults of logs: functions that take an arm's true motion and return a log that is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rigs.arms.wrong_arms import Truth, truth_of
from rigs.files.places import MODELS
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording

_OTHER_ARMS = {
    6: ("universal_robots_ur5e/ur5e.xml", "trossen/wxai/wxai_follower.xml"),
    7: (
        "franka_panda/panda_nohand.xml",
        "kuka_iiwa_14/iiwa14.xml",
        "ufactory_xarm7/xarm7_nohand.xml",
        "kinova_gen3/gen3.xml",
    ),
}
"""Model files of public arms by their number of joints."""


def _torque(truth: Truth, tau: np.ndarray) -> Recording:
    """Return the log with other torques (N, n)."""
    return replace(truth.log, tau=tau)


def _position(truth: Truth, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """Return the log with positions and, where it has them, velocities changed."""
    qd = truth.log.qd
    return replace(
        truth.log, q=change(truth.log.q), qd=None if qd is None else change(qd)
    )


def millinewtonmetres(truth):
    """Return the log with torques in mN m."""
    return _torque(truth, 1e3 * truth.log.tau)


def other_unit(truth):
    """Return the log with torques in N cm, kgf cm or lbf in."""
    return _torque(truth, truth.rng.choice([100.0, 10.197, 8.851]) * truth.log.tau)


def motor_side(truth):
    """Return the log with torques on the motors' side of the gears."""
    return _torque(
        truth, truth.log.tau / truth.rng.choice([50.0, 100.0, 101.0, 121.0, 160.0])
    )


def amperes(truth):
    """Return the log with motor currents, every motor with its own torque constant."""
    return _torque(
        truth, truth.log.tau / truth.rng.uniform(6.0, 14.0, truth.robot.n_joints)
    )


def per_cent(truth):
    """Return the log with torques in per cent of the motors' rated torques."""
    peak = np.max(np.abs(truth.rigid), axis=0)
    rated = np.maximum(peak, 0.1 * peak.max()) * truth.rng.uniform(0.8, 1.5, len(peak))
    return _torque(truth, 100.0 * truth.log.tau / rated)


def gravity_compensated(truth):
    """Return the log with torques from which gravity is subtracted."""
    return _torque(truth, truth.log.tau - truth.still)


def external(truth):
    """Return the log with torques from which the controller's model is subtracted."""
    return _torque(truth, truth.log.tau - truth.rigid)


def computed_torque(truth):
    """Return the log with the torques of the controller's model, not measured ones."""
    return _torque(truth, truth.rigid)


def torque_sign(truth):
    """Return the log with one joint's torque of the wrong sign."""
    sign = np.ones(truth.robot.n_joints)
    sign[carrying_joint(truth)] = -1.0
    return _torque(truth, sign * truth.log.tau)


def position_sign(truth):
    """Return the log with one joint's position of the wrong sign."""
    sign = np.ones(truth.robot.n_joints)
    sign[carrying_joint(truth)] = -1.0
    return _position(truth, lambda columns: sign * columns)


def exchanged_joints(truth):
    """Return the log with two joints exchanged in positions, in torques, or in both."""
    order = np.arange(truth.robot.n_joints)
    first = carrying_joint(truth)
    second = int(truth.rng.choice(np.delete(order, first)))
    order[[first, second]] = order[[second, first]]
    which = truth.rng.integers(3)
    log = (
        truth.log if which == 1 else _position(truth, lambda columns: columns[:, order])
    )
    return log if which == 0 else replace(log, tau=log.tau[:, order])


def reversed_order(truth):
    """Return the log with its joints from the last one to the base."""
    log = _position(truth, lambda columns: columns[:, ::-1])
    return replace(log, tau=log.tau[:, ::-1])


def degrees_as_radians(truth):
    """Return the log with positions in degrees that are read as radians."""
    return _position(truth, np.degrees)


def radians_as_degrees(truth):
    """Return the log with positions in radians that are read as degrees."""
    return _position(truth, np.radians)


def position_offset(truth):
    """Return the log with one joint's zero off, of a joint that gravity loads."""
    q = truth.log.q.copy()
    weight = np.sqrt(np.mean(truth.still**2, axis=0))
    joint = truth.rng.choice(np.flatnonzero(weight >= 0.2 * weight.max()))
    q[:, joint] += truth.rng.choice([-1.0, 1.0]) * truth.rng.uniform(0.08, 0.3)
    return replace(truth.log, q=q)


def dropped_samples(truth):
    """Return the log without a tenth of its samples; time is row number over rate."""
    rows = np.flatnonzero(truth.rng.random(len(truth.log)) > 0.1)
    log = truth.log
    return Recording(log.time[: len(rows)], log.q[rows], None, log.tau[rows])


def saturated_sensor(truth):
    """Return the log with a torque sensor that saturates for a fifth of the time."""
    tau = truth.log.tau.copy()
    joint = carrying_joint(truth)
    limit = float(np.quantile(np.abs(tau[:, joint]), 0.8))
    tau[:, joint] = np.clip(tau[:, joint], -limit, limit)
    return _torque(truth, tau)


def held(truth):
    """Return the log with a torque channel that holds its value for some seconds."""
    tau = truth.log.tau.copy()
    joint = carrying_joint(truth)
    start = int(truth.rng.integers(500, 1200))
    tau[start : start + 750, joint] = tau[start, joint]
    return _torque(truth, tau)


def collision(truth):
    """Return the log with half a second of contact."""
    tau = truth.log.tau.copy()
    start = int(truth.rng.integers(600, len(tau) - 600))
    bump = np.sin(np.linspace(0.0, np.pi, 125))[:, None]
    reach = 0.5 + 0.5 * truth.rng.random(truth.robot.n_joints)
    tau[start : start + 125] += bump * reach * np.max(np.abs(truth.rigid), axis=0)
    return _torque(truth, tau)


def late_torque(truth):
    """Return the log with torques 20 ms and more behind the positions."""
    shift = int(truth.rng.integers(5, 15))
    late = truth.log[shift:]
    return replace(late, tau=truth.log.tau[:-shift])


def clock_jump(truth):
    """Return the log with a clock that jumps ahead by some tenths of a second, twice."""
    time = truth.log.time.copy()
    for at in truth.rng.integers(500, len(time) - 500, 2):
        time[at:] += truth.rng.uniform(0.1, 0.4)
    return replace(truth.log, time=time)


def one_joint_in_millinewtonmetres(truth):
    """Return the log with the least loaded joint's torque in mN m, with little noise."""
    tau = truth.log.tau.copy()
    sound = truth.rigid + truth.friction
    joint = int(np.argmin(np.mean(sound**2, axis=0)))
    noise = 0.02 * np.max(np.abs(sound[:, joint])) * truth.rng.normal(size=len(tau))
    tau[:, joint] = 1e3 * (sound[:, joint] + noise)
    return _torque(truth, tau)


def late_joint(truth):
    """Return the log with one joint's torque 60 ms late."""
    shift = 15
    joint = carrying_joint(truth)
    tau = truth.log.tau.copy()
    tau[shift:, joint] = truth.log.tau[:-shift, joint]
    return _torque(truth, tau)[shift:]


def hum(truth):
    """Return the log with a slow sine in one joint's torque, a twelfth of its load."""
    tau = truth.log.tau.copy()
    joint = carrying_joint(truth)
    size = 0.12 * float(np.sqrt(np.mean(truth.rigid[:, joint] ** 2)))
    tau[:, joint] += size * np.sin(2.0 * np.pi * 0.47 * truth.log.time)
    return _torque(truth, tau)


def drifting_clock(truth):
    """Return the log with a clock that is fast by more and more, by 10 % at the end."""
    time = truth.log.time
    return replace(truth.log, time=time * (1.0 + 0.1 * time / time[-1]), qd=None)


def other_arm(truth):
    """Return a log of another arm with as many joints."""
    for path in truth.rng.permutation(_OTHER_ARMS[truth.robot.n_joints]):
        if not (MODELS / path).samefile(truth.robot.path):
            robot = load_robot_model(MODELS / path, None, None, 2.0)
            return truth_of(robot, int(truth.rng.integers(2**31))).log
    raise AssertionError("all public arms are the same one")


def carrying_joint(truth: Truth) -> int:
    """Return a joint, drawn from those that carry a fair part of what the strongest one carries."""
    rms_torque = np.sqrt(np.mean(truth.rigid**2, axis=0))
    return int(truth.rng.choice(np.flatnonzero(rms_torque >= 0.1 * rms_torque.max())))


_FAULTS = (
    millinewtonmetres,
    other_unit,
    motor_side,
    amperes,
    per_cent,
    gravity_compensated,
    external,
    computed_torque,
    torque_sign,
    position_sign,
    exchanged_joints,
    reversed_order,
    degrees_as_radians,
    radians_as_degrees,
    position_offset,
    dropped_samples,
    saturated_sensor,
    held,
    collision,
    late_torque,
    clock_jump,
    one_joint_in_millinewtonmetres,
    late_joint,
    hum,
    drifting_clock,
    other_arm,
)
FAULTS: dict[str, Callable[[Truth], Recording]] = {
    fault.__name__: fault for fault in _FAULTS
}
"""Name of a fault to the function that returns a log with it."""

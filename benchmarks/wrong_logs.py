"""Public arms, and the ways in which a log of one can be wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement, RobotModel
from robot_sysid.signals.resampling import slice_samples
from tests.support.places import MODELS
from tests.support.wrong_logs import Truth, truth_of

ARMS: dict[str, tuple[str, str | None]] = {
    "gen3": ("kinova_gen3/gen3.xml", None),
    "panda": ("franka_panda/panda_nohand.xml", None),
    "fr3": ("franka_fr3/FrankaFR3_7DoF.urdf", None),
    "iiwa14": ("kuka_iiwa_14/iiwa14.xml", None),
    "ur5e": ("universal_robots_ur5e/ur5e.xml", None),
    "xarm7": ("ufactory_xarm7/xarm7_nohand.xml", None),
    "wxai": ("trossen/wxai/wxai_follower.xml", None),
    "openarm": ("openarm_v2/openarm_bimanual.xml", "openarm_left_joint7"),
    "gen3 2023": ("kinova_gen3/gen3_7dof_2023.xml", None),
    "gen3 official": ("kinova_gen3/gen3_official.xml", None),
}
"""Name to (model file, terminal joint)."""


def robot_of(arm: str) -> RobotModel:
    path, joint = ARMS[arm]
    return load_robot_model(MODELS / path, None, joint, 2.0)


def _torque(truth: Truth, tau: np.ndarray) -> Measurement:
    return replace(truth.log, tau=tau)


def _position(truth: Truth, change: Callable[[np.ndarray], np.ndarray]) -> Measurement:
    """Return the log with positions and, where it has them, velocities changed."""
    qd = truth.log.qd
    return replace(
        truth.log, q=change(truth.log.q), qd=None if qd is None else change(qd)
    )


def millinewtonmetres(truth):
    return _torque(truth, 1e3 * truth.log.tau)


def other_unit(truth):
    """N cm, kgf cm, lbf in."""
    return _torque(truth, truth.rng.choice([100.0, 10.197, 8.851]) * truth.log.tau)


def motor_side(truth):
    """On the motor's side of the gear."""
    return _torque(
        truth, truth.log.tau / truth.rng.choice([50.0, 100.0, 101.0, 121.0, 160.0])
    )


def amperes(truth):
    """Motor currents; every motor has a constant of its own."""
    return _torque(
        truth, truth.log.tau / truth.rng.uniform(6.0, 14.0, truth.robot.n_joints)
    )


def per_cent(truth):
    """Per cent of rated torque; the base's motors are the strongest."""
    peak = np.max(np.abs(truth.rigid), axis=0)
    rated = np.maximum(peak, 0.1 * peak.max()) * truth.rng.uniform(0.8, 1.5, len(peak))
    return _torque(truth, 100.0 * truth.log.tau / rated)


def times_two_or_more(truth):
    return _torque(truth, truth.rng.uniform(2.0, 5.0) * truth.log.tau)


def gravity_compensated(truth):
    return _torque(truth, truth.log.tau - truth.still)


def external(truth):
    """What is left after the controller's model is taken off."""
    return _torque(truth, truth.log.tau - truth.rigid)


def computed(truth):
    """The controller's model in place of a measurement."""
    return _torque(truth, truth.rigid)


def torque_sign(truth):
    sign = np.ones(truth.robot.n_joints)
    sign[carrying_joint(truth)] = -1.0
    return _torque(truth, sign * truth.log.tau)


def position_sign(truth):
    sign = np.ones(truth.robot.n_joints)
    sign[carrying_joint(truth)] = -1.0
    return _position(truth, lambda columns: sign * columns)


def exchanged(truth):
    """Two joints' columns are exchanged, those of position, of torque, or all."""
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
    log = _position(truth, lambda columns: columns[:, ::-1])
    return replace(log, tau=log.tau[:, ::-1])


def degrees_as_radians(truth):
    return _position(truth, np.degrees)


def radians_as_degrees(truth):
    """Radians that were declared to be degrees."""
    return _position(truth, np.radians)


def position_offset(truth):
    """One joint's zero is off; one that gravity would not tell is not drawn."""
    q = truth.log.q.copy()
    weight = np.sqrt(np.mean(truth.still**2, axis=0))
    joint = truth.rng.choice(np.flatnonzero(weight >= 0.2 * weight.max()))
    q[:, joint] += truth.rng.choice([-1.0, 1.0]) * truth.rng.uniform(0.08, 0.3)
    return replace(truth.log, q=q)


def dropped_samples(truth):
    """A tenth of the samples is lost, time is the row number over the rate."""
    kept = np.flatnonzero(truth.rng.random(len(truth.log)) > 0.1)
    log = truth.log
    return Measurement(log.time[: len(kept)], log.q[kept], None, log.tau[kept])


def milliseconds(truth):
    return replace(truth.log, time=1e3 * truth.log.time)


def saturated(truth):
    """A torque sensor that ends short of what the joint needs for a fifth of the time."""
    tau = truth.log.tau.copy()
    joint = carrying_joint(truth)
    limit = float(np.quantile(np.abs(tau[:, joint]), 0.8))
    tau[:, joint] = np.clip(tau[:, joint], -limit, limit)
    return _torque(truth, tau)


def held(truth):
    """A torque channel that stands still for some seconds."""
    tau = truth.log.tau.copy()
    joint = carrying_joint(truth)
    start = int(truth.rng.integers(500, 1200))
    tau[start : start + 750, joint] = tau[start, joint]
    return _torque(truth, tau)


def collision(truth):
    """Half a second of contact."""
    tau = truth.log.tau.copy()
    start = int(truth.rng.integers(600, len(tau) - 600))
    bump = np.sin(np.linspace(0.0, np.pi, 125))[:, None]
    reach = 0.5 + 0.5 * truth.rng.random(truth.robot.n_joints)
    tau[start : start + 125] += bump * reach * np.max(np.abs(truth.rigid), axis=0)
    return _torque(truth, tau)


def late_torque(truth):
    """Torque 20 ms and more behind position."""
    shift = int(truth.rng.integers(5, 15))
    late = slice_samples(truth.log, shift, len(truth.log))
    return replace(late, tau=truth.log.tau[:-shift])


def clock_jump(truth):
    """The clock jumps ahead by some tenths of a second, twice; no sample is missing."""
    time = truth.log.time.copy()
    for at in truth.rng.integers(500, len(time) - 500, 2):
        time[at:] += truth.rng.uniform(0.1, 0.4)
    return replace(truth.log, time=time)


def scaled(factor):
    """All torques times something that could be heavier or lighter links."""
    return lambda truth: _torque(truth, factor * truth.log.tau)


def one_joint_in_millinewtonmetres(truth):
    """The joint that carries least, with little noise."""
    tau = truth.log.tau.copy()
    sound = truth.rigid + truth.friction
    joint = int(np.argmin(np.mean(sound**2, axis=0)))
    noise = 0.02 * np.max(np.abs(sound[:, joint])) * truth.rng.normal(size=len(tau))
    tau[:, joint] = 1e3 * (sound[:, joint] + noise)
    return _torque(truth, tau)


def late_joint(truth):
    """One joint's torque is 60 ms behind."""
    shift = 15
    joint = carrying_joint(truth)
    tau = truth.log.tau.copy()
    tau[shift:, joint] = truth.log.tau[:-shift, joint]
    return slice_samples(_torque(truth, tau), shift, len(tau))


def hum(truth):
    """A slow sine in one joint's torque, a twelfth of what it carries."""
    tau = truth.log.tau.copy()
    joint = carrying_joint(truth)
    size = 0.12 * float(np.sqrt(np.mean(truth.rigid[:, joint] ** 2)))
    tau[:, joint] += size * np.sin(2.0 * np.pi * 0.47 * truth.log.time)
    return _torque(truth, tau)


def drifting(share):
    """A clock that is fast by more and more, by a share at the end."""

    def made(truth):
        time = truth.log.time
        return replace(truth.log, time=time * (1.0 + share * time / time[-1]), qd=None)

    return made


def long_time(truth):
    return replace(truth.log, time=1.05 * truth.log.time, qd=None)


def other_arm(truth):
    """The log is of another arm with as many joints."""
    rivals = {6: ("ur5e", "wxai"), 7: ("panda", "iiwa14", "xarm7", "gen3")}[
        truth.robot.n_joints
    ]
    robots = (robot_of(name) for name in truth.rng.permutation(rivals))
    other = next(r for r in robots if not r.path.samefile(truth.robot.path))
    return truth_of(other, int(truth.rng.integers(2**31))).log


def carrying_joint(truth: Truth) -> int:
    """Return a joint, drawn from those that carry a fair part of what the strongest one carries."""
    usual = np.sqrt(np.mean(truth.rigid**2, axis=0))
    return int(truth.rng.choice(np.flatnonzero(usual >= 0.1 * usual.max())))


KINDS: dict[str, Callable[[Truth], Measurement]] = {
    kind.__name__: kind
    for kind in (
        *(
            millinewtonmetres,
            other_unit,
            motor_side,
            amperes,
            per_cent,
            times_two_or_more,
        ),
        *(
            gravity_compensated,
            external,
            computed,
            torque_sign,
            position_sign,
            exchanged,
        ),
        *(reversed_order, degrees_as_radians, radians_as_degrees, position_offset),
        *(
            dropped_samples,
            milliseconds,
            saturated,
            held,
            collision,
            late_torque,
            clock_jump,
        ),
        *(one_joint_in_millinewtonmetres, late_joint, hum, long_time, other_arm),
    )
}
KINDS.update({f"times_{factor}": scaled(factor) for factor in (0.85, 1.15, 1.25)})
KINDS.update({f"drifting_{share}": drifting(share) for share in (0.05, 0.1)})

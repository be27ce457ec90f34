"""What is not known of a joint behind a servo, and what is known of it before the data.

The servo of a joint with gain K drives rotor inertia A against the links' torque tau:

    A qdd = clip(K beyond(c - q, dead zone) - w damping qd, +-limit) - (1 - w) damping qd - friction
            - tau(q + zero)
    friction = Coulomb + share load + (Stribeck + more load) exp(-(qd / SLIP_SPEED)^2)
    load = |motor + links|
    lag dc/dt = command(t - delay) - c

The limit beside which damping stands (w = 0) is that of a voltage: the line from a motor's stall
torque to its speed without load. Damping that a servo commands, by a gain of its own, is within its
limit (w = 1). Friction that grows with the load of the gears, and the Stribeck part of
both, are those of Duclusaud et al., "Extended friction models for the physics simulation of servo
actuators" (2024), model M4.

All torques are taken over the gain, so that the links' torque alone shows the gain: a motion shows
the ratios, whatever the links weigh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.records import Array

SLIP_SPEED = 0.1
"""Speed over which the Stribeck part of friction fades [rad/s or m/s]: of several the one with
which recordings of an XL330 that were not fitted are played best."""


@dataclass(frozen=True)
class Unknown:
    """A number of a joint behind a servo.

    Attributes:
        mean: before the data, in its unit; of a logarithm, what the number is.
        deviation: its standard deviation before the data; of a logarithm, that of the logarithm.
        step: of derivatives, in deviations.
        misfit: error by what real servos do otherwise than these equations, as ``deviation`` is
            stated.
        is_logarithm: whether the number is positive, and searched by its logarithm.
        is_signed: whether it may be negative.
        most: its largest value.
    """

    mean: float
    deviation: float
    step: float
    misfit: float
    is_logarithm: bool = False
    is_signed: bool = False
    most: float = np.inf


UNKNOWNS = {
    "gain": Unknown(1.0, usual_errors.SERVO_GAIN, 0.03, 0.03, True),
    "torque_limit": Unknown(usual_errors.SERVO_REACH, 1.0, 0.05, 0.1, True),
    "damping": Unknown(usual_errors.SERVO_LAG, 1.0, 0.05, 0.02, True),
    "limited_damping": Unknown(
        0.0, usual_errors.SERVO_LIMITED_DAMPING, 0.1, 0.05, most=1.0
    ),
    "frictionloss": Unknown(usual_errors.SERVO_STICKING, 1.5, 0.05, 0.06, True),
    "armature": Unknown(usual_errors.SERVO_BANDWIDTH**-2.0, 1.5, 0.05, 0.04, True),
    "stribeck": Unknown(0.0, usual_errors.SERVO_STICKING, 0.1, 3e-4),
    "load_share": Unknown(
        usual_errors.SERVO_LOAD_SHARE, usual_errors.SERVO_LOAD_SHARE_SPREAD, 0.1, 0.01
    ),
    "load_stribeck": Unknown(
        usual_errors.SERVO_LOAD_STICKING,
        usual_errors.SERVO_LOAD_STICKING_SPREAD,
        0.1,
        0.01,
    ),
    "dead_zone": Unknown(0.0, usual_errors.SERVO_PLAY, 0.1, 3e-4),
    "command_delay": Unknown(0.0, usual_errors.SERVO_DELAY, 0.01, 1e-3),
    "loop_lag": Unknown(0.0, usual_errors.SERVO_LOOP_LAG, 0.1, 2e-3),
    "zero": Unknown(0.0, usual_errors.SERVO_ZERO, 0.1, 1e-2, False, True),
}
"""Name to unknown: the gain over its likely value; limit, damping, friction, rotor inertia and the
Stribeck part over the gain [rad, s, rad, s^2, rad]; the share of the damping that the servo
commands, within its limit; the share of the load that is friction, and what it is more at rest;
dead zone [rad]; delay and lag [s]; what the links are turned by where a position is zero [rad]."""
NAMES = tuple(UNKNOWNS)
IN_FILE = (
    "gain",
    "torque_limit",
    "damping",
    "limited_damping",
    "frictionloss",
    "armature",
)
"""Those that MJCF holds: a position actuator with its range of forces, and a joint."""
_COLUMN = {name: k for k, name in enumerate(NAMES)}
_MEANS = np.array([unknown.mean for unknown in UNKNOWNS.values()])
DEVIATIONS = np.array([unknown.deviation for unknown in UNKNOWNS.values()])
STEPS = np.array([unknown.step for unknown in UNKNOWNS.values()])
LEAST_ERRORS = np.array([each.misfit for each in UNKNOWNS.values()]) / DEVIATIONS
"""Error of each unknown by what real servos do otherwise, in its deviations."""
_IS_LOGARITHM = np.array([unknown.is_logarithm for unknown in UNKNOWNS.values()])
_IS_FREE = _IS_LOGARITHM | np.array([each.is_signed for each in UNKNOWNS.values()])
LEAST = np.where(_IS_FREE, -np.inf, -_MEANS / DEVIATIONS)
"""Least value of each unknown in standard deviations from its mean."""
MOST = (np.array([each.most for each in UNKNOWNS.values()]) - _MEANS) / DEVIATIONS
"""Largest value of each unknown in standard deviations from its mean."""
ABSENT = np.where(_IS_FREE, 0.0, LEAST)
"""Values of the unknowns where a servo has none of what they stand for."""


def column(name: str) -> int:
    """Return the number of an unknown."""
    return _COLUMN[name]


def numbers_at(x: Array) -> Array:
    """Return numbers (..., u) in their units that x (..., u), in deviations from the mean, stand
    for.
    """
    with np.errstate(over="ignore"):
        factors = _MEANS * np.exp(DEVIATIONS * x)
    return np.where(_IS_LOGARITHM, factors, _MEANS + DEVIATIONS * x)

"""Which weight on the last link would fix the absolute sizes of an arm's servos, and how well.

A motion shows ratios: all torques over the gain, and the links' over it, too. Where the links are
wrong by a share, so is the gain. A weight of known mass adds a torque that is not: with r the share
of the links in the torque at rest with the weight, the logarithm a of the gain and the share s by
which the links' torque is off are seen without and with it as

    s - a = 0 +- e,      r s - a = 0 +- r e,

e being the error of the gain if the links are right: a torque that is larger shows a gain so much
better. What is known of s before is what the links make of the gain's error in the fit.

n is the number of joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.records import Array, RobotModel
from robot_sysid.servo.derived import drawn_poses, torque_at_rest
from robot_sysid.servo.fit import ServoFit
from robot_sysid.servo.unknowns import DEVIATIONS, UNKNOWNS, column, numbers_at
from robot_sysid.simulation.playback import chain_actuators
from robot_sysid.spatial import aluminium_ball, com_from_theta

WEIGHTS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Weights to choose from [kg]."""
CARRIED = 0.7
"""Share of a servo's largest torque that links and weight may ask of it at rest."""
LARGEST_ERROR = 0.2
"""Relative error of a gain above which its size is to be known better."""
WORTH_IT = 0.5
"""Share of that error which a weight may leave."""
HAND_ERROR = 0.02
"""Relative error of the torque of a weight whose mass and place were measured by hand: 1 g of
100 g, 2 mm of 100 mm."""
LEAST_INFORMATION = 1.0
"""Information on the logarithm of a gain from which on the log shows its size at all."""
LEAST_VARIANCE = 1e-12
"""Variance of the logarithm of a gain that is none."""
ROUNDING = 1e-9
"""Share of the largest torque that is none."""


@dataclass(frozen=True)
class Weighing:
    """A weight on the last link, and what it would tell.

    Attributes:
        mass: of the weight [kg].
        position: in the frame of the last link's body [m].
        joints: names of those whose sizes would be known better.
        now, after: the largest relative error of their gains, without and with the weight.
    """

    mass: float
    position: tuple[float, ...]
    joints: tuple[str, ...]
    now: float
    after: float


def best_weighing(robot: RobotModel, fit: ServoFit) -> Weighing | None:
    """Return the weight that tells most of what the servos carry; None where none is worth it.

    Args:
        robot: the arm as in the model file.
        fit: of its servos, recorded without a weight.
    """
    gain = column("gain")
    now = DEVIATIONS[gain] * np.sqrt(fit.covariance[:, gain, gain])
    is_unknown = fit.is_known & (now > LARGEST_ERROR)
    if not np.any(is_unknown):
        return None
    q = drawn_poses(robot)
    links = torque_at_rest(robot, q, robot.thetas)
    _, com, _ = com_from_theta(robot.thetas[-1])
    per_kg = _torque_per_kg(robot, q, com)
    strength = CARRIED * _least_limits(robot, fit)
    best = None
    for mass in WEIGHTS:
        asked = np.max(np.abs(links + mass * per_kg), axis=0)
        # A joint that carries no part of the weight is no reason against it.
        if np.any((asked > strength) & np.any(np.abs(per_kg) > 0.0, axis=0)):
            break
        after = _errors_with(fit, links, mass * per_kg)
        is_better = is_unknown & (after < WORTH_IT * now)
        if np.any(is_better):
            names = np.array(robot.joint_names)[is_better].tolist()
            best = Weighing(
                mass=mass,
                position=tuple(np.round(com, 3).tolist()),
                joints=tuple(names),
                now=float(np.max(now[is_better])),
                after=float(np.max(after[is_better])),
            )
    return best


def _torque_per_kg(robot: RobotModel, q: Array, com: Array) -> Array:
    """Return the torque (m, n) at rest of 1 kg at a point of the last link in poses q (m, n)."""
    thetas = np.zeros_like(robot.thetas)
    thetas[-1] = aluminium_ball(1.0, com)
    return torque_at_rest(robot, q, thetas)


def _least_limits(robot: RobotModel, fit: ServoFit) -> Array:
    """Return the largest torques (n,) that servos surely have, one standard error less [N m]."""
    limit = column("torque_limit")
    x = fit.x.copy()
    x[:, limit] -= np.sqrt(fit.covariance[:, limit, limit])
    found = numbers_at(x)[:, limit] * fit.over_gain[:, column("gain")]
    return np.minimum(found, chain_actuators(robot).limit)


def _errors_with(fit: ServoFit, links: Array, weight: Array) -> Array:
    """Return the relative errors (n,) of gains after a further log with a weight.

    Args:
        fit: of the log without it.
        links, weight: torques at rest (m, n) in poses [N m].
    """
    gain = column("gain")
    scale = DEVIATIONS[gain]
    of_links = np.sqrt(np.mean(links**2, axis=0))
    of_both = np.sqrt(np.mean((links + weight) ** 2, axis=0))
    rounding = ROUNDING * np.max(of_both)
    times = (of_both + rounding) / (of_links + rounding)
    prior = np.full(len(fit.x), np.inf)
    prior[fit.is_known] = scale * fit.deviation[:, gain]
    given_links = scale**2 * fit.given_links[:, gain, gain]
    by_links = np.maximum(
        scale**2 * fit.covariance[:, gain, gain] - given_links, LEAST_VARIANCE
    )
    # What the log tells of the gain, beside what is known before. What servos do otherwise than
    # they are taken to is as much with a weight.
    misfit = UNKNOWNS["gain"].misfit
    information = 1.0 / np.maximum(given_links - misfit**2, LEAST_VARIANCE)
    information -= prior**-2.0
    at_hand = np.hypot(HAND_ERROR, misfit)
    errors = np.full(len(fit.x), np.inf)
    for k in np.flatnonzero(information > LEAST_INFORMATION).tolist():
        seen = np.array([[-1.0, 1.0], [-times[k], 1.0]])
        matrix = information[k] * seen.T @ seen
        matrix += np.diag([0.0, 1.0 / by_links[k]])
        errors[k] = np.hypot(np.sqrt(np.linalg.inv(matrix)[0, 0]), at_hand)
    return errors

"""What a servo's numbers mean for its owner: dead band, sag, and what else needs no scale.

All of them are ratios to the gain or to the links' weight, which a motion shows whatever the links
weigh. Weight is the largest torque at rest that gravity asks of a joint in any pose within the
joints' limits, of links that are off as was found. A standard error is the one of a first-order
change of all numbers together, link errors among them.

n is the number of joints, u that of unknowns, J that of directions of link errors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.records import Array, RobotModel
from robot_sysid.servo.fit import ServoFit
from robot_sysid.servo.play import KnownLinks
from robot_sysid.servo.unknowns import DEVIATIONS, NAMES, UNKNOWNS, numbers_at

LEAST_WEIGHT = 1e-6
"""Weight that is none [N m or N]."""
POSES = 400
"""Number of poses that are drawn for the largest weight."""
TURN = np.pi
"""Range to both sides of a joint without limits [rad]."""
CHANGE = 1e-3
"""Step of derivatives, in deviations of the unknowns."""


@dataclass(frozen=True)
class Derived:
    """A number of each joint, and its standard error.

    Attributes:
        unit: of both.
        values: (n,) numbers.
        errors: (n,) standard errors.
    """

    unit: str
    values: Array
    errors: Array


def drawn_poses(robot: RobotModel) -> Array:
    """Return poses (m, n) within the joints' limits [rad or m]."""
    lower = np.maximum(robot.limits.lower, -TURN)
    upper = np.minimum(robot.limits.upper, TURN)
    return np.random.default_rng(0).uniform(lower, upper, (POSES, robot.n_joints))


def torque_at_rest(robot: RobotModel, q: Array, thetas: Array) -> Array:
    """Return the torque (m, n) that gravity asks of each joint at rest in poses q (m, n) [N m].

    Args:
        robot: the arm.
        q: poses [rad or m].
        thetas: (n, 10) of its links.
    """
    at_rest = np.zeros_like(q)
    return LinkDynamics(robot).motion(q, at_rest, at_rest).torque(thetas)


def largest_weights(robot: RobotModel, thetas: Array) -> tuple[Array, Array]:
    """Return the largest torque (n,) that gravity asks of each joint at rest [N m], and its
    derivative (n, 10 n) by the thetas (n, 10) of the links.
    """
    q = drawn_poses(robot)
    at_rest = np.zeros_like(q)
    motion = LinkDynamics(robot).motion(q, at_rest, at_rest)
    torque = motion.torque(thetas)
    joints = np.arange(robot.n_joints)
    pose = np.argmax(np.abs(torque), axis=0)
    signs = np.sign(torque[pose, joints])
    by_thetas = motion.columns(joints.tolist())[pose, joints]
    return np.abs(torque[pose, joints]), signs[:, None] * by_thetas


def _added(links: KnownLinks, by_thetas: Array) -> Array:
    """Return what link errors add to weights (n, J + 1) with these derivatives (n, 10 n).

    The last of them is what the errors add that no direction has: they move nothing in the logs.
    """
    added = np.einsum("nk,nkj->nj", by_thetas, links.directions)
    of_all = np.sum((by_thetas @ links.factor) ** 2, axis=1)
    unseen = np.maximum(of_all - np.sum(added**2, axis=1), 0.0)
    return np.column_stack((added, np.sqrt(unseen)))


def _formulas() -> Mapping[str, tuple[str, Callable[[dict[str, Array]], Array]]]:
    """Return name to unit and formula of numbers by name (n,), "weight" [N m] among them."""

    def dead_band(at: dict[str, Array]) -> Array:
        """Return the position error up to which a joint without load does not move."""
        return at["frictionloss"] + at["stribeck"] + at["dead_zone"]

    def sag(at: dict[str, Array]) -> Array:
        """Return the position error that carries the largest weight."""
        return at["weight"] / at["gain"]

    def even_speed(at: dict[str, Array]) -> Array:
        """Return the speed at which viscous friction equals dry friction."""
        return at["frictionloss"] / at["damping"]

    def strength(at: dict[str, Array]) -> Array:
        """Return the largest torque over the largest weight."""
        torque = at["torque_limit"] * at["gain"]
        return torque / np.maximum(at["weight"], LEAST_WEIGHT)

    return {
        "dead_band": ("rad", dead_band),
        "sag": ("rad", sag),
        "friction_over_gain": ("rad", lambda at: at["frictionloss"]),
        "damping_over_gain": ("s", lambda at: at["damping"]),
        "even_speed": ("rad/s", even_speed),
        "torque_over_weight": ("", strength),
    }


def derived_numbers(
    robot: RobotModel, fit: ServoFit, times: float = 1.0
) -> dict[str, Derived]:
    """Return what follows from a fit by name, in the order of a table.

    Args:
        robot: the arm as in the model file.
        fit: of its servos.
        times: gain of which the numbers are, over that of the fit: friction and the torque limit
            do not follow a gain that is set.
    """
    weight, by_thetas = largest_weights(robot, fit.links.thetas)
    added = _added(fit.links, by_thetas)
    u = len(NAMES)

    def at(whole: Array) -> dict[str, Array]:
        """Return numbers of all joints by name at unknowns and link errors (n, u + J + 1)."""
        numbers = numbers_at(whole[:, :u])
        numbers[:, 0] *= fit.likely_gain * times
        by_name = dict(zip(NAMES, numbers.T))
        for name in TIMES_GAIN:
            by_name[name] = by_name[name] / times
        of_links = np.sum(added * whole[:, u:], axis=1)
        return {**by_name, "weight": np.abs(weight + of_links)}

    whole = np.column_stack((fit.x, fit.link_errors, np.zeros(len(fit.x))))
    covariance = np.tile(np.eye(whole.shape[1]), (len(whole), 1, 1))
    covariance[:, :-1, :-1] = fit.covariance
    found = {}
    for name, (unit, formula) in _formulas().items():
        slopes = np.empty_like(whole)
        for k in range(whole.shape[1]):
            step = CHANGE * (np.arange(whole.shape[1]) == k)
            more, less = formula(at(whole + step)), formula(at(whole - step))
            slopes[:, k] = (more - less) / (2.0 * CHANGE)
        variance = np.einsum("nk,nkl,nl->n", slopes, covariance, slopes)
        values = formula(at(whole))
        errors = np.sqrt(np.maximum(variance, 0.0))
        if name == "torque_over_weight":
            # A joint that carries nothing has no such number.
            carries = weight > LEAST_WEIGHT
            values = np.where(carries, values, 0.0)
            errors = np.where(carries, errors, np.inf)
        found[name] = Derived(unit, values, errors)
    return found


def absolute_numbers(fit: ServoFit) -> dict[str, Derived]:
    """Return the numbers of the servos by name, with the errors of the links in theirs."""
    numbers = fit.over_gain
    gain = numbers[:, :1]
    units = {
        "gain": "N·m/rad",
        "torque_limit": "N·m",
        "damping": "N·m·s/rad",
        "limited_damping": "",
        "frictionloss": "N·m",
        "armature": "kg·m²",
        "stribeck": "N·m",
        "load_share": "",
        "load_stribeck": "",
        "dead_zone": "rad",
        "loop_lag": "s",
    }
    found = {}
    for name, unit in units.items():
        k = NAMES.index(name)
        scale = DEVIATIONS[k] * (numbers[:, k] if UNKNOWNS[name].is_logarithm else 1.0)
        slopes = np.zeros_like(fit.x)
        slopes[:, k] = scale
        values = numbers[:, k]
        if name in TIMES_GAIN:
            slopes *= gain
            slopes[:, 0] += DEVIATIONS[0] * gain[:, 0] * values
            values = gain[:, 0] * values
        own = fit.covariance[:, : len(NAMES), : len(NAMES)]
        variance = np.einsum("nk,nkl,nl->n", slopes, own, slopes)
        found[name] = Derived(unit, values, np.sqrt(np.maximum(variance, 0.0)))
    return found


TIMES_GAIN = ("torque_limit", "damping", "frictionloss", "armature", "stribeck")
"""Numbers that are searched over the gain."""

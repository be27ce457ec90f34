"""The numbers of the example arm: frames, inertials, limits and friction of a Kinova Gen3.

Frames and inertials are those that Kinova publishes in its ROS description packages: "standard" is
the arm with seven continuous-duty actuators, "brakes" the newer arm with brakes. Inertias are about
each link's centre of mass, axes parallel to the link frame. Units: m, kg, kg m^2, rad, N m.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial

Array = NDArray[np.float64]

LINKS = ("base", "link0", "link1", "link2", "link3", "link4", "link5", "link6")

# Turn of a body against its parent, always about x: MuJoCo normalises these quaternions.
_FLIP = (0, 1, 0, 0)
_UP = (1, 1, 0, 0)
_DOWN = (1, -1, 0, 0)

# Kinova's last frame looks into the arm. Ours is turned by pi about x, so that +z leaves the arm
# at the flange: _DOWN becomes _UP, and the joint axis 0 0 -1 keeps the published sense of turning.
FRAMES: Mapping[str, tuple[tuple[float, float, float], tuple[int, int, int, int]]] = {
    "link0": ((0.0, 0.0, 0.15643), _FLIP),
    "link1": ((0.0, 0.005375, -0.12838), _UP),
    "link2": ((0.0, -0.21038, -0.006375), _DOWN),
    "link3": ((0.0, 0.006375, -0.21038), _UP),
    "link4": ((0.0, -0.20843, -0.006375), _DOWN),
    "link5": ((0.0, 0.00017505, -0.10593), _UP),
    "link6": ((0.0, -0.10593, -0.00017505), _UP),
}
FLANGE = (0.0, 0.0, 0.061525)
BRACELET_TO_LINK6 = np.diag([1.0, -1.0, -1.0])

# link: (mass, centre of mass, (Ixx, Ixy, Ixz, Iyy, Iyz, Izz) about the centre of mass)
Inertial = tuple[
    float, tuple[float, float, float], tuple[float, float, float, float, float, float]
]

STANDARD: Mapping[str, Inertial] = {
    "base": (
        1.697,
        (-0.000648, -0.000166, 0.084487),
        (0.004622, 9e-6, 6e-5, 0.004495, 9e-6, 0.002079),
    ),
    "link0": (
        1.3773,
        (-2.3e-5, -0.010364, -0.07336),
        (0.00457, 1e-6, 2e-6, 0.004831, 0.000448, 0.001409),
    ),
    "link1": (
        1.1636,
        (-4.4e-5, -0.09958, -0.013278),
        (0.011088, 5e-6, 0.0, 0.001072, -0.000691, 0.011255),
    ),
    "link2": (
        1.1636,
        (-4.4e-5, -0.006641, -0.117892),
        (0.010932, 0.0, -7e-6, 0.011127, 0.000606, 0.001043),
    ),
    "link3": (
        0.9302,
        (-1.8e-5, -0.075478, -0.015006),
        (0.008147, -1e-6, 0.0, 0.000631, -0.0005, 0.008316),
    ),
    "link4": (
        0.6781,
        (1e-6, -0.009432, -0.063883),
        (0.001596, 0.0, 0.0, 0.001607, 0.000256, 0.000399),
    ),
    "link5": (
        0.6781,
        (1e-6, -0.045483, -0.00965),
        (0.001641, 0.0, 0.0, 0.00041, -0.000278, 0.001641),
    ),
}

BRAKES: Mapping[str, Inertial] = {
    "base": (
        1.7565703,
        (-0.00075876, -0.00019207, 0.09605351),
        (0.00562309, 5.96e-6, 6.235e-5, 0.00551518, 6.09e-6, 0.00205231),
    ),
    "link0": (
        1.46990145,
        (-2.522e-5, -0.00759535, -0.08865077),
        (0.00432687, 2.5e-7, 9.4e-7, 0.00447028, 0.0001016, 0.00145324),
    ),
    "link1": (
        1.2357745,
        (-4.533e-5, -0.12951716, -0.01354356),
        (0.0115879, -1.05e-6, 5e-8, 0.00104574, -0.00096902, 0.0116684),
    ),
    "link2": (
        1.2357745,
        (-4.533e-5, -0.00361448, -0.14407154),
        (0.01009873, 5.7e-7, 1.89e-6, 0.01017801, 0.00013166, 0.00104697),
    ),
    "link3": (
        0.89954802,
        (-0.00030188, -0.104938, -0.01559665),
        (0.00889854, 1.98e-5, -2.39e-6, 0.00060297, -0.00074456, 0.00898975),
    ),
    "link4": (
        0.70588351,
        (-0.00035363, -0.00659443, -0.07560343),
        (0.00145671, 3.35e-6, 7.62e-6, 0.00145189, 0.00012055, 0.00039299),
    ),
    "link5": (
        0.70583924,
        (-0.00035547, -0.06159424, -0.00850171),
        (0.00187208, 6.1e-6, -2.17e-6, 0.00041077, -0.00033774, 0.0018494),
    ),
}

# In Kinova's bracelet frame, with the vision module.
BRAKES_BRACELET: Inertial = (
    0.43504643,
    (-0.00027419, -0.01170136, -0.03437502),
    (0.00048886, 2.59e-6, 1.75e-6, 0.00029425, 8.248e-5, 0.000542),
)

# Base of a two-finger gripper (Robotiq 2F-85) in the flange frame.
GRIPPER_BASE: Inertial = (
    0.66320,
    (0.0, 2.3e-5, 0.03232),
    (5.16e-4, 0, 0, 5.88e-4, 0, 3.95e-4),
)

# Wrist link of the guess: the terminal link that the project's README identifies, inertia about
# the body origin, order of spatial.PARAMETER_NAMES.
GUESS_LINK6 = np.array(
    [
        0.789160,
        *(-0.000047, 0.009093, 0.120437),
        *(0.024382, 0.000001, 0.000009, 0.024312, -0.001638, 0.000551),
    ]
)


@dataclass(frozen=True)
class Joint:
    """Limits of one joint.

    Attributes:
        axis: rotation axis in the child frame.
        limit: position limit, symmetric [rad]; None turns without end.
        velocity: speed limit [rad/s].
        torque: nominal torque [N m].
    """

    axis: tuple[int, int, int]
    limit: float | None
    velocity: float
    torque: float


def _large(limit: float | None) -> Joint:
    """Return a large joint; ``limit`` is the position limit to both sides [rad], None for none."""
    return Joint((0, 0, 1), limit, velocity=1.3963, torque=39.0)


def _small(limit: float | None, axis: tuple[int, int, int] = (0, 0, 1)) -> Joint:
    """Return a small joint; ``limit`` is the position limit to both sides [rad], None for none."""
    return Joint(axis, limit, velocity=1.2218, torque=9.0)


# The torques are the efforts of Kinova's URDF, not the actuators' hard limits (105 and 52 N m): a
# trajectory planned with them never comes near the arm's own torque warnings.
JOINTS: tuple[Joint, ...] = (
    _large(None),
    _large(2.24),
    _large(None),
    _large(2.57),
    _small(None),
    _small(2.09),
    _small(None, axis=(0, 0, -1)),
)

HOME = (0.0, 0.26179939, 3.14159265, -2.26892803, 0.0, 0.95993109, 1.57079633)

# (Coulomb N m, viscous N m s/rad) per joint. Kinova publishes none: the guess only has a rough
# value for the last joint. The truth's Coulomb values come from a third-party configuration of a
# Gen3, its viscous values are assumed.
GUESS_FRICTION = ((0.0, 0.0),) * 6 + ((0.4, 0.1),)
TRUE_FRICTION = (
    (0.522, 1.0),
    (0.577, 0.8),
    (0.421, 1.0),
    (0.495, 0.8),
    (0.161, 0.2),
    (0.133, 0.2),
    (0.143, 0.2),
)

# Rotor inertia seen through the gear [kg m^2], the same in every joint: Kinova publishes none, and
# 0.1 is what the public MuJoCo model of this arm has been proposed to use. It is the same in both
# models, as if it had been measured beforehand.
ARMATURE = 0.1


def theta(inertial: Inertial) -> Array:
    """Return the ten parameters (10,) of a published inertial, in its own frame."""
    mass, com, six = inertial
    return spatial.theta_from_com(
        mass, np.array(com), spatial.symmetric_from_six(np.array(six))
    )


def solid_box(mass: float, centre: tuple[float, float, float], size: Array) -> Array:
    """Return theta (10,) of a homogeneous box: I_xx = m (b^2 + c^2) / 12 and so on.

    Args:
        mass: [kg].
        centre: (3,) its middle [m].
        size: (3,) full edge lengths [m].
    """
    squares = np.asarray(size, dtype=float) ** 2
    inertia = mass / 12.0 * np.diag(squares.sum() - squares)
    return spatial.theta_from_com(mass, np.array(centre), inertia)


def gripper() -> Array:
    """Return theta (10,) in the flange frame: the gripper with two fingers.

    Each finger counts as one bar of knuckle and finger mass (0.01385 + 0.0426 kg).
    """
    bar = np.array([0.02, 0.022, 0.09])
    fingers = [
        solid_box(0.05645, (side * 0.035, 0.0, 0.115), bar) for side in (-1.0, 1.0)
    ]
    return theta(GRIPPER_BASE) + sum(fingers)


def workpiece() -> Array:
    """Return theta (10,) in the flange frame: the steel block in the gripper's grip."""
    return solid_box(0.306, (0.0, 0.0, 0.145), np.array([0.05, 0.03, 0.026]))


def true_link6(tool: Array) -> Array:
    """Return theta (10,) of the brakes arm's bracelet with a tool, given in the flange frame."""
    bracelet = spatial.transform_theta(
        theta(BRAKES_BRACELET), BRACELET_TO_LINK6, np.zeros(3)
    )
    return bracelet + spatial.transform_theta(tool, np.eye(3), np.array(FLANGE))

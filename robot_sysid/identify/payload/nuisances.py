"""What is known beforehand of everything but the payload, as priors."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics.gravity import TILT_NAMES
from robot_sysid.estimation.nuisances import NuisanceGroup
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.nuisances import independent, link_group
from robot_sysid.identify.payload.equations import PAYLOAD_NAMES, PayloadEquations
from robot_sysid.records import DELAY_NAME, Array, RobotModel

DRIFT, LAG, LOAD_FRICTION = 0.2, 5e-3, 0.1
"""Standard deviations: of friction's drift from the middle of the recordings to their ends (a
share), of the torque's lag behind the position [s], of a gear's loss (a share of its load)."""
SCALE, LINKS, BOUNDS = "torque scale", "other links", "bounds"
COMMON, WEIGHT = "common torque scale", "known mass"
"""Names of causes."""
_EXACT = 1e-9
_EXACT_LINKS = 1e-5
_EXACT_MASS = 1e-6


def nuisance_groups(
    robot: RobotModel,
    equations: PayloadEquations,
    options: EstimationOptions,
    scale: float | None = None,
) -> tuple[NuisanceGroup, ...]:
    """Return the priors of all nuisances; what is said to be exactly known hardly moves.

    Args:
        robot: the arm.
        equations: whose parameters they are.
        options: how far they may be off.
        scale: how far torque scales may be off [%]; None takes that of the options.
    """
    joints, percent = robot.joint_names, 1e-2
    of_scale = percent * (options.scale_uncertainty if scale is None else scale)
    sizes = (
        (SCALE, equations.scale_names, joints, of_scale),
        ("joint offsets", equations.zero_names, joints, 1e-3 * options.zero_uncertainty),
        ("gravity", TILT_NAMES, TILT_NAMES, np.radians(options.gravity_uncertainty)),
        ("lag", (DELAY_NAME,), (DELAY_NAME,), LAG),
        ("drift of friction", equations.drift_names, joints, DRIFT),
        ("load friction", equations.load_names, joints, LOAD_FRICTION),
    )
    groups = [
        independent(cause, names, members, max(size, _EXACT), size > _EXACT)
        for cause, names, members, size in sizes
        if names
    ]
    links = [number for number, link in enumerate(robot.links) if link.has_mass]
    share = max(percent * options.link_uncertainty, _EXACT_LINKS)
    return (*groups, link_group(robot, links, share, LINKS))


def no_common_scale(equations: PayloadEquations) -> NuisanceGroup:
    """Return what holds the mean of all torque scales at one.

    A scale that all joints have in common scales every mass alike. Only the model's masses could
    tell it, and they are what is not trusted here, so it goes into the errors instead.
    """
    names = equations.scale_names
    mean = np.ones((len(names), len(names))) / len(names)
    factor = np.eye(len(names)) - (1.0 - _EXACT) * mean
    return NuisanceGroup(COMMON, names, np.zeros(len(names)), 1e3 * factor, names)


def weight_group(mass: float) -> NuisanceGroup:
    """Return what is known of a payload of known mass [kg]."""
    factor = np.array([[_EXACT_MASS * mass]])
    return NuisanceGroup(WEIGHT, PAYLOAD_NAMES[:1], np.array([mass]), factor, ("payload",))


def held_at(names: tuple[str, ...], values: Array) -> NuisanceGroup:
    """Return what holds some parameters at bounds that they would cross."""
    factor = _EXACT * np.eye(len(names))
    return NuisanceGroup(BOUNDS, names, values, factor, names)

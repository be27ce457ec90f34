"""What a fitted log says of its model: torque that is unexplained, and links that are implausible.

All functions take the ``Posterior`` of a log's model, with n joints and K rows per joint. Its
coefficients are deviations of the parameters from the prior's means, in units of the prior's
standard deviations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import COLUMNS_ADVICE, Finding, Level
from robot_sysid.diagnosis.log_model import Posterior
from robot_sysid.diagnosis.log_rows import rms
from robot_sysid.dynamics.equations import link_names, other_links
from robot_sysid.records import Array

SURE = 3.0
"""Standard errors by which friction, or an explanation's coefficients, have to differ from zero to
be significant."""
HEAVIEST = 0.6
"""Largest mass of a plausible last link, as a share of the arm's mass."""
FAR = 40.0
"""Value of ``strain`` that no log reaches with the right model of its arm."""
DRIVING = 0.05
"""Least Coulomb friction that drives a joint for sure, as a share of its typical torque."""


def last_mass(posterior: Posterior) -> tuple[float, float]:
    """Return the last link's mass, the first of all parameters, and its standard error [kg]."""
    return float(posterior.values[0]), float(posterior.standard_errors[0])


def strain(posterior: Posterior) -> float:
    """Return the squared deviation d' P^-1 d of all links but the last one from the model.

    d are the deviations of their parameters and P is the prior covariance of d.
    """
    log = posterior.model.log
    prior = posterior.model.prior
    names: list[str] = []
    for link in other_links(log.robot):
        names += link_names(log.robot, link)
    at = prior.positions(log.columns.indices(names))
    deviations = posterior.coefficients[at]
    return float(deviations @ prior.precision[np.ix_(at, at)] @ deviations)


def is_plausible(posterior: Posterior) -> bool:
    """Return whether the last link's mass and the other links are plausible.

    The mass has to lie, within two standard errors, between zero and the larger of two limits:
    ``HEAVIEST`` of the arm's mass, and the link's mass in the model plus 30 % of the arm's mass.
    The ``strain`` of the other links has to be below ``FAR``.
    """
    robot = posterior.model.log.robot
    largest_mass = max(HEAVIEST * robot.mass, robot.prior.mass + 0.3 * robot.mass)
    mass, error = last_mass(posterior)
    is_possible = mass + 2.0 * error > 0.0 and mass - 2.0 * error < largest_mass
    return is_possible and strain(posterior) < FAR


def dry_friction(posterior: Posterior) -> tuple[Array, Array]:
    """Return the Coulomb friction (n,) of each joint and its standard error (n,) [N m]."""
    model = posterior.model
    indices = model.log.friction_indices("coulomb")
    errors = posterior.standard_errors[model.prior.positions(indices)]
    return posterior.values[indices], errors


def least_friction_share(posterior: Posterior) -> Array:
    """Return a lower bound (n,) of Coulomb friction, as a share of each joint's typical torque.

    The bound is ``SURE`` standard errors below the estimate; zero where that is negative.
    """
    dry, error = dry_friction(posterior)
    least = np.maximum(np.abs(dry) - SURE * error, 0.0)
    return np.asarray(least / posterior.model.log.typical_torque)


def misfit_by_joint(posterior: Posterior) -> Array:
    """Return the unexplained torque (n,) of each joint, as a share of ``typical_torque``.

    It is the root mean square residual less white noise, whose power is taken from the upper half
    of the frequencies, in which links make little torque.
    """
    # (K, n): in each window of time, by ascending frequency of the cosine transform.
    squares = posterior.residual**2
    slow = np.zeros(squares.shape[1])
    for window in posterior.model.log.windows:
        spectrum = squares[window]
        upper_half = spectrum[len(spectrum) // 2 :]
        white = len(spectrum) * np.mean(upper_half, axis=0)
        slow += np.maximum(np.sum(spectrum, axis=0) - white, 0.0)
    typical_torque = posterior.model.log.typical_torque
    return np.asarray(np.sqrt(slow / posterior.model.count) / typical_torque)


def misfit(posterior: Posterior) -> float:
    """Return the unexplained torque (``misfit_by_joint``) of all joints, as a share of all torque.

    Both are the norm over joints of root mean squares.
    """
    log = posterior.model.log
    slow = misfit_by_joint(posterior) * log.typical_torque
    return float(np.linalg.norm(slow) / np.linalg.norm(rms(log.torque)))


def reverses_friction(base: Posterior, corrected: Posterior) -> bool:
    """Return whether a correction turns any joint's Coulomb friction from braking into driving.

    Only friction of at least ``SURE`` standard errors counts. Where links hardly load a joint, all
    torques but friction fit with either sign.

    Args:
        base: posterior of the base model of the log as it is.
        corrected: posterior of the base model of the corrected log.
    """
    dry, error = dry_friction(base)
    return bool(np.any((dry > SURE * error) & drives(corrected)))


def drives(posterior: Posterior) -> NDArray[np.bool_]:
    """Return which joints (n,) have Coulomb friction that drives, by ``SURE`` standard errors."""
    dry, error = dry_friction(posterior)
    return np.asarray(dry < -SURE * error)


def driving_findings(posterior: Posterior) -> list[Finding]:
    """Return a finding for each joint that its friction drives, at least by ``DRIVING``.

    Where links hardly load a joint, its torque fits with either sign but for friction.
    """
    is_driven = drives(posterior) & (least_friction_share(posterior) > DRIVING)
    text = "friction of joint {} drives it in place of braking: its torque or its position has the "
    text += f"opposite sign of the model's{COLUMNS_ADVICE}"
    names = np.array(posterior.model.log.robot.joint_names)[is_driven]
    return [Finding("sign", Level.WARN, text.format(name)) for name in names]

"""From square-root information to an Estimate, by the estimator's name."""

from __future__ import annotations

import numpy as np

from robot_sysid import spatial
from robot_sysid.estimators.ols import least_squares
from robot_sysid.identifiability import N_INERTIAL, analyse_identifiability
from robot_sysid.records import (
    Array,
    Estimate,
    Identifiability,
    SquareRootInformation,
    Status,
    checked_array,
)


def identify_parameters(
    information: SquareRootInformation,
    prior: Array,
    method: str = "ols",
    terminal_joint: str | None = None,
) -> Estimate:
    """Estimate all parameters; what the data cannot see keeps the prior's value.

    Args:
        information: the data.
        prior: (p,) the model's own values, in the order of ``information.names``.
        method: name of the estimator.
        terminal_joint: name of the terminal joint, if it is not the information's last.

    Returns:
        The estimate with rank, condition, residuals and a status that names cause and remedy.
    """
    prior = checked_array(prior, (len(information.names),), "prior")
    values = least_squares(information, prior)
    identifiability = analyse_identifiability(information, terminal_joint)
    rmse, per_joint = torque_rmse(information, values)
    return Estimate(
        names=information.names,
        values=values,
        identifiability=identifiability,
        rmse=rmse,
        rmse_per_joint=per_joint,
        status=judge(values, identifiability),
        method=method,
    )


def torque_rmse(
    information: SquareRootInformation, values: Array
) -> tuple[float, dict[str, float]]:
    """Return root mean square torque residuals [N m]: (over all equations, per joint)."""
    squared = information.squared_residuals(values)
    counts = np.array([max(joint.n_samples, 1) for joint in information.joints])
    per_joint = {
        joint.joint: float(np.sqrt(s / n))
        for joint, s, n in zip(information.joints, squared, counts)
    }
    return float(np.sqrt(np.sum(squared) / max(information.n_samples, 1))), per_joint


def judge(values: Array, identifiability: Identifiability) -> Status:
    """Return how the identification ended."""
    if not spatial.is_consistent(values[:N_INERTIAL]):
        return Status.INCONSISTENT
    if identifiability.rank < identifiability.n_parameters:
        return Status.PARTLY_FROM_MODEL
    return Status.OK

"""From square-root information to an estimate by plain least squares."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.spatial import N_INERTIAL
from robot_sysid.estimate.bodies import LinksProblem, consistent_least_squares
from robot_sysid.estimate.identifiability import analyse_identifiability, visible_space
from robot_sysid.records import Array, Estimate, SquareRootInformation

# Smallest noise, as a share of the root mean square torque: rounding.
_LEAST_NOISE = 1e-9


def identify_parameters(
    information: SquareRootInformation, prior: Array, possible: bool = False
) -> Estimate:
    """Return the estimate of all p parameters by ordinary least squares.

    Parameters that the data does not identify keep the prior's value. The first ten are those of
    the terminal link, the body that ``possible`` constrains.

    Args:
        information: the equations of all joints.
        prior: (p,) the model's own values, in the order of ``information.names``.
        possible: whether a terminal link that is no possible rigid body is estimated again, with
            the constraint to be one.
    """
    matrix, right_side = information.equations()
    space = visible_space(matrix)
    free = prior + space.solve(right_side - matrix @ prior)
    freedom = max(information.n_samples - space.rank, 1)
    torque = np.linalg.norm(right_side) / np.sqrt(max(information.n_samples, 1))
    rms = np.sqrt(np.sum(information.squared_residuals(free)) / freedom)
    noise = float(max(rms, _LEAST_NOISE * torque)) or 1.0
    values = free
    if possible and not spatial.is_consistent(free[:N_INERTIAL]):
        # Near this body the solver looks for possible ones; other parameters are zero in it.
        link_only = np.append(prior[:N_INERTIAL], np.zeros(len(prior) - N_INERTIAL))
        problem = LinksProblem((np.arange(N_INERTIAL),), link_only)
        values = consistent_least_squares(matrix / noise, right_side / noise, problem)
    covariance = noise**2 * space.inverse()
    errors = np.where(space.is_identified, np.sqrt(np.diag(covariance)), np.inf)
    joints = [joint.joint for joint in information.joints]
    counts = np.array([joint.n_samples for joint in information.joints])
    squares = information.squared_residuals(values)
    rms_per_joint = np.sqrt(squares / np.maximum(counts, 1)).tolist()
    return Estimate(
        names=information.names,
        values=values,
        identifiability=analyse_identifiability(matrix, information.names, joints[-1]),
        rmse=float(np.sqrt(np.sum(squares) / max(information.n_samples, 1))),
        rmse_per_joint=dict(zip(joints, rms_per_joint)),
        standard_errors=errors,
        noise_per_joint={j: noise for j, count in zip(joints, counts) if count},
        samples=dict(zip(joints, counts.tolist())),
    )

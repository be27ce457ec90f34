"""From square-root information to an estimate by plain least squares."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.spatial import N_INERTIAL
from robot_sysid.estimation.algebra.consistent_bodies import (
    LinksProblem,
    consistent_least_squares,
)
from robot_sysid.estimation.algebra.identifiability import analyse_identifiability
from robot_sysid.estimation.algebra.least_squares import (
    ordinary_noise,
    residual_errors,
    solver,
)
from robot_sysid.estimation.algebra.uncertainty import uncertainty
from robot_sysid.records import Array, Estimate, SquareRootInformation


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
    solve = solver(information, prior)
    # The standard deviation of each joint's torque [N m]; rows are weighted by its inverse.
    noise = ordinary_noise(information, solve)
    free, _ = solve(1.0 / noise)
    values = free
    if possible and not spatial.is_consistent(free[:N_INERTIAL]):
        # Near this body the solver looks for possible ones; other parameters are zero in it.
        link_only = np.append(prior[:N_INERTIAL], np.zeros(len(prior) - N_INERTIAL))
        problem = LinksProblem((np.arange(N_INERTIAL),), link_only)
        equations = information.equations(1.0 / noise)
        values = consistent_least_squares(*equations, problem)
    errors = uncertainty(information, 1.0 / noise, noise)
    n_samples = {}
    noise_per_joint = {}
    for joint, joint_noise in zip(information.joints, noise.tolist()):
        n_samples[joint.joint] = float(joint.n_samples)
        if joint.n_samples:
            noise_per_joint[joint.joint] = joint_noise
    return Estimate(
        names=information.names,
        values=values,
        identifiability=analyse_identifiability(information),
        **residual_errors(information, values),
        method="ols",
        covariance=errors.covariance,
        standard_errors=errors.standard_errors,
        noise_per_joint=noise_per_joint,
        effective_samples=n_samples,
        constrained=bool(np.any(values != free)),
    )

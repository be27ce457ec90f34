"""The solver with priors of nuisances and noise that is correlated in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.estimation.algebra.least_squares import (
    estimate_noise,
    ordinary_noise,
    solver,
)
from robot_sysid.estimation.algebra.priors import with_prior
from robot_sysid.estimation.algebra.uncertainty import (
    collect_residuals,
    joint_space,
    uncertainty,
)
from robot_sysid.solver import identify_parameters

METHODS = {"ols": ordinary_noise, "wls": estimate_noise}


def prior_errors(errors, group, names):
    """Return the share of the standard errors (p,) that the prior of some nuisances causes."""
    spread = np.linalg.norm(group.covariance_rows(names, errors.inverse), axis=0)
    return np.where(np.isfinite(errors.standard_errors), spread, np.inf)


def identify(information, prior, method="ols", samples=None, nuisances=()):
    """Return an estimate as of ``solver.identify_parameters``, made from more than the triangles.

    Args:
        information: square-root information of all joints.
        prior: (p,) values of what the data does not show.
        method: "ols" or "wls".
        samples: equations (joint number, rows, torque), for noise that is correlated in time.
        nuisances: priors of the last parameters.
    """
    information = with_prior(information, nuisances)
    solve = solver(information, prior)
    noise = METHODS[method](information, solve)
    weights = 1.0 / noise
    values, _ = solve(weights)
    residuals = []
    if samples is not None:
        root = joint_space(information, weights).inverse_root()
        residuals = collect_residuals(information, samples, values, root, weights)
    errors = uncertainty(information, weights, noise, residuals)
    joints = [joint.joint for joint in information.joints]
    return replace(
        identify_parameters(information, prior),
        values=values,
        method=method,
        covariance=errors.covariance,
        standard_errors=errors.standard_errors,
        noise_per_joint=dict(zip(joints, noise.tolist())),
        effective_samples=dict(zip(joints, errors.effective)),
    )

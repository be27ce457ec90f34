"""The solver with what the core knows beside the data: samples and nuisances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.estimation.algebra.autocorrelation import collect_residuals
from robot_sysid.estimation.algebra.least_squares import (
    estimate_noise,
    ordinary,
    solver,
)
from robot_sysid.estimation.algebra.nuisances import with_prior
from robot_sysid.estimation.algebra.uncertainty import joint_space, uncertainty
from robot_sysid.solver import identify_parameters

METHODS = {"ols": ordinary, "wls": estimate_noise}


def explained(errors, group, names):
    """The part of the standard errors (p,) that what is known of some nuisances stands for."""
    spread = np.linalg.norm(group.covariance_rows(names, errors.inverse), axis=0)
    return np.where(np.isfinite(errors.standard_errors), spread, np.inf)


def identified(information, prior, method="ols", samples=None, nuisances=()):
    """An estimate as ``solver.identify_parameters`` makes it, of more than the data's triangles.

    ``samples`` are for noise that is correlated in time; ``nuisances`` are what is known of the
    last parameters.
    """
    information = with_prior(information, nuisances)
    solved = solver(information, prior)
    noise = METHODS[method](information, solved)
    weights = 1.0 / noise
    values, _ = solved(weights)
    left = []
    if samples is not None:
        root = joint_space(information, weights).inverse_root()
        left = collect_residuals(information, samples, values, root, weights)
    errors = uncertainty(information, weights, noise, left)
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

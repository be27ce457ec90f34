"""The solver with what the core knows beside the data: samples, nuisances, motion that repeats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.estimation.algebra.autocorrelation import collect_residuals
from robot_sysid.estimation.algebra.identifiability import analyse_identifiability
from robot_sysid.estimation.algebra.information import joint_rmse, restricted, sample_counts
from robot_sysid.estimation.algebra.least_squares import least_squares, ordinary, weighted
from robot_sysid.estimation.algebra.nuisances import with_prior
from robot_sysid.estimation.algebra.uncertainty import (
    coloured_uncertainty,
    joint_space,
    white_uncertainty,
)
from robot_sysid.solver import identify_parameters

METHODS = {"ols": ordinary, "wls": weighted}


def explained(errors, group, names):
    """The part of the standard errors (p,) that what is known of some nuisances stands for."""
    spread = np.diag(errors.inverse @ group.precision(names) @ errors.inverse)
    return np.where(np.isfinite(errors.standard_errors), np.sqrt(np.maximum(spread, 0.0)), np.inf)


def identified(
    information, prior, method="ols", samples=None, nuisances=(), inflation=None, residuals=None
):
    """An estimate as ``solver.identify_parameters`` makes it, of more than the data's triangles.

    ``samples`` (or what a pass over them left, ``residuals``) are for noise that is correlated in
    time; ``nuisances`` are what is known of the last parameters; ``inflation``
    (joints,) is by how much less than independent samples each joint's count.
    """
    information = with_prior(information, nuisances)
    fewer = np.ones(len(information.joints)) if inflation is None else inflation
    equations = METHODS[method](information, prior)
    equations = replace(equations, noise=equations.noise * np.sqrt(fewer))
    values = least_squares(information, prior, 1.0 / equations.noise)
    known = sum(len(group.names) for group in nuisances)
    interest = information.names[: len(information.names) - known]
    left = residuals if samples is None else _residuals(information, equations, values, samples)
    errors, effective = _errors(information, equations, left, fewer)
    plain = identify_parameters(information, prior)
    counts = plain.samples
    noise = dict(zip(counts, (equations.noise / np.sqrt(fewer)).tolist()))
    return replace(
        plain,
        values=values,
        identifiability=analyse_identifiability(restricted(information, interest)),
        rmse_per_joint=dict(zip(counts, joint_rmse(information, values).tolist())),
        method=method,
        covariance=errors.covariance,
        standard_errors=errors.standard_errors,
        noise_errors=errors.noise_errors,
        error_budget={g.cause: explained(errors, g, information.names) for g in nuisances},
        noise_per_joint={joint: noise[joint] for joint, count in counts.items() if count},
        effective_samples=dict(zip(counts, effective)),
    )


def _errors(information, equations, residuals, inflation):
    """Return (uncertainty, effective number of samples per joint)."""
    weights = 1.0 / equations.noise
    if residuals is None:
        counts = (sample_counts(information) / inflation).tolist()
        return white_uncertainty(information, weights, equations.noise), counts
    repeated = [replace(r, products=d * r.products) for r, d in zip(residuals, inflation)]
    found, effective = coloured_uncertainty(information, weights, repeated)
    return found, [n / d for n, d in zip(effective, inflation.tolist())]


def _residuals(information, equations, values, samples):
    weights = 1.0 / equations.noise
    root = joint_space(information, weights).inverse_root()
    return collect_residuals(information, samples, values, root, weights)

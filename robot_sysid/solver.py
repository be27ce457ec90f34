"""From square-root information to an Estimate, by the estimator's name."""

from __future__ import annotations

import math

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.consistency import consistent_least_squares
from robot_sysid.estimation.algebra.identifiability import N_INERTIAL, analyse_identifiability
from robot_sysid.estimation.algebra.information import joint_rmse
from robot_sysid.estimation.algebra.least_squares import WeightedEquations, least_correction
from robot_sysid.estimation.algebra.options import ESTIMATORS, EstimationOptions
from robot_sysid.estimation.algebra.uncertainty import white_uncertainty, with_body_prior
from robot_sysid.records import Array, Estimate, SquareRootInformation


def identify_parameters(
    information: SquareRootInformation,
    prior: Array,
    method: str = "ols",
    options: EstimationOptions | None = None,
) -> Estimate:
    """Estimate all parameters; what the data cannot see keeps the prior's value.

    Args:
        prior: (p,) the model's own values, in the order of ``information.names``.
        method: name of the estimator: "ols" or "wls"; "robust" needs every sample.
        options: physical consistency and prior; None takes the plain estimate.

    Raises:
        InputError: the method is unknown, or it is "robust".
    """
    chosen = options or EstimationOptions(consistency="off")
    if method not in ESTIMATORS:
        raise InputError(f"unknown method {method!r}; valid: {', '.join(ESTIMATORS)}")
    equations = ESTIMATORS[method](information, prior, None)
    values, constrained = solve(equations, prior, chosen)
    weights = 1.0 / equations.noise
    errors = white_uncertainty(information, weights, equations.noise)
    if chosen.entropic_weight:
        body, pull = prior[:N_INERTIAL], chosen.entropic_weight
        errors = with_body_prior(errors, information, weights, body, pull)
    counts = {joint.joint: joint.n_samples for joint in information.joints}
    noise = dict(zip(counts, equations.noise.tolist()))
    squared = float(np.sum(information.squared_residuals(values)))
    return Estimate(
        names=information.names,
        values=values,
        identifiability=analyse_identifiability(information),
        rmse=math.sqrt(squared / max(information.n_samples, 1)),
        rmse_per_joint=dict(zip(counts, joint_rmse(information, values).tolist())),
        method=method,
        covariance=errors.covariance,
        standard_errors=errors.standard_errors,
        noise_errors=errors.noise_errors,
        data_share=errors.data_share,
        noise_per_joint={joint: noise[joint] for joint, count in counts.items() if count},
        samples=counts,
        effective_samples={joint: float(count) for joint, count in counts.items()},
        constrained=constrained,
    )


def solve(
    equations: WeightedEquations, prior: Array, options: EstimationOptions
) -> tuple[Array, bool]:
    """Return (values (p,), whether they are a constrained fit) of whitened equations.

    Args:
        prior: (p,) the model's values.
    """
    matrix, right = equations.whitened()
    if options.entropic_weight > 0.0:
        return consistent_least_squares(matrix, right, prior, options.entropic_weight), False
    free = least_correction(matrix, right, prior)
    possible = options.consistency == "auto" and spatial.is_consistent(free[:N_INERTIAL])
    if options.consistency == "off" or possible:
        return free, False
    values = consistent_least_squares(matrix, right, prior)
    return values, bool(np.any(values != free))

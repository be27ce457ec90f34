"""From square-root information to an Estimate, by the estimator's name."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import InputError
from robot_sysid.estimation.autocorrelation import collect_residuals
from robot_sysid.estimation.consistency import consistent_least_squares
from robot_sysid.estimation.identifiability import N_INERTIAL, analyse_identifiability
from robot_sysid.estimation.information import joint_rmse, sample_counts
from robot_sysid.estimation.least_squares import WeightedEquations, least_correction
from robot_sysid.estimation.options import ESTIMATORS, EstimationOptions
from robot_sysid.estimation.uncertainty import (
    Uncertainty,
    coloured_uncertainty,
    joint_space,
    prior_curvature,
    white_uncertainty,
)
from robot_sysid.records import (
    Array,
    Estimate,
    Identifiability,
    SampleSource,
    SquareRootInformation,
    Status,
)

_KNOWN_MASS = 1e-6
"""Standard error of the mass that is never too large [kg]."""


def identify_parameters(
    information: SquareRootInformation,
    prior: Array,
    method: str = "ols",
    options: EstimationOptions | None = None,
    samples: SampleSource | None = None,
) -> Estimate:
    """Estimate all parameters; what the data cannot see keeps the prior's value.

    Args:
        information: the data.
        prior: (p,) the model's own values, in the order of ``information.names``.
        method: name of the estimator: "ols", "wls" or "robust".
        options: physical consistency and prior; None takes the plain estimate.
        samples: the same equations sample by sample; with them the standard errors allow for noise
            that is correlated in time. "robust" needs them.

    Raises:
        InputError: the method is unknown, or it is "robust" and there are no samples.
    """
    if method not in ESTIMATORS:
        raise InputError(f"unknown method {method!r}; valid: {', '.join(ESTIMATORS)}")
    chosen = options or EstimationOptions(consistency="off")
    equations = ESTIMATORS[method](information, prior, samples)
    values, constrained = solve(equations, prior, chosen)
    identifiability = analyse_identifiability(information)
    errors, effective = _errors(information, equations, values, chosen, samples)
    squared = np.sum(information.squared_residuals(values))
    counts = {joint.joint: joint.n_samples for joint in information.joints}
    noise = dict(zip(counts, equations.noise.tolist()))
    return Estimate(
        names=information.names,
        values=values,
        identifiability=identifiability,
        rmse=float(np.sqrt(squared / max(information.n_samples, 1))),
        rmse_per_joint=dict(zip(counts, joint_rmse(information, values).tolist())),
        status=judge(values, identifiability, errors.standard_errors),
        method=method,
        covariance=errors.covariance,
        standard_errors=errors.standard_errors,
        data_share=errors.data_share,
        noise_per_joint={joint: noise[joint] for joint, count in counts.items() if count},
        samples=counts,
        effective_samples=dict(zip(counts, effective)),
        constrained=constrained,
    )


def solve(
    equations: WeightedEquations, prior: Array, options: EstimationOptions
) -> tuple[Array, bool]:
    """Return (values (p,), whether they are a constrained fit) of whitened equations.

    Args:
        equations: what an estimator hands on.
        prior: (p,) the model's values.
        options: consistency and prior.
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


def judge(values: Array, identifiability: Identifiability, errors: Array) -> Status:
    """Return how the identification ended.

    Args:
        values: (p,) the estimate.
        identifiability: what the data sees.
        errors: (p,) standard errors.
    """
    if not spatial.is_consistent(values[:N_INERTIAL]):
        return Status.INCONSISTENT
    if np.isfinite(errors[0]) and errors[0] > max(_KNOWN_MASS, 0.5 * values[0]):
        return Status.TOO_WEAK
    if identifiability.rank < identifiability.n_parameters:
        return Status.PARTLY_FROM_MODEL
    return Status.OK


def _errors(
    information: SquareRootInformation,
    equations: WeightedEquations,
    values: Array,
    options: EstimationOptions,
    samples: SampleSource | None,
) -> tuple[Uncertainty, list[float]]:
    """Return (uncertainty, effective number of samples per joint)."""
    weights = 1.0 / equations.noise
    curvature = prior_curvature(values[:N_INERTIAL], options.entropic_weight, len(values))
    if samples is None:
        counts = sample_counts(information).tolist()
        return white_uncertainty(information, weights, equations.noise, curvature), counts
    space = joint_space(information, weights, curvature)
    root, clip = space.inverse_root(), equations.clip
    residuals = collect_residuals(information, samples, values, clip, root, weights)
    return coloured_uncertainty(space, weights, residuals, curvature)

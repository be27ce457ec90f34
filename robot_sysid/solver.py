"""From square-root information to an Estimate, by the estimator's name."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import InputError
from robot_sysid.estimation.autocorrelation import collect_residuals
from robot_sysid.estimation.consistency import consistent_least_squares
from robot_sysid.estimation.identifiability import (
    N_INERTIAL,
    analyse_identifiability,
    visible_space,
)
from robot_sysid.estimation.least_squares import WeightedEquations
from robot_sysid.estimation.options import ESTIMATORS, EstimationOptions
from robot_sysid.estimation.uncertainty import (
    Uncertainty,
    coloured_uncertainty,
    inverse_root,
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
    checked_array,
)

_KNOWN_MASS = 1e-6
"""Standard error of the mass that is never too large [kg]."""


def identify_parameters(
    information: SquareRootInformation,
    prior: Array,
    method: str = "ols",
    options: EstimationOptions | None = None,
    samples: SampleSource | None = None,
    terminal_joint: str | None = None,
) -> Estimate:
    """Estimate all parameters; what the data cannot see keeps the prior's value.

    Args:
        information: the data.
        prior: (p,) the model's own values, in the order of ``information.names``.
        method: name of the estimator: "ols", "wls" or "robust".
        options: physical consistency and prior; None takes the plain estimate.
        samples: the same equations sample by sample; with them the standard errors allow for noise
            that is correlated in time. "robust" needs them.
        terminal_joint: name of the terminal joint, if it is not the information's last.

    Returns:
        The estimate with rank, condition, residuals and a status that names cause and remedy.

    Raises:
        InputError: unknown method or option; lists the valid ones.
    """
    if method not in ESTIMATORS:
        raise InputError(f"unknown method {method!r}; valid: {', '.join(ESTIMATORS)}")
    chosen = options or EstimationOptions(consistency="off")
    prior = checked_array(prior, (len(information.names),), "prior")
    equations = ESTIMATORS[method](information, prior, samples)
    values, constrained = solve(equations, prior, chosen)
    identifiability = analyse_identifiability(information, terminal_joint)
    rmse, per_joint = torque_rmse(information, values)
    errors, effective = _errors(information, equations, values, chosen, samples)
    joints = [joint.joint for joint in information.joints]
    return Estimate(
        names=information.names,
        values=values,
        identifiability=identifiability,
        rmse=rmse,
        rmse_per_joint=per_joint,
        status=judge(values, identifiability, errors.standard_errors),
        method=method,
        covariance=errors.covariance,
        standard_errors=errors.standard_errors,
        data_share=errors.data_share,
        noise_per_joint=_noise(information, equations),
        samples={joint.joint: joint.n_samples for joint in information.joints},
        effective_samples=dict(zip(joints, effective)),
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
    free = prior + visible_space(matrix).solve(right - matrix @ prior)
    possible = options.consistency == "auto" and spatial.is_consistent(free[:N_INERTIAL])
    if options.consistency == "off" or possible:
        return free, False
    values = consistent_least_squares(matrix, right, prior)
    return values, bool(np.any(values != free))


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
        counts = [float(joint.n_samples) for joint in information.joints]
        noise = equations.noise
        return white_uncertainty(equations.information, weights, noise, curvature), counts
    root = inverse_root(information, weights, curvature)
    residuals = collect_residuals(information, samples, values, equations.clip, root, weights)
    return coloured_uncertainty(information, weights, residuals, curvature)


def _noise(information: SquareRootInformation, equations: WeightedEquations) -> dict[str, float]:
    pairs = zip(information.joints, equations.noise)
    return {joint.joint: float(noise) for joint, noise in pairs if joint.n_samples}

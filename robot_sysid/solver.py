"""From square-root information to an Estimate, by the estimator's name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import InputError
from robot_sysid.estimation.autocorrelation import JointResiduals, collect_residuals
from robot_sysid.estimation.consistency import consistent_least_squares
from robot_sysid.estimation.identifiability import N_INERTIAL, analyse_identifiability
from robot_sysid.estimation.information import joint_rmse, restricted, sample_counts
from robot_sysid.estimation.least_squares import WeightedEquations, least_correction
from robot_sysid.estimation.nuisances import NuisanceGroup, with_prior
from robot_sysid.estimation.options import ESTIMATORS, EstimationOptions
from robot_sysid.estimation.uncertainty import (
    Uncertainty,
    coloured_uncertainty,
    joint_space,
    white_uncertainty,
    with_body_prior,
)
from robot_sysid.records import (
    Array,
    Estimate,
    Identifiability,
    SampleSource,
    SquareRootInformation,
)


def identify_parameters(
    information: SquareRootInformation,
    prior: Array,
    method: str = "ols",
    options: EstimationOptions | None = None,
    samples: SampleSource | None = None,
    nuisances: Sequence[NuisanceGroup] = (),
    inflation: Array | None = None,
    residuals: Sequence[JointResiduals] | None = None,
) -> Estimate:
    """Estimate all parameters; what the data cannot see keeps the prior's value.

    Args:
        information: the data.
        prior: (p,) the model's own values, in the order of ``information.names``.
        method: name of the estimator: "ols", "wls" or "robust".
        options: physical consistency and prior; None takes the plain estimate.
        samples: the same equations sample by sample; with them the standard errors allow for noise
            that is correlated in time. "robust" needs them.
        nuisances: what is known beforehand of the last parameters.
        inflation: (joints,) by how much less than independent samples each joint's count, see
            ``signals.repetition``; None for no less.
        residuals: what a pass over the samples left, in place of the samples.

    Raises:
        InputError: the method is unknown, or it is "robust" and there are no samples.
    """
    chosen = options or EstimationOptions(consistency="off")
    information = with_prior(information, nuisances)
    fewer = np.ones(len(information.joints)) if inflation is None else inflation
    equations = _weighed(information, prior, method, samples, fewer)
    values, constrained = solve(equations, prior, chosen)
    n_nuisances = sum(len(group.names) for group in nuisances)
    identifiability = _identifiability(information, n_nuisances)
    left = residuals if samples is None else _residuals(information, equations, values, samples)
    errors, effective = _errors(information, equations, left, fewer)
    counts = {joint.joint: joint.n_samples for joint in information.joints}
    noise = dict(zip(counts, (equations.noise / np.sqrt(fewer)).tolist()))
    return Estimate(
        names=information.names,
        values=values,
        identifiability=identifiability,
        rmse=_rmse(information, values),
        rmse_per_joint=dict(zip(counts, joint_rmse(information, values).tolist())),
        method=method,
        covariance=errors.covariance,
        standard_errors=errors.standard_errors,
        noise_errors=errors.noise_errors,
        error_budget={g.cause: errors.budget(g.precision(information.names)) for g in nuisances},
        data_share=_data_share(prior, chosen, errors, equations),
        noise_per_joint={joint: noise[joint] for joint, count in counts.items() if count},
        samples=counts,
        effective_samples=dict(zip(counts, effective)),
        constrained=constrained,
        n_nuisances=n_nuisances,
    )


def _rmse(information: SquareRootInformation, values: Array) -> float:
    squared = float(np.sum(information.squared_residuals(values)))
    return math.sqrt(squared / max(information.n_samples, 1))


def _identifiability(information: SquareRootInformation, n_nuisances: int) -> Identifiability:
    interest = information.names[: len(information.names) - n_nuisances]
    return analyse_identifiability(restricted(information, interest))


def _weighed(
    information: SquareRootInformation,
    prior: Array,
    method: str,
    samples: SampleSource | None,
    inflation: Array,
) -> WeightedEquations:
    """Return what an estimator hands on, each joint's noise as it counts."""
    if method not in ESTIMATORS:
        raise InputError(f"unknown method {method!r}; valid: {', '.join(ESTIMATORS)}")
    equations = ESTIMATORS[method](information, prior, samples)
    return replace(equations, noise=equations.noise * np.sqrt(inflation))


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


def _errors(
    information: SquareRootInformation,
    equations: WeightedEquations,
    residuals: Sequence[JointResiduals] | None,
    inflation: Array,
) -> tuple[Uncertainty, list[float]]:
    """Return (uncertainty, effective number of samples per joint)."""
    weights = 1.0 / equations.noise
    if residuals is None:
        counts = (sample_counts(information) / inflation).tolist()
        return white_uncertainty(information, weights, equations.noise), counts
    repeated = [replace(r, products=d * r.products) for r, d in zip(residuals, inflation)]
    found, effective = coloured_uncertainty(information, weights, repeated)
    return found, [n / d for n, d in zip(effective, inflation.tolist())]


def _residuals(
    information: SquareRootInformation,
    equations: WeightedEquations,
    values: Array,
    samples: SampleSource,
) -> list[JointResiduals]:
    weights = 1.0 / equations.noise
    root = joint_space(information, weights).inverse_root()
    return collect_residuals(information, samples, values, equations.clip, root, weights)


def _data_share(
    prior: Array, options: EstimationOptions, errors: Uncertainty, equations: WeightedEquations
) -> Array:
    """Return (p,) how much of each value is the data's; the model's body may have some of it."""
    if options.entropic_weight == 0.0:
        return errors.data_share
    information, weights = equations.information, 1.0 / equations.noise
    body, pull = prior[:N_INERTIAL], options.entropic_weight
    return with_body_prior(errors, information, weights, body, pull).data_share

"""Weighted least squares: each joint's equations are divided by that joint's own noise."""

from __future__ import annotations

import numpy as np

from robot_sysid.estimators.ols import least_squares
from robot_sysid.estimators.options import EstimatorOptions
from robot_sysid.estimators.weighting import WeightedEquations, joint_noise, no_clip
from robot_sysid.records import Array, SampleSource, SquareRootInformation

_SETTLED = 1e-8


def weighted(
    information: SquareRootInformation,
    prior: Array,
    options: EstimatorOptions,
    samples: SampleSource | None = None,
) -> WeightedEquations:
    """Find noise and estimate in turns until the noise settles.

    Iterated feasible generalised least squares; for independent normal noise the fixed point is
    the maximum-likelihood estimate (Oberhofer, Kmenta 1974).
    """
    weights = np.ones(len(information.joints))
    noise = joint_noise(information, least_squares(information, prior), weights)
    for _ in range(options.max_iterations):
        values = least_squares(information, prior, 1.0 / noise)
        before, noise = noise, joint_noise(information, values, 1.0 / noise)
        if np.max(np.abs(noise / before - 1.0)) < _SETTLED:
            break
    return WeightedEquations(information, noise, no_clip(information))

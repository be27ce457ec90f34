"""Ordinary least squares: all joints' equations count alike."""

from __future__ import annotations

import numpy as np

from robot_sysid.estimators.options import EstimatorOptions
from robot_sysid.estimators.weighting import WeightedEquations, leverage, no_clip, noise_floor
from robot_sysid.identifiability import visible_space
from robot_sysid.records import Array, SampleSource, SquareRootInformation


def ordinary(
    information: SquareRootInformation,
    prior: Array,
    options: EstimatorOptions,
    samples: SampleSource | None = None,
) -> WeightedEquations:
    """Weigh all joints alike; the common noise comes from all residuals together."""
    ones = np.ones(len(information.joints))
    squared = float(np.sum(information.squared_residuals(least_squares(information, prior))))
    freedom = max(information.n_samples - float(np.sum(leverage(information, ones))), 1.0)
    common = max(np.sqrt(squared / freedom), noise_floor(information))
    return WeightedEquations(information, common * ones, no_clip(information))


def least_squares(
    information: SquareRootInformation, prior: Array, weights: Array | None = None
) -> Array:
    """Return x = prior + argmin_d ||A d - (b - A prior)||, of minimum norm in scaled columns.

    Whatever A cannot see keeps the prior's value, because d has no part there.

    Args:
        information: the data, A and b.
        prior: (p,) values to stay at where the data is blind.
        weights: (joints,) weight of each joint's equations [1/(N m)]; None weighs all alike.
    """
    matrix, right = information.stacked(weights)
    return prior + visible_space(matrix).solve(right - matrix @ prior)

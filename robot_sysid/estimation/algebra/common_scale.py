"""An error that the torque scales of all joints share: when results note it.

Where the model's links are the only reference, torques that all read 10 % too high and links that
are all 10 % lighter than modelled give the same equations. A prior for a common scale is used where
the recordings show such a scale, so that arms whose links are all off by chance raise false alarms.
"""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import numpy as np

from robot_sysid.estimation.algebra.priors import NuisanceGroup
from robot_sysid.records import Array

# Standard deviation of a mean that is held, as a share of that of all other directions.
_HELD = 1e-9
LEAST_SCALE = 0.08
"""Smallest common torque scale (relative) that results note: 1.5 times the default error of links.
"""
SIGNIFICANT = 1.0
"""Standard errors from zero above which the common scale is significant: torques that read 15 % too
high or too low reach 1.15 and more, links that are 2 % off at most 0.4 (benchmarks/confusion)."""


def is_notable_scale(scales: Array, spread: Array) -> bool:
    """Return whether the mean torque scale is significant and large enough to be noted in results.

    Args:
        scales: (joints,) estimated relative errors of the torque scales, 0.1 for 10 %.
        spread: (joints, joints) covariance of these estimates.
    """
    # The mean of all elements of a covariance is the variance of the mean.
    least = max(SIGNIFICANT * sqrt(np.mean(spread)), LEAST_SCALE)
    return bool(abs(np.mean(scales)) > least)


def with_common(group: NuisanceGroup, common_deviation: float) -> NuisanceGroup:
    """Return a prior with one more error, which acts alike on all nuisances of the group.

    Args:
        group: the prior without this error; not changed, returned as it is for a deviation of zero.
        common_deviation: standard deviation of the additional error [SI].
    """
    if not common_deviation:
        return group
    # The common error has this variance in all elements; the factor is the symmetric root.
    covariance = group.factor @ group.factor.T + common_deviation**2
    values, vectors = np.linalg.eigh(covariance)
    return replace(group, factor=vectors @ (np.sqrt(values)[:, None] * vectors.T))


def common_error(spread: Array) -> float:
    """Return the standard deviation of the mean of torque scales, weighted by 1 / variance.

    It is zero where one scale is known exactly.

    Args:
        spread: (joints,) standard deviations of the scales, whose errors are independent.
    """
    return 1.0 / float(np.linalg.norm(1.0 / spread)) if np.all(spread > 0.0) else 0.0


def hold_mean(scales: NuisanceGroup, cause: str) -> NuisanceGroup:
    """Return a prior that holds the mean error of torque scales at zero, weighted by 1 / variance.

    A scale that all joints have in common scales every mass alike. Only the model's masses could
    identify it. They are not trusted where a payload is weighed, so that the common scale is held
    at zero and counts as a cause of error. Of scales with independent priors, this mean is
    independent of all their differences.

    Args:
        scales: prior of the torque scales, independent of each other; the result is used beside it.
        cause: cause of error of the returned prior, as it is called in results.
    """
    weights = np.diag(scales.factor) ** -2
    mean = np.outer(weights, weights) / (weights @ weights)
    # Standard deviation 1e3 * _HELD along the mean, and 1e3, which is no constraint, across.
    factor = np.eye(len(weights)) - (1.0 - _HELD) * mean
    return replace(scales, cause=cause, factor=1e3 * factor, may_widen=False)

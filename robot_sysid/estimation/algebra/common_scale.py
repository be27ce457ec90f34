"""An error that the torque scales of all joints share: when results note it, and false alarms.

Where the model's links are the only reference, torques that all read 10 % too high and links that
are all 10 % lighter than modelled give the same equations. A prior for a common scale is used where
the recordings show such a scale, so that arms whose links are all off by chance raise false alarms.
"""

from __future__ import annotations

from dataclasses import replace
from math import erfc, exp, pi, sqrt

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
    return bool(abs(np.mean(scales)) > _least_notable_scale(spread))


def _least_notable_scale(spread: Array) -> float:
    """Return the smallest mean scale (relative) that results note.

    ``spread`` (joints, joints) is the covariance of the scales.
    """
    # The mean of all elements of a covariance is the variance of the mean.
    return max(SIGNIFICANT * sqrt(np.mean(spread)), LEAST_SCALE)


def false_alarms(
    separate: tuple[Array, Array], common: tuple[Array, Array]
) -> tuple[float, Array]:
    """Return the probability that a common torque scale is noted although there is none, and the
    mean products E[D x x^T D] (joints, joints) over these false alarms.

    The probability is over arms drawn from the prior of separate scales. Estimates x of the scales
    with separate priors become (1 + C_common D) x with a common scale, D = K_separate - K_common, K
    the prior precision of the scales, C their posterior covariance. x is Gaussian; its covariance
    is the prior covariance minus the posterior one. Both results are zero where the data holds no
    information on the scales, so that the two are equal.

    Args:
        separate: (prior, posterior) covariance of the scales with separate priors, each (joints,
            joints).
        common: (prior, posterior) covariance of the scales with a common scale in the prior.
    """
    prior, posterior = separate
    common_prior, common_posterior = common
    # D of the docstring.
    precision_loss = np.linalg.inv(prior) - np.linalg.inv(common_prior)
    # The mean of the scales with a common scale is weights^T x.
    weights = np.mean(np.eye(len(prior)) + common_posterior @ precision_loss, axis=0)
    covariance = prior - posterior
    variance = float(weights @ covariance @ weights)
    # Without information on scales, rounding remains.
    if variance <= 0.0:
        return 0.0, 0.0 * covariance
    # L, the least mean that is noted, in standard deviations.
    limit = _least_notable_scale(common_posterior) / sqrt(variance)
    probability = erfc(limit / sqrt(2.0))
    # The mean square of a unit Gaussian beyond L is 1 + L phi(L) / (1 - Phi(L)) (Johnson, Kotz,
    # Balakrishnan, "Continuous Univariate Distributions", vol. 1, 1994, ch. 13).
    excess = 0.0
    if probability:
        excess = limit * exp(-0.5 * limit**2) * sqrt(2.0 / pi) / probability
    along = covariance @ weights
    products = covariance + excess / variance * np.outer(along, along)
    return probability, precision_loss @ products @ precision_loss


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

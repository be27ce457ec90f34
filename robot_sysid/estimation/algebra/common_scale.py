"""Whether all torques together read too high or too low, and how often that test is wrong.

Where the model's links are the only reference, torques that all read 10 % too high and links
that are all 10 % lighter than modelled look alike. A common torque scale is estimated where a
recording calls for it, so that right recordings of arms whose links are all off by chance raise
false alarms.
"""

from __future__ import annotations

from math import erfc, exp, pi, sqrt

import numpy as np

from robot_sysid.records import Array

LEAST_SCALE = 0.08
"""Common torque scale above which a note is added: one and a half times the default error of links.
"""
SIGNIFICANT = 1.0
"""Standard errors from zero above which the common scale is significant: torques that read 15 % too
high or too low reach 1.15 and more, links that are 2 % off at most 0.4
(benchmarks/wrong_log_table)."""


def is_worth_a_word(scales: Array, spread: Array) -> bool:
    """Tell whether scales (joints,) with covariance (joints, joints) are clearly off together."""
    return bool(abs(np.mean(scales)) > _least(spread))


def _least(spread: Array) -> float:
    return max(SIGNIFICANT * sqrt(np.mean(spread)), LEAST_SCALE)


def false_alarms(
    separate: tuple[Array, Array], common: tuple[Array, Array]
) -> tuple[float, Array]:
    """Return the probability that right recordings call for a common scale, for arms drawn from the
    prior, and the mean products (joints, joints) of D x in that case.

    Estimates x of the scales with separate priors become with a common scale

        (1 + C_common D) x,   D = K_separate - K_common,

    K the prior precision of the scales, C their posterior covariance. The covariance of x, which is
    Gaussian, is the prior covariance minus the posterior one.

    Args:
        separate: (prior, posterior) covariance of the scales, (joints, joints) each.
        common: the same with a common scale.
    """
    prior, posterior = separate
    common_prior, common_posterior = common
    freed = np.linalg.inv(prior) - np.linalg.inv(common_prior)
    weights = np.mean(np.eye(len(prior)) + common_posterior @ freed, axis=0)
    products = prior - posterior
    variance = float(weights @ products @ weights)
    # Without information on scales, rounding remains.
    if variance <= 0.0:
        return 0.0, 0.0 * products
    far = _least(common_posterior) / sqrt(variance)
    along = products @ weights
    share = erfc(far / sqrt(2.0))
    # Of a Gaussian beyond L standard deviations, the square is 1 + L phi(L) / (1 - Phi(L)).
    more = far * exp(-0.5 * far**2) * sqrt(2.0 / pi) / share if share else 0.0
    products = products + more / variance * np.outer(along, along)
    return share, freed @ products @ freed

"""What is known of an arm: values of its parameters, and the covariance of their errors.

After logs (``knowledge_of``) the covariance is that of data, priors and, of what the fit lets free,
priors as wide as an unknown joint or link: a short log leaves combinations free of which other
motions see much. It is raised by the jackknife like every printed error. The covariance of the
file's own fit in its place promises two to four times too little. docs/method.md has how well it
holds.

Shapes: p parameters of motions, J joints with equations.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.estimate.equations.inverse import solve
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.rows import Sums
from robot_sysid.expected.motions import grams
from robot_sysid.expected.unknown import (
    is_told,
    is_without_rows,
    kinds_of,
    learn_priors,
    with_zero_torque,
)
from robot_sysid.records import Array

MOST_RAISED = 2.0
"""Most by which the jackknife raises an error here: it is uncertain itself, and of ten blocks its
largest values are chance. Without it fewer files of real arms are as good as is expected."""


@dataclass(frozen=True)
class Knowledge:
    """What is known of the p parameters of motions, in the order of their sums.

    Attributes:
        values: (p,) of the parameters.
        covariance: (p, p) of the errors of these values.
    """

    values: Array
    covariance: Array

    def of(self, is_part: NDArray[np.bool_]) -> Knowledge:
        """Return what is known of some parameters (p,), the others being zero and known."""
        of_parts = np.outer(is_part, is_part)
        return Knowledge(
            np.where(is_part, self.values, 0.0),
            np.where(of_parts, self.covariance, 0.0),
        )


@dataclass(frozen=True)
class LogKnowledge:
    """What a fit knows of the p parameters of made-up motions, those that its logs lack included.

    Attributes:
        values: (p,) of the fit, what it lets free drawn to what it is without any log
            (``unknown``); the model's of those that it does not estimate.
        precision: (p, p) of data and those priors of the fit that stay.
        wide: (p,) precision of priors that stand in place of the fit's; zero of other parameters.
        raised: (p,) times its error by which the jackknife raises that of a parameter.
        of_scales: (p, p) covariance of what torque scales do beyond their columns.
        weights: (J,) of each joint's rows [1/(N m)].
        row_rate: rows per second of its logs [Hz].
    """

    values: Array
    precision: Array
    wide: Array
    raised: Array
    of_scales: Array
    weights: Array
    row_rate: float

    def after(self, further: Array | float = 0.0) -> Knowledge:
        """Return what is known after the products (p, p) of ``further`` rows are added."""
        # What the jackknife raises is the error of data, not of what nothing is known of.
        raised: Array = self.raised[:, None] * self.raised
        normal = with_zero_torque(
            (self.precision + further) / raised + np.diag(self.wide)
        )
        is_free = np.diag(self.precision) + self.wide > 0.0
        _, inverse = solve(normal, self.values, is_free)
        share = usual_errors.ERRORS_AS_THEY_ARE
        return Knowledge(self.values, share**2 * (inverse + self.of_scales))

    def rows(self, sums: Sums, length: float, weights: Array) -> Array:
        """Return the products (p, p) of the rows of a log that moves as the motions of sums do.

        Args:
            sums: of made-up motions.
            length: of the log [s].
            weights: (J,) of each joint's rows [1/(N m)].
        """
        total = np.zeros(self.precision.shape)
        shares = self.row_rate * length / sums.row_counts
        for weight, share, gram in zip(weights, shares, grams(sums)):
            total += weight**2 * share * gram[:-1, :-1]
        return total


def knowledge_of(fitted: Fit, sums: Sums) -> LogKnowledge:
    """Return what a fit of all terms knows of the parameters of made-up motions.

    Of a joint that stood still no row tells anything: its rows weigh as those of an average one.
    """
    is_still = is_without_rows(fitted)
    noise = fitted.noise * np.sqrt(fitted.correlation)
    average = np.sqrt(np.mean(noise[~is_still] ** 2))
    known = is_told(fitted, sums.names)
    at = np.flatnonzero(known)
    of_fit = fitted.at([*itertools.compress(sums.names, known)])
    precision = np.zeros((len(known), len(known)))
    precision[at[:, None], at] = _marginal_precision(fitted.normal[:-1, :-1], of_fit)
    formal = np.maximum(np.diag(fitted.inverse), 1e-300)
    of_data = np.sqrt(np.clip(fitted.jackknife / formal, 1.0, MOST_RAISED**2))
    raised = np.ones(len(known))
    raised[at] = np.where(fitted.is_hidden, 1.0, of_data)[of_fit]
    of_scales = np.zeros_like(precision)
    of_scales[at[:, None], at] = fitted.scale_errors[of_fit[:, None], of_fit]
    kinds = kinds_of(fitted, sums)
    for kind in kinds:
        precision[kind.at, kind.at] -= kind.replaced
    of_sums = np.array([fitted.by_name[name] for name in sums.names])
    priors = learn_priors(kinds, precision, of_sums)
    first = fitted.recordings[0]
    return LogKnowledge(
        priors.values,
        precision,
        priors.wide,
        raised,
        of_scales,
        1.0 / np.where(is_still, average, noise),
        first.rate / (first.low_pass.step * first.every),
    )


def _marginal_precision(normal: Array, at: NDArray[np.int64]) -> Array:
    """Return the marginal precision (m, m) of some parameters: the others are not known either.

    Made-up motions lack a column of a log, that of its delay.
    """
    others = np.setdiff1d(np.arange(len(normal)), at)
    across = normal[at[:, None], others]
    of_others = normal[others[:, None], others]
    return normal[at[:, None], at] - across @ np.linalg.solve(of_others, across.T)

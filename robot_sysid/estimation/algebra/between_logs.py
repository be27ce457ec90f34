"""How much numbers that belong to one log differ from log to log.

L logs give estimates x_1 ... x_L of the same f numbers, with everything else in common and a
covariance of all of them. In orthonormal contrasts d of the logs (Helmert's), which leave out the
mean, a model with a variance of its own for what differs between logs is

    d ~ N(0, C + T),    T = diag(t^2),

with C what noise makes of the contrasts: its likelihood is the restricted one of meta-analysis
(Harville, "Maximum likelihood approaches to variance component estimation", JASA 72, 1977). Numbers
count one by one in it, as if noise were not correlated between them: of many logs all of C is
large. Two logs give a single difference per number, so that numbers of one kind, such as the
Coulomb friction of all joints, have a share r of their size in common, t = r * size, which is
averaged over a grid. A number's own differences then count beside it, as in a scaled inverse
chi-square prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimation.algebra.least_squares import eliminate_others
from robot_sysid.estimation.algebra.priors import is_no_chance
from robot_sysid.records import Array

SHARES = (0.0, *(0.01 * 2.0**k for k in range(8)))
"""Grid of differences from log to log, as shares of a number's size, equally likely."""
COMMON_FREEDOM = 4.0
"""Weight of the share of a whole kind, in differences of one number."""
SURE_DIFFERENCE = 0.999
"""Significance of a contradiction between logs: the errors of differences are themselves off by up
to a fifth (measured), which 0.99 would not cover."""
# Prior standard deviation, in sizes, of a number that a log does not identify.
_UNSEEN = 100.0


@dataclass(frozen=True)
class BetweenLogs:
    """Estimates of the same f numbers from L logs.

    Attributes:
        values: (L, f) according to each log, with everything else in common.
        errors: (L, f) their standard errors due to the noise of each log.
        spread: (f,) standard deviation from log to log, beyond these errors.
        contrasts: (L - 1, f) orthonormal contrasts of the logs.
        noise: (L - 1, f, L - 1, f) covariance of the contrasts that noise makes.
    """

    values: Array
    errors: Array
    spread: Array
    contrasts: Array
    noise: Array

    def next_log(self, errors: Array) -> Array:
        """Return standard errors (f,) for another log, from those of all logs together."""
        more = 1.0 + 1.0 / len(self.values)
        return np.asarray(np.sqrt(np.square(errors) + more * self.spread**2))

    def differ(self, numbers: NDArray[np.int64], tests: int) -> bool:
        """Tell whether the logs contradict each other in these numbers, as one of several tests."""
        off = self.contrasts[:, numbers].ravel()
        noise = self.noise[:, numbers][:, :, :, numbers].reshape(len(off), len(off))
        squared = float(off @ np.linalg.solve(noise, off))
        return is_no_chance(
            squared, float(len(off)), 1.0 - SURE_DIFFERENCE ** (1.0 / tests)
        )


def compare_logs(
    normals: Sequence[Array],
    prior: Array,
    indices: NDArray[np.int64],
    center: Array,
    sizes: Array,
    kinds: NDArray[np.int64],
) -> BetweenLogs:
    """Return estimates of numbers that may differ between logs.

    Args:
        normals: per log (p + 1, p + 1) [A b]' [A b] of its equations, weighted.
        prior: (p + 1, p + 1) [A b]' [A b] of the priors of all other parameters.
        indices: (f,) of the numbers among the p parameters.
        center: (f,) their values from all logs together.
        sizes: (f,) their typical sizes.
        kinds: (f,) the kind of each number, as an integer.
    """
    count = len(normals)
    values, covariance = _of_each_log(normals, prior, indices, center, sizes)
    change = _helmert(count)
    contrasts = change @ values
    noise = np.einsum("ia,afbg,jb->ifjg", change, covariance, change, optimize=True)
    spread = _spread(contrasts, noise, sizes, kinds)

    # The errors of the contrasts are divided between the logs as the errors of each log alone.
    weak = np.diag((_UNSEEN * sizes) ** -2)
    variances = [
        np.diag(np.linalg.inv(normal[np.ix_(indices, indices)] + weak))
        for normal in normals
    ]
    total = np.einsum("ifif->f", noise) / (1.0 - 1.0 / count)
    errors = np.sqrt(np.array(variances) * total / np.sum(variances, axis=0))
    return BetweenLogs(values, errors, spread, contrasts, noise)


def _of_each_log(
    normals: Sequence[Array],
    prior: Array,
    indices: NDArray[np.int64],
    center: Array,
    sizes: Array,
) -> tuple[Array, Array]:
    """Return values (L, f) according to each log, and their covariance (L, f, L, f)."""
    size = len(prior)
    number = len(indices)
    common = np.setdiff1d(np.arange(size - 1), indices)
    system = np.zeros((len(common) + len(normals) * number + 1,) * 2)
    shared = np.arange(len(common))
    last = len(system) - 1
    at = np.append(shared, last)
    rows = np.append(common, size - 1)
    system[np.ix_(at, at)] = prior[np.ix_(rows, rows)]
    rows = np.concatenate((common, indices, [size - 1]))
    for log, normal in enumerate(normals):
        of_log = len(common) + log * number + np.arange(number)
        at = np.concatenate((shared, of_log, [last]))
        system[np.ix_(at, at)] += normal[np.ix_(rows, rows)]
    matrix, right_side = eliminate_others(system, np.arange(len(common), last))
    weak = np.tile((_UNSEEN * sizes) ** -2, len(normals))
    covariance = np.linalg.inv(matrix + np.diag(weak))
    values = covariance @ (right_side + weak * np.tile(center, len(normals)))
    count = len(normals)
    by_log = np.asarray(covariance.reshape(count, number, count, number))
    return np.asarray(values.reshape(count, number)), by_log


def _helmert(count: int) -> Array:
    """Return orthonormal contrasts (count - 1, count), each row of which adds up to zero."""
    rows = np.tril(np.ones((count, count)), -1)[1:]
    rows[np.arange(count - 1), np.arange(1, count)] = -np.arange(1.0, count)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _spread(
    contrasts: Array, noise: Array, sizes: Array, kinds: NDArray[np.int64]
) -> Array:
    """Return standard deviations (f,) from log to log, of contrasts (L - 1, f) of their noise."""
    # In axes of its own, the noise of a number's contrasts is independent.
    variances, axes = np.linalg.eigh(np.einsum("ifjf->fij", noise))
    turned = np.einsum("fij,if->fj", axes, contrasts)
    common = np.zeros(len(sizes))
    for label in np.unique(kinds):
        is_kind = kinds == label
        between = np.multiply.outer(np.square(SHARES), sizes[is_kind, None] ** 2)
        variance = variances[is_kind] + between
        log_likelihood = -0.5 * np.sum(
            turned[is_kind] ** 2 / variance + np.log(variance), axis=(1, 2)
        )
        probability = np.exp(log_likelihood - np.max(log_likelihood))
        share = np.sqrt(np.square(SHARES) @ probability / np.sum(probability))
        common[is_kind] = share * sizes[is_kind]
    # The expected square of each contrast without its noise.
    gain = common[:, None] ** 2 / (variances + common[:, None] ** 2)
    squares = (gain * turned) ** 2 + gain * variances
    freedom = len(contrasts)
    pooled = COMMON_FREEDOM * common**2 + np.sum(squares, axis=1)
    return np.asarray(np.sqrt(pooled / (COMMON_FREEDOM + freedom)))

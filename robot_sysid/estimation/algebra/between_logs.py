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

from robot_sysid.estimation.algebra.information import eliminate_others
from robot_sysid.estimation.algebra.nuisances import is_no_chance
from robot_sysid.records import Array

SHARES = (0.0, *(0.01 * 2.0**k for k in range(8)))
"""Shares of its size that a number may differ by from log to log, each as likely."""
COMMON_FREEDOM = 4.0
"""Differences that the share of a whole kind counts for, beside those of one number."""
SURE_DIFFERENCE = 0.999
"""Probability with which logs must contradict each other: errors of differences are themselves off
by up to a fifth (measured), which 0.99 would not allow for."""
# Width of what keeps a number in bounds that a log does not show, in units of its size.
_UNSEEN = 100.0


@dataclass(frozen=True)
class BetweenLogs:
    """What L logs say of the same f numbers.

    Attributes:
        values: (L, f) according to each log, with everything else in common.
        errors: (L, f) standard errors of these by what logs do not have in common.
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
        """Tell whether the logs contradict each other in some numbers, one of so many tests."""
        off = self.contrasts[:, numbers].ravel()
        noise = self.noise[:, numbers][:, :, :, numbers].reshape(len(off), len(off))
        squared = float(off @ np.linalg.solve(noise, off))
        return is_no_chance(squared, float(len(off)), 1.0 - SURE_DIFFERENCE ** (1.0 / tests))


def compare_logs(
    normals: Sequence[Array],
    prior: Array,
    places: NDArray[np.int64],
    usual: Array,
    sizes: Array,
    kinds: NDArray[np.int64],
) -> BetweenLogs:
    """Return what logs say of numbers that may differ between them.

    Args:
        normals: per log (p + 1, p + 1) [A b]' [A b] of its equations, weighted.
        prior: (p + 1, p + 1) the same of what is known beforehand of everything else.
        places: (f,) of the numbers among the p parameters.
        usual: (f,) about what they are.
        sizes: (f,) what counts as their size.
        kinds: (f,) numbers of those of one kind.
    """
    count = len(normals)
    values, covariance = _of_each_log(normals, prior, places, usual, sizes)
    change = _helmert(count)
    contrasts = change @ values
    noise = np.einsum("ia,afbg,jb->ifjg", change, covariance, change, optimize=True)
    spread = _spread(contrasts, noise, sizes, kinds)

    # What contrasts are off by, divided between the logs as each would have it by itself.
    weak = np.diag((_UNSEEN * sizes) ** -2)
    own = [np.diag(np.linalg.inv(normal[np.ix_(places, places)] + weak)) for normal in normals]
    whole = np.einsum("ifif->f", noise) / (1.0 - 1.0 / count)
    errors = np.sqrt(np.array(own) * whole / np.sum(own, axis=0))
    return BetweenLogs(values, errors, spread, contrasts, noise)


def _of_each_log(
    normals: Sequence[Array], prior: Array, places: NDArray[np.int64], usual: Array, sizes: Array
) -> tuple[Array, Array]:
    """Return values (L, f) according to each log, and their covariance (L, f, L, f)."""
    size = len(prior)
    number = len(places)
    common = np.setdiff1d(np.arange(size - 1), places)
    whole = np.zeros((len(common) + len(normals) * number + 1,) * 2)
    shared = np.arange(len(common))
    last = len(whole) - 1
    at = np.append(shared, last)
    rows = np.append(common, size - 1)
    whole[np.ix_(at, at)] = prior[np.ix_(rows, rows)]
    rows = np.concatenate((common, places, [size - 1]))
    for log, normal in enumerate(normals):
        own = len(common) + log * number + np.arange(number)
        at = np.concatenate((shared, own, [last]))
        whole[np.ix_(at, at)] += normal[np.ix_(rows, rows)]
    matrix, right = eliminate_others(whole, np.arange(len(common), last))
    weak = np.tile((_UNSEEN * sizes) ** -2, len(normals))
    covariance = np.linalg.inv(matrix + np.diag(weak))
    values = covariance @ (right + weak * np.tile(usual, len(normals)))
    count = len(normals)
    by_log = np.asarray(covariance.reshape(count, number, count, number))
    return np.asarray(values.reshape(count, number)), by_log


def _helmert(count: int) -> Array:
    """Return orthonormal contrasts (count - 1, count), each row of which adds up to zero."""
    rows = np.tril(np.ones((count, count)), -1)[1:]
    rows[np.arange(count - 1), np.arange(1, count)] = -np.arange(1.0, count)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _spread(contrasts: Array, noise: Array, sizes: Array, kinds: NDArray[np.int64]) -> Array:
    """Return standard deviations (f,) from log to log, of contrasts (L - 1, f) of their noise."""
    # In axes of its own, the noise of a number's contrasts is independent.
    variances, axes = np.linalg.eigh(np.einsum("ifjf->fij", noise))
    turned = np.einsum("fij,if->fj", axes, contrasts)
    common = np.zeros(len(sizes))
    for kind in np.unique(kinds):
        own = kinds == kind
        between = np.multiply.outer(np.square(SHARES), sizes[own, None] ** 2)
        whole = variances[own] + between
        log_likelihood = -0.5 * np.sum(turned[own] ** 2 / whole + np.log(whole), axis=(1, 2))
        probability = np.exp(log_likelihood - np.max(log_likelihood))
        share = np.sqrt(np.square(SHARES) @ probability / np.sum(probability))
        common[own] = share * sizes[own]
    # The expected square of each contrast without its noise.
    gain = common[:, None] ** 2 / (variances + common[:, None] ** 2)
    squares = (gain * turned) ** 2 + gain * variances
    freedom = len(contrasts)
    pooled = COMMON_FREEDOM * common**2 + np.sum(squares, axis=1)
    return np.asarray(np.sqrt(pooled / (COMMON_FREEDOM + freedom)))

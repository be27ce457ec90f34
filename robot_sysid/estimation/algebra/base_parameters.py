"""Base parameters: the combinations of the links' parameters that joint torques can show.

Of the ten parameters of a link, many change no torque by themselves, but only in combination with
those of links closer to the base. A QR factorisation with column pivoting finds them (Gautier,
"Numerical calculation of the base inertial parameters of robots", ICRA 1990): with
W P = Q [R1 R2; 0 0], R1 of full rank r, the first r columns of W P span all, and

    x_base = x_1 + R1^-1 R2 x_2.

Which of them a log needs follows from backward elimination: the one with the largest relative
standard deviation is removed and the others are fitted again, until the largest is no more than 30
times the smallest (Pham, Gautier, "Essential parameters of robots", CDC 1991) or is below 10 %. It
is a report on the data; the estimate does not use it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimation.algebra.identifiability import in_words
from robot_sysid.records import Array

RELATIVE_CUT = 1e-8
"""Diagonal entries of R below this share of the largest count as zero."""
ESSENTIAL_RATIO = 30.0
"""How many times the smallest relative standard deviation an essential parameter may have."""
WELL_KNOWN = 0.1
"""Relative standard deviation below which a parameter is essential in any case."""
_ROUNDING = 1e-5
# Relative difference up to which two columns count as equal.
_ALIKE = 1e-6


@dataclass(frozen=True)
class BaseCombinations:
    """The parameter combinations that a regressor identifies, x_base = matrix x.

    Attributes:
        matrix: (r, p).
        leading: (r,) index of the parameter that names each combination.
    """

    matrix: Array
    leading: NDArray[np.int64]

    @property
    def rank(self) -> int:
        """Number of combinations r."""
        return len(self.leading)

    def names(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the combinations in words, with the parameters' names (p,)."""
        return tuple(
            in_words(row, int(first), names)
            for row, first in zip(self.matrix, self.leading)
        )


def base_combinations(regressor: Array, scale: Array) -> BaseCombinations:
    """Return the base parameters of a regressor (M, p), with typical parameter sizes (p,)."""
    from scipy.linalg import qr, solve_triangular

    # Of equal columns the first one leads, whatever their rounding.
    scale = scale * (1.0 - _ALIKE * np.arange(len(scale)))
    triangle, order = qr(regressor * scale, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(triangle))
    rank = int(
        np.count_nonzero(diagonal > RELATIVE_CUT * np.max(diagonal, initial=0.0))
    )
    weights = solve_triangular(triangle[:rank, :rank], triangle[:rank, rank:])
    weights[np.abs(weights) < _ROUNDING] = 0.0
    matrix = np.zeros((rank, len(order)))
    first = order[:rank]
    others = order[rank:]
    matrix[np.arange(rank), first] = 1.0
    matrix[:, others] = scale[first][:, None] * weights / scale[others]
    sorting = np.argsort(first)
    return BaseCombinations(matrix[sorting], first[sorting])


def essential(base: Array, nuisance: Array, right_side: Array) -> NDArray[np.bool_]:
    """Return (r,) which base parameters backward elimination keeps.

    Args:
        base: (M, r) whitened columns of the base parameters.
        nuisance: (M, k) whitened columns of all other parameters, which are always fitted.
        right_side: (M,) whitened right-hand sides.
    """
    from scipy.linalg import qr

    span, triangle, _ = qr(nuisance, mode="economic", pivoting=True)
    size = np.abs(np.diag(triangle))
    span = span[:, size > RELATIVE_CUT * np.max(size, initial=0.0)]
    columns = base - span @ (span.T @ base)
    target = right_side - span @ (span.T @ right_side)
    is_essential = np.ones(base.shape[1], dtype=bool)
    while np.count_nonzero(is_essential) > 1:
        length = np.linalg.norm(columns[:, is_essential], axis=0)
        scaled = columns[:, is_essential] / np.where(length > 0.0, length, 1.0)
        inverse = np.linalg.pinv(scaled.T @ scaled, hermitian=True)
        values = inverse @ (scaled.T @ target)
        relative = np.sqrt(np.maximum(np.diag(inverse), 0.0)) / np.maximum(
            np.abs(values), 1e-300
        )
        if np.max(relative) <= max(ESSENTIAL_RATIO * np.min(relative), WELL_KNOWN):
            break
        is_essential[np.flatnonzero(is_essential)[int(np.argmax(relative))]] = False
    return is_essential

"""Design criteria: how good an information matrix is, as one number to minimise, with gradient.

Each is the logarithm of something readable, so that a change of 0.01 means about 1 %:

====  =============================================  ==========================================
name  exp(value)                                     makes small
====  =============================================  ==========================================
A     root of the sum of variances, sqrt(tr L^-1)    the average uncertainty
D     det(L)^(-1/2r), r parameters                   the volume of the confidence ellipsoid
cond  condition number of the scaled regressor       the spread between best and worst direction
====  =============================================  ==========================================

(Pukelsheim, "Optimal Design of Experiments", 2006, ch. 6.) The condition number says nothing about
how large the information is; it is offered for comparison.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Callable

import numpy as np

from robot_sysid.records import Array

Criterion = Callable[[Array], "tuple[float, Array]"]
_SINGULAR = 1e-14


def a_criterion(information: Array) -> tuple[float, Array]:
    """Return (ln sqrt(tr L^-1), gradient (r, r)); infinite where L is singular."""
    if _is_singular(information):
        return np.inf, np.zeros_like(information)
    covariance = _inverse(information)
    trace = float(np.trace(covariance))
    return 0.5 * float(np.log(trace)), -0.5 * covariance @ covariance / trace


def d_criterion(information: Array) -> tuple[float, Array]:
    """Return (-ln det L / 2r, gradient (r, r)); infinite where L is singular."""
    if _is_singular(information):
        return np.inf, np.zeros_like(information)
    size = len(information)
    value = -float(np.linalg.slogdet(information)[1]) / (2.0 * size)
    return value, -_inverse(information) / (2.0 * size)


def condition_criterion(information: Array) -> tuple[float, Array]:
    """Return (ln of the condition number with columns of unit length, gradient (r, r))."""
    if _is_singular(information):
        return np.inf, np.zeros_like(information)
    root = np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(information / np.outer(root, root))
    low, high = vectors[:, 0], vectors[:, -1]
    # d ln(high / low) / 2 with respect to the scaled matrix, then through the scaling.
    # Each eigenvector's share of the scaling's own derivative is its squared entries.
    inner = np.outer(high, high) / values[-1] - np.outer(low, low) / values[0]
    gradient = inner / np.outer(root, root) - np.diag((high**2 - low**2) / root**2)
    return 0.5 * float(np.log(values[-1] / values[0])), 0.5 * gradient


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _is_singular(information: Array) -> bool:
    """Tell whether L, scaled to unit diagonal, has no usable inverse."""
    diagonal = np.diag(information)
    if not np.all(np.isfinite(information)) or np.any(diagonal <= 0.0):
        return True
    root = np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(information / np.outer(root, root))[0] <= _SINGULAR)


CRITERIA: Mapping[str, Criterion] = {
    "A": a_criterion,
    "D": d_criterion,
    "cond": condition_criterion,
}
"""Criterion name to function; a new criterion is one more line here."""

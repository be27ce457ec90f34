"""Normal equations: solution and inverse of products A'A and A'b, by NumPy alone.

A normal matrix is scaled to a diagonal of ones and factorised once, N = L L'. Its inverse is H H'
with H the inverse of L', which also solves for any right-hand side. SciPy has routines for
triangles, and takes longer to import than all of a log's equations to solve.

Shapes: k parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array

RIDGE = 1e-12
"""Added to the diagonal of scaled equations: parameters that nothing shows stay at the model's."""
# Blocks on the diagonal that a triangle is inverted by, a power of two: the inverse of one of 110
# rows takes two thirds of the time that NumPy takes for the whole, which it takes for a square.
_BLOCKS = 4
# Rows from which on a triangle is inverted by blocks.
_LARGE = 48


@dataclass(frozen=True)
class InverseFactor:
    """A factor F of the inverse F F' of a normal matrix (k, k).

    Attributes:
        matrix: (k, k) the normal matrix.
        factor: (k, k) F.
    """

    matrix: Array
    factor: Array

    @classmethod
    def of(cls, matrix: Array) -> InverseFactor:
        """Return the factor of the inverse of a normal matrix (k, k), regular but for rounding."""
        length = np.sqrt(np.maximum(np.diag(matrix), 0.0))
        scale = 1.0 / np.where(length > 0.0, length, 1.0)
        scaled = scale[:, None] * matrix * scale
        scaled.flat[:: len(scaled) + 1] += RIDGE
        try:
            root = np.asarray(np.linalg.cholesky(scaled), dtype=float)
            half = inverse_of_triangle(root).T
        except np.linalg.LinAlgError:
            # Rounding has made it indefinite: its positive rows.
            values, vectors = np.linalg.eigh(scaled)
            half = vectors / np.sqrt(np.maximum(values, RIDGE))
        return cls(matrix, scale[:, None] * half)

    @property
    def inverse(self) -> Array:
        """The inverse (k, k) of the matrix."""
        return self.factor @ self.factor.T

    def solve(self, right_side: Array, start: Array) -> Array:
        """Return the solution (k,) for A'b (k,); where nothing shows it, it stays at ``start``."""
        values = start
        # The second step is one of refinement: nearly singular equations lose digits.
        for _ in range(2):
            gradient = right_side - self.matrix @ values
            values = values + self.factor @ (self.factor.T @ gradient)
        return values


def inverse_of_triangle(root: Array) -> Array:
    """Return the inverse (k, k) of a lower triangle (k, k).

    Blocks on its diagonal are inverted at once, then joined in pairs:
    [[A, 0], [B, C]]^-1 = [[A^-1, 0], [-C^-1 B A^-1, C^-1]].
    """
    count = len(root)
    # The inverse of an upper triangle exchanges no rows.
    if count < _LARGE:
        return np.asarray(np.linalg.inv(root.T)).T
    size = -(-count // _BLOCKS)
    padded = np.eye(size * _BLOCKS)
    padded[:count, :count] = root
    inverses = np.linalg.inv(np.swapaxes(_diagonal_blocks(padded, size), 1, 2))
    inverses = np.swapaxes(inverses, 1, 2)
    while len(inverses) > 1:
        upper = inverses[::2]
        lower = inverses[1::2]
        below = _diagonal_blocks(padded, 2 * size)[:, size:, :size]
        joined = np.zeros((len(upper), 2 * size, 2 * size))
        joined[:, :size, :size] = upper
        joined[:, size:, size:] = lower
        joined[:, size:, :size] = -lower @ (below @ upper)
        inverses = joined
        size *= 2
    return np.asarray(inverses[0, :count, :count])


def _diagonal_blocks(matrix: Array, size: int) -> Array:
    """Return the blocks (m, size, size) on the diagonal of a matrix (m size, m size)."""
    count = len(matrix) // size
    numbers = np.arange(count)
    return matrix.reshape(count, size, count, size)[numbers, :, numbers]


def solve(
    normal: Array, reference: Array, is_free: NDArray[np.bool_] | None = None
) -> tuple[Array, Array]:
    """Return (solution (k,), inverse (k, k)) of products [A b]'[A b] (k + 1, k + 1).

    Directions that nothing shows stay at ``reference`` (k,). Parameters that are not ``is_free``
    (k,) stay there, too; their rows of the inverse are zero.
    """
    if is_free is None or np.all(is_free):
        factor = InverseFactor.of(normal[:-1, :-1])
        return factor.solve(normal[:-1, -1], reference), factor.inverse
    at = np.flatnonzero(is_free)
    factor, values = _solve_free(normal[:-1, :-1], normal[:-1, -1], reference, at)
    inverse = np.zeros_like(factor.matrix, shape=(len(values), len(values)))
    inverse[at[:, None], at] = factor.inverse
    return values, inverse


def solution(
    matrix: Array,
    right_side: Array,
    reference: Array,
    is_free: NDArray[np.bool_] | None = None,
) -> Array:
    """Return the solution (k,) of ``solve`` without the inverse.

    ``matrix`` (k, k) and ``right_side`` (k,) are the products A'A and A'b.
    """
    if is_free is None or np.all(is_free):
        return InverseFactor.of(matrix).solve(right_side, reference)
    at = np.flatnonzero(is_free)
    _, values = _solve_free(matrix, right_side, reference, at)
    return values


def rough_solution(
    matrix: Array,
    right_side: Array,
    reference: Array,
    at: NDArray[np.int64] | slice = slice(None),
) -> Array:
    """Return about the solution (k,) of ``solution``, in a third of its time: nearly singular
    equations lose digits, which comparing hundreds of readings of a log does not need.

    ``at`` (m,) are the parameters that are free.
    """
    own = matrix[at][:, at]
    length = np.sqrt(np.maximum(np.diag(own), 0.0))
    scale = 1.0 / np.where(length > 0.0, length, 1.0)
    scaled = scale[:, None] * own * scale
    scaled.flat[:: len(scaled) + 1] += RIDGE
    gradient = (right_side - matrix @ reference)[at]
    values = reference.copy()
    values[at] += scale * np.linalg.solve(scaled, scale * gradient)
    return values


def _solve_free(
    matrix: Array, right_side: Array, reference: Array, at: NDArray[np.int64]
) -> tuple[InverseFactor, Array]:
    """Return (factor of some rows and columns (m,), solution (k,) in which the others stay)."""
    held = reference.copy()
    held[at] = 0.0
    factor = InverseFactor.of(matrix[at[:, None], at])
    values = reference.copy()
    values[at] = factor.solve(right_side[at] - matrix[at] @ held, reference[at])
    return factor, values

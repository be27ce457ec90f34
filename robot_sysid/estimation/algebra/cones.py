"""Symmetric matrices of one size that have to stay positive definite, many of them at once.

A cone stands for K_i(z) = K0_i + sum_k z_ik B_ik > 0 of m matrices with k coordinates each, and for
their duals Z_i, which are to be t K_i^-1. In the scaling of Nesterov and Todd both become the same
diagonal matrix D (Toh, Todd, Tutuncu, "SDPT3 - a MATLAB software package for semidefinite
programming", 1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array


@dataclass(frozen=True)
class Cone:
    """The matrices and what the objective says of them: w(t) (linear_i^T z_i - log det K_i).

    Attributes:
        constant: (m, s, s) K0.
        basis: (m, k, s, s) B.
        linear: (m, k) in units of w(t).
        least: (m,) w(t) = t, at least this.
    """

    constant: Array
    basis: Array
    linear: Array
    least: Array

    def weight(self, t: float) -> Array:
        """Return w(t) (m,)."""
        return np.maximum(t, self.least)

    def matrices(self, z: Array) -> Array:
        """Return K(z) (m, s, s)."""
        return self.constant + _combined(z, self.basis)

    def dual_roots(self, z: Array, t: float) -> Array:
        """Return R (m, s, s) with R R^T = w(t) K^-1."""
        return np.linalg.cholesky(self.weight(t)[:, None, None] * np.linalg.inv(self.matrices(z)))

    def scaled(self, z: Array, dual_roots: Array) -> ScaledCone:
        """Return the cone in coordinates in which K and its dual are the same diagonal matrix.

        Duals are known by their roots: squared, rounding would hide their least eigenvalues.

        Raises:
            numpy.linalg.LinAlgError: one of them is not positive definite.
        """
        primal_root = np.linalg.cholesky(self.matrices(z))
        left, diagonal, _ = np.linalg.svd(_transposed(dual_roots) @ primal_root)
        inverse = _transposed(left / np.sqrt(diagonal)[:, None, :]) @ _transposed(dual_roots)
        turned = inverse[:, None] @ self.basis @ _transposed(inverse)[:, None]
        return ScaledCone(self, diagonal, inverse, turned)


@dataclass(frozen=True)
class ScaledCone:
    """A cone at one point, scaled.

    Attributes:
        cone: which.
        diagonal: (m, s) D.
        inverse: (m, s, s) G^-1 with G^-1 K G^-T = G^T Z G = D.
        basis: (m, k, s, s) G^-1 B G^-T.
    """

    cone: Cone
    diagonal: Array
    inverse: Array
    basis: Array

    def rows(self) -> Array:
        """Return (m s s, m k) rows whose squares are the barrier's curvature."""
        count, k, size, _ = self.basis.shape
        rows = np.zeros((count, size * size, count, k))
        each = np.arange(count)
        rows[each, :, each] = np.swapaxes(self.basis.reshape(count, k, -1), 1, 2)
        return rows.reshape(count * size * size, count * k)

    def slope(self, t: float) -> Array:
        """Return the gradient (m k,) of the linear term."""
        return (self.cone.weight(t)[:, None] * self.cone.linear).ravel()

    def changes(self, step: Array, t: float, correction: Array) -> tuple[Array, Array]:
        """Return what a step (m k,) does to K and to the duals, scaled, (m, s, s) each."""
        primal = _combined(step, self.basis)
        return primal, self.aim(t) - self._here() - correction - primal

    def second_order(self, primal: Array, dual: Array) -> Array:
        """Return the correction (m, s, s) for the product of both changes."""
        product = primal @ dual
        both = self.diagonal[:, :, None] + self.diagonal[:, None, :]
        return (product + _transposed(product)) / both

    def room(self, change: Array) -> float:
        """Return which part of a change leaves the matrices positive definite."""
        roots = np.sqrt(self.diagonal)
        relative = change / (roots[:, :, None] * roots[:, None, :])
        lowest = float(np.min(np.linalg.eigvalsh(relative), initial=0.0))
        return -1.0 / lowest if lowest < 0.0 else np.inf

    def centrality(self, primal: Array, dual: Array) -> float:
        """Return the least eigenvalue of a K Z over their mean after scaled changes.

        Matrices are not compared with each other: their weights differ.
        """
        roots = [np.linalg.cholesky(self._here() + change) for change in (primal, dual)]
        products = np.linalg.svd(_transposed(roots[0]) @ roots[1], compute_uv=False) ** 2
        return float(np.min(products / np.mean(products, axis=1, keepdims=True)))

    def moved(self, change: Array) -> Array:
        """Return roots of the duals (m, s, s) after a scaled change."""
        return _transposed(self.inverse) @ np.linalg.cholesky(self._here() + change)

    def _here(self) -> Array:
        return self.diagonal[:, :, None] * np.eye(self.diagonal.shape[1])

    def aim(self, t: float) -> Array:
        """Return K and its duals (m, s, s) as they are to be at t, scaled."""
        size = self.diagonal.shape[1]
        return (self.cone.weight(t)[:, None] / self.diagonal)[:, :, None] * np.eye(size)


def _combined(z: Array, basis: Array) -> Array:
    return np.einsum("mk,mkij->mij", z.reshape(len(basis), -1), basis)


def _transposed(matrices: NDArray[Any]) -> NDArray[Any]:
    return np.swapaxes(matrices, -1, -2)

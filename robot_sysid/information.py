"""Square-root information: one QR triangle per joint, accumulated chunk by chunk.

For equations Y x = tau the triangle R of [Y tau] = Q R holds all that least squares needs: normal
matrix, residual and rank. Stacking a new chunk under R and factorising again gives the triangle of
all rows (Bierman, "Factorization Methods for Discrete Sequential Estimation", 1977, ch. IV), so
memory does not grow with the number of samples.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array, JointInformation, SquareRootInformation


class InformationAccumulator:
    """Collects the rows of several joints into a SquareRootInformation.

    Args:
        names: (p,) global parameter names.
        joints: names of the joints whose equations will come.
        columns: per joint, which global parameters its rows contain.
    """

    def __init__(
        self,
        names: Sequence[str],
        joints: Sequence[str],
        columns: Sequence[NDArray[np.int64]],
    ) -> None:
        self._names = tuple(names)
        self._joints = tuple(joints)
        self._columns = [np.asarray(c, dtype=np.int64) for c in columns]
        self._triangles = [np.zeros((len(c) + 1, len(c) + 1)) for c in self._columns]
        self._counts = [0] * len(self._joints)

    def add(self, index: int, rows: Array, tau: Array) -> None:
        """Add equations of joint number ``index``.

        Args:
            index: position in ``joints``.
            rows: (N, k) regressor rows for that joint's columns.
            tau: (N,) right-hand sides [N m].
        """
        self._triangles[index] = update_triangle(
            self._triangles[index], np.column_stack((rows, tau))
        )
        self._counts[index] += len(tau)

    def result(self) -> SquareRootInformation:
        """Return what has been collected so far."""
        joints = tuple(
            JointInformation(joint, columns, triangle, count)
            for joint, columns, triangle, count in zip(
                self._joints, self._columns, self._triangles, self._counts
            )
        )
        return SquareRootInformation(self._names, joints)


def update_triangle(triangle: Array, rows: Array) -> Array:
    """Return the (k, k) triangle of all rows so far and the new ones (N, k)."""
    stacked = np.vstack((triangle, rows))
    return np.linalg.qr(stacked, mode="r")

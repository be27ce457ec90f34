"""Equations of a simulation as one triangle per joint, in constant memory.

For equations Y x = tau the triangle R of [Y tau] = Q R contains all that least squares needs.
Stacking a new chunk of rows under R and factorising again gives the triangle of all rows (Bierman,
"Factorization Methods for Discrete Sequential Estimation", 1977, ch. IV). No digit is lost, as in
products of rows: a self-test returns the model's parameters to 1e-8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array, JointInformation, SquareRootInformation


class InformationAccumulator:
    """Collects the rows of several joints into a SquareRootInformation.

    Args:
        names: (p,) global parameter names.
        joints: names of the joints, base to terminal.
        columns: per joint (k,) indices into ``names`` of the parameters in its rows.
    """

    def __init__(
        self,
        names: Sequence[str],
        joints: Sequence[str],
        columns: Sequence[NDArray[np.int64]],
    ) -> None:
        self._names = tuple(names)
        self._joints = []
        for joint, indices in zip(joints, columns):
            triangle = np.zeros((0, len(indices) + 1))
            self._joints.append(JointInformation(joint, indices, triangle, 0))

    def add(self, index: int, rows: Array, tau: Array) -> None:
        """Add equations rows x = tau of one joint to the rows collected so far.

        Args:
            index: number of the joint, base to terminal.
            rows: (N, k) one column per index in the joint's ``columns``.
            tau: (N,) torque [N m].
        """
        joint = self._joints[index]
        stacked = np.vstack((joint.triangle, np.column_stack((rows, tau))))
        triangle = stacked[np.any(stacked != 0.0, axis=1)]
        # Fewer rows than columns are kept as they are.
        if len(triangle) >= triangle.shape[1]:
            triangle = np.asarray(np.linalg.qr(triangle, mode="r"))
        count = joint.n_samples + len(tau)
        self._joints[index] = replace(joint, triangle=triangle, n_samples=count)

    def result(self) -> SquareRootInformation:
        """Return the information of all rows added so far."""
        return SquareRootInformation(self._names, tuple(self._joints))

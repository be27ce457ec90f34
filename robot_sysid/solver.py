"""Equations of a simulation to an estimate by plain least squares, in constant memory.

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

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.spatial import N_INERTIAL
from robot_sysid.estimate.bodies import LinksProblem, consistent_least_squares
from robot_sysid.estimate.identifiability import analyse_identifiability, visible_space
from robot_sysid.records import Array, Estimate, JointInformation, SquareRootInformation

# Smallest noise, as a share of the root mean square torque: rounding.
_LEAST_NOISE = 1e-9


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


def identify_parameters(
    information: SquareRootInformation, prior: Array, possible: bool = False
) -> Estimate:
    """Return the estimate of all p parameters by ordinary least squares.

    Parameters that the data does not identify keep the prior's value. The first ten are those of
    the terminal link, the body that ``possible`` constrains.

    Args:
        information: the equations of all joints.
        prior: (p,) the model's own values, in the order of ``information.names``.
        possible: whether a terminal link that is no possible rigid body is estimated again, with
            the constraint to be one.
    """
    matrix, right_side = information.equations()
    space = visible_space(matrix)
    free = prior + space.solve(right_side - matrix @ prior)
    freedom = max(information.n_samples - space.rank, 1)
    torque = np.linalg.norm(right_side) / np.sqrt(max(information.n_samples, 1))
    rms = np.sqrt(np.sum(information.squared_residuals(free)) / freedom)
    noise = float(max(rms, _LEAST_NOISE * torque)) or 1.0
    values = free
    if possible and not spatial.is_consistent(free[:N_INERTIAL]):
        # Near this body the solver looks for possible ones; other parameters are zero in it.
        link_only = np.append(prior[:N_INERTIAL], np.zeros(len(prior) - N_INERTIAL))
        problem = LinksProblem((np.arange(N_INERTIAL),), link_only)
        rows = matrix / noise
        values = consistent_least_squares(rows, right_side / noise, problem).values
    covariance = noise**2 * space.inverse()
    errors = np.where(space.is_identified, np.sqrt(np.diag(covariance)), np.inf)
    joints = [joint.joint for joint in information.joints]
    counts = np.array([joint.n_samples for joint in information.joints])
    squares = information.squared_residuals(values)
    rms_per_joint = np.sqrt(squares / np.maximum(counts, 1)).tolist()
    return Estimate(
        names=information.names,
        values=values,
        identifiability=analyse_identifiability(matrix, information.names, joints[-1]),
        rmse=float(np.sqrt(np.sum(squares) / max(information.n_samples, 1))),
        rmse_per_joint=dict(zip(joints, rms_per_joint)),
        standard_errors=errors,
        noise_per_joint={j: noise for j, count in zip(joints, counts) if count},
        samples=dict(zip(joints, counts.tolist())),
    )

"""Ordinary and weighted least squares: the noise of each joint, and the solution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimation.algebra.identifiability import triangle_space
from robot_sysid.estimation.algebra.information import sample_counts, stretches
from robot_sysid.records import Array, SquareRootInformation

# Most rounds of an iteration; measured: 5 to 7 for seven joints.
_MOST_ROUNDS = 30
# Relative change of the noise at which it has converged: it moves no printed digit.
_SETTLED = 1e-6
# Shares of the root mean square torque, see ``noise_floor``.
_NOISE_FLOOR = 1e-9
_NOISE_FLOOR_WITH_PRIOR = 1e-4
# Least pivot of a scaled matrix, whose diagonal is 1: rounding makes pivots up to 1e-14 of zeros,
# and exact data of arms with priors has 1e-12 (measured).
_LEAST_PIVOT = 1e-13
# Gradient at which conjugate gradients have converged, as a share of all right-hand sides.
_ROUNDING = 1e-14
# Ratio to its floor up to which noise is at the floor.
_AT_FLOOR = 1.01
# Floor of ``lower_floor``, as a share of the usual one, and its rounds.
_LOWER_FLOOR = 0.01
_LOWER_ROUNDS = 2


Solve = Callable[[Array], tuple[Array, Array]]
Block = tuple[NDArray[np.int64], Array]
"""Indices of the columns of rows [A b] among all, right-hand sides last, and the rows."""


def ordinary(information: SquareRootInformation, solve: Solve) -> Array:
    """Return the noise (joints,), equal for all joints, from all residuals [N m]."""
    ones = np.ones(len(information.joints))
    common = 1.0
    for _ in range(_MOST_ROUNDS):
        values, leverage = solve(ones / common)
        freedom = max(information.n_samples - float(np.sum(leverage)), 1.0)
        rms = np.sqrt(float(np.sum(information.squared_residuals(values))) / freedom)
        previous = common
        common = float(max(rms, noise_floor(information)))
        # Without a prior the estimate does not depend on the size of the noise.
        if information.prior is None or abs(common / previous - 1.0) < _SETTLED:
            break
    return common * ones


def estimate_noise(
    information: SquareRootInformation, solve: Solve, start: Array | None = None
) -> Array:
    """Return the noise (joints,) [N m], iterated with the estimate until both converge.

    Iterated feasible generalised least squares; for independent normal noise the fixed point is
    the maximum-likelihood estimate (Oberhofer, Kmenta 1974).
    """
    noise = ordinary(information, solve) if start is None else start
    floor = noise_floor(information)
    for _ in range(_MOST_ROUNDS):
        previous = noise
        noise = joint_noise(information, *solve(1.0 / noise), floor)
        if np.max(np.abs(noise / previous - 1.0)) < _SETTLED:
            break
    return noise


def solver(information: SquareRootInformation, prior: Array) -> Solve:
    """Return the fastest function that solves the equations for given weights.

    Its argument are the weights (joints,) of each joint's equations [1/(N m)]; it returns

        x = prior + argmin_d ||A d - (b - A prior)||,

    of minimum norm in scaled columns, and the leverage (joints,) of each joint's equations, see
    ``joint_noise``. Parameters that the data does not identify keep the prior's value (p,).
    """
    plain = partial(_solve_by_decomposition, information, prior)
    if information.prior is None:
        return plain
    normal = _Normal(information, prior)
    solutions = dict[bytes, tuple[Array, Array]]()

    def solve(weights: Array) -> tuple[Array, Array]:
        # At the floor of the noise the same weights repeat.
        key = weights.tobytes()
        if key not in solutions:
            solutions[key] = normal.solve(weights) or plain(weights)
        return solutions[key]

    return solve


def inverse_root(normal: Array) -> Array | None:
    """Return G (p, p) with G G^T the inverse of a normal matrix; None where it is singular within
    rounding.

    It takes a tenth of the time of a decomposition and loses half of the digits, which noise and
    widths of priors do not need.
    """
    from scipy.linalg.lapack import dtrtri

    length = np.sqrt(np.diag(normal))
    scale = 1.0 / np.where(length > 0.0, length, 1.0)
    try:
        root = np.linalg.cholesky(scale[:, None] * normal * scale)
    except np.linalg.LinAlgError:
        return None
    is_clear = np.min(np.diag(root)) ** 2 > _LEAST_PIVOT
    return np.asarray(scale[:, None] * dtrtri(root.T)[0]) if is_clear else None


class _Normal:
    """Normal equations of data with a prior."""

    def __init__(self, information: SquareRootInformation, prior: Array) -> None:
        assert information.prior is not None
        size = len(information.names)
        # Columns of few joints come first, so that each joint's columns are contiguous.
        has = np.array(
            [np.isin(np.arange(size), j.columns) for j in information.joints]
        )
        order = np.lexsort((np.argmax(has, axis=0), np.sum(has, axis=0)))
        self._indices = np.append(np.argsort(order), size)
        self._prior = prior[order]
        blocks = [
            (self._indices[[*j.columns, -1]], j.triangle) for j in information.joints
        ]
        self._blocks: list[Block] = [*blocks, (self._indices, information.prior)]
        ordered = ((np.sort(at), rows[:, np.argsort(at)]) for at, rows in self._blocks)
        self._squares = [(rows.T @ rows, stretches(at)) for at, rows in ordered]

    def solve(self, weights: Array) -> tuple[Array, Array] | None:
        """Return what ``solver`` describes; None where the equations are ill-conditioned."""
        normal = np.zeros((len(self._prior) + 1,) * 2)
        squares = np.append(weights, 1.0) ** 2
        for (gram, runs), square in zip(self._squares, squares):
            for source, target in runs:
                normal[target] += square * gram[source]
        solution = solve_normal(normal, self._blocks, squares, self._prior)
        if solution is None:
            return None
        values, root = solution
        spread = np.pad(root @ root.T, (0, 1))
        leverage = [
            square
            * sum(np.einsum("ij,ij", gram[i], spread[target]) for i, target in runs)
            for (gram, runs), square in zip(self._squares, squares[:-1])
        ]
        return values[self._indices[:-1]], np.array(leverage)


def solve_normal(
    normal: Array, blocks: Sequence[Block], squares: Array, values: Array
) -> tuple[Array, Array] | None:
    """Return (least-squares solution (p,), G (p, p) of ``inverse_root``) of normal equations; None
    where they are ill-conditioned.

    Rounding of the normal equations is removed by conjugate gradients on the equations themselves,
    preconditioned with G (Bjorck, "Numerical methods for least squares problems", 1996, ch. 7.4).

    Args:
        normal: (p + 1, p + 1) sum of the weighted squares of all blocks.
        blocks: their equations.
        squares: (blocks,) squared weight of each block.
        values: (p,) at which the iteration starts.
    """
    root = inverse_root(normal[:-1, :-1])
    if root is None:
        return None
    direction = np.zeros(len(root))
    previous = np.inf
    for _ in range(_MOST_ROUNDS):
        slope = np.zeros(len(normal))
        full = np.append(values, -1.0)
        for (at, rows), square in zip(blocks, squares):
            slope[at] -= square * ((rows @ full[at]) @ rows)
        steep = root.T @ slope[:-1]
        squared_slope = float(steep @ steep)
        if squared_slope <= _ROUNDING**2 * normal[-1, -1]:
            return values, root
        direction = steep + squared_slope / previous * direction
        previous = squared_slope
        step = root @ direction
        values = values + squared_slope / (step @ normal[:-1, :-1] @ step) * step
    return None


def solve_rows(rows: Array) -> tuple[Array, Array]:
    """Return (solution (p,) of minimum norm in scaled columns, G (p, r) with G G^T the inverse of
    A^T A) of equations [A b] (M, p + 1), by a decomposition.
    """
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    space = triangle_space(triangle[:, :-1])
    return space.solve(triangle[:, -1]), space.inverse_root()


def noise_floor(information: SquareRootInformation) -> float:
    """Return the smallest noise: 1e-9 of the root mean square torque [N m].

    With a prior it is 1e-4, the error of filtering, which nuisances would explain otherwise.
    """
    squared = sum(
        float(np.sum(joint.triangle[:, -1] ** 2)) for joint in information.joints
    )
    rms = np.sqrt(squared / max(information.n_samples, 1))
    share = _NOISE_FLOOR if information.prior is None else _NOISE_FLOOR_WITH_PRIOR
    return float(share * rms) or 1.0


def lower_floor(
    information: SquareRootInformation, solve: Solve, noise: Array
) -> Array:
    """Return the noise (joints,) with a lower floor for joints at the usual one [N m].

    With the usual floor, the priors would weigh too much against exact data.
    """
    floor = noise_floor(information)
    at_floor = noise <= _AT_FLOOR * floor
    lowered = noise
    if information.prior is None or not np.any(at_floor):
        return noise
    for _ in range(_LOWER_ROUNDS):
        least = joint_noise(information, *solve(1.0 / lowered), _LOWER_FLOOR * floor)
        lowered = np.where(at_floor, least, noise)
    return lowered


def joint_noise(
    information: SquareRootInformation, values: Array, leverage: Array, floor: float
) -> Array:
    """Return (joints,) noise standard deviation of each joint's torque [N m].

    sigma_j^2 = |r_j|^2 / (n_j - l_j) at the solution (p,), with the leverage l_j = w_j^2 tr(Y_j C
    Y_j^T): the number of parameters that this joint's equations determine (Seber, Lee, "Linear
    Regression Analysis", 2003).
    """
    squared = information.squared_residuals(values)
    freedom = np.maximum(sample_counts(information) - leverage, 1.0)
    return np.maximum(np.sqrt(squared / freedom), floor)


def _solve_by_decomposition(
    information: SquareRootInformation, prior: Array, weights: Array
) -> tuple[Array, Array]:
    """Return what ``solver`` describes, by a decomposition."""
    matrix, right_side = information.stacked(weights)
    values, root = solve_rows(np.column_stack((matrix, right_side - matrix @ prior)))
    pairs = zip(information.joints, weights)
    leverage = [
        w**2 * np.sum((j.triangle[:, :-1] @ root[j.columns]) ** 2) for j, w in pairs
    ]
    return prior + values, np.array(leverage)

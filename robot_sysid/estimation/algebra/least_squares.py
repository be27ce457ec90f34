"""Square-root information, one QR triangle per joint, and its weighted least-squares solution.

For equations Y x = tau the triangle R of [Y tau] = Q R contains all that least squares needs:
normal matrix, residual and rank. Stacking a new chunk of rows under R and factorising again gives
the triangle of all rows (Bierman, "Factorization Methods for Discrete Sequential Estimation", 1977,
ch. IV), so memory does not grow with the number of samples.

``SquareRootInformation`` holds the names of p parameters. Per joint it holds the indices (k,) of
the parameters in the joint's equations, and a triangle (k + 1, k + 1) whose last column is that of
tau. Its prior is equations [A b] (r, p + 1) of unit variance. Noise stands for the standard
deviation of a joint's torque residual [N m]; the weight of the joint's rows is the inverse of the
noise. Noise is iterated together with the solution.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import compress, islice, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimation.algebra.identifiability import triangle_space
from robot_sysid.records import Array, JointInformation, SquareRootInformation

# Largest number of rounds of the noise, and of conjugate gradients; measured: 5 to 7 for seven
# joints.
_MOST_ROUNDS = 30
# Relative change of the noise below which it has converged: no printed digit changes.
_SETTLED = 1e-6
# Smallest noise without a prior, as a share of the root mean square torque.
_NOISE_FLOOR = 1e-9
# Smallest noise with a prior, as a share of the root mean square torque.
_NOISE_FLOOR_WITH_PRIOR = 1e-4
# Least pivot of a matrix with diagonal 1, below which the matrix counts as singular: rounding turns
# zeros into up to 1e-14, and exact data of arms with priors has 1e-12 (measured).
_LEAST_PIVOT = 1e-13
# Length of the preconditioned gradient at which conjugate gradients have converged, as a share of
# the length of all weighted right-hand sides.
_ROUNDING = 1e-14
# Ratio of a joint's noise to the floor up to which the noise counts as being at the floor.
_AT_FLOOR = 1.01
# Floor in ``lower_floor``, as a share of ``noise_floor``.
_LOWER_FLOOR = 0.01
# Number of rounds of ``lower_floor``.
_LOWER_ROUNDS = 2
Solve = Callable[[Array], tuple[Array, Array]]
"""Function of weights (joints,) [1/(N m)] that returns (values (p,), leverage (joints,)); see
``solver``."""
Block = tuple[NDArray[np.int64], Array]
"""(indices (k + 1,), rows (m, k + 1)): equations [A b] in k of p parameters; the indices are those
of the columns among all p + 1, the last one is p for the right-hand side."""


def ordinary_noise(information: SquareRootInformation, solve: Solve) -> Array:
    """Return the noise (joints,) [N m] of ordinary least squares, which is equal for all joints.

    With a prior, noise and solution are computed from each other until the noise converges. The
    noise is at least ``noise_floor``.

    Args:
        information: equations of all joints.
        solve: ``solver`` of these equations.
    """
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
    """Return the standard deviation of each joint's torque noise (joints,) [N m].

    Estimate and noise are computed from each other until the noise converges. The noise is at least
    ``noise_floor``.

    This is iterated feasible generalised least squares. For independent normal noise its fixed
    point is the maximum-likelihood estimate (Oberhofer, Kmenta 1974).

    Args:
        information: equations of all joints.
        solve: takes weights (joints,) [1/(N m)], returns (the weighted estimate (p,), leverage
            (joints,)); made by ``solver``.
        start: (joints,) first noise [N m]; None for that of the unweighted estimate.
    """
    noise = ordinary_noise(information, solve) if start is None else start
    floor = noise_floor(information)
    for _ in range(_MOST_ROUNDS):
        previous = noise
        noise = joint_noise(information, *solve(1.0 / noise), floor)
        if np.max(np.abs(noise / previous - 1.0)) < _SETTLED:
            break
    return noise


def solver(information: SquareRootInformation, prior: Array) -> Solve:
    """Return the fastest function that solves the equations for given weights.

    The function takes the weights (joints,) of each joint's equations [1/(N m)]. It returns

        x = prior + argmin_d ||A d - (b - A prior)||,

    with d of minimum norm in scaled columns, and the leverage (joints,) of each joint's equations,
    see ``joint_noise``. Parameters that neither data nor ``information.prior`` identifies keep
    their values in ``prior``. With a prior distribution the function keeps all its results and
    returns the identical arrays for equal weights: do not change them.

    Args:
        information: equations [A b] of all joints, and the prior distribution or None.
        prior: (p,) values, not the prior distribution, which is in ``information.prior``.
    """
    plain = partial(_solve_by_decomposition, information, prior)
    if information.prior is None:
        return plain
    solve_normally = _normal_solver(information, information.prior, prior)
    solutions = dict[bytes, tuple[Array, Array]]()

    def solve(weights: Array) -> tuple[Array, Array]:
        """Return (values (p,), leverage (joints,)) from normal equations where they suffice."""
        # At the floor of the noise, weights repeat from round to round.
        key = weights.tobytes()
        if key not in solutions:
            solutions[key] = solve_normally(weights) or plain(weights)
        return solutions[key]

    return solve


def inverse_root(normal: Array) -> Array | None:
    """Return G (p, p) with G G^T the inverse of a normal matrix (p, p); None where the matrix is
    singular but for rounding.

    This takes a tenth of the time of a decomposition of the equations and loses half of the digits,
    which noise and standard deviations of priors do not need.
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


def _normal_solver(
    information: SquareRootInformation, prior_rows: Array, prior: Array
) -> Callable[[Array], tuple[Array, Array] | None]:
    """Return a function that solves the normal equations of data and prior for given weights.

    The function takes the weights (joints,) of each joint's equations [1/(N m)]. It returns the
    values (p,) and the leverage (joints,) of ``solver``, or None where the normal equations are
    ill-conditioned.

    Args:
        information: equations of all joints.
        prior_rows: (r, p + 1) equations of the prior, of unit variance.
        prior: (p,) values that stay where nothing identifies a parameter.
    """
    # Parameters are solved for in another order: ``order`` (p,) has their old indices, ``indices``
    # (p + 1,) the new index of each parameter and of the right-hand side, which stays last.
    size = len(information.names)
    has_column = np.zeros((len(information.joints), size), dtype=bool)
    for row, joint in zip(has_column, information.joints):
        row[joint.columns] = True
    # Columns of few joints come first, so that each joint's columns are contiguous.
    order = np.lexsort((np.argmax(has_column, axis=0), np.sum(has_column, axis=0)))
    indices = np.append(np.argsort(order), size)
    blocks: list[Block] = []
    for joint in information.joints:
        blocks.append((indices[[*joint.columns, -1]], joint.triangle))
    blocks.append((indices, prior_rows))
    # Per block its Gram matrix, and where that is added to the normal matrix (``stretches``).
    grams = []
    for at, rows in blocks:
        ordered = rows[:, np.argsort(at)]
        grams.append((ordered.T @ ordered, stretches(np.sort(at))))

    def solve(weights: Array) -> tuple[Array, Array] | None:
        """Return (values (p,), leverage (joints,)), or None, for weights (joints,)."""
        normal = np.zeros((size + 1, size + 1))
        # The last block, the prior, has the weight one.
        squares = np.append(weights, 1.0) ** 2
        for (gram, runs), square in zip(grams, squares):
            for source, target in runs:
                normal[target] += square * gram[source]
        solution = solve_normal(normal, blocks, squares, prior[order])
        if solution is None:
            return None
        values, root = solution
        # Zeros for the right-hand side, which Gram matrices contain, too.
        spread = np.pad(root @ root.T, (0, 1))
        leverage = np.zeros(len(weights))
        for k, (gram, runs) in enumerate(grams[:-1]):
            for source, target in runs:
                leverage[k] += np.einsum("ij,ij", gram[source], spread[target])
        return values[indices[:-1]], squares[:-1] * leverage

    return solve


def solve_normal(
    normal: Array, blocks: Sequence[Block], squares: Array, values: Array
) -> tuple[Array, Array] | None:
    """Return (least-squares solution x (p,), G (p, p) with G G^T the inverse normal matrix); None
    where the normal equations are ill-conditioned.

    Rounding of the normal equations is removed by conjugate gradients on the equations themselves,
    preconditioned with G (Bjorck, "Numerical methods for least squares problems", 1996, ch. 7.4).

    Args:
        normal: (p + 1, p + 1) sum over the blocks of w^2 [A b]^T [A b].
        blocks: the equations [A b] that the normal equations are made from, not weighted.
        squares: (blocks,) squared weight w^2 of each block.
        values: (p,) parameters at which the iteration starts; not changed.
    """
    root = inverse_root(normal[:-1, :-1])
    if root is None:
        return None
    # In coordinates y, x = G y: the gradient is ``steep``; the first direction has no predecessor.
    direction = np.zeros(len(root))
    previous = np.inf
    for _ in range(_MOST_ROUNDS):
        slope = np.zeros(len(normal))
        # [A b] (x, -1) = A x - b.
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
    """Return (least-squares solution (p,), G (p, r)) of equations [A b], by a decomposition.

    The solution is that of minimum norm in scaled columns; G G^T is the pseudo-inverse of A^T A.

    Args:
        rows: (M, p + 1) [A b], with A of rank r.
    """
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    space = triangle_space(triangle[:, :-1])
    return space.solve(triangle[:, -1]), space.inverse_root()


def noise_floor(information: SquareRootInformation) -> float:
    """Return the smallest noise of a joint [N m]: 1e-9 of the root mean square torque, or 1e-4 with
    a prior.

    The latter is the error of filtering, which nuisances would explain otherwise. Where all torques
    are zero, the floor is 1 N m.
    """
    squares = 0.0
    for joint in information.joints:
        squares += np.sum(joint.triangle[:, -1] ** 2)
    rms = np.sqrt(float(squares) / max(information.n_samples, 1))
    share = _NOISE_FLOOR if information.prior is None else _NOISE_FLOOR_WITH_PRIOR
    return float(share * rms) or 1.0


def lower_floor(
    information: SquareRootInformation, solve: Solve, noise: Array
) -> Array:
    """Return the noise (joints,) [N m], estimated with a lower floor for joints at ``noise_floor``.

    With ``noise_floor``, priors would weigh too much against exact data. Without a prior, or with
    no joint at the floor, ``noise`` itself is returned.

    Args:
        information: equations of all joints.
        solve: ``solver`` of these equations.
        noise: (joints,) of ``estimate_noise`` [N m].
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
    """Return the noise (joints,): the standard deviation of each joint's torque residual [N m].

    sigma_j^2 = |r_j|^2 / (n_j - l_j) with r_j the residuals of the joint's n_j equations and
    l_j = w_j^2 tr(Y_j C Y_j^T) their leverage, the number of parameters that they determine (Seber,
    Lee, "Linear Regression Analysis", 2003).

    Args:
        information: equations of all joints.
        values: (p,) the solution, at which residuals are taken.
        leverage: (joints,) l_j.
        floor: smallest noise [N m].
    """
    squared = information.squared_residuals(values)
    freedom = np.maximum(sample_counts(information) - leverage, 1.0)
    return np.maximum(np.sqrt(squared / freedom), floor)


def _solve_by_decomposition(
    information: SquareRootInformation, prior: Array, weights: Array
) -> tuple[Array, Array]:
    """Return (solution x (p,), leverage (joints,)), by a decomposition of the equations.

    Leverage is that of ``joint_noise``.

    Args:
        information: equations of all joints, and the prior distribution or None.
        prior: (p,) values that parameters keep that nothing identifies.
        weights: (joints,) of each joint's equations [1/(N m)].
    """
    matrix, right_side = information.equations(weights)
    values, root = solve_rows(np.column_stack((matrix, right_side - matrix @ prior)))
    leverage = []
    for joint, weight in zip(information.joints, weights):
        rows = joint.triangle[:, :-1] @ root[joint.columns]
        leverage.append(weight**2 * np.sum(rows**2))
    return prior + values, np.array(leverage)


# Number of joints whose rows are multiplied at once: on a long arm they share most columns.
_TOGETHER = 8
# Added to the unit diagonal of a scaled normal matrix: keeps it invertible for parameters without
# data.
_RIDGE = 1e-12


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
            indices = np.asarray(indices, dtype=np.int64)
            triangle = np.zeros((0, len(indices) + 1))
            empty = JointInformation(joint, indices, triangle, n_samples=0)
            self._joints.append(empty)

    def add(self, index: int, rows: Array, tau: Array) -> None:
        """Add equations rows x = tau of one joint to the rows collected so far.

        Args:
            index: number of the joint, base to terminal.
            rows: (N, k) one column per index in the joint's ``columns``.
            tau: (N,) torque [N m].
        """
        joint = self._joints[index]
        triangle = update_triangle(joint.triangle, np.column_stack((rows, tau)))
        count = joint.n_samples + len(tau)
        self._joints[index] = replace(joint, triangle=triangle, n_samples=count)

    def result(self) -> SquareRootInformation:
        """Return the information of all rows added so far."""
        return SquareRootInformation(self._names, tuple(self._joints))


def update_triangle(triangle: Array, rows: Array) -> Array:
    """Return the triangle (k, k) of a previous triangle (m, k) and new rows (N, k) together.

    Where fewer than k rows are not zero, these rows are returned without factorising them.
    """
    stacked = np.vstack((triangle, rows)) if len(triangle) else rows
    is_used = np.any(stacked != 0.0, axis=1)
    stacked = stacked if np.all(is_used) else stacked[is_used]
    is_tall = len(stacked) >= stacked.shape[1]
    return np.asarray(np.linalg.qr(stacked, mode="r")) if is_tall else stacked


def normal_matrix(information: SquareRootInformation, weights: Array) -> Array:
    """Return the normal matrix [A b]^T [A b] (p + 1, p + 1) of weighted equations and prior.

    Args:
        information: equations of all joints; its prior rows count, where it has any.
        weights: (joints,) of each joint's equations [1/(N m)].
    """
    normal = np.zeros((len(information.names) + 1,) * 2)
    blocks = information.equation_blocks(weights)
    # A few blocks of rows at a time, in the columns that are not zero.
    while batch := list(islice(blocks, _TOGETHER)):
        rows = np.vstack(batch)
        at = np.flatnonzero(np.any(rows != 0.0, axis=0))
        rows = rows[:, at]
        gram = rows.T @ rows  # one array with itself takes half of the time
        for source, target in stretches(at):
            normal[target] += gram[source]
    return normal


def eliminate_others(normal: Array, indices: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the normal equations (matrix (k, k), right-hand side (k,)) of some parameters, with
    all others eliminated: the Schur complement of the block of the others.

    Args:
        normal: (p + 1, p + 1) [A b]^T [A b] of all parameters; not changed.
        indices: (k,) of the parameters that remain.
    """
    others = np.setdiff1d(np.arange(len(normal) - 1), indices)
    columns = np.append(indices, len(normal) - 1)
    diagonal = np.diag(normal)[others]
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = scale[:, None] * normal[np.ix_(others, others)] * scale
    scaled[np.diag_indices_from(scaled)] += _RIDGE
    crossed = scale[:, None] * normal[np.ix_(others, columns)]
    solved = crossed.T @ np.linalg.solve(scaled, crossed)
    remainder = normal[np.ix_(columns, columns)] - solved
    return 0.5 * (remainder + remainder.T)[:-1, :-1], remainder[:-1, -1]


def stretches(at: NDArray[np.int64]) -> list[tuple[Any, Any]]:
    """Return (source, target) indices of blocks that add a matrix (k, k) to a larger matrix.

    With ``larger[target] += matrix[source]`` for all of them, each element (i, j) is added to the
    larger matrix at (at[i], at[j]). Contiguous indices share a block, which is twice as fast as
    single elements.

    Args:
        at: (k,) ascending indices of the larger matrix.
    """
    # Runs of contiguous indices: positions in ``at`` where each begins and ends.
    ends = [0, *(np.flatnonzero(np.diff(at) != 1) + 1).tolist(), len(at)]
    runs = []
    for start, end in zip(ends, ends[1:]):
        if start < end:
            target = slice(int(at[start]), int(at[end - 1]) + 1)
            runs.append((slice(start, end), target))
    blocks: list[tuple[Any, Any]] = []
    for (row_source, row_target), (column_source, column_target) in product(
        runs, repeat=2
    ):
        blocks.append(((row_source, column_source), (row_target, column_target)))
    return blocks


def sample_counts(information: SquareRootInformation) -> Array:
    """Return the number of equations (samples) of each joint (joints,)."""
    return np.array([joint.n_samples for joint in information.joints], dtype=float)


def residual_errors(
    information: SquareRootInformation, values: Array
) -> dict[str, Any]:
    """Return the fields of an ``Estimate`` about the torque residuals at parameters ``values``.

    Args:
        information: equations of all joints.
        values: (p,) the estimate.

    Returns:
        Root mean square residual of all joints and per joint name [N m], and the number of samples
        per joint name.
    """
    squared = information.squared_residuals(values)
    samples = {}
    for joint in information.joints:
        samples[joint.joint] = joint.n_samples
    rms = np.sqrt(squared / np.maximum(sample_counts(information), 1.0)).tolist()
    return {
        "rmse": float(np.sqrt(np.sum(squared) / max(information.n_samples, 1))),
        "rmse_per_joint": dict(zip(samples, rms)),
        "samples": samples,
    }


def combine(blocks: Sequence[SquareRootInformation]) -> SquareRootInformation:
    """Return the information of all blocks' data together, with the prior of the first one.

    Args:
        blocks: one at least, all with the same parameters, joints and prior.
    """
    if len(blocks) == 1:
        return blocks[0]
    joints = []
    for k, joint in enumerate(blocks[0].joints):
        of_blocks = [block.joints[k] for block in blocks]
        rows = np.vstack([block_joint.triangle for block_joint in of_blocks])
        triangle = update_triangle(rows[:0], rows)
        count = sum(block_joint.n_samples for block_joint in of_blocks)
        joints.append(replace(joint, triangle=triangle, n_samples=count))
    return SquareRootInformation(blocks[0].names, tuple(joints), blocks[0].prior)


def block_views(
    total: SquareRootInformation, blocks: Sequence[SquareRootInformation]
) -> Iterator[SquareRootInformation]:
    """Yield each block again, with rows that are views of the total where it contains these rows.

    Views halve the memory. A block's rows stay as they are where the total is factorised.

    Args:
        total: ``combine`` of the blocks.
        blocks: information of separate data.
    """
    of_all_blocks = []
    for k, whole in enumerate(total.joints):
        joints = [block.joints[k] for block in blocks]
        ends = np.cumsum([len(joint.triangle) for joint in joints])
        rows, width = whole.triangle.shape
        # Where the blocks have fewer rows than columns, the total has their rows one below the
        # other, not factorised.
        if ends[-1] == rows < width:
            views = np.split(whole.triangle, ends[:-1])
            joints = [replace(joint, triangle=v) for joint, v in zip(joints, views)]
        of_all_blocks.append(joints)
    for block, joints_of_block in zip(blocks, zip(*of_all_blocks)):
        yield replace(block, joints=joints_of_block)


def restrict(
    information: SquareRootInformation, names: Sequence[str], held: Array | None = None
) -> SquareRootInformation:
    """Return the data's information about some parameters, with the others held at fixed values.

    The result has no prior, and the parameters in the order of ``information``.

    Args:
        information: equations in p parameters; not changed.
        names: the parameters that remain.
        held: (p,) values at which the others are held, in the order of ``information``; those of
            remaining parameters do not count. Zeros by default.
    """
    is_free = np.isin(information.names, names)
    # (p,) index of each remaining parameter among the remaining ones.
    new_index = np.cumsum(is_free) - 1
    joints = []
    for joint in information.joints:
        free = is_free[joint.columns]
        triangle = joint.triangle[:, np.append(free, True)]
        if held is not None:
            fixed = joint.columns[~free]
            triangle[:, -1] -= joint.triangle[:, :-1][:, ~free] @ held[fixed]
        smaller = update_triangle(triangle[:0], triangle)
        columns = new_index[joint.columns[free]]
        joints.append(replace(joint, columns=columns, triangle=smaller))
    remaining = tuple(compress(information.names, is_free))
    return SquareRootInformation(remaining, tuple(joints))

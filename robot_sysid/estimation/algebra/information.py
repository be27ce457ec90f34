"""Square-root information: one QR triangle per joint, accumulated chunk by chunk.

For equations Y x = tau the triangle R of [Y tau] = Q R holds all that least squares needs: normal
matrix, residual and rank. Stacking a new chunk under R and factorising again gives the triangle of
all rows (Bierman, "Factorization Methods for Discrete Sequential Estimation", 1977, ch. IV), so
memory does not grow with the number of samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import compress, islice, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array, JointInformation, SquareRootInformation

# Joints whose equations are squared together: on a long arm they share most columns.
_TOGETHER = 8
# Keeps equations of parameters without data invertible.
_RIDGE = 1e-12


class InformationAccumulator:
    """Collects the rows of several joints into a SquareRootInformation.

    Args:
        names: (p,) global parameter names.
        columns: per joint (k,) indices of the parameters of its rows.
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
        self._triangles = [np.zeros((0, len(c) + 1)) for c in self._columns]
        self._counts = [0] * len(self._joints)

    def add(self, index: int, rows: Array, tau: Array) -> None:
        """Add equations (N, k) of joint number ``index``, right-hand sides tau (N,) [N m]."""
        self._triangles[index] = update_triangle(
            self._triangles[index], np.column_stack((rows, tau))
        )
        self._counts[index] += len(tau)

    def result(self) -> SquareRootInformation:
        """Return the information of all rows added so far."""
        joints = tuple(
            JointInformation(joint, columns, triangle, count)
            for joint, columns, triangle, count in zip(
                self._joints, self._columns, self._triangles, self._counts
            )
        )
        return SquareRootInformation(self._names, joints)


def update_triangle(triangle: Array, rows: Array) -> Array:
    """Return the triangle (k, k) of all rows so far and the new ones (N, k); fewer than k non-zero
    rows are returned unchanged.
    """
    stacked = np.vstack((triangle, rows)) if len(triangle) else rows
    is_used = np.any(stacked != 0.0, axis=1)
    stacked = stacked if np.all(is_used) else stacked[is_used]
    is_tall = len(stacked) >= stacked.shape[1]
    return np.asarray(np.linalg.qr(stacked, mode="r")) if is_tall else stacked


def normal_matrix(information: SquareRootInformation, weights: Array) -> Array:
    """Return (p+1, p+1) [A b]^T [A b] of the equations of ``stacked``."""
    normal = np.zeros((len(information.names) + 1,) * 2)
    blocks = information.blocks(weights)
    while batch := list(islice(blocks, _TOGETHER)):
        rows = np.vstack(batch)
        at = np.flatnonzero(np.any(rows != 0.0, axis=0))
        rows = rows[:, at]
        gram = rows.T @ rows  # one array with itself takes half of the time
        for source, target in stretches(at):
            normal[target] += gram[source]
    return normal


def eliminate_others(normal: Array, indices: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the normal equations (k, k), (k,) of k parameters of [A b]' [A b] (p + 1, p + 1)."""
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
    """Return pairs of slices that add a matrix (k, k) to a larger one at indices (k,).

    Each pair is (block of the matrix, block of the larger one); contiguous indices share a block,
    which is twice as fast as single ones.
    """
    ends = [0, *(np.flatnonzero(np.diff(at) != 1) + 1).tolist(), len(at)]
    edges = [pair for pair in zip(ends, ends[1:]) if pair[0] < pair[1]]
    runs = [(slice(a, b), slice(int(at[a]), int(at[b - 1]) + 1)) for a, b in edges]
    return [tuple(zip(*pair)) for pair in product(runs, repeat=2)]


def sample_counts(information: SquareRootInformation) -> Array:
    """Return (joints,) number of equations of each joint."""
    return np.array([joint.n_samples for joint in information.joints], dtype=float)


def residual_errors(
    information: SquareRootInformation, values: Array
) -> dict[str, Any]:
    """Return the fields of an ``Estimate`` about the residuals at values (p,)."""
    squared = information.squared_residuals(values)
    counts = sample_counts(information)
    joints = [joint.joint for joint in information.joints]
    rms = np.sqrt(squared / np.maximum(counts, 1.0)).tolist()
    return {
        "rmse": float(np.sqrt(np.sum(squared) / max(information.n_samples, 1))),
        "rmse_per_joint": dict(zip(joints, rms)),
        "samples": {joint.joint: joint.n_samples for joint in information.joints},
    }


def combine(blocks: Sequence[SquareRootInformation]) -> SquareRootInformation:
    """Return the information of all blocks' data; a prior that they share counts once.

    All blocks, one at least, have the same parameters and joints.
    """
    if len(blocks) == 1:
        return blocks[0]
    joints = tuple(
        JointInformation(
            same[0].joint,
            same[0].columns,
            update_triangle(
                same[0].triangle[:0], np.vstack([j.triangle for j in same])
            ),
            sum(j.n_samples for j in same),
        )
        for same in zip(*(block.joints for block in blocks))
    )
    return SquareRootInformation(blocks[0].names, joints, blocks[0].prior)


def parts_of(
    total: SquareRootInformation, blocks: Sequence[SquareRootInformation]
) -> Iterator[SquareRootInformation]:
    """Yield the blocks of which a total is the sum, with the rows that it contains unchanged as
    views of it, which halves the memory.
    """
    counts = np.array(
        [[len(joint.triangle) for joint in block.joints] for block in blocks]
    )
    sizes = [joint.triangle.shape for joint in total.joints]
    # Rows were not made a triangle where they are fewer than the columns.
    shared = [
        count == rows < width
        for count, (rows, width) in zip(np.sum(counts, axis=0), sizes)
    ]
    for block, ends, sizes_of_block in zip(blocks, np.cumsum(counts, axis=0), counts):
        joints = tuple(
            replace(joint, triangle=every.triangle[end - count : end])
            if is_shared
            else joint
            for joint, every, is_shared, end, count in zip(
                block.joints, total.joints, shared, ends, sizes_of_block
            )
        )
        yield replace(block, joints=joints)


def restrict(
    information: SquareRootInformation, names: Sequence[str], held: Array | None = None
) -> SquareRootInformation:
    """Return the data's information about named parameters, with the others held at fixed values.

    The order of the parameters does not change.

    Args:
        held: (p,) values of all parameters; zeros by default.
    """
    joints = []
    selected = set(names)
    is_free = np.array([name in selected for name in information.names])
    for joint in information.joints:
        free = is_free[joint.columns]
        triangle = joint.triangle[:, np.append(free, True)]
        if held is not None:
            triangle[:, -1] -= (
                joint.triangle[:, :-1][:, ~free] @ held[joint.columns[~free]]
            )
        columns = (np.cumsum(is_free) - 1)[joint.columns[free]]
        smaller = update_triangle(triangle[:0], triangle)
        joints.append(JointInformation(joint.joint, columns, smaller, joint.n_samples))
    return SquareRootInformation(
        tuple(compress(information.names, is_free)), tuple(joints)
    )

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

# Joints whose equations are squared together: of many joints they share most columns.
_TOGETHER = 8
# Lifts equations of what nothing shows off zero.
_RIDGE = 1e-12


class InformationAccumulator:
    """Collects the rows of several joints into a SquareRootInformation.

    Args:
        names: (p,) global parameter names.
        columns: per joint, which global parameters its rows contain.
    """

    def __init__(
        self, names: Sequence[str], joints: Sequence[str], columns: Sequence[NDArray[np.int64]]
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
        """Return what has been collected so far."""
        joints = tuple(
            JointInformation(joint, columns, triangle, count)
            for joint, columns, triangle, count in zip(
                self._joints, self._columns, self._triangles, self._counts
            )
        )
        return SquareRootInformation(self._names, joints)


def update_triangle(triangle: Array, rows: Array) -> Array:
    """Return the triangle (k, k) of all rows so far and the new ones (N, k); fewer than k rows that
    are not zero, which no triangle makes fewer, as they are.
    """
    stacked = np.vstack((triangle, rows)) if len(triangle) else rows
    there = np.any(stacked != 0.0, axis=1)
    stacked = stacked if np.all(there) else stacked[there]
    is_tall = len(stacked) >= stacked.shape[1]
    return np.asarray(np.linalg.qr(stacked, mode="r")) if is_tall else stacked


def normal_matrix(information: SquareRootInformation, weights: Array) -> Array:
    """Return (p+1, p+1) [A b]^T [A b] of the equations of ``stacked``."""
    found, blocks = np.zeros((len(information.names) + 1,) * 2), information.blocks(weights)
    while some := list(islice(blocks, _TOGETHER)):
        rows = np.vstack(some)
        at = np.flatnonzero(np.any(rows != 0.0, axis=0))
        rows = rows[:, at]
        gram = rows.T @ rows  # of one array with itself, which is half of the work
        for own, there in stretches(at):
            found[there] += gram[own]
    return found


def eliminate_others(normal: Array, places: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the normal equations (k, k), (k,) of some places of [A b]' [A b] (p + 1, p + 1)."""
    others = np.setdiff1d(np.arange(len(normal) - 1), places)
    wanted = np.append(places, len(normal) - 1)
    diagonal = np.diag(normal)[others]
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = scale[:, None] * normal[np.ix_(others, others)] * scale
    scaled[np.diag_indices_from(scaled)] += _RIDGE
    crossed = scale[:, None] * normal[np.ix_(others, wanted)]
    solved = crossed.T @ np.linalg.solve(scaled, crossed)
    left = normal[np.ix_(wanted, wanted)] - solved
    return 0.5 * (left + left.T)[:-1, :-1], left[:-1, -1]


def stretches(at: NDArray[np.int64]) -> list[tuple[Any, Any]]:
    """Return pairs of parts of a matrix (k, k), and where they stand in a larger one, of places
    (k,): neighbours together, which is twice as fast as each by itself.
    """
    ends = [0, *(np.flatnonzero(np.diff(at) != 1) + 1).tolist(), len(at)]
    edges = [pair for pair in zip(ends, ends[1:]) if pair[0] < pair[1]]
    runs = [(slice(a, b), slice(int(at[a]), int(at[b - 1]) + 1)) for a, b in edges]
    return [tuple(zip(*pair)) for pair in product(runs, repeat=2)]


def sample_counts(information: SquareRootInformation) -> Array:
    """Return (joints,) how many equations there are of each joint."""
    return np.array([joint.n_samples for joint in information.joints], dtype=float)


def residual_errors(information: SquareRootInformation, values: Array) -> dict[str, Any]:
    """Return what an ``Estimate`` says of the residuals at values (p,)."""
    squared, counts = information.squared_residuals(values), sample_counts(information)
    joints = [joint.joint for joint in information.joints]
    each = np.sqrt(squared / np.maximum(counts, 1.0)).tolist()
    return {
        "rmse": float(np.sqrt(np.sum(squared) / max(information.n_samples, 1))),
        "rmse_per_joint": dict(zip(joints, each)),
        "samples": {joint.joint: joint.n_samples for joint in information.joints},
    }


def combined(parts: Sequence[SquareRootInformation]) -> SquareRootInformation:
    """Return the information of all parts' data together; a prior they have counts once.

    All parts, one at least, have the same parameters and joints.
    """
    if len(parts) == 1:
        return parts[0]
    joints = tuple(
        JointInformation(
            same[0].joint,
            same[0].columns,
            update_triangle(same[0].triangle[:0], np.vstack([j.triangle for j in same])),
            sum(j.n_samples for j in same),
        )
        for same in zip(*(part.joints for part in parts))
    )
    return SquareRootInformation(parts[0].names, joints, parts[0].prior)


def parts_of(
    whole: SquareRootInformation, parts: Sequence[SquareRootInformation]
) -> Iterator[SquareRootInformation]:
    """Yield the parts that a whole is ``combined`` from; what rows are there as they are is shared,
    which takes half of the memory.
    """
    counts = np.array([[len(joint.triangle) for joint in part.joints] for part in parts])
    sizes = [joint.triangle.shape for joint in whole.joints]
    # A triangle would have as many rows as columns.
    shared = [count == rows < width for count, (rows, width) in zip(np.sum(counts, axis=0), sizes)]
    for part, ends, own in zip(parts, np.cumsum(counts, axis=0), counts):
        joints = tuple(
            replace(joint, triangle=every.triangle[end - count : end]) if is_there else joint
            for joint, every, is_there, end, count in zip(
                part.joints, whole.joints, shared, ends, own
            )
        )
        yield replace(part, joints=joints)


def restricted(
    information: SquareRootInformation, names: Sequence[str], held: Array | None = None
) -> SquareRootInformation:
    """Return the data's information about some parameters, the others held at (p,) values or zero.

    The order that parameters have in the information is kept.
    """
    wanted, joints = set(names), list[JointInformation]()
    kept = np.array([name in wanted for name in information.names])
    for joint in information.joints:
        stay = kept[joint.columns]
        triangle = joint.triangle[:, np.append(stay, True)]
        if held is not None:
            known = joint.triangle[:, :-1][:, ~stay] @ held[joint.columns[~stay]]
            triangle[:, -1] -= known
        columns = (np.cumsum(kept) - 1)[joint.columns[stay]]
        smaller = update_triangle(triangle[:0], triangle)
        joints.append(JointInformation(joint.joint, columns, smaller, joint.n_samples))
    return SquareRootInformation(tuple(compress(information.names, kept)), tuple(joints))

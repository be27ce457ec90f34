"""Least squares, plain and weighted: how much each joint's equations count, and what they give."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimation.algebra.identifiability import triangle_space
from robot_sysid.estimation.algebra.information import sample_counts, stretches
from robot_sysid.records import Array, SquareRootInformation

# Measured: 5 to 7 rounds for seven joints; a millionth of the noise moves no printed digit.
_MOST_ROUNDS, _SETTLED = 30, 1e-6
# Shares of the root mean square torque, see ``noise_floor``.
_NOISE_FLOOR, _NOISE_FLOOR_WITH_PRIOR = 1e-9, 1e-4
# Least pivot of a scaled matrix, whose diagonal is 1: rounding makes up to 1e-14 of none, and exact
# data of arms leaves 1e-12 beside priors (measured). What counts as no step any more, as a share of
# all right-hand sides.
_LEAST_PIVOT, _ROUNDING = 1e-13, 1e-14
# Noise within one per cent of its floor is at it; there it may be as small as a hundredth of the
# floor, found in so many rounds.
_AT_FLOOR, _SHARPEST, _SHARPER = 1.01, 0.01, 2


Solved = Callable[[Array], tuple[Array, Array]]
Part = tuple[NDArray[np.int64], Array]
"""Which of all parameters, right-hand sides last, some rows [A b] have, and the rows."""


def ordinary(information: SquareRootInformation, solved: Solved) -> Array:
    """Return the noise (joints,) that all joints have in common, from all residuals [N m]."""
    ones, common = np.ones(len(information.joints)), 1.0
    for _ in range(_MOST_ROUNDS):
        values, paid = solved(ones / common)
        freedom = max(information.n_samples - float(np.sum(paid)), 1.0)
        rms = np.sqrt(float(np.sum(information.squared_residuals(values))) / freedom)
        before, common = common, float(max(rms, noise_floor(information)))
        # Without a prior the estimate does not depend on the size of the noise.
        if information.prior is None or abs(common / before - 1.0) < _SETTLED:
            break
    return common * ones


def weighted(
    information: SquareRootInformation, solved: Solved, start: Array | None = None
) -> Array:
    """Return the noise (joints,) [N m], found in turns with the estimate until it settles.

    Iterated feasible generalised least squares; for independent normal noise the fixed point is
    the maximum-likelihood estimate (Oberhofer, Kmenta 1974).
    """
    noise = ordinary(information, solved) if start is None else start
    floor = noise_floor(information)
    for _ in range(_MOST_ROUNDS):
        before, noise = noise, joint_noise(information, *solved(1.0 / noise), floor)
        if np.max(np.abs(noise / before - 1.0)) < _SETTLED:
            break
    return noise


def solver(information: SquareRootInformation, prior: Array) -> Solved:
    """Return a function, by the fastest way there is, of weights (joints,) by which each joint's
    equations are multiplied [1/(N m)]. It returns

        x = prior + argmin_d ||A d - (b - A prior)||,

    of minimum norm in scaled columns, and how many parameters each joint's equations pay for
    (joints,). Whatever the data cannot see keeps the prior's value (p,): d has no part there.
    """
    plain = partial(_solved, information, prior)
    if information.prior is None:
        return plain
    normal, known = _Normal(information, prior), dict[bytes, tuple[Array, Array]]()

    def solved(weights: Array) -> tuple[Array, Array]:
        # At the floor of the noise the same weights come again and again.
        key = weights.tobytes()
        if key not in known:
            known[key] = normal.solved(weights) or plain(weights)
        return known[key]

    return solved


def inverse_root(normal: Array) -> Array | None:
    """Return G (p, p) with G G^T the inverse of a normal matrix; None where it is not definite, or
    no more than rounding makes of what nothing shows.

    A tenth of the time of a decomposition. Half of the digits are lost, which noise and widths of
    priors do not notice.
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
        # What few joints have comes first, so that each joint's columns stand side by side.
        has = np.array([np.isin(np.arange(size), j.columns) for j in information.joints])
        order = np.lexsort((np.argmax(has, axis=0), np.sum(has, axis=0)))
        self._places, self._prior = np.append(np.argsort(order), size), prior[order]
        parts = [(self._places[[*j.columns, -1]], j.triangle) for j in information.joints]
        self._parts: list[Part] = [*parts, (self._places, information.prior)]
        ordered = ((np.sort(at), rows[:, np.argsort(at)]) for at, rows in self._parts)
        self._squares = [(rows.T @ rows, stretches(at)) for at, rows in ordered]

    def solved(self, weights: Array) -> tuple[Array, Array] | None:
        """Return what ``_solved`` returns; None where the equations show something too badly."""
        normal, squares = np.zeros((len(self._prior) + 1,) * 2), np.append(weights, 1.0) ** 2
        for (gram, places), square in zip(self._squares, squares):
            for own, there in places:
                normal[there] += square * gram[own]
        found = descended(normal, self._parts, squares, self._prior)
        if found is None:
            return None
        values, root = found
        spread = np.pad(root @ root.T, (0, 1))
        paid = [
            square * sum(np.einsum("ij,ij", gram[own], spread[there]) for own, there in places)
            for (gram, places), square in zip(self._squares, squares[:-1])
        ]
        return values[self._places[:-1]], np.array(paid)


def descended(
    normal: Array, parts: Sequence[Part], squares: Array, values: Array
) -> tuple[Array, Array] | None:
    """Return (least squares' values (p,), G (p, p) of ``inverse_root``), from values to begin with;
    None where normal equations (p + 1, p + 1) show something too badly.

    They are those of parts, each of which counts by the square (parts,) of its weight.

    What rounding of the squares has left is taken off by conjugate gradients of the equations
    themselves, in coordinates in which their squares are next to one (Bjorck, "Numerical methods
    for least squares problems", 1996, ch. 7.4).
    """
    root = inverse_root(normal[:-1, :-1])
    if root is None:
        return None
    way, before = np.zeros(len(root)), np.inf
    for _ in range(_MOST_ROUNDS):
        slope, full = np.zeros(len(normal)), np.append(values, -1.0)
        for (at, rows), square in zip(parts, squares):
            slope[at] -= square * ((rows @ full[at]) @ rows)
        steep = root.T @ slope[:-1]
        left = float(steep @ steep)
        if left <= _ROUNDING**2 * normal[-1, -1]:
            return values, root
        way, before = steep + left / before * way, left
        step = root @ way
        values = values + left / (step @ normal[:-1, :-1] @ step) * step
    return None


def decomposed(rows: Array) -> tuple[Array, Array]:
    """Return (values (p,) of minimum norm in scaled columns, G (p, p) with G G^T the inverse of
    squares) of equations (M, p + 1), by a decomposition.
    """
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    space = triangle_space(triangle[:, :-1])
    return space.solve(triangle[:, -1]), space.inverse_root()


def noise_floor(information: SquareRootInformation) -> float:
    """Return what counts as no noise at all: 1e-9 of the root mean square torque [N m].

    With a prior it is 1e-4, which is what filtering leaves: else nuisances would explain that.
    """
    squared = sum(float(np.sum(joint.triangle[:, -1] ** 2)) for joint in information.joints)
    rms = np.sqrt(squared / max(information.n_samples, 1))
    share = _NOISE_FLOOR if information.prior is None else _NOISE_FLOOR_WITH_PRIOR
    return float(share * rms) or 1.0


def sharpened(information: SquareRootInformation, solved: Solved, noise: Array) -> Array:
    """Return less noise (joints,) where there is hardly any [N m], by ``solver``.

    Beside priors no noise is taken to be smaller than a floor. Of exact data the priors would then
    weigh more than they need to.
    """
    floor = noise_floor(information)
    at_floor, found = noise <= _AT_FLOOR * floor, noise
    if information.prior is None or not np.any(at_floor):
        return noise
    for _ in range(_SHARPER):
        least = joint_noise(information, *solved(1.0 / found), _SHARPEST * floor)
        found = np.where(at_floor, least, noise)
    return found


def joint_noise(
    information: SquareRootInformation, values: Array, paid: Array, floor: float
) -> Array:
    """Return (joints,) noise standard deviation of each joint's torque [N m].

    sigma_j^2 = |r_j|^2 / (n_j - l_j), with the leverage l_j = w_j^2 tr(Y_j C Y_j^T): how many
    parameters this joint's equations pay for (Seber, Lee, "Linear Regression Analysis", 2003), at
    the solution (p,).
    """
    squared = information.squared_residuals(values)
    freedom = np.maximum(sample_counts(information) - paid, 1.0)
    return np.maximum(np.sqrt(squared / freedom), floor)


def _solved(
    information: SquareRootInformation, prior: Array, weights: Array
) -> tuple[Array, Array]:
    """Return what ``solver`` says, by a decomposition."""
    matrix, right = information.stacked(weights)
    values, root = decomposed(np.column_stack((matrix, right - matrix @ prior)))
    pairs = zip(information.joints, weights)
    paid = [w**2 * np.sum((j.triangle[:, :-1] @ root[j.columns]) ** 2) for j, w in pairs]
    return prior + values, np.array(paid)

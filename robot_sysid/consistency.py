"""Estimates that a rigid body can have: positive definite pseudo-inertia.

Minimises ||A x - b||^2 subject to J(x) positive definite (Wensing, Kim, Slotine 2018), or
||A x - b||^2 + weight d(J(x) || J0) with the log-det divergence as a prior (Lee, Wensing, Park,
"Geometric robot dynamic identification: a convex programming approach", 2020)

    d(J || J0) = tr(J0^-1 J) - log det(J0^-1 J) - 4.

All other parameters (friction, offsets) are free and eliminated beforehand, so the search runs over
ten numbers. Where the data is blind the constrained optimum is not unique: of all bodies that
explain the data equally well, the one nearest (in that divergence) to the plain estimate, rounded
until it is possible, is taken; along blind directions the plain estimate is the prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid import spatial
from robot_sysid.barrier import MatrixProblem, minimise
from robot_sysid.identifiability import (
    N_INERTIAL,
    VisibleSpace,
    column_scale,
    visible_space,
)
from robot_sysid.records import Array

INTERIOR_MARGIN = 1e-9
"""Smallest eigenvalue, relative to a well-rounded body of the same size, that is allowed."""
_GAP = 1e-9
_ROUNDNESS = 0.01
_PRIOR_FLOOR = 1e-6


def consistent_least_squares(
    matrix: Array, right: Array, prior: Array, weight: float = 0.0
) -> Array:
    """Return the best physically consistent parameters (p,).

    Args:
        matrix: (M, p) A; ten inertial columns first.
        right: (M,) b.
        prior: (p,) the model's values; parameters the data is blind to stay there.
        weight: of the divergence from the prior body, in units of ||A x - b||^2; 0 for none.

    Returns:
        The plain least-squares solution where weight is 0 and that one is already consistent.
    """
    plain = prior + visible_space(matrix).solve(right - matrix @ prior)
    body, inertial = prior[:N_INERTIAL], plain[:N_INERTIAL]
    start = lifted_body(inertial, body, _ROUNDNESS)
    if weight == 0.0 and _is_inside(inertial, start):
        return plain
    return _search(_eliminate_nuisances(matrix, right, prior), start, weight)


def lifted_body(theta: Array, scale_of: Array, floor: float) -> Array:
    """Return a safely possible body (10,) near theta.

    Eigenvalues of the pseudo-inertia, made dimensionless with mass and size of another body, are
    lifted to ``floor`` times the largest magnitude.

    Args:
        theta: (10,) parameters, possible or not.
        scale_of: (10,) body whose mass and size set the scale.
        floor: smallest eigenvalue relative to the largest magnitude (but at least 1).
    """
    mass = float(scale_of[0]) if scale_of[0] > 0.0 else 1.0
    length = spatial.characteristic_length(scale_of)
    units = np.sqrt(mass) * np.array([length, length, length, 1.0])
    values, vectors = np.linalg.eigh(spatial.pseudo_inertia(theta) / np.outer(units, units))
    lifted = np.maximum(values, floor * max(float(np.max(np.abs(values))), 1.0))
    if lifted[0] == values[0]:
        return np.array(theta, dtype=float)
    return spatial.theta_from_pseudo_inertia(
        (vectors * lifted) @ vectors.T * np.outer(units, units)
    )


def body_divergence(theta: Array, prior: Array) -> float:
    """Return d(J(theta) || J(prior)) >= 0; infinite where theta is not a possible body."""
    ratio = np.linalg.solve(spatial.pseudo_inertia(prior), spatial.pseudo_inertia(theta))
    sign, logarithm = np.linalg.slogdet(ratio)
    if sign <= 0.0 or not spatial.is_consistent(theta):
        return float("inf")
    return float(np.trace(ratio) - logarithm - 4.0)


@dataclass(frozen=True)
class _Reduced:
    """The problem in the ten inertial deviations from the prior, nuisances eliminated."""

    space: VisibleSpace
    right: Array
    nuisance: VisibleSpace
    coupling: Array
    nuisance_right: Array
    prior: Array

    def expand(self, deviation: Array) -> Array:
        """Return all parameters (p,) with the nuisances at their optimum."""
        free = self.nuisance.solve(self.nuisance_right - self.coupling @ deviation)
        return self.prior + np.concatenate((deviation, free))


def _eliminate_nuisances(matrix: Array, right: Array, prior: Array) -> _Reduced:
    scale, dead = column_scale(matrix)
    clean = np.where(dead, 0.0, matrix)
    deviation = right - clean @ prior
    inertial, nuisance = clean[:, :N_INERTIAL], visible_space(clean[:, N_INERTIAL:])
    onto = nuisance.left
    seen = inertial - onto @ (onto.T @ inertial)
    space = visible_space(seen, scale[:N_INERTIAL])
    return _Reduced(
        space, deviation - onto @ (onto.T @ deviation), nuisance, inertial, deviation, prior
    )


def _is_inside(theta: Array, rounded: Array) -> bool:
    return spatial.is_consistent(theta - INTERIOR_MARGIN * rounded)


def _search(reduced: _Reduced, start: Array, weight: float) -> Array:
    """Return all parameters (p,) that minimise the constrained or the entropic problem."""
    prior = reduced.prior[:N_INERTIAL]
    problem, basis = _normalised(reduced, start, weight)
    rest = max(float(np.sum(reduced.right**2) - np.sum(problem.right**2)), 0.0)
    strongest = float(np.max(problem.singular))
    weakest = float(np.min(problem.singular[problem.singular > 0.0], initial=strongest))
    # Where nothing but rounding is left to explain, the data's own strength sets the accuracy.
    floor = max(1e-8 * weakest**2, 1e-15 * strongest**2, np.finfo(float).tiny / _GAP)

    def target(w: Array) -> float:
        size = 4.0 + float(np.trace(problem.matrix(w)))
        return weight or _GAP * max(problem.misfit(w) + rest, floor) / size

    w = minimise(problem, np.linalg.solve(basis, start - prior), target)
    return reduced.expand(basis @ w)


def _normalised(reduced: _Reduced, start: Array, weight: float) -> tuple[MatrixProblem, Array]:
    """Return (problem in w, basis (10, 10)) with deviation = basis w.

    K(w) = L^-1 J L^-T with L L^T = J(start); without a prior it is lowered by the interior margin.
    """
    space, prior = reduced.space, reduced.prior[:N_INERTIAL]
    basis = space.scale[:, None] * np.hstack((space.right, space.null))
    inverse = np.linalg.inv(np.linalg.cholesky(spatial.pseudo_inertia(start)))
    singular, right = np.zeros(N_INERTIAL), np.zeros(N_INERTIAL)
    singular[: space.rank] = space.singular
    right[: space.rank] = space.left.T @ reduced.right
    directions = spatial.pseudo_inertia(basis.T)
    precision = np.linalg.inv(spatial.pseudo_inertia(lifted_body(prior, prior, _PRIOR_FLOOR)))
    constant = inverse @ spatial.pseudo_inertia(prior) @ inverse.T
    problem = MatrixProblem(
        singular=singular,
        right=right,
        linear=weight * np.einsum("kij,ij->k", directions, precision),
        tied=weight == 0.0,
        constant=constant - (INTERIOR_MARGIN if weight == 0.0 else 0.0) * np.eye(4),
        basis=inverse @ directions @ inverse.T,
    )
    return problem, basis

"""Estimates that a rigid body can have: positive definite pseudo-inertia.

Minimises ||A x - b||^2 subject to J(x) positive definite (Wensing, Kim, Slotine 2018), or
||A x - b||^2 + weight d(J(x) || J0) with the log-det divergence as a prior (Lee, Wensing, Park,
"Geometric robot dynamic identification: a convex programming approach", 2020)

    d(J || J0) = tr(J0^-1 J) - log det(J0^-1 J) - 4.

All other parameters (friction, offsets) are free and eliminated beforehand, so the search runs
over ten numbers. Directions the data cannot see stay at the prior as long as that leaves a possible
body with what the data does see. Where it does not, they give way first: the divergence from the
prior, with a weight that is nothing beside the data (``YIELDING``), chooses by how much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.barrier import MatrixProblem, minimise
from robot_sysid.estimation.identifiability import (
    N_INERTIAL,
    VisibleSpace,
    column_scale,
    visible_space,
)
from robot_sysid.estimation.least_squares import least_correction
from robot_sysid.records import Array

INTERIOR_MARGIN = 1e-9
"""Smallest eigenvalue, relative to a well-rounded body of the same size, that is allowed."""
# Excess over the optimum that is aimed at, and what rounding can resolve of the barrier.
_GAP, _RESOLUTION = 1e-9, 1e-13
# Eigenvalues are lifted to these shares of the largest: in the start, and in an impossible prior.
_ROUNDNESS, _PRIOR_FLOOR = 0.01, 1e-6
# How much harder than the best visible one an unidentifiable direction is held at the prior.
_PIN = 1e8
YIELDING = 1.0
"""Weight of the divergence, in units of squared whitened residuals, that invisible directions give
way under."""
# Smallest eigenvalue in units of the prior body that rounding may leave.
_LEAST = 1e-12


def consistent_least_squares(
    matrix: Array, right: Array, prior: Array, weight: float = 0.0
) -> Array:
    """Return the best physically consistent parameters (p,).

    Args:
        matrix: (M, p) A; ten inertial columns first.
        right: (M,) b.
        prior: (p,) the model's values; where the data shows nothing the result stays there.
        weight: of the divergence from the prior body, in units of ||A x - b||^2; 0 for none.

    Returns:
        The plain least-squares solution where weight is 0 and that one is already consistent.
        A prior body that is impossible itself is replaced by a possible one nearby.
    """
    plain = least_correction(matrix, right, prior)
    rounded = lifted_body(plain[:N_INERTIAL], prior[:N_INERTIAL], _ROUNDNESS)
    if weight == 0.0 and spatial.is_consistent(plain[:N_INERTIAL] - INTERIOR_MARGIN * rounded):
        return plain
    base = np.array(prior, dtype=float)
    base[:N_INERTIAL] = lifted_body(prior[:N_INERTIAL], prior[:N_INERTIAL], _PRIOR_FLOOR)
    reduced = _eliminate_nuisances(matrix, right, base)
    hidden = reduced.space.rank < N_INERTIAL
    return _search(reduced, rounded, YIELDING if weight == 0.0 and hidden else weight)


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


@dataclass(frozen=True)
class _Reduced:
    """The problem in the ten inertial deviations from the prior, nuisances eliminated."""

    space: VisibleSpace
    right: Array
    nuisance: VisibleSpace
    coupling: Array
    nuisance_right: Array
    prior: Array

    def directions(self) -> Array:
        """Return (10, 10) directions of deviation: the visible ones first, then the others."""
        seen = np.where(self.space.zero[:, None], 0.0, self.space.right)
        return self.space.scale[:, None] * np.hstack((seen, self.space.null))

    def expand(self, deviation: Array) -> Array:
        """Return all parameters (p,) with the nuisances at their optimum."""
        free = self.nuisance.solve(self.nuisance_right - self.coupling @ deviation)
        return self.prior + np.concatenate((deviation, free))


def _eliminate_nuisances(matrix: Array, right: Array, prior: Array) -> _Reduced:
    scale, zero = column_scale(matrix)
    clean = np.where(zero, 0.0, matrix)
    deviation = right - clean @ prior
    inertial, nuisance = clean[:, :N_INERTIAL], visible_space(clean[:, N_INERTIAL:], inertial=False)
    onto = nuisance.left
    seen = inertial - onto @ (onto.T @ inertial)
    space = visible_space(seen, scale[:N_INERTIAL])
    return _Reduced(
        space, deviation - onto @ (onto.T @ deviation), nuisance, inertial, deviation, prior
    )


def _search(reduced: _Reduced, start: Array, weight: float) -> Array:
    """Return all parameters (p,) that minimise the constrained or the entropic problem.

    Args:
        reduced: the problem in deviations from the prior.
        start: (10,) possible body.
        weight: of the entropic prior.
    """
    prior, rank = reduced.prior[:N_INERTIAL], reduced.space.rank
    basis = reduced.directions()
    problem = _normalised(reduced, basis, start, weight)
    rest = max(float(np.sum(reduced.right**2) - np.sum(problem.right[:rank] ** 2)), 0.0)
    seen = reduced.space.singular
    # Where nothing but rounding is left to explain, the data's own strength sets the accuracy.
    floor = max(1e-8 * np.min(seen, initial=1.0) ** 2, 1e-15 * np.max(seen, initial=0.0) ** 2)

    def target(w: Array) -> float:
        size = 4.0 + float(np.trace(problem.matrix(w)))
        resolvable = _RESOLUTION * float(np.linalg.norm(problem.balance(w)))
        return weight or max(_GAP * max(problem.misfit(w) + rest, floor) / size, resolvable)

    w = minimise(problem, np.linalg.solve(basis, start - prior), target)
    if weight == 0.0:
        w[rank:] = 0.0
    return reduced.expand(_pulled_inside(prior, basis @ w))


def _pulled_inside(prior: Array, deviation: Array) -> Array:
    """Return the deviation, shortened by what rounding may have put outside."""
    inverse = np.linalg.inv(np.linalg.cholesky(spatial.pseudo_inertia(prior)))
    change = inverse @ spatial.pseudo_inertia(deviation) @ inverse.T
    lowest = 1.0 + float(np.linalg.eigvalsh(change)[0])
    if lowest >= _LEAST:
        return deviation
    return deviation * (1.0 - _LEAST) / (1.0 - lowest)


def _normalised(reduced: _Reduced, basis: Array, start: Array, weight: float) -> MatrixProblem:
    """Return the problem in w with deviation = basis w, K(w) = L^-1 J L^-T, L L^T = J(start).

    Without a prior K is lowered by the interior margin, and unidentifiable directions are pinned.
    """
    space, prior = reduced.space, reduced.prior[:N_INERTIAL]
    inverse = np.linalg.inv(np.linalg.cholesky(spatial.pseudo_inertia(start)))
    pinned = _PIN * np.max(space.singular, initial=1.0) if weight == 0.0 else 0.0
    singular, right = np.full(N_INERTIAL, pinned), np.zeros(N_INERTIAL)
    singular[: space.rank] = space.singular
    right[: space.rank] = space.left.T @ reduced.right
    directions = spatial.pseudo_inertia(basis.T)
    precision = np.linalg.inv(spatial.pseudo_inertia(prior))
    margin = INTERIOR_MARGIN if weight == 0.0 else 0.0
    return MatrixProblem(
        singular=singular,
        right=right,
        linear=weight * np.einsum("kij,ij->k", directions, precision),
        constant=inverse @ spatial.pseudo_inertia(prior) @ inverse.T - margin * np.eye(4),
        basis=inverse @ directions @ inverse.T,
    )

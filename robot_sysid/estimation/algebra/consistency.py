"""Estimates of one link that a rigid body can have: positive definite pseudo-inertia.

Minimises ||A x - b||^2 subject to J(x) positive definite (Wensing, Kim, Slotine 2018), or
||A x - b||^2 + weight d(J(x) || J0) with the log-det divergence as a prior (Lee, Wensing, Park,
"Geometric robot dynamic identification: a convex programming approach", 2020)

    d(J || J0) = tr(J0^-1 J) - log det(J0^-1 J) - 4.

Directions the data cannot see stay at the prior as long as that leaves a possible body with what
the data does see. Where it does not, they give way first: the divergence from the prior, with a
weight that is nothing beside the data (``YIELDING``), chooses by how much.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.consistent_links import ConsistentLinks, LinksProblem
from robot_sysid.estimation.algebra.identifiability import N_INERTIAL, visible_space
from robot_sysid.estimation.algebra.least_squares import least_correction
from robot_sysid.records import Array

INTERIOR_MARGIN = 1e-9
"""Smallest eigenvalue, relative to a well-rounded body of the same size, that is allowed."""
YIELDING = 1.0
"""Weight of the divergence, in units of squared whitened residuals, that invisible directions give
way under."""
# Excess over the optimum that is aimed at, and what rounding leaves to explain of exact data.
_GAP, _LEAST_MISFIT = 1e-10, 1e-15
# Eigenvalues of a body beside the plain estimate are lifted to this share of the largest.
_ROUNDNESS = 0.01


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
    rounded = spatial.lifted_body(plain[:N_INERTIAL], prior[:N_INERTIAL], _ROUNDNESS)
    if weight == 0.0 and spatial.is_consistent(plain[:N_INERTIAL] - INTERIOR_MARGIN * rounded):
        return plain
    if weight == 0.0 and not all(visible_space(matrix).identified[:N_INERTIAL]):
        weight = YIELDING
    others = np.append(np.zeros(N_INERTIAL), prior[N_INERTIAL:])
    left, start = right - matrix @ others, np.zeros(len(prior))
    start[:N_INERTIAL] = rounded
    misfit = float(np.sum((right - matrix @ plain) ** 2))
    gamma = 0.5 * (weight or _GAP * max(misfit, _LEAST_MISFIT * float(left @ left)))
    usual = prior - others if weight else start
    problem = LinksProblem((np.arange(N_INERTIAL),), usual, np.zeros(1), start)
    return others + next(ConsistentLinks(matrix, left, problem).path([gamma]))

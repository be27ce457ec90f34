"""Physically consistent bodies: least squares in which all bodies are possible.

Minimises ||A x - b||^2 over the ten parameters of every body and all other parameters, with each
body's pseudo-inertia P (4, 4) at least a small share of that of its reference body P0: a consistent
body that is expected without any data, such as the model's. A body is consistent where its
pseudo-inertia is positive definite (Wensing, Kim, Slotine, "Linear matrix inequalities for
physically consistent inertial parameter identification", IEEE Robotics and Automation Letters 3(1),
2018). Directions without data stay at the reference bodies where that costs hardly anything.

The problem is convex, and Clarabel solves it. Each body is expressed relative to its reference
body, P = L K L^T with P0 = L L^T; its coordinates z are the coefficients of K - 1 in an orthonormal
basis of symmetric matrices, which are also the rows of Clarabel's cone.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimate.identifiability import visible_space
from robot_sysid.records import Array

LEAST_SHARE = 1e-6
"""Least eigenvalue of a body's pseudo-inertia, relative to that of its reference body; more for
bodies that are expected to be larger than ``SPREADS``, as rounding is relative to their size."""
SPREADS = (1.0, 10.0, 100.0)
"""Standard deviations of a body from its reference body that are tried, as shares of it: the
smallest one is used that fits hardly worse, so that what data hardly shows stays near it."""
WIDEST = 1e5
"""Largest spread, for a reference body that is far too small."""
TOLERANCES = (1e-8, 1e-6)
"""Relative errors of the solution that are tried: where rounding ends a search for the first one,
the second one is reached before."""
HARDLY = 3.0
"""Increase of the sum of squared residuals, each of unit variance, that is negligible: fitting is
expected to decrease this sum by the number of parameters."""
# Largest norm of the equations.
_HEAVIEST = 1e7
# Weight of rows that hold directions without data at the reference bodies, in shares of them.
_PIN = 1e4
# Share of the largest eigenvalue to which those of an inconsistent reference body are raised.
_FLOOR = 1e-6
# Standard deviation of other parameters, whose columns have unit length: holds those without data.
_UNSEEN = 1e5
# Orthonormal basis (10, 4, 4) of symmetric matrices with the inner product tr(A B): a matrix has a
# one on its diagonal, or sqrt(1/2) at (i, j) and (j, i). The order is that of Clarabel's triangles.
_COLUMNS, _ROWS = np.tril_indices(4)
_BASIS = np.zeros((10, 4, 4))
_BASIS[range(10), _ROWS, _COLUMNS] = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(0.5))
_BASIS[range(10), _COLUMNS, _ROWS] = _BASIS[range(10), _ROWS, _COLUMNS]


@dataclass(frozen=True)
class LinksProblem:
    """The links among the p parameters of a least-squares problem.

    Attributes:
        links: per link (10,) indices of its parameters, in the order of
            ``spatial.PARAMETER_NAMES``.
        prior: (p,) parameters of the reference bodies at these indices, zero elsewhere.
    """

    links: tuple[NDArray[np.int64], ...]
    prior: Array

    @cached_property
    def bodies(self) -> tuple[tuple[Array, Array], ...]:
        """Per link (theta, U): reference body (10,), made consistent, and U (10, 10).

        The coordinates z (10,) of a link stand for the body theta + U z.
        """
        bodies = []
        for link in self.links:
            prior = self.prior[link]
            theta = spatial.nearest_consistent_body(prior, prior, floor=_FLOOR)
            root = np.linalg.cholesky(spatial.pseudo_inertia(theta))
            units = map(spatial.theta_from_pseudo_inertia, root @ _BASIS @ root.T)
            bodies.append((theta, np.column_stack(list(units))))
        return tuple(bodies)


def consistent_least_squares(
    matrix: Array, right_side: Array, problem: LinksProblem, has_hidden: bool = True
) -> Array:
    """Return x (p,) of nearly the least ||A x - b|| with which all bodies are consistent.

    The squared residuals are at most ``HARDLY`` above the least. Within this limit, directions that
    A does not show are held at the reference bodies if that is possible, and bodies have the
    smallest of ``SPREADS``, or a larger spread where they lie beyond all of these.

    Args:
        matrix: A (M, p), whitened, so that residuals have unit variance.
        right_side: b (M,).
        problem: which of the p parameters are links, and their reference bodies.
        has_hidden: whether A may not show some direction.

    Raises:
        SysidError: the search does not converge.
    """
    size = matrix.shape[1]
    # Coordinates y stand for x = reference + unit y: z of each link, other columns of unit length.
    length = np.linalg.norm(matrix, axis=0)
    unit = np.diag(1.0 / np.where(length > 0.0, length, 1.0))
    reference = np.zeros(size)
    for link, (theta, units) in zip(problem.links, problem.bodies):
        reference[link] = theta
        unit[np.ix_(link, link)] = units
    # A few rows with the same squares.
    rows = np.column_stack((matrix @ unit, right_side - matrix @ reference))
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))

    def cost(y: Array) -> float:
        """Return the sum of squared residuals."""
        return float(np.sum((triangle @ np.append(y, -1.0)) ** 2))

    # Equations of exact data weigh as much as rounding allows.
    equations = triangle / max(1.0, np.linalg.norm(triangle) / _HEAVIEST)
    spreads = list(SPREADS)
    best = _solve(equations, problem, spreads[-1])
    bodies = np.concatenate(problem.links)
    while spreads[-1] < WIDEST and np.linalg.norm(best[bodies]) > spreads[-1]:
        # The prior around the reference bodies keeps the larger ones away that the data shows.
        spreads.append(10.0 * spreads[-1])
        best = _solve(equations, problem, spreads[-1])
    limit = cost(best) + HARDLY
    pins = np.zeros((0, size + 1))
    if has_hidden:
        # Rows that measure the hidden part of x, in orthonormal combinations of y.
        space = visible_space(matrix)
        hidden = _PIN * np.linalg.qr(unit.T @ (space.null.T / space.scale).T)[0].T
        pins = np.column_stack((hidden, np.zeros(len(hidden))))
    # With all hidden directions held, then with none of them.
    choices = (pins, pins[:0]) if len(pins) else (pins,)
    for held, spread in product(choices, spreads):
        # Where a narrow search fails, a wider one may not.
        with suppress(SysidError):
            y = _solve(np.vstack((equations, held)), problem, spread)
            if cost(y) <= limit:
                return np.asarray(reference + unit @ y)
    return np.asarray(reference + unit @ best)


def _solve(rows: Array, problem: LinksProblem, deviation: float) -> Array:
    """Return the coordinates y (p,) of least squared residuals with which bodies are consistent.

    Args:
        rows: equations [A b] (M, p + 1) in these coordinates.
        problem: which of the parameters are links.
        deviation: standard deviation of bodies from their reference bodies, as a share of them.

    Raises:
        SysidError: the search does not converge.
    """
    # Imported here, as SciPy's sparse matrices take half a second and most runs need no body.
    import clarabel
    from scipy import sparse

    # Residuals are variables of their own: the condition of the problem is not squared.
    count, size = len(rows), rows.shape[1] - 1
    bodies = np.concatenate(problem.links)
    precision = np.append(np.full(size, _UNSEEN**-2.0), np.ones(count))
    precision[bodies] = deviation**-2.0
    cone_rows = np.zeros((len(bodies), size + count))
    cone_rows[range(len(bodies)), bodies] = -1.0
    constraints = np.vstack((np.hstack((rows[:, :-1], -np.eye(count))), cone_rows))
    least_share = LEAST_SHARE * max(1.0, deviation / SPREADS[-1])
    least = (1.0 - least_share) * np.trace(_BASIS, axis1=1, axis2=2)
    limits = np.append(rows[:, -1], np.tile(least, len(problem.links)))
    cones = [
        clarabel.ZeroConeT(count),
        *(clarabel.PSDTriangleConeT(4) for _ in problem.links),
    ]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    for tolerance in TOLERANCES:
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
        solver = clarabel.DefaultSolver(
            sparse.diags(precision, format="csc"),
            np.zeros(len(precision)),
            sparse.csc_matrix(constraints),
            limits,
            cones,
            settings,
        )
        try:
            solution = solver.solve()
        except BaseException as error:
            # What Clarabel raises where rounding leaves it without a number is no Exception.
            if type(error).__name__ != "PanicException":
                raise
            continue
        if str(solution.status) in ("Solved", "AlmostSolved"):
            return np.asarray(solution.x)[:size]
    raise SysidError(
        "the fit of all links did not converge; check the units of the torques and of the model's "
        "inertias"
    )

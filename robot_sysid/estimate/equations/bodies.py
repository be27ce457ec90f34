"""Physically consistent bodies: least squares in which all bodies are possible.

Minimises ||A x - b||^2 over the ten parameters of every body and all other parameters, with each
body's pseudo-inertia P (4, 4) at least a small share of that of its reference body P0: a consistent
body that is expected without any data, such as the model's. Other parameters keep within bounds, at
once with the bodies: one that is crossed beside impossible bodies is often not reached beside
possible ones. A body is consistent where its
pseudo-inertia is positive definite (Wensing, Kim, Slotine, "Linear matrix inequalities for
physically consistent inertial parameter identification", IEEE Robotics and Automation Letters 3(1),
2018). Directions without data stay at the reference bodies where that costs hardly anything.

The problem is convex, and Clarabel solves it. Each body is expressed relative to a consistent body
of about the same size, P = L K L^T with P0 = L L^T; its coordinates z are the coefficients of K - 1
in an orthonormal basis of symmetric matrices, which are also the rows of Clarabel's cone.
"""

from __future__ import annotations

import contextlib
import sys
from dataclasses import dataclass, replace
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader, FileFinder
from importlib.util import module_from_spec
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimate.identifiability import ROUNDING, visible_space
from robot_sysid.records import Array
from robot_sysid.spatial import (
    N_INERTIAL,
    nearest_consistent_bodies,
    nearest_consistent_body,
)

LEAST_SHARE = 1e-6
"""Least eigenvalue of a body's pseudo-inertia, relative to that of its reference body."""
SPREADS = (1.0, 10.0, 100.0, 1e3, 1e4, 1e5, 1e6, 1e8, 1e12)
"""Standard deviations of bodies from their reference bodies, as a share of them, that are tried one
after the other. The largest ones are for reference bodies that are far too small."""
MOST_ABOVE = 3.0
"""Most by which squared residuals exceed the least ones that possible bodies have, in units of
their variance: fitting is expected to decrease them by the number of parameters."""
HELD_WEIGHT = 1e4
"""Weight of rows that hold hidden directions at the reference bodies; columns have unit length."""
LOOSE = 1e10
"""Standard deviation of other parameters, whose columns have unit length: they are held where they
have no data, and nowhere else."""
LEAST_AXIS = 0.1
"""Least eigenvalue of the body relative to which others are expressed, over that of its reference
body: none of its directions is tiny."""
SMALL_DISTANCE = 3e4
"""Squared residuals, in units of their variance, up to which a search need not begin again: the
solver's error is relative to the distance, and far less than ``MOST_ABOVE`` there."""
HEAVIEST = (1e7, 1e5, 1e3)
"""Largest norms of the equations, tried one after the other: where rounding ends a search with
exact data, it comes to an end with data that weighs less."""
AT_BOUND = 1e-3
"""Distance from its bound up to which a parameter is at it, in units of the torque's standard
deviation that it makes: the solver comes no nearer, and no torque shows it."""
# Relative error of the solution.
_TOLERANCE = 1e-8
# Orthonormal basis (10, 4, 4) of symmetric matrices with the inner product tr(A B): a matrix has a
# one on its diagonal, or sqrt(1/2) at (i, j) and (j, i). The order is that of Clarabel's triangles.
_COLUMNS, _ROWS = np.tril_indices(4)
_BASIS = np.zeros((10, 4, 4))
_BASIS[range(10), _ROWS, _COLUMNS] = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(0.5))
_BASIS[range(10), _COLUMNS, _ROWS] = _BASIS[range(10), _ROWS, _COLUMNS]
# Matrix (10, 16) that takes the entries of a pseudo-inertia to theta.
_ENTRIES = np.eye(16).reshape(16, 4, 4)
_THETAS = np.column_stack([spatial.theta_from_pseudo_inertia(e) for e in _ENTRIES])


@dataclass(frozen=True)
class Possible:
    """A solution with possible bodies.

    Attributes:
        values: (p,) the solution x.
        is_inside: (p,) which parameters are at no bound.
        is_held: whether directions that the equations do not show are held at the reference bodies.
        spread: standard deviation of bodies from their reference bodies, as a share of them.
    """

    values: Array
    is_inside: NDArray[np.bool_]
    is_held: bool
    spread: float


@dataclass(frozen=True)
class SparseColumns:
    """A sparse matrix as Clarabel reads it: SciPy's class takes half a second to import.

    Attributes:
        data: (nnz,) the numbers that are not zero, column by column.
        indices: (nnz,) their rows.
        indptr: (columns + 1,) where each column begins in these.
        shape: numbers of rows and columns.
    """

    data: Array
    indices: NDArray[np.int64]
    indptr: NDArray[np.int64]
    shape: tuple[int, ...]
    has_canonical_format = True

    @classmethod
    def of(cls, matrix: Array) -> SparseColumns:
        """Return a matrix without its zeros."""
        columns, rows = np.nonzero(matrix.T)
        starts = np.searchsorted(columns, np.arange(matrix.shape[1] + 1))
        return cls(matrix[rows, columns], rows, starts, matrix.shape)

    def with_diagonal(self, value: float, count: int) -> SparseColumns:
        """Return the matrix with columns beside it that have a value on their diagonal alone."""
        rows, columns = self.shape
        return SparseColumns(
            np.append(self.data, np.full(count, value)),
            np.append(self.indices, np.arange(count)),
            np.append(self.indptr, self.nnz + 1 + np.arange(count)),
            (rows, columns + count),
        )

    @property
    def nnz(self) -> int:
        """How many numbers are not zero."""
        return len(self.data)


@dataclass(frozen=True)
class _Sought:
    """What is searched: coordinates of links, which are last, and of parameters before them.

    Attributes:
        bodies: (L, 10) reference bodies of the links, consistent ones.
        lower, upper: (q,) bounds of the parameters that have any, which come before the links.
        start: (L, 10) bodies to begin with; None for those nearest to the free solution.
    """

    bodies: Array
    lower: Array
    upper: Array
    start: Array | None = None


def consistent_least_squares(
    matrix: Array,
    right_side: Array,
    links: NDArray[np.int64],
    prior: Array,
    has_hidden: bool = True,
    like: Possible | None = None,
    bounds: tuple[Array, Array] | None = None,
) -> Possible:
    """Return x (p,) of nearly the least ||A x - b|| with which all bodies are consistent.

    The squared residuals are at most 3 above the least, where fitting is expected to decrease them
    by the number of parameters; masses of last links are further off with less. Within this limit,
    directions that A does not show are held at the reference bodies if that is possible, and bodies
    have the smallest of some standard deviations from these, so that what data hardly shows stays
    near them.

    Args:
        matrix: A (M, p), whitened, so that residuals have unit variance.
        right_side: b (M,).
        links: (L, 10) indices of the parameters of each body, in the order of
            ``spatial.PARAMETER_NAMES``.
        prior: (p,) parameters, of which those at these indices are the reference bodies.
        has_hidden: whether A may not show some direction.
        like: solution of equations that are nearly the same, from which the search begins, and
            which says what is held; None for none.
        bounds: (p,) least and largest parameters, which bodies do not have; None for none.

    Raises:
        SysidError: the equations are no numbers.
    """
    if not (np.all(np.isfinite(matrix)) and np.all(np.isfinite(right_side))):
        raise SysidError(
            "the fit of all links did not converge; check the units of the torques and of the "
            "model's inertias"
        )
    size = matrix.shape[1]
    bodies = nearest_consistent_bodies(prior[links], prior[links], LEAST_SHARE)
    # Coordinates y stand for x = reference + unit y: z of each link, other columns of unit length.
    length = np.linalg.norm(matrix, axis=0)
    unit = np.diag(1.0 / np.where(length > 0.0, length, 1.0))
    reference = np.zeros(size)
    reference[links] = bodies
    unit[links[:, :, None], links[:, None]] = _units(bodies)
    lower, upper = bounds or (np.full(size, -np.inf), np.full(size, np.inf))
    is_bounded = np.isfinite(lower) | np.isfinite(upper)
    is_bounded[links] = False
    bounded = np.flatnonzero(is_bounded)
    # Other parameters come first, so that what is searched has a triangle of its own.
    at = np.append(links, bounded)
    order = np.concatenate(
        (np.setdiff1d(np.arange(size), at), bounded, np.ravel(links))
    )
    measure = np.where(length > 0.0, length, 1.0)[bounded]
    sought = _Sought(bodies, lower[bounded] * measure, upper[bounded] * measure)
    shown = np.column_stack((matrix @ unit[:, order], right_side - matrix @ reference))

    def cost(y: Array) -> float:
        """Return the sum of squared residuals."""
        return np.sum((shown @ np.append(y, -1.0)) ** 2)

    hidden = np.zeros((0, size + 1))
    if has_hidden:
        # Rows that measure the hidden part of x, in orthonormal combinations of y. They weigh so
        # much that they hold it at the reference bodies.
        space = visible_space(matrix)
        rows = unit[:, order].T @ (space.null.T / space.scale).T
        held = HELD_WEIGHT * np.linalg.qr(rows)[0].T
        hidden = np.column_stack((held, np.zeros(len(held))))
    if like is None:
        # With all hidden directions held, then with none of them.
        tried = [*product((True, False) if has_hidden else (False,), SPREADS)]
        limit = cost(_solve(shown, sought, SPREADS[-1])) + MOST_ABOVE
    else:
        sought = replace(sought, start=like.values[links])
        tried = [(like.is_held and has_hidden, like.spread)]
        limit = np.inf
    for is_held, spread in tried:
        rows = np.vstack((shown, hidden)) if is_held else shown
        y = _solve(rows, sought, spread)
        if cost(y) <= limit:
            break
    values = reference + unit[:, order] @ y
    if not spatial.is_consistent(values[links]):
        for link in links:
            theta = values[link]
            if not spatial.is_consistent(theta):
                values[link] = nearest_consistent_body(theta, theta, ROUNDING)
    near = AT_BOUND / np.where(length > 0.0, length, 1.0)
    is_low = is_bounded & (values < lower + near)
    is_high = is_bounded & (values > upper - near)
    values = np.where(is_low, lower, np.where(is_high, upper, values))
    return Possible(values, ~(is_low | is_high), is_held, spread)


def _solve(rows: Array, sought: _Sought, spread: float) -> Array:
    """Return the coordinates y (p,) of least squared residuals with which bodies are consistent.

    Args:
        rows: equations [A b] (M, p + 1) in these coordinates, what is sought last.
        sought: bodies and bounded parameters.
        spread: standard deviation of bodies from their reference bodies, as a share of them.
    """
    size = rows.shape[1] - 1
    links = size - sought.bodies.size
    others = links - len(sought.lower)
    precision = np.eye(size, size + 1)
    precision[:links] /= LOOSE
    precision[links:] /= spread
    triangle = np.asarray(np.linalg.qr(np.vstack((rows, precision)), mode="r"))
    z = _possible_coordinates(triangle[others:, others:], sought)
    top = triangle[:others]
    shown = top[:, -1] - top[:, others:-1] @ z
    return np.append(np.linalg.solve(top[:, :others], shown), z)


def _possible_coordinates(equations: Array, sought: _Sought) -> Array:
    """Return the coordinates z (q + 10 L,) of least ||A z - b|| with which L bodies are consistent.

    The first q are parameters with bounds. Those of one link stand for the body theta + U z, theta
    its reference body and U ``_units`` of it. They are searched relative to the consistent bodies
    that are nearest to the solution in which bodies may be impossible, so that numbers of very
    different sizes do not meet; and again relative to what was found where the distance is large,
    as rounding counts relative to it.

    Args:
        equations: [A b] (q + 10 L + 1, q + 10 L + 1), triangular.
        sought: bodies and bounds.
    """
    bodies = sought.bodies
    units = _units(bodies)
    free = np.linalg.lstsq(equations[:, :-1], equations[:, -1], rcond=None)[0]
    z = np.asarray(free, dtype=float)
    count = len(sought.lower)
    # Most searches near the reference bodies need no other ones.
    if _is_possible(z, units, sought):
        return z
    if sought.start is not None:
        z[count:] = _solutions(units, sought.start - bodies)
    links = np.arange(count, len(z)).reshape(-1, N_INERTIAL)
    for _ in range(3):
        centre = np.zeros_like(z)
        centre[:count] = np.clip(z[:count], sought.lower, sought.upper)
        change = np.eye(len(z))
        found_before = bodies + (units @ z[links][..., None])[..., 0]
        near = nearest_consistent_bodies(found_before, bodies, LEAST_AXIS)
        centre[count:] = _solutions(units, near - bodies)
        change[links[:, :, None], links[:, None]] = np.linalg.solve(units, _units(near))
        inverse = np.linalg.inv(np.linalg.cholesky(spatial.pseudo_inertia(near)))
        least = inverse @ spatial.pseudo_inertia(bodies) @ np.swapaxes(inverse, 1, 2)
        shifted = equations[:, -1] - equations[:, :-1] @ centre
        rows = np.column_stack((equations[:, :-1] @ change, shifted))
        limits = LEAST_SHARE * least + _TOLERANCE * np.eye(4)
        below = sought.lower - centre[:count]
        above = sought.upper - centre[:count]
        found = _by_cone(rows, limits, below, above)
        z = centre + change @ found
        is_small = shifted @ shifted < SMALL_DISTANCE
        if found.any() and (sought.start is not None or is_small):
            break
    return np.asarray(z)


def _is_possible(z: Array, units: Array, sought: _Sought) -> bool:
    """Return whether coordinates z (q + 10 L,) keep all bounds, and their bodies are consistent.

    ``units`` (L, 10, 10) are those of the reference bodies.
    """
    bounded = z[: len(sought.lower)]
    if np.any(bounded < sought.lower) or np.any(bounded > sought.upper):
        return False
    changes = z[len(bounded) :].reshape(-1, N_INERTIAL)
    moved = (units @ changes[..., None])[..., 0]
    return spatial.is_consistent((1.0 - LEAST_SHARE) * sought.bodies + moved)


def _by_cone(equations: Array, least: Array, lower: Array, upper: Array) -> Array:
    """Return the coordinates z (q + 10 L,) of least ||A z - b|| by Clarabel; zeros where it fails.

    Zeros are what the search begins with, which is near the best already.

    Args:
        equations: [A b] (M, q + 10 L + 1).
        least: (L, 4, 4) of each K, which are at least these.
        lower, upper: (q,) bounds of the first coordinates.
    """
    # Most runs need no body.
    import clarabel

    _load_lapack()
    count, size = len(equations), equations.shape[1] - 1
    every = np.eye(size)
    at_least = np.flatnonzero(np.isfinite(lower))
    at_most = np.flatnonzero(np.isfinite(upper))
    # Coefficients of the matrices 1 - least in the basis.
    above = (np.eye(4) - least).reshape(-1, 16) @ _BASIS.reshape(10, 16).T
    cones = [
        clarabel.ZeroConeT(count),
        clarabel.NonnegativeConeT(len(at_least) + len(at_most)),
        *(clarabel.PSDTriangleConeT(4) for _ in least),
    ]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _TOLERANCE
    # Residuals are variables of their own: the condition of the problem is not squared.
    squares = SparseColumns(
        np.ones(count),
        np.arange(size, size + count),
        np.maximum(np.arange(size + count + 1) - size, 0),
        (size + count, size + count),
    )
    for heaviest in HEAVIEST:
        rows = equations / max(1.0, float(np.linalg.norm(equations)) / heaviest)
        constraints = np.vstack(
            (rows[:, :-1], -every[at_least], every[at_most], -every[len(lower) :])
        )
        bounds = np.concatenate((-lower[at_least], upper[at_most]))
        limits = np.concatenate((rows[:, -1], bounds, np.ravel(above)))
        try:
            solution = clarabel.DefaultSolver(
                squares,
                np.zeros(size + count),
                SparseColumns.of(constraints).with_diagonal(-1.0, count),
                limits,
                cones,
                settings,
            ).solve()
        except BaseException as error:
            # What Clarabel raises where rounding leaves it without a number is no Exception.
            if type(error).__name__ != "PanicException":
                raise
            continue
        if str(solution.status) in ("Solved", "AlmostSolved"):
            return np.asarray(solution.x)[:size]
    return np.zeros(size)


@cache
def _load_lapack() -> None:
    """Load the two modules of SciPy in which Clarabel looks up LAPACK, and nothing around them.

    Their package takes as long to import as all searches of a log. Where a release of SciPy has
    them elsewhere, or they need more of it, Clarabel imports the package.
    """
    import scipy

    folder = str(Path(scipy.__file__).parent / "linalg")
    finder = FileFinder(folder, (ExtensionFileLoader, EXTENSION_SUFFIXES))
    for name in ("scipy.linalg.cython_blas", "scipy.linalg.cython_lapack"):
        spec = None if name in sys.modules else finder.find_spec(name)
        if spec is not None and spec.loader is not None:
            with contextlib.suppress(ImportError):
                module = module_from_spec(spec)
                spec.loader.exec_module(module)
                sys.modules[name] = module


def _units(thetas: Array) -> Array:
    """Return the change (L, 10, 10) of consistent bodies (L, 10) by each of their coordinates."""
    root = np.linalg.cholesky(spatial.pseudo_inertia(thetas))[:, None]
    turned = root @ _BASIS @ np.swapaxes(root, 2, 3)
    return np.swapaxes(turned.reshape(-1, N_INERTIAL, 16) @ _THETAS.T, 1, 2)


def _solutions(units: Array, changes: Array) -> Array:
    """Return the coordinates (10 L,) of changes (L, 10) of bodies with these units (L, 10, 10)."""
    return np.ravel(np.linalg.solve(units, changes[..., None]))

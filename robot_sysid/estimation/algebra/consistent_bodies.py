"""Physically consistent bodies: least squares for all links together, and the estimate's errors.

Minimises, over the ten parameters of every link and all other estimated parameters,

    1/2 ||A x - b||^2 + sum_i g_i [tr(P0_i^-1 P_i) - log det P_i]

with P_i the pseudo-inertia (4, 4) of link i and P0_i that of its usual body: a consistent body that
is expected for this link without any data, such as the model's. The second term is the log-det
divergence of Lee, Wensing, Park, "Geometric robot dynamic identification: a convex programming
approach", IEEE Transactions on Robotics 36(2), 2020, for a whole arm. A body is consistent where
its pseudo-inertia is positive definite. Priors are rows of A. The weight g_i (gamma) is far below
the resolution of the data and only keeps bodies consistent, unless a link is to be held near P0_i.

The problem is convex. A primal-dual method decreases gamma from a value at which P0 alone decides,
in the scaling of Nesterov and Todd, in which the matrices and their duals become one and the same
diagonal matrix (Toh, Todd, Tutuncu, "SDPT3 - a MATLAB software package for semidefinite
programming", 1999), with Mehrotra's predictor and corrector. A step is one factorisation for all
links, of rows and not of their squares. Two changes of coordinates keep steps accurate in weakly
identified directions. Each link is expressed relative to its usual body, P_i = L_i K_i L_i^T with
P0_i = L_i L_i^T, and z_i are the ten coordinates of K_i - 1. Then z is rotated into the singular
directions of A, in which the second derivative of ||A x - b||^2 is diagonal.

Making a body consistent changes its errors. An inconsistent estimate theta + e, e ~ N(0, C), is
replaced by the best consistent body. The error of that body, computed for random draws of e, is
T e by linear regression, plus a residual of covariance R. The other parameters keep their
regression G on the body, as it is in C: with E, which selects the body, errors e of all parameters
become (1 + G (T - 1) E) e.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra.identifiability import RELATIVE_CUT, visible_space
from robot_sysid.estimation.algebra.uncertainty import Uncertainty
from robot_sysid.records import Array

GAMMAS = (0.1, 0.01, 1e-3, 1e-4)
"""Weights gamma of the divergence from the usual bodies that ``best`` tries, the largest first."""
HARDLY = 3.0
"""Increase of the sum of squared residuals, each of unit variance, that is negligible: fitting is
expected to decrease this sum by the number of parameters."""
# Share of the largest eigenvalue to which those of an inconsistent usual body are raised.
_FLOOR = 1e-6
# Diagonal of the rows that hold parameters without data at zero, where columns have unit length.
_RIDGE = 1e-5
# Gamma at which the path begins: the usual bodies are about the minimiser there.
_EASY = 100.0
# Squared length of a step at convergence, as a multiple of gamma.
_CONVERGED = 1e-6
# Largest number of Newton steps, and of reductions of one step: problems take 15 to 30 steps.
_MOST_STEPS = 1000
# Largest step, as a share of the step at which a matrix becomes singular.
_TO_THE_WALL = 0.95
# Least eigenvalue of the product of a matrix and its dual, as a share of the mean eigenvalue.
_CENTRALITY = 0.02
# Factor by which a step is reduced until it satisfies ``_CENTRALITY``.
_REDUCTION = 0.7
# Length of a step below which a step without second-order correction is tried as well.
_SHORT = 0.5
# Least relative decrease of gamma after a step of full length.
_EAGER = 0.8
# Weight of rows that hold the null space at the usual bodies; the data's rows have weight one.
_PIN = 1e3
# Relative rounding error of a sum of squared residuals.
_RESOLUTION = 1e-15
# Rounding error of the squared length of a step, as a share of the sum of squared residuals.
_SHORTEST = 1e-18
# Likewise for this many steps in a row that do not shrink.
_STALLED = 1e-16
_MOST_STALLED = 3


@dataclass(frozen=True)
class LinksProblem:
    """The links among the p parameters of a least-squares problem.

    Attributes:
        links: per link (10,) indices of its parameters, in the order of
            ``spatial.PARAMETER_NAMES``.
        prior: (p,) parameters of the usual bodies at these indices, zero elsewhere.
    """

    links: tuple[NDArray[np.int64], ...]
    prior: Array

    @cached_property
    def bodies(self) -> tuple[tuple[Array, Array], ...]:
        """Per link (theta, U): usual body (10,), made consistent, and U (10, 10).

        The coordinates z (10,) of a link stand for the body theta + U z.
        """
        bodies = []
        for link in self.links:
            prior = self.prior[link]
            theta = spatial.nearest_consistent_body(prior, prior, floor=_FLOOR)
            # Root L of the pseudo-inertia P0; row k of ``units`` is the body of L B_k L^T.
            root = np.linalg.cholesky(spatial.pseudo_inertia(theta))
            units = _components(root @ _BASIS @ root.T) @ _THETAS
            bodies.append((theta, units.T))
        return tuple(bodies)


End = tuple[float, Array, Array]
"""Point of the path: gamma, and at its minimiser the coordinates z (10 links,) and square roots of
the dual matrices (links, 4, 4)."""


class ConsistentLinks:
    """Least-squares problem A x = b with consistent bodies, solved for one or several gammas.

    Args:
        matrix: A (M, p), whitened, so that residuals have unit variance.
        right_side: b (M,).
        problem: which of the p parameters are links, and their usual bodies.
        start: ``first`` of a similar problem, at which to begin; None for the usual bodies.

    Attributes:
        first: the minimiser for the first gamma that was solved; None before ``path`` or ``best``.
    """

    def __init__(
        self,
        matrix: Array,
        right_side: Array,
        problem: LinksProblem,
        start: End | None = None,
    ) -> None:
        self._matrix = matrix
        self._right_side = right_side
        self._problem = problem
        self._start = start
        self.first: End | None = None
        self._bodies = np.concatenate(problem.links)
        # Scaled coordinates y stand for the parameters x = origin + unit y: z for each link,
        # columns of unit length for all other parameters.
        length = np.linalg.norm(matrix, axis=0)
        self._origin = np.zeros(len(problem.prior))
        self._unit = np.diag(1.0 / np.where(length > 0.0, length, 1.0))
        for link, (theta, units) in zip(problem.links, problem.bodies):
            self._origin[link] = theta
            self._unit[np.ix_(link, link)] = units
        self._others = np.delete(np.arange(len(self._origin)), self._bodies)
        self._other_rows, of_bodies = self._eliminate_others()
        # The last row has a right-hand side alone, the residual that no body explains.
        left, singular, directions = np.linalg.svd(of_bodies[:-1, :-1])
        self._turn = directions.T
        self._singular = singular
        self._projected = left.T @ of_bodies[:-1, -1]
        self._inverse_condition = np.min(singular) / np.max(singular, initial=_RIDGE)
        self._squared = float(self._projected @ self._projected)
        self._unexplained = float(of_bodies[-1, -1] ** 2)

    def _eliminate_others(self) -> tuple[Array, Array]:
        """Return rows [A b] of a QR factorisation in scaled coordinates.

        Columns are c parameters that belong to no body, held by a small ridge where they have no
        data, k coordinates of the bodies, and the right-hand side. The first rows (c, c + k + 1)
        determine the c parameters from the bodies, the others (k + 1, k + 1) contain bodies alone.
        """
        count = len(self._others)
        scaled = self._matrix @ self._unit
        right_side = self._right_side - self._matrix @ self._origin
        order = np.append(self._others, self._bodies)
        rows = np.column_stack((scaled[:, order], right_side))
        ridge = np.zeros((rows.shape[1], rows.shape[1]))
        ridge[range(count), range(count)] = _RIDGE
        triangle = np.asarray(np.linalg.qr(np.vstack((rows, ridge)), mode="r"))
        return triangle[:count], triangle[count:, count:]

    def _all(self, z: Array) -> Array:
        """Return all parameters (p,) for coordinates z (k,) of bodies, others by least squares."""
        count = len(self._others)
        values = np.zeros(len(self._origin))
        goal = self._other_rows[:, -1] - self._other_rows[:, count:-1] @ z
        values[self._bodies] = z
        values[self._others] = np.linalg.solve(self._other_rows[:, :count], goal)
        return self._origin + self._unit @ values

    def best(self) -> Array:
        """Return the minimiser (p,) for the largest of ``GAMMAS`` that hardly increases residuals.

        Their sum of squares may exceed that for the smallest gamma, which is taken where no other
        fits, by ``HARDLY``. Directions without data then stay at the usual bodies,
        exactly so where the null space can be held there within this limit. Directions with data
        are not biased towards the usual bodies, even of a tool much larger than the model's link.
        SysidError where a search does not converge.
        """
        candidates = []
        solvers = [*self._hold_null_space(), self]
        for solver in solvers:
            ends = solver.path((GAMMAS[0], GAMMAS[-1]))
            candidate = next(ends)
            # No body, consistent or not, leaves less than the unexplained residuals.
            if self._squared_residuals(candidate) <= self._unexplained + HARDLY:
                return candidate
            candidates.append(candidate)
        # The last solver is this one: the next of its ends is that for the smallest gamma.
        limit = self._squared_residuals(next(ends)) + HARDLY
        paths = [solver.path(GAMMAS[1:]) for solver in solvers]
        for candidate in chain(candidates, *paths):
            if self._squared_residuals(candidate) <= limit:
                break
        return candidate

    def _hold_null_space(self) -> Iterator[ConsistentLinks]:
        """Yield the problem with the null space of A held at the usual bodies, if there is one."""
        if self._inverse_condition > RELATIVE_CUT:
            return
        space = visible_space(self._matrix)
        rows = _PIN * space.null.T / space.scale
        matrix = np.vstack((self._matrix, rows))
        right_side = np.append(self._right_side, rows @ self._origin)
        yield ConsistentLinks(matrix, right_side, self._problem)

    def _squared_residuals(self, values: Array) -> float:
        """Return the sum of squared residuals ||A x - b||^2 of parameters (p,)."""
        return float(np.sum((self._matrix @ values - self._right_side) ** 2))

    def path(self, gammas: Sequence[float]) -> Iterator[Array]:
        """Yield the minimiser (p,) for each of several gammas, given largest first; set ``first``.

        Each search begins at the previous minimiser; where it fails from there, at the usual bodies
        at the gamma ``_EASY``, and then at one that outweighs exact data; SysidError where all
        fail. A gamma below the rounding error of the squared residuals is raised to that error.
        """
        end = self.first or self._start or self._beginning(_EASY)
        for gamma in np.maximum(gammas, _RESOLUTION * self._squared).tolist():
            for start in (end, self._beginning(_EASY)):
                with suppress(SysidError):
                    end = self._follow(*start, gamma)
                    break
            else:
                end = self._follow(*self._beginning(max(_EASY, self._squared)), gamma)
            self.first = self.first or end
            yield self._all(end[1])

    def _beginning(self, gamma: float) -> End:
        """Return the usual bodies with their duals, the minimiser if gamma outweighs the data."""
        z = np.zeros(len(self._bodies))
        # Roots of Z = gamma K^-1, K = 1.
        duals = np.repeat(np.sqrt(gamma) * np.eye(4)[None], len(z) // 10, axis=0)
        return gamma, z, duals

    def _follow(self, t: float, z: Array, duals: Array, gamma: float) -> End:
        """Return the minimiser at gamma, from the ``End`` (t, z, duals), or raise SysidError."""
        # t is the gamma that a step aims at, length the part of the last step that was taken.
        t = max(t, gamma)
        length = 1.0
        size_limit = max(_CONVERGED * gamma, _SHORTEST * self._squared)
        previous_size = np.inf
        n_stalled = 0
        for _ in range(_MOST_STEPS):
            try:
                cone = ScaledBodies(z, duals)
                unexplained = self._projected - self._singular * (self._turn.T @ z)
                newton = _Newton(cone, self._singular, unexplained, self._turn)
                predictor = newton.step(gamma)
                remainder = 1.0 - min(1.0, newton.step_limit(predictor))
                # After a long step, t decreases even where the predictor step is short.
                t = max(gamma, min(remainder**2, 1.0 - _EAGER * length) * t)
                step, length = newton.best(t, predictor)
                z = z + length * step.direction
                duals = cone.move_duals(length * step.dual)
            except np.linalg.LinAlgError:
                break
            # Rounding may keep steps above the limit; a single step may grow for other reasons.
            is_stalled = 0.5 * previous_size <= step.size <= _STALLED * self._squared
            n_stalled = n_stalled + 1 if t == gamma and is_stalled else 0
            if t == gamma and (step.size <= size_limit or n_stalled == _MOST_STALLED):
                return gamma, z, duals
            previous_size = step.size
        raise SysidError(
            "the fit of all links did not converge; check the units of the torques and of the "
            "model's inertias"
        )


class ScaledBodies:
    """The links' matrices K and their dual matrices Z, both scaled to one diagonal matrix D.

    At the minimiser for gamma = t, Z is t K^-1. Matrices in scaled coordinates are G^-1 K G^-T and
    G^T Z G, which both equal D (4, 4) for each link before a step.

    Args:
        z: (10 links,) coordinates, K = 1 + sum_k z_k B_k with the basis B of symmetric matrices.
        duals: (links, 4, 4) roots R with Z = R R^T: rounding of Z itself would hide its smallest
            eigenvalues.

    Raises:
        LinAlgError: a matrix is not positive definite.
    """

    def __init__(self, z: Array, duals: Array) -> None:
        bodies = np.eye(4) + np.tensordot(z.reshape(-1, 10), _BASIS, 1)
        product = _transpose(duals) @ np.linalg.cholesky(bodies)
        left, self._diagonal, _ = np.linalg.svd(product)
        scaled = left / np.sqrt(self._diagonal)[:, None, :]
        # G^-1 with G^-1 K G^-T = G^T Z G = D.
        self._inverse = _transpose(scaled) @ _transpose(duals)
        inverse = self._inverse[:, None]
        self._basis = inverse @ _BASIS @ _transpose(inverse)
        # D (links, 4, 4): K and Z in scaled coordinates.
        self._here = self._diagonal[:, :, None] * np.eye(4)

    def rows(self) -> Array:
        """Return rows R (links, 10, 10), R^T R the barrier's second derivative in z per link."""
        return _transpose(_components(self._basis))

    def aim(self, t: float) -> Array:
        """Return t D^-1 (links, 4, 4), which Newton's equation demands of D + dK + dZ."""
        return np.asarray((t / self._diagonal)[:, :, None] * np.eye(4))

    def changes(self, step: Array, t: float, correction: Array) -> tuple[Array, Array]:
        """Return the scaled changes (links, 4, 4) of K and of the duals by a Newton step.

        Args:
            step: (10 links,) change of z.
            t: gamma that the step aims at.
            correction: (links, 4, 4) of ``second_order``, or zeros.
        """
        primal = np.einsum("mk,mkij->mij", step.reshape(-1, 10), self._basis)
        return primal, self.aim(t) - self._here - correction - primal

    def second_order(self, primal: Array, dual: Array) -> Array:
        """Return Mehrotra's second-order term (links, 4, 4) of scaled changes of K and Z."""
        product = primal @ dual
        both = self._diagonal[:, :, None] + self._diagonal[:, None, :]
        return np.asarray((product + _transpose(product)) / both)

    def step_limit(self, change: Array) -> float:
        """Return the largest factor of a scaled change (links, 4, 4) of K, or of Z, after which it
        is still positive semidefinite; infinite without a limit."""
        roots = np.sqrt(self._diagonal)
        relative = change / (roots[:, :, None] * roots[:, None, :])
        lowest = float(np.min(np.linalg.eigvalsh(relative), initial=0.0))
        return -1.0 / lowest if lowest < 0.0 else np.inf

    def centrality(self, primal: Array, dual: Array) -> float:
        """Return the smallest eigenvalue of K Z over the mean one, the least over all links.

        Args:
            primal: (links, 4, 4) scaled change of K.
            dual: (links, 4, 4) scaled change of Z.

        Raises:
            LinAlgError: a matrix is not positive definite after its change.
        """
        root = np.linalg.cholesky(self._here + primal)
        dual_root = np.linalg.cholesky(self._here + dual)
        products = np.linalg.svd(_transpose(root) @ dual_root, compute_uv=False) ** 2
        return float(np.min(products / np.mean(products, axis=1, keepdims=True)))

    def move_duals(self, change: Array) -> Array:
        """Return roots of the duals (links, 4, 4), not scaled, after a scaled change of them."""
        root = np.linalg.cholesky(self._here + change)
        return np.asarray(_transpose(self._inverse) @ root)


@dataclass(frozen=True)
class _Step:
    """A Newton step.

    Attributes:
        direction: (10 links,) change of the coordinates z.
        primal: (links, 4, 4) scaled change of the matrices K.
        dual: (links, 4, 4) scaled change of the dual matrices.
        size: squared length of the change of z, measured by the second derivative.
    """

    direction: Array
    primal: Array
    dual: Array
    size: float


class _Newton:
    """Newton's equations at one point, solved as least squares; LinAlgError where singular.

    Rounding of normal equations would hide weakly identified directions.

    Args:
        cone: the matrices at this point.
        singular: (k,) singular values of the data's rows of the bodies, k = 10 links.
        unexplained: (k,) residual along each singular direction.
        turn: (k, k) right singular vectors of these rows, as columns.
    """

    def __init__(
        self, cone: ScaledBodies, singular: Array, unexplained: Array, turn: Array
    ) -> None:
        from scipy.linalg.lapack import dgeqrf, dormqr, dtrtri

        self._cone = cone
        self._unexplained = unexplained
        self._turn = turn
        curvature = cone.rows() @ turn.reshape(-1, 10, len(turn))
        rows = np.vstack((np.diag(singular), curvature.reshape(turn.shape)))
        # Q as Householder vectors: to form it would take longer than all other steps.
        packed, factors, *_ = dgeqrf(rows)
        self._turned = partial(dormqr, "L", "T", packed, factors)  # Q^T times columns
        self._inverse, failed = dtrtri(np.triu(packed[: len(turn)]))
        if failed:
            raise np.linalg.LinAlgError("singular")

    def step(self, t: float, predictor: _Step | None = None) -> _Step:
        """Return the full Newton step towards the minimiser at gamma = t.

        Args:
            t: gamma.
            predictor: step whose second-order term corrects this one; None for no correction.
        """
        cone = self._cone
        aim = cone.aim(t)
        correction = 0.0 * aim
        if predictor is not None:
            correction = cone.second_order(predictor.primal, predictor.dual)
        # Gradient of t sum_i tr(K_i), along the singular directions.
        slope = t * (self._turn.T @ np.tile(_TRACES, len(aim)))
        goal = np.append(self._unexplained, _components(aim - correction))
        turned = self._turned(goal[:, None], len(goal))[0][: len(slope), 0]
        scaled = turned - self._inverse.T @ slope
        direction = self._turn @ (self._inverse @ scaled)
        primal, dual = cone.changes(direction, t, correction)
        return _Step(direction, primal, dual, size=float(scaled @ scaled))

    def step_limit(self, step: _Step) -> float:
        """Return the largest factor of a step that leaves K and its duals positive semidefinite."""
        return min(self._cone.step_limit(step.primal), self._cone.step_limit(step.dual))

    def best(self, t: float, predictor: _Step) -> tuple[_Step, float]:
        """Return (step towards gamma = t, factor by which to take it).

        The step is corrected by the second-order term of ``predictor``, unless its factor is then
        below ``_SHORT`` and a step without correction has a larger one.
        """
        step = self.step(t, predictor)
        length = self.central_length(step)
        if length >= _SHORT:
            return step, length
        plain = self.step(t)
        other = self.central_length(plain)
        return (plain, other) if other > length else (step, length)

    def central_length(self, step: _Step) -> float:
        """Return a factor (at most 1) of a step that leaves ``centrality`` at ``_CENTRALITY``."""
        length = min(1.0, _TO_THE_WALL * self.step_limit(step))
        centrality = self._cone.centrality
        for _ in range(_MOST_STEPS):
            if centrality(length * step.primal, length * step.dual) >= _CENTRALITY:
                break
            length *= _REDUCTION
        return length


def _transpose(matrices: NDArray[Any]) -> NDArray[Any]:
    """Return the transpose (..., n, m) of each matrix (..., m, n)."""
    return np.swapaxes(matrices, -1, -2)


def _components(matrices: Array) -> Array:
    """Return the coefficients (..., 10) of symmetric matrices (..., 4, 4) in ``_BASIS``."""
    return np.tensordot(matrices, _BASIS, ((-2, -1), (1, 2)))


# Orthonormal basis (10, 4, 4) of symmetric matrices with the inner product tr(A B): a matrix has a
# one on its diagonal, or sqrt(1/2) at (i, j) and (j, i).
_ROWS, _COLUMNS = np.triu_indices(4)
_BASIS = np.zeros((10, 4, 4))
_BASIS[range(10), _ROWS, _COLUMNS] = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(0.5))
_BASIS[range(10), _COLUMNS, _ROWS] = _BASIS[range(10), _ROWS, _COLUMNS]
# Inertial parameters (10, 10) of the pseudo-inertias in the basis: theta = coefficients @ _THETAS.
_THETAS = np.array([spatial.theta_from_pseudo_inertia(matrix) for matrix in _BASIS])
# Trace (10,) of each matrix of the basis.
_TRACES = np.trace(_BASIS, axis1=1, axis2=2)
BODIES = "physical consistency"
"""Name, in results, of the error that is left by making an inconsistent body consistent."""
# Number of random errors, half of them the negatives of the others. For a UR5e's last link, 60 and
# 1000 give standard errors of the mass that agree to 7 %.
_DRAWS = 60


def project_errors(
    uncertainty: Uncertainty,
    causes: Mapping[str, Array],
    indices: NDArray[np.int64],
    theta: Array,
    center: Array,
) -> tuple[Uncertainty, dict[str, Array]]:
    """Return the errors of an estimate whose body is made consistent: in total, and by cause.

    Args:
        uncertainty: errors of the k estimated parameters before the body is made consistent.
        causes: per cause of errors, rows R (m, k) with R^T R the covariance due to this cause.
        indices: (10,) indices of the body among the k estimated parameters.
        theta: (10,) estimated inertial parameters of the body.
        center: (10,) inertial parameters of a plausible body, the usual body of the fit.

    Returns:
        The new errors and causes, with ``BODIES`` as one more cause; both as given where the body
        is not identifiable or needs no change.
    """
    of_body = uncertainty.covariance[np.ix_(indices, indices)]
    is_identifiable = np.all(np.isfinite(uncertainty.standard_errors[indices]))
    projection = _projected_errors(theta, of_body, center) if is_identifiable else None
    if projection is None:
        return uncertainty, dict(causes)
    turn, residual = projection
    # (10, k) regression of all parameters on the body: G^T of the module's formula.
    regression = np.linalg.solve(of_body, uncertainty.covariance[indices])
    change = (turn - np.eye(10)).T @ regression

    def project(rows: Array) -> Array:
        """Return rows (m, k) of errors after the body is made consistent, without the residual."""
        return rows + rows[:, indices] @ change

    by_cause = {cause: project(rows) for cause, rows in causes.items()}
    rows_of_bodies = residual @ regression
    by_cause[BODIES] = rows_of_bodies
    # A covariance changes by rows, then by columns.
    covariance = project(project(uncertainty.covariance).T)
    covariance = covariance + rows_of_bodies.T @ rows_of_bodies
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    is_unidentifiable = np.isinf(uncertainty.standard_errors)
    return replace(
        uncertainty,
        covariance=covariance,
        noise=project(project(uncertainty.noise).T),
        standard_errors=np.where(is_unidentifiable, np.inf, errors),
    ), by_cause


def projected_covariance(theta: Array, covariance: Array) -> Array:
    """Return the covariance (10, 10) of a body's errors after the body is made consistent.

    It is ``covariance`` where bodies need no change, or where making them consistent fails.

    Args:
        theta: (10,) estimated inertial parameters of the body.
        covariance: (10, 10) of the errors of ``theta`` before that.
    """
    projection = _projected_errors(theta, covariance, center=theta)
    if projection is None:
        return covariance
    turn, residual = projection
    return turn @ covariance @ turn.T + residual.T @ residual


def _projected_errors(
    theta: Array, covariance: Array, center: Array
) -> tuple[Array, Array] | None:
    """Return T (10, 10), and rows (m, 10) whose product rows^T rows is the covariance R.

    Errors e of a body become T e plus a residual of covariance R when the body is made consistent.
    None where all drawn bodies are consistent, where ``covariance`` is singular, or where one body
    cannot be made consistent: ``covariance`` is an upper bound then.

    Args:
        theta: (10,) estimated inertial parameters of the body.
        covariance: (10, 10) of their errors e.
        center: (10,) the usual body of the fit.
    """
    half = np.random.default_rng(0).standard_normal((_DRAWS // 2, 10))
    draws = np.vstack((half, -half))
    # Their sample covariance is exactly 1, so that T is exactly 1 if draws are not changed.
    draws = np.linalg.solve(np.linalg.cholesky(draws.T @ draws / _DRAWS), draws.T).T
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return None
    errors = draws @ root.T
    rows = np.linalg.inv(root)
    # The first minimiser of the previous body; None while all bodies have been consistent.
    start = None
    projected = errors.copy()
    problem = LinksProblem((np.arange(10),), center)
    for k, error in enumerate(errors):
        if spatial.is_consistent(theta + error):
            continue
        try:
            solver = ConsistentLinks(rows, rows @ (theta + error), problem, start)
            projected[k] = solver.best() - theta
            start = solver.first
        except SysidError:
            return None
    if start is None:
        return None
    turn = projected.T @ draws @ rows / _DRAWS
    return turn, (projected - errors @ turn.T) / np.sqrt(_DRAWS)

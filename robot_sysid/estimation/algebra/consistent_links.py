"""All links' parameters at once, each link a possible rigid body.

Minimises, over the ten parameters of every link and everything else that is sought,

    1/2 ||A x - b||^2 + sum_i g_i [tr(P0_i^-1 P_i) - log det P_i]

with P_i the pseudo-inertia of link i and P0_i that of a usual body: the log-det divergence of Lee,
Wensing, Park, "Geometric robot dynamic identification: a convex programming approach", IEEE
Transactions on Robotics 36(2), 2020, for a whole arm. Priors stand among the equations; g_i is far
below what data can resolve and only keeps bodies possible, unless a link is to be held near P0_i.

The problem is convex. A primal-dual method follows g down from where P0 alone decides, in the
scaling of Nesterov and Todd, in which the matrices and their duals become the same diagonal matrix
(Toh, Todd, Tutuncu, "SDPT3 - a MATLAB software package for semidefinite programming", 1999), with
Mehrotra's predictor and corrector; a step is one factorisation for all links, of rows and not of
their squares. Two changes of coordinates keep steps accurate however weak a direction is. Each link
is measured in the pseudo-inertia of its usual body, P_i = L_i K_i L_i^T with K_i = 1 + Z_i. Then
everything is turned into the singular directions of A, where the data's part of the second
derivative is diagonal.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra.identifiability import RELATIVE_CUT, visible_space
from robot_sysid.records import Array

GAMMAS, HARDLY = (0.1, 0.01, 1e-3, 1e-4), 3.0
"""Weights of usual bodies that are tried, and how many squared residuals of unit variance hardly
count: chance alone makes as many as there are parameters."""
# Eigenvalues of an impossible model's body are lifted to this share of the largest.
_FLOOR = 1e-6
# What nothing shows stays at zero: 1 would be as strong as the data's sight of a column.
_RIDGE = 1e-5
# Where the path of gamma begins; how small a step is none, in units of gamma; steps that no problem
# needs (most take 15 to 30).
_EASY, _CONVERGED, _MOST_STEPS = 100.0, 1e-6, 1000
_TO_THE_WALL = 0.95
# How far the products of primal and dual eigenvalues may lag behind their mean.
_CENTRALITY = 0.02
# Below this length a step without second-order correction is tried as well.
_SHORT = 0.5
# By which share gamma goes down after a step of full length, whatever a bold step promises.
_EAGER = 0.8
# How strongly what is not seen is held, beside what is seen.
_PIN = 1e3
# What rounding resolves of squared residuals, and of the squared length of a step.
_RESOLUTION, _SHORTEST = 1e-15, 1e-18


@dataclass(frozen=True)
class LinksProblem:
    """What is known beside the data and the priors among its equations: where the ten parameters of
    each link stand among all, and usual bodies there, zero elsewhere (p,).
    """

    links: tuple[NDArray[np.int64], ...]
    prior: Array

    @cached_property
    def bodies(self) -> tuple[tuple[Array, Array], ...]:
        """Each link's usual body, possible, theta (10,), and U (10, 10) with theta + U z."""
        found = []
        for link in self.links:
            theta = spatial.lifted_body(self.prior[link], self.prior[link], _FLOOR)
            root = np.linalg.cholesky(spatial.pseudo_inertia(theta))
            units = _components(root @ _BASIS @ root.T) @ _THETAS
            found.append((theta, units.T))
        return tuple(found)


End = tuple[float, Array, Array]
"""A weight gamma, and coordinates (k,) and roots of the duals (links, 4, 4) of the minimiser."""


class ConsistentLinks:
    """Solves A x = b, (M, p) and (M,), residuals of unit variance, for any weight of the model.

    ``first`` is where the path ended first, None before that; ``near``, that of a solved problem
    much alike, is where to begin.
    """

    def __init__(
        self, matrix: Array, right: Array, problem: LinksProblem, near: End | None = None
    ) -> None:
        self._matrix, self._right, self._problem = matrix, right, problem
        self._near = near
        self.first: End | None = None
        self._bodies = np.concatenate(problem.links)
        # All parameters are origin + unit z.
        length, self._origin = np.linalg.norm(matrix, axis=0), np.zeros(len(problem.prior))
        self._unit = np.diag(1.0 / np.where(length > 0.0, length, 1.0))
        for link, (theta, units) in zip(problem.links, problem.bodies):
            self._origin[link], self._unit[np.ix_(link, link)] = theta, units
        self._others = np.delete(np.arange(len(self._origin)), self._bodies)
        self._free, rest = self._eliminated()
        left, singular, directions = np.linalg.svd(rest[:-1, :-1])
        self._turn, self._singular, self._seen = directions.T, singular, left.T @ rest[:-1, -1]
        self._least_seen = np.min(singular) / np.max(singular, initial=_RIDGE)
        self._squared, self._unseen = float(self._seen @ self._seen), float(rest[-1, -1] ** 2)

    def _eliminated(self) -> tuple[Array, Array]:
        """Return (triangular rows of what is no body, those of bodies alone), right sides last."""
        count, scaled = len(self._others), self._matrix @ self._unit
        right = self._right - self._matrix @ self._origin
        rows = np.column_stack((scaled[:, self._others], scaled[:, self._bodies], right))
        ridge = np.pad(
            _RIDGE * np.eye(count), ((0, len(self._bodies) + 1), (0, len(rows.T) - count))
        )
        triangle = np.asarray(np.linalg.qr(np.vstack((rows, ridge)), mode="r"))
        return triangle[:count], triangle[count:, count:]

    def _all(self, z: Array) -> Array:
        """Return all parameters (p,) for coordinates of the bodies (k,)."""
        count, found = len(self._others), np.zeros(len(self._origin))
        goal = self._free[:, -1] - self._free[:, count:-1] @ z
        found[self._bodies], found[self._others] = z, np.linalg.solve(self._free[:, :count], goal)
        return self._origin + self._unit @ found

    def best(self) -> Array:
        """Return the minimiser (p,) for the largest gamma that hardly costs the data anything.

        What the data does not show stays with usual bodies then, exactly where that hardly costs
        anything, and what it does show is not pulled towards them, however much larger a tool is
        than the model's link.
        """
        firsts, solvers = [], [*self._pinned(), self]
        for each in solvers:
            ends = each.path((GAMMAS[0], GAMMAS[-1]))
            firsts.append(next(ends))
            # Nothing leaves less than what no body explains, possible or not.
            if self._left(firsts[-1]) <= self._unseen + HARDLY:
                return firsts[-1]
        allowed = self._left(next(ends)) + HARDLY
        weaker = chain.from_iterable(each.path(GAMMAS[1:]) for each in solvers)
        return next(found for found in chain(firsts, weaker) if self._left(found) <= allowed)

    def _pinned(self) -> Iterator[ConsistentLinks]:
        """Yield the same with all that the data does not show held at the usual bodies."""
        if self._least_seen > RELATIVE_CUT:
            return
        space = visible_space(self._matrix)
        rows = _PIN * space.null.T / space.scale
        matrix = np.vstack((self._matrix, rows))
        yield ConsistentLinks(matrix, np.append(self._right, rows @ self._origin), self._problem)

    def _left(self, values: Array) -> float:
        """Return the sum of squared residuals."""
        return float(np.sum((self._matrix @ values - self._right) ** 2))

    def path(self, gammas: Sequence[float]) -> Iterator[Array]:
        """Yield the minimiser (p,) for each of several gammas, largest first.

        None of them is followed below what rounding of the data's part can resolve.

        Raises:
            SysidError: the method did not converge.
        """
        end = self.first or self._near or self._beginning()
        for gamma in (max(gamma, _RESOLUTION * self._squared) for gamma in gammas):
            try:
                found = self._follow(*end, gamma)
            except SysidError:
                found = self._follow(*self._beginning(), gamma)
            self.first, end = self.first or found, found
            yield self._all(end[1])

    def _beginning(self) -> End:
        """Return where usual bodies alone decide."""
        z = np.zeros(len(self._bodies))
        return _EASY, z, np.repeat(np.sqrt(_EASY) * np.eye(4)[None], len(z) // 10, axis=0)

    def _follow(self, t: float, z: Array, duals: Array, gamma: float) -> End:
        """Return where the path is at gamma, coming from where it is at t."""
        t = max(t, gamma)
        length, least = 1.0, max(_CONVERGED * gamma, _SHORTEST * self._squared)
        for _ in range(_MOST_STEPS):
            try:
                cone = ScaledBodies(z, duals)
                unexplained = self._seen - self._singular * (self._turn.T @ z)
                newton = _Newton(cone, self._singular, unexplained, self._turn)
                bold = newton.step(gamma)
                # Where a bold step finds no room but the last one did well, t goes down all the
                # same.
                left = min((1.0 - min(1.0, newton.room(bold))) ** 2, 1.0 - _EAGER * length)
                t = max(gamma, left * t)
                step, length = newton.best(t, bold)
                z, duals = z + length * step.direction, cone.moved(length * step.dual)
            except np.linalg.LinAlgError:
                break
            if t == gamma and step.size <= least:
                return gamma, z, duals
        raise SysidError(
            "the fit of all links did not converge; check the units of the torques and of the "
            "model's inertias"
        )


class ScaledBodies:
    """The links' K at one point and their duals Z, which are to be t K^-1, both as one diagonal D.

    From coordinates z (10 links,) and roots of the duals (links, 4, 4): squared, rounding would
    hide what is least. LinAlgError where a matrix is not positive definite.
    """

    def __init__(self, z: Array, duals: Array) -> None:
        bodies = np.eye(4) + np.tensordot(z.reshape(-1, 10), _BASIS, 1)
        left, self._diagonal, _ = np.linalg.svd(_transposed(duals) @ np.linalg.cholesky(bodies))
        # G^-1 with G^-1 K G^-T = G^T Z G = D.
        self._inverse = _transposed(left / np.sqrt(self._diagonal)[:, None, :]) @ _transposed(duals)
        self._basis = self._inverse[:, None] @ _BASIS @ _transposed(self._inverse)[:, None]
        self._here = self._diagonal[:, :, None] * np.eye(4)

    def rows(self) -> Array:
        """Return (links, 10, 10) rows of each link whose squares are the barrier's curvature."""
        return _transposed(_components(self._basis))

    def aim(self, t: float) -> Array:
        """Return K and its duals (links, 4, 4) as they are to be at t, scaled."""
        return np.asarray((t / self._diagonal)[:, :, None] * np.eye(4))

    def changes(self, step: Array, t: float, correction: Array) -> tuple[Array, Array]:
        """Return what a step (10 links,) does to K and to the duals, scaled, (links, 4, 4) each."""
        primal = np.einsum("mk,mkij->mij", step.reshape(-1, 10), self._basis)
        return primal, self.aim(t) - self._here - correction - primal

    def second_order(self, primal: Array, dual: Array) -> Array:
        """Return the correction (links, 4, 4) for the product of both changes."""
        product = primal @ dual
        both = self._diagonal[:, :, None] + self._diagonal[:, None, :]
        return np.asarray((product + _transposed(product)) / both)

    def room(self, change: Array) -> float:
        """Return which part of a change leaves the matrices positive definite."""
        roots = np.sqrt(self._diagonal)
        relative = change / (roots[:, :, None] * roots[:, None, :])
        lowest = float(np.min(np.linalg.eigvalsh(relative), initial=0.0))
        return -1.0 / lowest if lowest < 0.0 else np.inf

    def centrality(self, primal: Array, dual: Array) -> float:
        """Return the least eigenvalue of a K Z over their mean after scaled changes."""
        roots = [np.linalg.cholesky(self._here + change) for change in (primal, dual)]
        products = np.linalg.svd(_transposed(roots[0]) @ roots[1], compute_uv=False) ** 2
        return float(np.min(products / np.mean(products, axis=1, keepdims=True)))

    def moved(self, change: Array) -> Array:
        """Return roots of the duals (links, 4, 4) after a scaled change."""
        return np.asarray(_transposed(self._inverse) @ np.linalg.cholesky(self._here + change))


@dataclass(frozen=True)
class _Step:
    """A change of the coordinates (k,), of K and of its duals, and its squared length."""

    direction: Array
    primal: Array
    dual: Array
    size: float


class _Newton:
    """Newton's equations at one point, as least squares: squared, rounding would hide what is weak.

    The data has singular values (k,), whose axes are the columns of ``turn`` (k, k); (k,) is left
    unexplained there of what they see.
    """

    def __init__(
        self, cone: ScaledBodies, singular: Array, unexplained: Array, turn: Array
    ) -> None:
        from scipy.linalg.lapack import dgeqrf, dormqr, dtrtri

        self._cone, self._unexplained, self._turn = cone, unexplained, turn
        curvature = cone.rows() @ turn.reshape(-1, 10, len(turn))
        # Q in the few numbers that it is made of: written out, it takes longer than all else.
        packed = dgeqrf(np.vstack((np.diag(singular), curvature.reshape(turn.shape))))[:2]
        self._turned = partial(dormqr, "L", "T", *packed)
        self._inverse, failed = dtrtri(np.triu(packed[0][: len(turn)]))
        if failed:
            raise np.linalg.LinAlgError("singular")

    def step(self, t: float, bold: _Step | None = None) -> _Step:
        """Return the step towards t, corrected for what a bolder one showed of second order."""
        cone, goal = self._cone, self._cone.aim(t)
        correction = 0.0 * goal if bold is None else cone.second_order(bold.primal, bold.dual)
        slope = t * (self._turn.T @ np.tile(_TRACES, len(goal)))
        goal = np.append(self._unexplained, _components(goal - correction))
        turned = self._turned(goal[:, None], len(goal))[0][: len(slope), 0]
        scaled = turned - self._inverse.T @ slope
        direction = self._turn @ (self._inverse @ scaled)
        return _Step(direction, *cone.changes(direction, t, correction), float(scaled @ scaled))

    def room(self, step: _Step) -> float:
        """Return which part of a step stays inside."""
        return min(self._cone.room(step.primal), self._cone.room(step.dual))

    def best(self, t: float, bold: _Step) -> tuple[_Step, float]:
        """Return (step towards t, its length), corrected for second order where that goes far."""
        step = self.step(t, bold)
        length = self.central_length(step)
        if length >= _SHORT:
            return step, length
        plain = self.step(t)
        other = self.central_length(plain)
        return (plain, other) if other > length else (step, length)

    def central_length(self, step: _Step) -> float:
        """Return a step length that leaves no eigenvalue of K Z far behind the others."""
        length = min(1.0, _TO_THE_WALL * self.room(step))
        for _ in range(_MOST_STEPS):
            if self._cone.centrality(length * step.primal, length * step.dual) >= _CENTRALITY:
                break
            length *= 0.7
        return length


def _transposed(matrices: NDArray[Any]) -> NDArray[Any]:
    return np.swapaxes(matrices, -1, -2)


def _components(matrices: Array) -> Array:
    """Return symmetric matrices (..., 4, 4) in the basis, (..., 10)."""
    return np.tensordot(matrices, _BASIS, ((-2, -1), (1, 2)))


def _orthonormal_basis() -> Array:
    """Return (10, 4, 4) symmetric matrices, orthonormal in tr(A B)."""
    basis = []
    for i in range(4):
        for j in range(i, 4):
            matrix = np.zeros((4, 4))
            matrix[i, j] = matrix[j, i] = 1.0 if i == j else np.sqrt(0.5)
            basis.append(matrix)
    return np.array(basis)


_BASIS = _orthonormal_basis()
_THETAS = np.array([spatial.theta_from_pseudo_inertia(matrix) for matrix in _BASIS])
_TRACES = np.trace(_BASIS, axis1=1, axis2=2)

"""All links' parameters at once, each link a possible rigid body.

Minimises, over the ten parameters of every link and everything else that is sought,

    1/2 ||A x - b||^2 + sum_i g_i [tr(P0_i^-1 P_i) - log det P_i]

with P_i the pseudo-inertia of link i and P0_i that of a usual body: the log-det divergence of Lee,
Wensing, Park, "Geometric robot dynamic identification: a convex programming approach", IEEE
Transactions on Robotics 36(2), 2020, for a whole arm. Priors stand among the equations; g_i is far
below what data can resolve and only keeps bodies possible, unless a link is to be held near P0_i.

The problem is convex. A primal-dual method follows g down from where P0 alone decides, in
the scaling of Nesterov and Todd with Mehrotra's predictor and corrector; a step is one
factorisation for all links. Two changes of coordinates keep steps accurate however weak a direction
is. Each link is measured in its usual body's own pseudo-inertia, P_i = L_i (1 + Z_i) L_i^T with
P0_i = L_i L_i^T. Then everything is turned into the singular directions of A, where the data's part
of the second derivative is diagonal.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimation.cones import Cone, ScaledCone
from robot_sysid.estimation.consistency import lifted_body
from robot_sysid.records import Array

GAMMAS, HARDLY = (0.1, 0.01, 1e-3, 1e-4), 3.0
"""Weights of usual bodies that are tried, and how many squared residuals of unit variance hardly
count: chance alone makes as many as there are parameters."""
# Eigenvalues of an impossible model's body are lifted to this share of the largest.
_FLOOR = 1e-6
# What nothing shows stays at zero: 1 would be as strong as the data's sight of a column.
_RIDGE = 1e-10
# Where the path of gamma begins, and how small a step is none, in units of gamma.
_EASY, _CONVERGED, _MOST_STEPS = 1e4, 1e-6, 1000
_TO_THE_WALL = 0.95
# How far the products of primal and dual eigenvalues may lag behind their mean.
_CENTRALITY = 0.02
# Below this length a step without second-order correction is tried as well.
_SHORT = 0.5
# By which share gamma goes down after a step of full length, whatever a bold step promises.
_EAGER = 0.8
# What rounding resolves of squared residuals.
_RESOLUTION = 1e-13


@dataclass(frozen=True)
class LinksProblem:
    """What is known beside the data and the priors among its equations.

    Attributes:
        links: per link, where its ten parameters stand among all.
        prior: (p,) usual bodies at those places, zero elsewhere.
        weights: (links,) least weight of each link's divergence from its usual body.
    """

    links: tuple[NDArray[np.int64], ...]
    prior: Array
    weights: Array

    @cached_property
    def bodies(self) -> tuple[tuple[Array, Array], ...]:
        """Each usual body made possible where it is not (10,), and the units of Z there."""
        thetas = [self.prior[link] for link in self.links]
        return tuple(_body(lifted_body(theta, theta, _FLOOR)) for theta in thetas)


class ConsistentLinks:
    """Solves one set of data for any weight of the model.

    Args:
        matrix: (M, p) A, residuals of unit variance.
        right: (M,) b.
        problem: what is known beside the data.
    """

    def __init__(self, matrix: Array, right: Array, problem: LinksProblem) -> None:
        self._matrix, self._right = matrix, right
        self._origin = possible_links(problem)
        self._unit = _units(matrix, problem)
        scaled = matrix @ self._unit
        missing = max(scaled.shape[1] - len(scaled), 0)
        padded = np.pad(scaled, ((0, missing), (0, 0)))
        left, self._singular, directions = np.linalg.svd(padded, full_matrices=False)
        self._turn = directions.T
        self._seen = left.T @ np.append(right - matrix @ self._origin, np.zeros(missing))
        self._ridge = np.full(len(self._origin), _RIDGE)
        self._ridge[np.concatenate(problem.links)] = 0.0
        self._start = np.zeros(len(self._origin))
        self._cones = (_cone(problem),)

    def best(self) -> Array:
        """Return the minimiser (p,) for the largest gamma that hardly costs the data anything.

        What the data does not show stays near usual bodies then, and what it does show is not
        pulled towards them, however much larger a tool is than the model's link.
        """
        found = list(self.path(GAMMAS))
        costs = [float(np.sum((self._matrix @ each - self._right) ** 2)) for each in found]
        return next(x for x, cost in zip(found, costs) if cost <= costs[-1] + HARDLY)

    def path(self, gammas: Sequence[float]) -> Iterator[Array]:
        """Yield the minimiser (p,) for each of several gammas, largest first.

        None of them is followed below what rounding of the data's part can resolve.

        Raises:
            SysidError: the method did not converge.
        """
        least = _RESOLUTION * float(self._seen @ self._seen)
        gammas = [max(gamma, least) for gamma in gammas]
        t, z = max(_EASY, *gammas, 0.0), self._start
        duals = [cone.duals(z, t) for cone in self._cones]
        for gamma in gammas:
            z, duals = self._follow(z, duals, t, gamma)
            t = gamma
            yield self._origin + self._unit @ z

    def _follow(
        self, z: Array, duals: list[Array], t: float, gamma: float
    ) -> tuple[Array, list[Array]]:
        """Return coordinates and duals at gamma, coming from those at t."""
        length = 1.0
        for _ in range(_MOST_STEPS):
            try:
                cones = [cone.scaled(z, dual) for cone, dual in zip(self._cones, duals)]
                newton = _Newton(cones, *self._derivatives(z), self._turn)
            except np.linalg.LinAlgError:
                break
            bold = newton.step(gamma)
            # Where a bold step finds no room but the last one did well, t goes down all the same.
            left = min((1.0 - min(1.0, newton.room(bold))) ** 2, 1.0 - _EAGER * length)
            t = max(gamma, left * t)
            step, length = newton.best(t, bold)
            z = z + length * step.direction
            duals = [c.moved(length * dual) for c, dual in zip(cones, step.duals)]
            if t == gamma and step.size <= _CONVERGED * gamma:
                return z, duals
        raise SysidError(
            "the fit of all links did not converge; check the units of the torques and of the "
            "model's inertias"
        )

    def _derivatives(self, z: Array) -> tuple[Array, Array]:
        """Return gradient (p,) and second derivative (p,) of the data's part, in turned axes."""
        misfit = self._singular * (self._turn.T @ z) - self._seen
        gradient = self._singular * misfit + self._turn.T @ (self._ridge * z)
        return gradient, self._singular**2


@dataclass(frozen=True)
class _Step:
    """A change of the coordinates (p,) and of each cone's K and duals, and its squared length."""

    direction: Array
    primals: list[Array]
    duals: list[Array]
    size: float


class _Newton:
    """Newton's equations at one point."""

    def __init__(
        self, cones: list[ScaledCone], gradient: Array, diagonal: Array, turn: Array
    ) -> None:
        self._cones, self._gradient, self._turn = cones, gradient, turn
        curvature = np.full(turn.shape[0], _RIDGE) * np.eye(turn.shape[0])
        for cone in cones:
            cone.add_curvature(curvature)
        hessian = turn.T @ curvature @ turn
        hessian[np.diag_indices_from(hessian)] += diagonal
        self._scale = 1.0 / np.sqrt(np.diag(hessian))
        self._inverse = np.linalg.inv(hessian * self._scale * self._scale[:, None])

    def step(self, t: float, bold: _Step | None = None) -> _Step:
        """Return the step towards t, corrected for what a bolder one showed of second order."""
        if bold is None:
            corrections = [np.zeros_like(cone.inverse) for cone in self._cones]
        else:
            pairs = zip(self._cones, bold.primals, bold.duals)
            corrections = [cone.second_order(*changes) for cone, *changes in pairs]
        slope = np.zeros(len(self._gradient))
        for cone, correction in zip(self._cones, corrections):
            cone.add_slope(slope, t, correction)
        gradient = self._scale * (self._gradient + self._turn.T @ slope)
        scaled = -self._inverse @ gradient
        direction = self._turn @ (self._scale * scaled)
        both = [cone.changes(direction, t, c) for cone, c in zip(self._cones, corrections)]
        primals, duals = [p for p, _ in both], [d for _, d in both]
        return _Step(direction, primals, duals, -float(scaled @ gradient))

    def room(self, step: _Step) -> float:
        """Return which part of a step stays inside all cones."""
        changes = zip(self._cones, step.primals, step.duals)
        return min(min(cone.room(p), cone.room(d)) for cone, p, d in changes)

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
            changes = zip(self._cones, step.primals, step.duals)
            if all(c.centrality(length * p, length * d) >= _CENTRALITY for c, p, d in changes):
                break
            length *= 0.7
        return length


def _cone(problem: LinksProblem) -> Cone:
    """Return the cone of the links: 1 + Z_i, pulled to the usual body by w(t) tr Z_i."""
    count = len(problem.links)
    basis = np.repeat(_BASIS[None], count, axis=0)
    constant = np.repeat(np.eye(4)[None], count, axis=0)
    linear = np.einsum("mkii->mk", basis)
    return Cone(np.array(problem.links), constant, basis, linear, problem.weights)


def possible_links(problem: LinksProblem) -> Array:
    """Return (p,) the usual bodies, made possible where they are not, and nothing else."""
    origin = np.zeros(len(problem.prior))
    for link, (theta, _) in zip(problem.links, problem.bodies):
        origin[link] = theta
    return origin


def _body(theta: Array) -> tuple[Array, Array]:
    """Return a possible link (10,) and (10, 10) U with theta + U z of its coordinates z."""
    root = np.linalg.cholesky(spatial.pseudo_inertia(theta))
    units = np.einsum("kij,bij->kb", root @ _BASIS @ root.T, _BASIS) @ _THETAS
    return theta, units.T


def _units(matrix: Array, problem: LinksProblem) -> Array:
    """Return (p, p) U with x = origin + U z."""
    length = np.linalg.norm(matrix, axis=0)
    unit = np.diag(1.0 / np.where(length > 0.0, length, 1.0))
    for link, (_, units) in zip(problem.links, problem.bodies):
        unit[np.ix_(link, link)] = units
    return unit


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

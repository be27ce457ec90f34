"""Least squares over positive definite matrices: a primal-dual log-det barrier Newton in numpy.

Minimises ||S w - d||^2 + l^T w - mu log det K(w) with S diagonal and K(w) = K0 + sum_k w_k K_k
while mu goes down to a target. A term tie tr K(w) makes K = 1 a good start and is loosened on the
way. With l_k = mu tr K_k the last two terms are a log-det divergence from the identity: a prior.

The dual matrix Z stands for mu K^-1. Steps use the symmetric scaling of Nesterov and Todd and
Mehrotra's predictor and corrector (Toh, Todd, Tutuncu, "SDPT3 - a MATLAB software package for
semidefinite programming", 1999), which stay fast where the optimum lies on the boundary. Each step
is solved as a least-squares problem, never through the squared Hessian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import SysidError
from robot_sysid.records import Array

# A step counts as none when its squared length is below this share of mu. Where rounding keeps
# steps longer than that, ten of them at the target with less than half of mu are taken as the end.
_CONVERGED, _PATIENCE, _ROUNDING = 1e-8, 10, 0.5
# At the end: mu this close to its target, and the tie this small compared with it.
_NEAR, _LOOSE = 1.2, 1e-6
# Share of the way to the wall a step may go, and the least eigenvalue of K Z over their mean.
_TO_THE_WALL, _CENTRALITY = 0.95, 0.02
# mu stays this far ahead of the tie: with less there is no room to loosen it.
_AHEAD = 3.0
# Below this length a step without second-order correction is tried as well.
_SHORT = 0.5
_MAX_STEPS = 100


@dataclass(frozen=True)
class MatrixProblem:
    """The data of the problem; the K_k are linearly independent.

    Attributes:
        singular: (k,) diagonal of S; zeros need an l that keeps K bounded.
        right: (k,) d.
        linear: (k,) l.
        constant: (s, s) K0.
        basis: (k, s, s) symmetric K_k.
    """

    singular: Array
    right: Array
    linear: Array
    constant: Array
    basis: Array

    def matrix(self, w: Array) -> Array:
        """Return K(w) (s, s)."""
        return self.constant + np.tensordot(w, self.basis, axes=1)

    def misfit(self, w: Array) -> float:
        """Return ||S w - d||^2."""
        return float(np.sum((self.singular * w - self.right) ** 2))

    def slope(self, w: Array) -> Array:
        """Return the gradient (k,) of ||S w - d||^2 + l^T w."""
        return 2.0 * self.singular * (self.singular * w - self.right) + self.linear

    def balance(self, w: Array) -> Array:
        """Return the least symmetric Z (s, s) with tr(K_k Z) = slope_k."""
        flat = self.basis.reshape(len(w), -1)
        dual = np.linalg.lstsq(flat, self.slope(w), rcond=None)[0].reshape(self.constant.shape)
        return 0.5 * (dual + dual.T)


def minimise(
    problem: MatrixProblem, start: NDArray[Any], target: Callable[[Array], float]
) -> Array:
    """Follow the minimiser down to mu = target(w).

    Args:
        problem: what to minimise.
        start: (k,) with K(start) positive definite, best close to the identity.
        target: the mu > 0 to end at, given the current w.

    Raises:
        SysidError: if it does not converge.
    """
    try:
        return _follow(problem, start, target)
    except np.linalg.LinAlgError as error:
        raise SysidError(
            "the physically consistent fit did not converge; check the units of the torques and "
            "of the model's inertias, or use --consistency off or a larger --prior-weight"
        ) from error


def _follow(problem: MatrixProblem, w: Array, target: Callable[[Array], float]) -> Array:
    dual = problem.balance(w)
    tie = max(2.0 * float(np.max(np.abs(np.linalg.eigvalsh(dual)))), target(w))
    # The tie puts the dual matrix well inside the cone.
    dual_root = np.linalg.cholesky(dual + tie * np.eye(len(dual)))
    arrivals = 0
    for _ in range(_MAX_STEPS):
        scaling = _Scaling(problem, w, dual_root)
        goal = target(w)
        step = _predict_and_correct(scaling, goal, tie)
        effect = scaling.effect(step.direction) / goal
        w = w + step.length * step.direction
        arrivals += scaling.mu <= _NEAR * goal and tie <= _LOOSE * goal
        if arrivals and effect <= (_CONVERGED if arrivals < _PATIENCE else _ROUNDING):
            return w
        dual_root = scaling.moved_dual_root(step.length * step.dual)
        tie = tie + step.length * (step.tie - tie)
    raise np.linalg.LinAlgError(f"not at the minimum after {_MAX_STEPS} steps")


class _Scaling:
    """The point (K, Z) in coordinates in which both are the same diagonal matrix."""

    def __init__(self, problem: MatrixProblem, w: Array, dual_root: NDArray[Any]) -> None:
        primal_root = np.linalg.cholesky(problem.matrix(w))
        left, self.diagonal, right = np.linalg.svd(dual_root.T @ primal_root)
        roots = np.sqrt(self.diagonal)
        outer = primal_root @ right.T / roots
        self._inverse = (left / roots).T @ dual_root.T
        self._basis = self._inverse @ problem.basis @ self._inverse.T
        self._trace = outer.T @ outer
        self._linear = problem.linear
        root = np.sqrt(2.0)
        curved = np.diag(root * problem.singular)
        self._matrix = np.vstack((curved, self._basis.reshape(len(w), -1).T))
        self._data = root * (problem.right - problem.singular * w)
        self._orthogonal, self._triangle = np.linalg.qr(self._matrix)

    @property
    def mu(self) -> float:
        """Mean eigenvalue of K Z."""
        return float(np.mean(self.diagonal**2))

    def solve(self, mu: float, tie: float, second_order: Array) -> tuple[Array, Array, Array]:
        """Return (dw, scaled dK, scaled dZ) that aim at K Z = mu and at this tie."""
        correction = 2.0 * second_order / (self.diagonal[:, None] + self.diagonal)
        pull = np.diag(mu / self.diagonal) - tie * self._trace - correction
        step = self._least_squares(np.concatenate((self._data, pull.ravel())))
        primal = np.tensordot(step, self._basis, axes=1)
        centre = np.diag(mu / self.diagonal - self.diagonal)
        return step, primal, centre - correction - primal

    def _least_squares(self, right: Array) -> Array:
        """Return argmin 0.5 ||matrix dw - right||^2 + l^T dw."""
        pulled = self._orthogonal.T @ right - np.linalg.solve(self._triangle.T, self._linear)
        return np.linalg.solve(self._triangle, pulled)

    def room(self, change: Array) -> float:
        """Return the largest factor <= 1 that keeps diagonal + factor * change positive."""
        roots = np.sqrt(self.diagonal)
        lowest = float(np.linalg.eigvalsh(change / np.outer(roots, roots))[0])
        return min(1.0, _TO_THE_WALL / -lowest) if lowest < 0.0 else 1.0

    def moved_dual_root(self, change: Array) -> Array:
        """Return a root of Z after a change given in scaled form."""
        return self._inverse.T @ np.linalg.cholesky(np.diag(self.diagonal) + change)

    def effect(self, step: Array) -> float:
        """Return the squared length of a step in the metric of the objective."""
        return float(np.sum((self._matrix @ step) ** 2))


@dataclass(frozen=True)
class _Step:
    direction: Array
    dual: Array
    tie: float
    length: float


def _predict_and_correct(scaling: _Scaling, goal: float, tie: float) -> _Step:
    """Return the next step; how far a bold one would get decides which mu and tie it aims at."""
    here = np.diag(scaling.diagonal)
    _, primal, dual = scaling.solve(goal, 0.0, np.zeros_like(here))
    bold = min(scaling.room(primal), scaling.room(dual))
    reached = float(np.sum((here + bold * primal) * (here + bold * dual))) / len(here)
    tie = (1.0 - bold) ** 2 * tie
    share = min(max(reached, 0.0) / scaling.mu, 1.0)
    mu = max(scaling.mu * share**3, _AHEAD * tie, goal)
    product = primal @ dual
    best = _aim(scaling, mu, tie, 0.5 * (product + product.T))
    if best.length < _SHORT:
        plain = _aim(scaling, mu, tie, np.zeros_like(here))
        best = plain if plain.length > best.length else best
    return best


def _aim(scaling: _Scaling, mu: float, tie: float, second_order: Array) -> _Step:
    direction, primal, dual = scaling.solve(mu, tie, second_order)
    return _Step(direction, dual, tie, _central_length(scaling, primal, dual))


def _central_length(scaling: _Scaling, primal: Array, dual: Array) -> float:
    """Return a step length that leaves no eigenvalue of K Z far behind the others."""
    here = np.diag(scaling.diagonal)
    length = min(scaling.room(primal), scaling.room(dual))
    for _ in range(_MAX_STEPS):
        roots = [np.linalg.cholesky(here + length * change) for change in (dual, primal)]
        products = np.linalg.svd(roots[0].T @ roots[1], compute_uv=False) ** 2
        if products[-1] >= _CENTRALITY * np.mean(products):
            break
        length *= 0.7
    return length

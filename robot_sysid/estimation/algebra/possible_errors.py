"""Errors of an estimate whose body is made physically consistent.

An inconsistent estimate theta + e, e ~ N(0, C), is replaced by the best consistent body
(``algebra.consistent_links``). Drawn errors show what remains of e: T e by linear regression, and a
residual of covariance R. The other parameters follow the body as they do in C: with G, their
regression on the body, and E, which selects the body, errors e of all become (1 + G (T - 1) E) e.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra.consistent_links import (
    ConsistentLinks,
    LinksProblem,
)
from robot_sysid.estimation.algebra.uncertainty import Uncertainty
from robot_sysid.records import Array

BODIES = "possible bodies"
"""Name of the residual's cause in results."""
_DRAWS = 60
"""Number of drawn errors, half of them the negatives of the others; for a UR5e's last link, whose
plain estimate is hardly ever consistent, 60 and 1000 give the same error of the mass to 7 %."""


def once_possible(
    uncertainty: Uncertainty,
    causes: Mapping[str, Array],
    indices: NDArray[np.int64],
    theta: Array,
    center: Array,
) -> tuple[Uncertainty, dict[str, Array]]:
    """Return the errors, all and by cause, of an estimate whose body is made consistent.

    Args:
        causes: cause to rows (m, k) whose squares are the covariance due to it.
        indices: (10,) of the body among the k estimated parameters.
        theta: (10,) of the body.
        center: (10,) a plausible body, at the centre of the barrier.
    """
    of_body = uncertainty.covariance[np.ix_(indices, indices)]
    is_known = np.all(np.isfinite(uncertainty.standard_errors[indices]))
    projection = _projected_errors(theta, of_body, center) if is_known else None
    if projection is None:
        return uncertainty, dict(causes)
    turn, residual = projection
    along = np.linalg.solve(of_body, uncertainty.covariance[indices])
    change = (turn - np.eye(10)).T @ along

    def project(rows: Array) -> Array:
        return rows + rows[:, indices] @ change

    by_cause = {cause: project(rows) for cause, rows in causes.items()}
    by_cause[BODIES] = residual @ along
    covariance = (
        project(project(uncertainty.covariance).T)
        + by_cause[BODIES].T @ by_cause[BODIES]
    )
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    hidden = np.isinf(uncertainty.standard_errors)
    return replace(
        uncertainty,
        covariance=covariance,
        noise=project(project(uncertainty.noise).T),
        standard_errors=np.where(hidden, np.inf, errors),
    ), by_cause


def possible_covariance(theta: Array, covariance: Array) -> Array:
    """Return the covariance (10, 10) of a body (10,) that is made consistent."""
    projection = _projected_errors(theta, covariance, theta)
    if projection is None:
        return covariance
    turn, residual = projection
    return turn @ covariance @ turn.T + residual.T @ residual


def _projected_errors(
    theta: Array, covariance: Array, center: Array
) -> tuple[Array, Array] | None:
    """Return T (10, 10) of a body, and rows (m, 10) whose squares are R.

    None where all drawn bodies are consistent, or where one cannot be made so: the plain errors are
    larger than those of consistent bodies.
    """
    half = np.random.default_rng(0).standard_normal((_DRAWS // 2, 10))
    draws = np.vstack((half, -half))
    # Of unit covariance exactly, so that consistent draws change nothing.
    draws = np.linalg.solve(np.linalg.cholesky(draws.T @ draws / _DRAWS), draws.T).T
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return None
    errors = draws @ root.T
    rows = np.linalg.inv(root)
    start = None
    projected = errors.copy()
    problem = LinksProblem((np.arange(10),), center)
    for k in [
        k for k, error in enumerate(errors) if not spatial.is_consistent(theta + error)
    ]:
        try:
            solver = ConsistentLinks(rows, rows @ (theta + errors[k]), problem, start)
            projected[k] = solver.best() - theta
            start = solver.first
        except SysidError:
            return None
    if start is None:
        return None
    turn = projected.T @ draws @ rows / _DRAWS
    return turn, (projected - errors @ turn.T) / np.sqrt(_DRAWS)

"""What errors become once a body has to be possible.

Of a plain estimate theta + e, e ~ N(0, C), that no body can have, the best possible one is taken
(``algebra.consistent_links``). Drawn errors tell what is left of each: T e by linear regression,
and a rest of covariance R. What else is sought follows the body as it does in C: with G, its
regression on the body, and E, which picks the body, errors e of all become (1 + G (T - 1) E) e.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra.consistent_links import ConsistentLinks, LinksProblem
from robot_sysid.estimation.algebra.uncertainty import Uncertainty
from robot_sysid.records import Array

BODIES = "possible bodies"
"""What the rest is called in results."""
_DRAWS = 60
"""Errors that are drawn, half of them the others' opposites; of a UR5e's last link, which is hardly
ever possible, 60 and 1000 tell the same mass to 7 %."""


def once_possible(
    whole: Uncertainty,
    causes: Mapping[str, Array],
    places: NDArray[np.int64],
    theta: Array,
    usual: Array,
) -> tuple[Uncertainty, dict[str, Array]]:
    """Return errors, whole and by cause, of estimates whose body is a possible one.

    Args:
        causes: cause to rows (m, k) whose squares are the covariance that it explains.
        places: (10,) of the body among the k that are sought.
        theta: (10,) of the body.
        usual: (10,) what such bodies usually are.
    """
    own = whole.covariance[np.ix_(places, places)]
    left = _left(theta, own, usual) if np.all(np.isfinite(whole.standard_errors[places])) else None
    if left is None:
        return whole, dict(causes)
    turn, rest = left
    along = np.linalg.solve(own, whole.covariance[places])
    change = (turn - np.eye(10)).T @ along

    def changed(rows: Array) -> Array:
        return rows + rows[:, places] @ change

    found = {cause: changed(rows) for cause, rows in causes.items()}
    found[BODIES] = rest @ along
    covariance = changed(changed(whole.covariance).T) + found[BODIES].T @ found[BODIES]
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    hidden = np.isinf(whole.standard_errors)
    return replace(
        whole,
        covariance=covariance,
        noise=changed(changed(whole.noise).T),
        standard_errors=np.where(hidden, np.inf, errors),
    ), found


def possible_covariance(theta: Array, covariance: Array) -> Array:
    """Return what becomes of errors (10, 10) of a body (10,) once it has to be possible."""
    left = _left(theta, covariance, theta)
    return covariance if left is None else left[0] @ covariance @ left[0].T + left[1].T @ left[1]


def _left(theta: Array, covariance: Array, usual: Array) -> tuple[Array, Array] | None:
    """Return T (10, 10) of a body, and rows (m, 10) whose squares are R; None where all that is
    drawn is possible, or cannot be made so: plain errors are larger.
    """
    half = np.random.default_rng(0).standard_normal((_DRAWS // 2, 10))
    draws = np.vstack((half, -half))
    # Of unit covariance exactly: where everything is possible, nothing changes.
    draws = np.linalg.solve(np.linalg.cholesky(draws.T @ draws / _DRAWS), draws.T).T
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return None
    off, rows, near = draws @ root.T, np.linalg.inv(root), None
    left, problem = off.copy(), LinksProblem((np.arange(10),), usual)
    for k in [k for k, each in enumerate(off) if not spatial.is_consistent(theta + each)]:
        try:
            solver = ConsistentLinks(rows, rows @ (theta + off[k]), problem, near)
            left[k], near = solver.best() - theta, solver.first
        except SysidError:
            return None
    if near is None:
        return None
    turn = left.T @ draws @ rows / _DRAWS
    return turn, (left - off @ turn.T) / np.sqrt(_DRAWS)

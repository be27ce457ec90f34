"""Payload and link as possible rigid bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.consistency import consistent_least_squares, lifted_body
from robot_sysid.identify.payload.equations import PAYLOAD_NAMES
from robot_sysid.identify.payload.joint_fit import JointFit
from robot_sysid.records import Array

_ROUNDS = 4
_ROUND = 1e-3
LINK = tuple(range(10))
"""Where the terminal link's parameters stand."""
ALUMINIUM = 2700.0
"""Density [kg/m^3]."""


def with_ball(fit: JointFit) -> JointFit:
    """Return the fit with the payload's inertia that of a ball of aluminium of its mass.

    At rest nothing shows the inertia; a small body there is as good a guess as any.
    """
    places = fit.equations.places(PAYLOAD_NAMES)
    mass, com, _ = spatial.com_from_theta(fit.values[places])
    radius = (3.0 * mass / (4.0 * np.pi * ALUMINIUM)) ** (1.0 / 3.0)
    values = fit.values.copy()
    values[places] = spatial.theta_from_com(mass, com, 0.4 * mass * radius**2 * np.eye(3))
    return replace(fit, values=values)


def possible_values(fit: JointFit) -> Array:
    """Return the best values (p,) with which payload and link are possible bodies.

    The two are constrained in turns, each with all other parameters free; the problem is convex
    and the constraints are apart, so that this leads to the best of both. A link that the model
    and the data leave impossible together stays as it is.
    """
    payload = tuple(fit.equations.places(PAYLOAD_NAMES))
    values = fit.values
    if _is_possible(values, payload) and _is_possible(values, LINK):
        return values
    matrix, right = fit.weighted.whitened()
    for _ in range(_ROUNDS):
        values = _constrained(matrix, right, values, payload, LINK)
        if _is_possible(values, LINK):
            return values
        values = _constrained(matrix, right, values, LINK, payload)
    return values


def _constrained(
    matrix: Array, right: Array, values: Array, body: tuple[int, ...], fixed: tuple[int, ...]
) -> Array:
    """Return the values with one body possible, another one fixed, and all else at its optimum.

    The other body is fixed only where it is possible already.
    """
    held = list(fixed) if _is_possible(values, fixed) else []
    rest = [k for k in range(len(values)) if k not in (*body, *held)]
    order = [*body, *rest]
    start = values.copy()
    start[list(body)] = lifted_body(values[list(body)], values[list(body)], _ROUND)
    known = matrix[:, held] @ values[held]
    found = values.copy()
    found[order] = consistent_least_squares(matrix[:, order], right - known, start[order])
    return found


def _is_possible(values: Array, body: tuple[int, ...]) -> bool:
    return spatial.is_consistent(values[list(body)])

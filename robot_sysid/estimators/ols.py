"""Ordinary least squares for the deviation from the prior."""

from __future__ import annotations

from robot_sysid.identifiability import visible_space
from robot_sysid.records import Array, SquareRootInformation


def least_squares(
    information: SquareRootInformation, prior: Array, weights: Array | None = None
) -> Array:
    """Return x = prior + argmin_d ||A d - (b - A prior)||, of minimum norm in scaled columns.

    Whatever A cannot see keeps the prior's value, because d has no part there.

    Args:
        information: the data, A and b.
        prior: (p,) values to stay at where the data is blind.
        weights: (joints,) weight of each joint's equations [1/(N m)]; None weighs all alike.
    """
    matrix, right = information.stacked(weights)
    return prior + visible_space(matrix).solve(right - matrix @ prior)

"""Keep chosen parameters at or above zero, whatever solver does the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from robot_sysid.records import Array

Solve = Callable[[Array, Array, Array], Array]
"""(A (M, p), b (M,), prior (p,)) -> x (p,); must leave a zero column at its prior."""


def solve_nonnegative(
    solve: Solve, matrix: Array, right: Array, prior: Array, chosen: Sequence[int]
) -> Array:
    """Return the solution with x[chosen] >= 0, by an active set as in non-negative least squares.

    Parameters that come out negative are held at zero; one that would rather be positive is let go
    again (Lawson, Hanson, "Solving Least Squares Problems", 1974, ch. 23).

    Args:
        solve: solver without bounds.
        matrix, right: A (M, p) and b (M,).
        prior: (p,) values to keep where the data is blind.
        chosen: indices of the bounded parameters.
    """
    index = np.asarray(chosen, dtype=np.int64)
    held = np.zeros(len(prior), dtype=bool)
    values = solve(matrix, right, prior)
    for _ in range(3 * len(index)):
        negative = index[values[index] < 0.0]
        wanting = _wanting_up(matrix, right, values, held)
        if len(negative) == 0 and wanting is None:
            break
        held[negative] = True
        if len(negative) == 0:
            held[wanting] = False
        values = solve(np.where(held, 0.0, matrix), right, np.where(held, 0.0, prior))
    return np.where(held, 0.0, values)


def _wanting_up(matrix: Array, right: Array, values: Array, held: Array) -> int | None:
    """Return the held parameter that would lower the misfit most by growing, if there is one."""
    residual = right - matrix @ values
    pull = np.where(held, matrix.T @ residual, 0.0)
    length = np.maximum(np.linalg.norm(matrix, axis=0), np.finfo(float).tiny)
    gain = pull / length
    best = int(np.argmax(gain))
    return best if gain[best] > 1e-9 * (1.0 + np.linalg.norm(residual)) else None

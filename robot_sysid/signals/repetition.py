"""Motion that repeats: what a model leaves unexplained comes again with it, and does not average.

Noise is new each time an arm passes a state (q, qd); friction that follows another law, or what a
filter leaves of a reversal, is the same each time. With e the residuals and N(p) the rows that pass
the state of row p at another time, the variance of a sum of the equations is

    D = 1 + sum_p e_p sum_{s in N(p)} e_s / sum_p e_p^2

times that of independent residuals: 1 where only noise is left, and the number of repetitions where
every one leaves the same. A row passes a state where it is nearer than the rows of that state's own
passage are to each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array, Motion, SampleSource, SquareRootInformation

PROBES = 2000
"""So many rows, spread evenly, stand for all."""
NEAR = 0.7
"""Of a row's step: rows of another passage are found about once each."""
APART = 20
"""Rows that are nearer in time belong to the same passage."""
_LEAST_SCALE = 0.01
_CHUNK = 100


@dataclass(frozen=True)
class Visits:
    """Pairs of rows that pass the same state at different times.

    Attributes:
        probes: (M,) the one row.
        others: (M,) the other.
        repeats: how often a state is passed again, on average.
    """

    probes: NDArray[np.int64]
    others: NDArray[np.int64]
    repeats: float

    def inflation(
        self, information: SquareRootInformation, samples: SampleSource, values: Array
    ) -> Array:
        """Return D (joints,) of residuals; 1 where the motion does not repeat as a whole.

        Args:
            information: what the samples are equations of.
            samples: the equations, row by row as in the motion.
            values: (p,) the estimate.
        """
        found = np.ones(len(information.joints))
        if self.repeats < 1.0:
            return found
        each = np.unique(self.probes)
        for index, rows, tau in samples:
            residual = np.nan_to_num(tau - rows @ values[information.joints[index].columns])
            squared = float(np.sum(residual[each] ** 2))
            again = float(residual[self.probes] @ residual[self.others])
            found[index] = max(1.0, 1.0 + again / squared) if squared > 0.0 else 1.0
        return found


def visits(motions: Sequence[Motion]) -> Visits:
    """Return which rows of some logs (K, n), taken together, pass the same states."""
    q, qd = (np.concatenate([getattr(m, name) for m in motions]) for name in ("q", "qd"))
    off = q - np.mean(q, axis=0)
    state = np.hstack([off / scales(off), qd / scales(qd)])
    radius = NEAR * np.concatenate(
        [_steps(part) for part in np.split(state, np.cumsum([len(m.time) for m in motions])[:-1])]
    )
    chosen = np.unique(np.linspace(0, len(state) - 1, PROBES).astype(np.int64))
    squares, rows = np.sum(state**2, axis=1), np.arange(len(state))
    pairs = []
    for some in np.array_split(chosen, -(-len(chosen) // _CHUNK)):
        apart = squares[some, None] + squares - 2.0 * state[some] @ state.T
        near = apart < radius[some, None] ** 2
        near &= np.abs(some[:, None] - rows) > APART
        probe, other = np.nonzero(near)
        pairs.append((some[probe], other))
    probes, others = (np.concatenate(same) for same in zip(*pairs))
    return Visits(probes, others, len(probes) / len(chosen))


def scales(values: Array) -> Array:
    """Return (n,) the spread of joints' values (K, n); that of a still joint is not too small."""
    spread = np.sqrt(np.mean(values**2, axis=0))
    return np.asarray(np.maximum(spread, _LEAST_SCALE * np.max(spread) or 1.0))


def _steps(state: Array) -> Array:
    """Return (K,) how far the state of one log moves from row to row."""
    moved = np.linalg.norm(np.diff(state, axis=0), axis=1)
    return 0.5 * (np.append(moved[:1], moved) + np.append(moved, moved[-1:]))

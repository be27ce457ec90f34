"""Motion that repeats: what a model leaves unexplained comes again with it, and does not average.

Noise is new each time an arm passes a state (q, qd); friction that follows another law, or what a
filter leaves of a reversal, is the same each time. With e the residuals and N(p) the rows that pass
the state of row p at another time, the variance of a sum of the equations is

    D = 1 + sum_p e_p sum_{s in N(p)} e_s / sum_p e_p^2

times that of independent residuals: 1 where only noise is left, and the number of repetitions where
every one leaves the same. A row passes a state where it is nearer than the rows of that state's own
passage are to each other.

Of any number of logs a sample of rows of bounded size stands for all: every row draws a number, and
those with the smallest stay. Samples put together in whatever order are then a sample of all rows
(bottom-k sampling: Cohen, Kaplan, "Summarizing data using bottom-k sketches", 2007).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.uncertainty import memory
from robot_sysid.records import Array, Motion

PROBES = 2000
"""So many rows, spread evenly, stand for all; a third of all tells D within a quarter (tests)."""
NEAR = 0.7
"""Of a row's step: of another passage, with a row each step, about one is found."""
APART = 20
"""Rows that are nearer in time belong to the same passage: ten periods of the cut-off."""
# A joint that hardly moves beside the others counts as if it moved by this part of them.
_LEAST_SCALE = 0.01
# Probes whose distances from all rows are in memory at a time.
_CHUNK = 100
MOST_ROWS = 2000
"""Rows of a sample; as many as ``PROBES``."""


@dataclass(frozen=True)
class Visits:
    """Pairs of rows (M,), (M,) that pass the same state again; ``repeats``: how often."""

    probes: NDArray[np.int64]
    others: NDArray[np.int64]
    repeats: float

    def inflation(self, residuals: Iterable[Array]) -> tuple[Array, Array]:
        """Return (D, M) (joints,) of each joint's residuals (K,) [N m]; NaN where unused.

        D is 1 where the motion does not repeat as a whole; M is what the memory of a joint's own
        residuals does to the variance of a slow sum.
        """
        again = []
        own = []
        each = np.unique(self.probes)
        for left in residuals:
            residual = np.nan_to_num(left)
            twice = 0.0
            squared = float(np.sum(residual[each] ** 2))
            if self.repeats >= 1.0 and squared > 0.0:
                twice = float(residual[self.probes] @ residual[self.others]) / squared
            again.append(max(1.0 + twice, 1.0))
            own.append(memory(left, again[-1]))
        return np.array(again), np.array(own)


def visits(motions: Sequence[Motion]) -> Visits:
    """Return which rows of some logs (K, n), taken together, pass the same states."""
    q, qd = (
        np.concatenate([getattr(m, name) for m in motions]) for name in ("q", "qd")
    )
    off = q - np.mean(q, axis=0)
    state = np.hstack([off / scales(off), qd / scales(qd)])
    ends = np.cumsum([len(m.time) for m in motions])[:-1]
    radius = NEAR * np.concatenate([_steps(part) for part in np.split(state, ends)])
    chosen = np.unique(np.linspace(0, len(state) - 1, PROBES).astype(np.int64))
    pairs = []
    for some in np.array_split(chosen, -(-len(chosen) // _CHUNK)):
        near = _near(state[some], radius[some], state)
        near &= np.abs(some[:, None] - np.arange(len(state))) > APART
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


def _near(probes: Array, radius: Array, state: Array) -> NDArray[np.bool_]:
    """Return (P, K) which rows' states lie within the radius (P,) of each of P."""
    apart = (
        np.sum(probes**2, axis=1)[:, None]
        + np.sum(state**2, axis=1)
        - 2.0 * probes @ state.T
    )
    return np.asarray(apart < radius[:, None] ** 2)


@dataclass(frozen=True, eq=False)
class RowSample:
    """At most ``MOST_ROWS`` M of ``total`` rows.

    Attributes:
        drawn: (M,) what each row drew, ascending.
        log, place: (M,) number of the log that a row is of, and which of its rows it is.
        moved: (M, 2n) how far position and velocity are from those of the next row.
        residual: (M, joints) what an estimate leaves [N m]; 0 in rows that are not used.
    """

    drawn: Array
    log: NDArray[np.uint64]
    place: NDArray[np.int64]
    q: Array
    qd: Array
    qdd: Array
    moved: Array
    residual: Array
    total: int

    def __add__(self, other: RowSample) -> RowSample:
        """Return the sample of both's rows, or raise InputError where a row is in both."""
        names = [each.name for each in fields(self) if each.name != "total"]
        both = {
            name: np.concatenate([getattr(s, name) for s in (self, other)])
            for name in names
        }
        order = np.argsort(both["drawn"], kind="stable")[:MOST_ROWS]
        log = both["log"][order]
        place = both["place"][order]
        if np.any((log[1:] == log[:-1]) & (place[1:] == place[:-1])):
            raise InputError(
                "the same log is in both parts of a sum; add each log once"
            )
        total = self.total + other.total
        return RowSample(
            **{name: rows[order] for name, rows in both.items()}, total=total
        )

    def motion(self, most: int) -> Motion:
        """Return some of the motion; its time only counts the rows."""
        time = np.arange(min(most, len(self.q)), dtype=float)
        return Motion(time, self.q[:most], self.qd[:most], self.qdd[:most])

    def inflation(self) -> Array:
        """Return D (joints,) from the sampled rows.

        Where few of very many rows are sampled, chance makes it too large rather than too small.
        """
        size = len(self.drawn)
        found = np.ones(self.residual.shape[1])
        off = self.q - np.mean(self.q, axis=0)
        scale = np.concatenate([scales(off), scales(self.qd)])
        state = np.hstack([off, self.qd]) / scale
        near = _near(state, NEAR * np.linalg.norm(self.moved / scale, axis=1), state)
        same = self.log[:, None] == self.log
        near &= ~(same & (np.abs(self.place[:, None] - self.place) <= APART))
        share = self.total / size
        if share * np.count_nonzero(near) < size:
            return found
        squared = np.sum(self.residual**2, axis=0)
        again = share * np.sum(self.residual * (near @ self.residual), axis=0)
        seen = squared > 0.0
        found[seen] = np.maximum(1.0, 1.0 + again[seen] / squared[seen])
        return found


def sampled(motion: Motion, residual: Array, log: int) -> RowSample:
    """Return a sample of one log's rows (K,) with residuals (K, joints) [N m], NaN where unused;
    the number that no other log has also decides what the rows draw.
    """
    drawn = np.random.default_rng(log).random(len(motion.time))
    chosen = np.argsort(drawn, kind="stable")[:MOST_ROWS]
    moved = np.diff(np.hstack([motion.q, motion.qd]), axis=0)
    # The last row has no next one; it is as far from the one before.
    moved = np.vstack([moved, moved[-1:]])
    q, qd, qdd, moved = (
        each[chosen] for each in (motion.q, motion.qd, motion.qdd, moved)
    )
    numbers = np.full(len(chosen), log, dtype=np.uint64)
    left = np.nan_to_num(residual[chosen])
    return RowSample(
        drawn[chosen], numbers, chosen, q, qd, qdd, moved, left, len(drawn)
    )

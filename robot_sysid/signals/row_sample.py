"""A sample of rows of any number of logs, of bounded size, that stands for all of them.

Every row draws a number; those with the smallest numbers stay. Samples of several logs together are
then a sample of all rows, in whatever order they are put together (bottom-k sampling: Cohen,
Kaplan, "Summarizing data using bottom-k sketches", 2007).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion
from robot_sysid.signals.repetition import APART, NEAR, scales

MOST_ROWS = 2000


@dataclass(frozen=True, eq=False)
class RowSample:
    """At most ``MOST_ROWS`` of N rows.

    Attributes:
        drawn: (M,) what each row drew, ascending.
        log: (M,) number of the log that a row is of.
        place: (M,) which of its log's rows it is.
        q, qd, qdd: (M, n) [rad, rad/s, rad/s^2].
        moved: (M, 2n) how far position and velocity are from those of the next row.
        residual: (M, joints) what an estimate leaves unexplained; 0 in rows that are not used
            [N m].
        total: N.
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
        """Return the sample of both's rows.

        Raises:
            InputError: a row is in both.
        """
        names = [each.name for each in fields(self) if each.name != "total"]
        both = {name: np.concatenate([getattr(s, name) for s in (self, other)]) for name in names}
        order = np.argsort(both["drawn"], kind="stable")[:MOST_ROWS]
        log, place = both["log"][order], both["place"][order]
        if np.any((log[1:] == log[:-1]) & (place[1:] == place[:-1])):
            raise InputError("the same log is in both parts of a sum; add each log once")
        total = self.total + other.total
        return RowSample(**{name: rows[order] for name, rows in both.items()}, total=total)

    def motion(self, most: int) -> Motion:
        """Return some of the motion; its time only counts the rows."""
        rows = slice(most)
        time = np.arange(len(self.q[rows]), dtype=float)
        return Motion(time, self.q[rows], self.qd[rows], self.qdd[rows])

    def inflation(self) -> Array:
        """Return D (joints,) as ``repetition.Visits.inflation`` does, from the sampled rows.

        Where few of very many rows are sampled, chance makes it too large rather than too small.
        """
        size, found = len(self.drawn), np.ones(self.residual.shape[1])
        off = self.q - np.mean(self.q, axis=0)
        scale = np.concatenate([scales(off), scales(self.qd)])
        state = np.hstack([off, self.qd]) / scale
        step = np.linalg.norm(self.moved / scale, axis=1)
        squares = np.sum(state**2, axis=1)
        near = squares[:, None] + squares - 2.0 * state @ state.T < (NEAR * step[:, None]) ** 2
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
    """Return a sample of one log's rows.

    Args:
        motion: of all rows.
        residual: (K, joints) [N m]; NaN in rows that are not used.
        log: a number that no other log has, which also decides what the rows draw.
    """
    drawn = np.random.default_rng(log).random(len(motion.time))
    chosen = np.argsort(drawn, kind="stable")[:MOST_ROWS]
    moved = np.diff(np.hstack([motion.q, motion.qd]), axis=0)
    # The last row has no next one; it is as far from the one before.
    moved = np.vstack([moved, moved[-1:]])
    return RowSample(
        drawn[chosen],
        np.full(len(chosen), log, dtype=np.uint64),
        chosen,
        motion.q[chosen],
        motion.qd[chosen],
        motion.qdd[chosen],
        moved[chosen],
        np.nan_to_num(residual[chosen]),
        len(drawn),
    )

"""A random sample of the rows of logs, of bounded size.

Every row draws a number, and the rows with the smallest numbers stay. Samples that are combined in
any order are then a sample of all rows (bottom-k sampling: Cohen, Kaplan, "Summarizing data using
bottom-k sketches", 2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion

MOST_ROWS = 2000
"""Rows of a random sample."""


@dataclass(frozen=True, eq=False)
class RowSample:
    """A random sample of M rows, at most ``MOST_ROWS``, of the ``total`` rows of one or more logs.

    Attributes:
        drawn: (M,) the random number from 0 to 1 that each row drew, ascending.
        log: (M,) number of the log that a row is from.
        place: (M,) index of the row in its log.
        q: (M, n) positions [rad].
        qd: (M, n) velocities [rad/s].
        qdd: (M, n) accelerations [rad/s^2].
        total: number of rows that the sample stands for.
    """

    drawn: Array
    log: NDArray[np.uint64]
    place: NDArray[np.int64]
    q: Array
    qd: Array
    qdd: Array
    total: int

    def __add__(self, other: RowSample) -> RowSample:
        """Return the sample of all rows that this sample and another one stand for.

        Raises:
            InputError: both contain the same row of the same log.
        """
        order = np.argsort(np.concatenate((self.drawn, other.drawn)), kind="stable")
        order = order[:MOST_ROWS]
        columns = {}
        for name, values in vars(self).items():
            if name != "total":
                both = np.concatenate((values, getattr(other, name)))
                columns[name] = both[order]
        # The same row of the same log drew the same number, so its copies are neighbours.
        is_same = np.diff(columns["log"]) == 0
        is_same &= np.diff(columns["place"]) == 0
        if np.any(is_same):
            raise InputError(
                "the same log is in both parts of a sum; add each log once"
            )
        return RowSample(**columns, total=self.total + other.total)

    def motion(self, count: int) -> Motion:
        """Return the motion at the first ``count`` rows; its time only numbers them."""
        time = np.arange(min(count, len(self.q)), dtype=float)
        return Motion(time, self.q[:count], self.qd[:count], self.qdd[:count])


def sample_rows(motion: Motion, log: int) -> RowSample:
    """Return a random sample of at most ``MOST_ROWS`` of one log's rows.

    Args:
        motion: at all rows (K, n).
        log: number that no other log has; it seeds the random numbers.
    """
    drawn = np.random.default_rng(log).random(len(motion.time))
    rows = np.argsort(drawn, kind="stable")[:MOST_ROWS]
    return RowSample(
        drawn=drawn[rows],
        log=np.full(len(rows), log, dtype=np.uint64),
        place=rows,
        q=motion.q[rows],
        qd=motion.qd[rows],
        qdd=motion.qdd[rows],
        total=len(drawn),
    )

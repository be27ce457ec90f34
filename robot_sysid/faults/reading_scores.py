"""How likely a log is that is read in one way or another, from the same rows.

Rows are made anew for each reading of the positions. Torques that are read otherwise turn the right
side of the same equations: the columns stand beside all recorded torques, whose products are kept.

Throughout, J is the number of joints with equations, n that of the chain's, k that of parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.estimate.equations.inverse import rough_solution
from robot_sysid.estimate.fit import Equations, equations_of
from robot_sysid.estimate.rows import Rows, of_rounding, row_chunks
from robot_sysid.estimate.terms import ArmTerms, Point, Term
from robot_sysid.faults.readings import Reading
from robot_sysid.records import Array
from robot_sysid.records.parameters import Parameter
from robot_sysid.signals.process import FilteredRecording

KEPT = 60
"""Readings of positions of which the products are kept: 0.7 MB each, of an arm of seven joints."""
FIRST_NOISE = 0.05
"""Noise that a score begins with, as a share of each joint's torque."""
NOISE_ROUNDS = 2
"""Rounds in which the noise is taken from the residuals: noise that is found to the end follows a
joint that other joints' errors were left to."""


@dataclass(frozen=True)
class Products:
    """Products of the rows of a log whose positions are read in one way.

    Attributes:
        own: (J, k, k) those of the parameters' columns.
        cross: (J, k, n + 1) those of them with the torque that is to be explained, and with all
            recorded torques.
        torque: (J, n + 1, n + 1) those of these torques.
        counts: (J,) number of rows.
    """

    own: Array
    cross: Array
    torque: Array
    counts: Array


class ReadingScores:
    """The likelihoods of a log that is read otherwise.

    Args:
        arm: the terms that are needed.
        recordings: the log.
        terms: the question.
    """

    def __init__(
        self,
        arm: ArmTerms,
        recordings: Sequence[FilteredRecording],
        terms: Sequence[Term],
    ) -> None:
        recorded = recorded_torque(arm)
        self._arm = arm.beside([recorded])
        self._recordings = recordings
        sums = self._arm.sums(recordings, self._arm.start(), False)
        self._equations = equations_of(self._arm, sums, terms, {})
        # What is held is no torque that is to be explained.
        left = self._equations.selection[:, -1:]
        torques = np.eye(len(left))[:, sums.at(recorded.names)]
        self._sides = np.concatenate((left, torques), axis=1)
        self._kept: dict[tuple[bytes, ...], Products] = {}
        self._scores: dict[tuple[bytes, ...], float] = {}

    def score(self, reading: Reading, share: float) -> float:
        """Return the log likelihood of the log that is read otherwise, but for a constant.

        Residuals below a ``share`` of all torque do not count.
        """
        gravity = reading.gravity
        gravity = self._arm.start().gravity if gravity is None else gravity
        numbers = (reading.position, reading.zeros, gravity, np.array(reading.time))
        of_positions = tuple(each.tobytes() for each in numbers)
        key = (*of_positions, reading.torque.tobytes(), np.array(share).tobytes())
        if key not in self._scores:
            if of_positions not in self._kept:
                if len(self._kept) >= KEPT:
                    self._kept.clear()
                self._kept[of_positions] = self._products(reading)
            products = self._kept[of_positions]
            self._scores[key] = self._score_of(products, reading, share)
        return self._scores[key]

    def _products(self, reading: Reading) -> Products:
        """Return the products of the log with positions that are read otherwise."""
        arm = self._arm
        as_recorded = replace(reading, torque=np.eye(len(reading.torque)))
        point = arm.start()
        if reading.gravity is not None:
            point = replace(point, gravity=reading.gravity)
        size = len(arm.names) + 1
        every = np.zeros((len(arm.joints), size, size))
        counts = np.zeros(len(arm.joints))
        for recording in self._recordings:
            chunks = row_chunks(as_recorded.apply(recording), size * len(arm.joints))
            for rows, is_used in (arm.equations(chunk, point) for chunk in chunks):
                counts += np.sum(is_used, axis=0)
                for joint, total in enumerate(every):
                    own = rows[is_used[:, joint], joint]
                    at = np.flatnonzero(np.any(own, axis=0))
                    own = own[:, at]
                    total[at[:, None], at] += own.T @ own
        for total in every:
            at = of_rounding(np.diag(total))
            total[at] = total[:, at] = 0.0
        moved = every @ self._sides
        own = self._equations.index
        return Products(
            every.take(own, 1).take(own, 2),
            moved[:, own],
            self._sides.T @ moved,
            np.maximum(counts, 1.0),
        )

    def _score_of(self, products: Products, reading: Reading, share: float) -> float:
        """Return the log likelihood of products, with torques that are read otherwise."""
        equations = self._equations
        torque = reading.torque
        change = (torque - np.eye(len(torque)))[self._arm.indices]
        sides = np.concatenate((np.ones((len(change), 1)), change), axis=1)
        cross = np.einsum("jks,js->jk", products.cross, sides)
        squared = np.einsum("js,jst,jt->j", sides, products.torque, sides)
        own = products.own
        counts = products.counts
        sizes = np.sqrt(squared / counts)
        # In the size of the recorded torques, so that larger ones are not more exact.
        factors = reading.factors[self._arm.indices]
        least = share * np.sqrt(np.mean((sizes / factors) ** 2)) * factors
        noise = np.maximum(FIRST_NOISE * sizes, least)
        prior = equations.prior
        for _ in range(NOISE_ROUNDS):
            weights = noise**-2.0
            matrix = prior[:-1, :-1] + np.tensordot(weights, own, 1)
            right_side = prior[:-1, -1] + weights @ cross
            values = rough_solution(matrix, right_side, equations.reference)
            crosses = equations.crossing(values)
            if np.any(crosses):
                start = np.where(crosses, equations.inside(values), equations.reference)
                free = np.flatnonzero(~crosses)
                values = rough_solution(matrix, right_side, start, free)
            squares = squared - 2.0 * (cross @ values) + (own @ values) @ values
            noise = np.maximum(np.sqrt(np.maximum(squares, 0.0) / counts), least)
        return likelihood(equations, values, counts, noise / factors)


def recorded_torque(arm: ArmTerms) -> Term:
    """Return a term whose columns, in every joint's rows, are all joints' recorded torques."""
    names = [f"recorded torque of {name}" for name in arm.robot.joint_names]

    def columns(rows: Rows, _: Point) -> Array:
        """Return the torques (m, J, n) [N m]; zero where there is none."""
        torque = np.nan_to_num(rows.recording.torque[rows.span])
        return np.repeat(torque[:, None], len(arm.joints), axis=1)

    return Term("", tuple(map(Parameter, names)), columns)


def likelihood(
    equations: Equations, values: Array, independent: Array, noise: Array
) -> float:
    """Return the log likelihood of values and of their priors, but for a constant.

    Args:
        equations: of the values.
        values: (k,) that solve them.
        independent: (J,) number of independent rows.
        noise: (J,) of the residuals [N m].
    """
    change = np.append(values, -1.0)
    pull = change @ equations.prior @ change
    return -float(independent @ np.log(noise) + 0.5 * pull)

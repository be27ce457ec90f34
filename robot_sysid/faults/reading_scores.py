"""How likely a log is that is read in one way or another, from the same rows.

Rows are made anew for each reading of the positions. Torques that are read otherwise turn the right
side of the same equations: the columns stand beside all recorded torques, whose products are kept.

Throughout, J is the number of joints with equations, n that of the chain's, k that of parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robot_sysid.dynamics.friction import COULOMB
from robot_sysid.dynamics.inverse_dynamics import ARRAY_SIZE
from robot_sysid.estimate.equations.inverse import rough_solution
from robot_sysid.estimate.equations.normal import Equations, equations_of
from robot_sysid.estimate.rows import Rows, of_rounding
from robot_sysid.estimate.terms import ArmTerms, Point, Term
from robot_sysid.faults.readings import Reading, directions
from robot_sysid.records import Array
from robot_sysid.records.parameters import Parameter
from robot_sysid.signals.process import FilteredRecording, KeptColumns, Mask

Positions = tuple[bytes, ...]
Key = tuple[Positions, bytes, float]
KEPT = 5_000_000
"""Numbers in the products that are kept of readings of positions, 40 MB: of an arm of seven joints
those of seventy readings."""
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
        recordings: the log, as from ``of_rows_alone``.
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
        size = sum(map(len, recordings)) * len(arm.joints) * len(self._arm.names)
        self._at_once = max(1, ARRAY_SIZE // max(size, 1))
        self._gravity = self._arm.start().gravity
        self._kept: dict[Positions, Products] = {}
        self._scores: dict[Key, float] = {}

    def scores(self, readings: Sequence[Reading], share: float) -> list[float]:
        """Return the log likelihoods of the log that is read in some ways, but for a constant.

        Residuals below a ``share`` of all torque do not count.
        """
        keys = [
            (self._positions_of(reading), reading.torque.tobytes(), share)
            for reading in readings
        ]
        new = {
            key: reading
            for key, reading in zip(keys, readings)
            if key not in self._scores
        }
        for batch in self._batches(new):
            self._make({key[0]: new[key] for key in batch})
            for key in batch:
                products = self._kept[key[0]]
                self._scores[key] = self._score_of(products, new[key], share)
        return [self._scores[key] for key in keys]

    def _positions_of(self, reading: Reading) -> Positions:
        """Return what tells the positions of a reading, and gravity, from those of another."""
        gravity = self._gravity if reading.gravity is None else reading.gravity
        numbers = reading.position, reading.zeros, gravity, np.array(reading.time)
        return tuple(each.tobytes() for each in numbers)

    def _batches(self, keys: Iterable[Key]) -> Iterator[list[Key]]:
        """Yield keys in turn, with as many positions that were not made as are made at once."""
        batch: list[Key] = []
        new: set[Positions] = set()
        for key in keys:
            batch.append(key)
            if key[0] not in self._kept:
                new.add(key[0])
            if len(new) == self._at_once:
                yield batch
                batch = []
                new = set()
        if batch:
            yield batch

    def _make(self, readings: dict[Positions, Reading]) -> None:
        """Keep the products of readings of positions, which are made at once where they can be.

        Many short arrays take longer than a few long ones.
        """
        size = len(self._arm.joints) * len(self._equations.names) ** 2
        if len(self._kept.keys() | readings.keys()) * size > KEPT:
            self._kept.clear()
        new = {at: read for at, read in readings.items() if at not in self._kept}
        by_gravity: dict[bytes, list[Positions]] = {}
        for positions in new:
            by_gravity.setdefault(positions[2], []).append(positions)
        for alike in by_gravity.values():
            made = self._rows([new[positions] for positions in alike])
            for positions, rows in zip(alike, made):
                self._kept[positions] = self._products(rows)

    def _rows(self, readings: Sequence[Reading]) -> list[list[tuple[Array, Mask]]]:
        """Return, for each reading with one gravity, the rows of each recording, and the used ones.

        Rows are [A b] (m, J, p + 1), as torques were recorded, and used (m, J).
        """
        arm = self._arm
        gravity = readings[0].gravity
        point = arm.start()
        point = point if gravity is None else replace(point, gravity=gravity)
        made: list[list[tuple[Array, Mask]]] = [[] for _ in readings]
        for recording in self._recordings:
            read = [
                replace(reading, torque=np.eye(len(reading.torque))).apply(recording)
                for reading in readings
            ]
            together = Rows(one_after_another(read), slice(None))
            rows, is_used = arm.equations(together, point)
            parts = zip(np.split(rows, len(read)), np.split(is_used, len(read)))
            for own, part in zip(made, parts):
                own.append(part)
        return made

    def _products(self, parts: Sequence[tuple[Array, Mask]]) -> Products:
        """Return the products of rows [A b] (m, J, p + 1), of which some are used (m, J)."""
        joints = parts[0][0].shape[1]
        # Most columns are zero in the rows of a joint: links before it make no torque there.
        place = np.full(len(self._sides), -1)
        place[self._equations.index] = np.arange(len(self._equations.index))
        k, sides = len(self._equations.index), self._sides.shape[1]
        own = np.zeros((joints, k, k))
        cross = np.zeros((joints, k, sides))
        torque = np.zeros((joints, sides, sides))
        for joint in range(joints):
            used = [rows[is_used[:, joint], joint] for rows, is_used in parts]
            is_there = np.any([np.any(rows, axis=0) for rows in used], axis=0)
            # The last one is that of the torque, beside which others are rounding.
            is_there[-1] = True
            at = np.flatnonzero(is_there)
            total = sum(rows[:, at].T @ rows[:, at] for rows in used)
            small = of_rounding(np.diag(total))
            total[small] = total[:, small] = 0.0
            moved = total @ self._sides[at]
            inner = place[at] >= 0
            to = place[at][inner]
            own[joint][to[:, None], to] = total[inner][:, inner]
            cross[joint, to] = moved[inner]
            torque[joint] = self._sides[at].T @ moved
        counts = np.sum([np.sum(is_used, axis=0) for _, is_used in parts], axis=0)
        return Products(own, cross, torque, np.maximum(counts, 1.0))

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


def of_rows_alone(recording: FilteredRecording) -> FilteredRecording:
    """Return a recording whose samples are its rows, so that to read them otherwise is fast.

    Of the columns that are made of all samples the direction of each joint's friction is kept; that
    of a motor which turns several joints is made of the rows, as of any other reading.
    """
    motion = recording.motion
    count = len(recording)
    return replace(
        recording,
        time=motion.time,
        q=motion.q,
        qd=motion.qd,
        qdd=motion.qdd,
        tau=recording.torque,
        bridged=np.zeros(count, dtype=bool),
        from_turn=np.full(motion.q.shape, np.inf),
        low_pass=replace(recording.low_pass, kernel=np.ones(1), step=1),
        every=1,
        chosen=recording.is_used,
        kept=KeptColumns({COULOMB.name: directions(recording)}),
    )


def one_after_another(recordings: Sequence[FilteredRecording]) -> FilteredRecording:
    """Return one recording of several whose samples are their rows (``of_rows_alone``)."""
    names = ("time", "q", "qd", "qdd", "tau", "bridged", "from_turn", "chosen")
    series: dict[str, Any] = {
        name: np.concatenate([getattr(each, name) for each in recordings])
        for name in names
    }
    dry = np.concatenate([*map(directions, recordings)])
    return replace(recordings[0], kept=KeptColumns({COULOMB.name: dry}), **series)


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

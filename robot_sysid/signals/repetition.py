"""States that a motion visits more than once: repeated passes, and poses approached from two sides.

Residuals that a model leaves unexplained repeat with a motion that repeats: they do not average
out. Noise is new each time an arm passes a state (q, qd); friction that follows another law, or the
error that a filter makes at a reversal, is the same each time. With e the residuals and N(p) the
rows that pass the state of row p at another time, the variance of a sum of the equations is

    D = 1 + sum_p e_p sum_{s in N(p)} e_s / sum_p e_p^2

times that of independent residuals: 1 where only noise is left, and the number of repetitions where
every one leaves the same residuals. A row passes a state where it is nearer to it than the rows of
that state's own passage are to each other.

For any number of logs a random sample of rows of bounded size stands for all: every row draws a
number, and the rows with the smallest numbers stay. Samples that are combined in any order are then
a sample of all rows (bottom-k sampling: Cohen, Kaplan, "Summarizing data using bottom-k sketches",
2007).

Dry friction holds an arm at rest with a torque of either sign. Where a pose is approached once from
below and once from above, the mean of both torques has none of it left (to the extent that it is
as large both ways), so that gravity alone remains.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.uncertainty import residual_correlation_time
from robot_sysid.records import Array, Measurement, Motion

PROBES = 2000
"""Rows, spread evenly over a log, whose visits are searched for; the visits of a third of all rows
give D within a quarter (tests)."""
RADIUS_SHARE = 0.7
"""Radius within which another row counts as passing the same state, over the distance between
successive rows: about one row of each other passage lies within the radius."""
PASSAGE_ROWS = 20
"""Rows that are at most so many rows apart belong to one passage: ten periods of the cut-off."""
_LEAST_SPREAD = 0.01
"""Least spread of a joint's positions or speeds, over the spread of the joint that moves most."""
_CHUNK = 100
"""Probes whose distances from all rows are in memory at a time."""
MOST_ROWS = 2000
"""Rows of a random sample; as many as ``PROBES``."""


@dataclass(frozen=True)
class Visits:
    """P pairs of rows that pass the same state at different times.

    The first row of a pair is a probe, one of at most ``PROBES`` rows whose visits were searched
    for; the second may be any row.

    Attributes:
        probes: (P,) row number of the first of each pair.
        others: (P,) row number of the second.
        repeats: mean number of pairs per probe.
    """

    probes: NDArray[np.int64]
    others: NDArray[np.int64]
    repeats: float

    def inflation(self, residuals: Iterable[Array]) -> tuple[Array, Array]:
        """Return two variance inflations (joints,): factors by which the variance of sums of each
        joint's residuals is larger than that of independent residuals.

        The first, D, is that by repetition; 1 where the motion hardly repeats. The second, for sums
        that vary slowly along the rows, is the integrated autocorrelation time of the residuals
        [rows].

        Args:
            residuals: per joint (K,) [N m], NaN in rows that are not used; K is the number of rows
                that ``find_visits`` got.
        """
        inflations = []
        autocorrelations = []
        probes = np.unique(self.probes)
        for joint_residual in residuals:
            residual = np.nan_to_num(joint_residual)
            inflation = 1.0
            squared = float(np.sum(residual[probes] ** 2))
            if self.repeats >= 1.0 and squared > 0.0:
                covariance = float(residual[self.probes] @ residual[self.others])
                inflation = max(1.0 + covariance / squared, 1.0)
            inflations.append(inflation)
            autocorrelation = residual_correlation_time(joint_residual, inflation)
            autocorrelations.append(autocorrelation)
        return np.array(inflations), np.array(autocorrelations)


def find_visits(motions: Sequence[Motion]) -> Visits:
    """Return the pairs of rows of logs that pass the same state (q, qd) at different times.

    Args:
        motions: of the rows of each log; rows are numbered one log after the other.
    """
    q = np.concatenate([motion.q for motion in motions])
    qd = np.concatenate([motion.qd for motion in motions])
    # (K, 2 n) positions and speeds of all rows, each over its spread.
    offset = q - np.mean(q, axis=0)
    state = np.hstack([offset / _spread(offset), qd / _spread(qd)])
    ends = np.cumsum([len(motion.time) for motion in motions])
    steps = map(_step_lengths, np.split(state, ends[:-1]))
    radius = RADIUS_SHARE * np.concatenate(list(steps))
    spread_rows = np.linspace(0, len(state) - 1, PROBES)
    rows = np.unique(spread_rows.astype(np.int64))
    probes = []
    others = []
    for chunk in np.array_split(rows, math.ceil(len(rows) / _CHUNK)):
        is_visit = _is_near(state[chunk], radius[chunk], state)
        row_distance = np.abs(chunk[:, None] - np.arange(len(state)))
        is_visit &= row_distance > PASSAGE_ROWS
        probe, other = np.nonzero(is_visit)
        probes.append(chunk[probe])
        others.append(other)
    n_pairs = sum(map(len, others))
    return Visits(np.concatenate(probes), np.concatenate(others), n_pairs / len(rows))


def _spread(values: Array) -> Array:
    """Return (n,) the root mean square of joints' values (K, n), at least 1 % of the largest one; 1
    where no joint moves.
    """
    spread = np.sqrt(np.mean(values**2, axis=0))
    return np.maximum(spread, _LEAST_SPREAD * np.max(spread) or 1.0)


def _step_lengths(state: Array) -> Array:
    """Return (K,) the mean of the distances from each state (K, 2 n) of a log to the state before
    and to the state after.
    """
    moved = np.linalg.norm(np.diff(state, axis=0), axis=1)
    return 0.5 * (np.append(moved[:1], moved) + np.append(moved, moved[-1:]))


def _is_near(probes: Array, radius: Array, state: Array) -> NDArray[np.bool_]:
    """Return (P, K) whether each state (K, 2 n) lies within the radius (P,) of probes (P, 2 n)."""
    squared_distance = (
        np.sum(probes**2, axis=1)[:, None]
        + np.sum(state**2, axis=1)
        - 2.0 * probes @ state.T
    )
    return squared_distance < radius[:, None] ** 2


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
        moved: (M, 2 n) change of position and velocity until the next row.
        residual: (M, joints) of an estimate [N m]; 0 in rows that are not used.
        total: number of rows that the sample stands for.
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

    def inflation(self) -> Array:
        """Return the variance inflation D (joints,) by repetition, from the sampled rows.

        Where few of very many rows are sampled, chance makes it too large rather than too small.
        """
        size = len(self.drawn)
        inflation = np.ones(self.residual.shape[1])
        offset = self.q - np.mean(self.q, axis=0)
        scale = np.concatenate([_spread(offset), _spread(self.qd)])
        state = np.hstack([offset, self.qd]) / scale
        radius = RADIUS_SHARE * np.linalg.norm(self.moved / scale, axis=1)
        is_visit = _is_near(state, radius, state)
        same_log = self.log[:, None] == self.log
        row_distance = np.abs(self.place[:, None] - self.place)
        is_visit &= ~(same_log & (row_distance <= PASSAGE_ROWS))
        # Each sampled row stands for so many rows, and so does each row that passes its state.
        share = self.total / size
        if share * np.count_nonzero(is_visit) < size:
            return inflation
        squared = np.sum(self.residual**2, axis=0)
        products = self.residual * (is_visit @ self.residual)
        covariance = share * np.sum(products, axis=0)
        used = squared > 0.0
        inflation[used] = np.maximum(1.0, 1.0 + covariance[used] / squared[used])
        return inflation


def sample_rows(motion: Motion, residual: Array, log: int) -> RowSample:
    """Return a random sample of at most ``MOST_ROWS`` of one log's rows.

    Args:
        motion: at all rows (K, n).
        residual: (K, joints) of an estimate [N m]; NaN where unused.
        log: number that no other log has; it seeds the random numbers.
    """
    drawn = np.random.default_rng(log).random(len(motion.time))
    rows = np.argsort(drawn, kind="stable")[:MOST_ROWS]
    moved = np.diff(np.hstack([motion.q, motion.qd]), axis=0)
    # The last row has no next row; its change is taken from the row before.
    moved = np.vstack([moved, moved[-1:]])
    return RowSample(
        drawn=drawn[rows],
        log=np.full(len(rows), log, dtype=np.uint64),
        place=rows,
        q=motion.q[rows],
        qd=motion.qd[rows],
        qdd=motion.qdd[rows],
        moved=moved[rows],
        residual=np.nan_to_num(residual[rows]),
        total=len(drawn),
    )


STILL = 2e-3
"""How far a joint may move while it rests: several steps of a coarse encoder (chosen) [rad]."""
LEAST_REST = 0.9
"""Shortest rest that counts [s]."""
SETTLING = 0.35
"""Time at the beginning and at the end of a rest that is left out [s]: a slow start or stop looks
like rest, and friction is that of the motion there."""
WINDOW = 0.1
"""Stretch of time within which a resting joint moves no further than ``STILL`` (chosen) [s]."""
SAME_POSE = 0.02
"""How far apart two rests in the same pose may be (chosen) [rad]."""
APPROACH = 0.3
"""Time before a rest over which a joint's direction is determined [s]."""
LEAST_APPROACH = 1e-3
"""Motion within ``APPROACH`` below which a joint has no direction of approach [rad]."""
FEWEST_POSES = 5
"""Fewest poses: mass and centre of mass are four unknowns, and their errors need more equations."""


def resting_poses(samples: Measurement) -> tuple[Measurement, NDArray[np.bool_]]:
    """Return (the K poses in which a log rests, (K, n) whether a joint's friction cancels there).

    A pose is two successive rests at nearly equal positions; its torque is the mean of the torques
    of both rests, and zero for joints that approached both rests from one side. Its velocities and
    accelerations are zero.

    Raises:
        InputError: there are fewer than ``FEWEST_POSES`` poses, or no joint approaches a pose from
            both sides.
    """
    n_joints = samples.q.shape[1]
    # Reshaped for a log without rests, of which numpy cannot know the number of columns.
    rests = np.array(list(_rests(samples)))
    rests = rests.reshape(-1, 1 + 3 * n_joints)
    time, q, tau, direction = np.split(rests, 1 + n_joints * np.arange(3), axis=1)
    is_same_pose = np.max(np.abs(np.diff(q, axis=0)), axis=1) < SAME_POSE
    count = np.count_nonzero(is_same_pose)
    if count < FEWEST_POSES:
        raise InputError(
            f"the log rests {len(rests)} times, and {count} poses were approached from both "
            f"sides; --static needs {FEWEST_POSES}: play what robot-sysid plan --for payload "
            "--static writes"
        )
    q = 0.5 * (q[:-1] + q[1:])[is_same_pose]
    tau = 0.5 * (tau[:-1] + tau[1:])[is_same_pose]
    # The joint came from opposite sides.
    is_balanced = (direction[:-1] * direction[1:])[is_same_pose] < 0.0
    is_balanced &= np.isfinite(tau)
    if not np.any(is_balanced):
        raise InputError(
            "no joint approaches its poses from both sides; --static needs that"
        )
    zeros = np.zeros_like(q)
    tau = np.where(is_balanced, tau, 0.0)
    poses = Measurement(time[:-1][is_same_pose, 0], q, zeros, tau, zeros)
    return poses, is_balanced


def _rests(samples: Measurement) -> Iterator[Array]:
    """Yield a row (1 + 3 n,) for each stretch of a log in which the arm rests.

    A row holds the time at which the rest begins [s], the mean position (n,) [rad], the mean torque
    (n,) [N m], and the direction (n,) from which each joint came: 1, -1, or 0 for a joint that had
    hardly moved.
    """
    time = samples.time
    q = samples.q
    # The ends of each run of samples around which all joints stay within STILL.
    is_still = np.concatenate(([False], _is_still(time, q), [False])).astype(int)
    for first, end in np.flatnonzero(np.diff(is_still)).reshape(-1, 2).tolist():
        if time[end - 1] - time[first] < LEAST_REST:
            continue
        settled = [time[first] + SETTLING, time[end - 1] - SETTLING]
        start, stop = np.searchsorted(time, settled).tolist()
        earlier = int(np.searchsorted(time, time[first] - APPROACH))
        resting = slice(start, stop + 1)
        mean = np.mean(q[resting], axis=0)
        moved = mean - q[earlier]
        direction = np.where(np.abs(moved) < LEAST_APPROACH, 0.0, np.sign(moved))
        tau = np.mean(samples.tau[resting], axis=0)
        yield np.hstack([time[first], mean, tau, direction])


def _is_still(time: Array, q: Array) -> NDArray[np.bool_]:
    """Return (N,) whether all joints stay within ``STILL`` around each sample of q (N, n)."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    step = float(np.median(np.diff(time)))
    width = max(int(round(WINDOW / step)), 2)
    span = maximum_filter1d(q, width, axis=0) - minimum_filter1d(q, width, axis=0)
    return np.all(span < STILL, axis=1)

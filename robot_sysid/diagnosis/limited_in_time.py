"""Faults that last a moment: what touched the arm, or a sensor that failed for a while.

Their stretches of a log are left out, and the rest is used. A sensor that fails shows itself: a
channel repeats one value while the arm moves (``signals.frozen``). All else shows as torque that
the arm's equations leave over at one time and at no other: residuals of a robust fit, which gives
no weight to rows with large ones, are of ordinary size but for these stretches. Where something is
wrong all the time, residuals are ordinarily large, and nothing is left out.

Throughout, K is the number of rows per joint, n that of joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import Finding, Level
from robot_sysid.diagnosis.log_prior import base_prior
from robot_sysid.diagnosis.log_rows import LogRows, log_rows
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.signals.frozen import equal_runs, frozen_positions
from robot_sysid.signals.process import LogPiece, ProcessedSignals

FAR = 15.0
"""Mean residual over ``_SMOOTH``, in ordinary sizes of the joint's, of a stretch that is left out:
right logs of real arms reach 10, a push of 2 % of the arm's weight 20."""
ORDINARY = 4.0
"""Mean residual at which a stretch that is left out ends."""
MOST_STRETCHES = 5
"""Number of stretches above which a fault comes back, and is not limited in time."""
MOST_SHARE = 0.5
"""Share of a log above which a fault is not limited in time."""
_SMOOTH = 0.3
"""Time over which residuals are averaged [s]."""
_OUTLYING = 6.0
"""Residual above which a row has no weight in the fit, in ordinary sizes."""
_LEAST_SIZE = 0.005
"""Least ordinary size of a residual, as a share of the joint's typical torque."""
_ROUNDS = 6
"""Number of fits, each with the weights of the one before."""
_CORRELATED = 5.0
"""Number of rows that count as one observation against the prior: residuals are correlated."""
# Number of different values below which a channel has coarse steps, which repeat by chance.
_MANY_VALUES = 100
# Least mean speed of an arm that moves [rad/s].
_MOVING = 0.05


@dataclass(frozen=True)
class Stretch:
    """A stretch of a log with a fault: begin and end [s], and the indices of the joints."""

    start: float
    stop: float
    joints: frozenset[int]


def join(stretches: Sequence[Stretch]) -> list[Stretch]:
    """Return stretches in the order of time, those that overlap as one."""
    joined: list[Stretch] = []
    for stretch in sorted(stretches, key=lambda each: each.start):
        if joined and stretch.start <= joined[-1].stop:
            last = joined.pop()
            stop = max(last.stop, stretch.stop)
            stretch = Stretch(last.start, stop, last.joints | stretch.joints)
        joined.append(stretch)
    return joined


def is_limited(stretches: Sequence[Stretch], pieces: Sequence[Measurement]) -> bool:
    """Return whether stretches are few, and leave most of a log."""
    duration = sum(float(np.ptp(piece.time)) for piece in pieces)
    left_out = sum(stretch.stop - stretch.start for stretch in stretches)
    return len(stretches) <= MOST_STRETCHES and left_out <= MOST_SHARE * duration


def leave_out(
    pieces: Sequence[Measurement], stretches: Sequence[Stretch]
) -> list[Measurement]:
    """Return the pieces of a log with the rows of stretches marked as left out.

    Positions that are frozen there are replaced by a smooth motion, so that the low-pass of the
    rows beside them meets no jump.
    """
    kept = []
    for piece in pieces:
        left_out = np.zeros(len(piece), dtype=bool)
        for stretch in stretches:
            left_out |= (piece.time >= stretch.start) & (piece.time <= stretch.stop)
        if np.any(left_out):
            if piece.left_out is not None:
                left_out |= piece.left_out
            q = _without_frozen_positions(piece)
            piece = LogPiece.of(replace(piece, q=q, left_out=left_out))
        kept.append(piece)
    return kept


def _without_frozen_positions(piece: Measurement) -> Array:
    """Return positions (N, n) with a smooth motion where they are frozen [rad]."""
    from scipy.interpolate import CubicSpline

    q = piece.q.copy()
    for joint, positions in enumerate(piece.q.T):
        frozen = np.zeros(len(piece), dtype=bool)
        for rows in frozen_positions(piece.time, positions):
            frozen[rows] = True
        if np.any(frozen):
            spline = CubicSpline(piece.time[~frozen], positions[~frozen])
            q[frozen, joint] = spline(piece.time[frozen])
    return q


def failed_sensors(pieces: Sequence[Measurement]) -> list[Stretch]:
    """Return the stretches in which a position or torque repeats its value while the arm moves."""
    stretches = []
    for piece in pieces:
        period = float(np.median(np.diff(piece.time)))
        for joint in range(piece.q.shape[1]):
            tau = piece.tau[:, joint]
            runs = [*frozen_positions(piece.time, piece.q[:, joint])]
            if len(np.unique(tau)) >= _MANY_VALUES:
                held = equal_runs(piece.time, tau)
                runs += [rows for rows in held if _moves(piece, rows)]
            for rows in runs:
                start, stop = piece.time[[rows.start, rows.stop - 1]].tolist()
                joints = frozenset([joint])
                stretches.append(Stretch(start - period, stop + period, joints))
    return join(stretches)


def _moves(piece: Measurement, rows: slice) -> bool:
    """Return whether any joint moves in some rows.

    The range of positions counts, not the difference: an arm may return to where it was.
    """
    length = min(float(np.ptp(piece.time[rows])), 1.0)
    return bool(np.max(np.ptp(piece.q[rows], axis=0)) > _MOVING * length)


def unusual_torque(
    robot: RobotModel, signals: Sequence[ProcessedSignals], options: EstimationOptions
) -> list[Stretch]:
    """Return the stretches in which torque is left over that is ordinary at no other time.

    Args:
        robot: the arm with its model.
        signals: low-passed signals of the log's pieces.
        options: prior uncertainties of the estimate.
    """
    log = log_rows(robot, signals)
    residual = robust_residual(log, options)
    time = log.motion.time
    # Time that the low-pass mixes with what happens in a stretch, and that it loses at both ends.
    low_pass = signals[0].low_pass
    margin = 0.5 / low_pass.cutoff
    lost = 2.0 * low_pass.half_width / low_pass.rate
    stretches = []
    for window in log.windows:
        size = np.abs(_running_mean(residual[window], log.used[window], time[window]))
        largest = np.max(size, axis=1)
        for rows in _true_runs(largest > ORDINARY):
            peaks = np.max(size[rows], axis=0)
            if np.max(peaks) <= FAR:
                continue
            start, stop = time[window][[rows.start, rows.stop - 1]].tolist()
            start -= margin if rows.start else lost
            stop += margin if rows.stop < len(largest) else lost
            joints = frozenset(np.flatnonzero(peaks > FAR).tolist())
            stretches.append(Stretch(start, stop, joints))
    return join(stretches)


def robust_residual(log: LogRows, options: EstimationOptions) -> Array:
    """Return residuals (K, n) of a robust fit, in ordinary sizes of each joint's; zero if not used.

    The ordinary size is the standard deviation of a normal distribution with the same median.
    """
    prior = base_prior(log, options)
    right_sides = log.right_sides - log.torque_of(prior.mean)
    equations = []
    for indices, rows in zip(log.indices, log.rows):
        is_estimated = np.isin(indices, prior.estimated)
        positions = prior.positions(indices[is_estimated])
        equations.append((positions, rows[:, is_estimated] * prior.spread[positions]))
    size = 0.05 * log.typical_torque
    weights = log.used.astype(float)
    relative = np.zeros_like(right_sides)
    for _ in range(_ROUNDS):
        precision = prior.precision.copy()
        pull = np.zeros(len(precision))
        for joint, (positions, columns) in enumerate(equations):
            weight = weights[:, joint] / (_CORRELATED * size[joint] ** 2)
            weighted = columns * weight[:, None]
            precision[np.ix_(positions, positions)] += columns.T @ weighted
            pull[positions] += weighted.T @ right_sides[:, joint]
        coefficients = np.linalg.solve(precision, pull)
        for joint, (positions, columns) in enumerate(equations):
            used = log.used[:, joint]
            residual = right_sides[:, joint] - columns @ coefficients[positions]
            median = np.median(np.abs(residual[used])) if np.any(used) else 0.0
            least = _LEAST_SIZE * log.typical_torque[joint]
            size[joint] = max(1.4826 * float(median), float(least))
            relative[:, joint] = residual * used / size[joint]
        distance = np.abs(relative)
        weights = log.used / np.maximum(1.0, 0.5 * distance)
        weights[distance > _OUTLYING] = 0.0
    return relative


def _running_mean(values: Array, used: NDArray[np.bool_], time: Array) -> Array:
    """Return the mean (K, n) over ``_SMOOTH`` around each row, of the rows that are used.

    Where fewer than a third are used, the others count as zero.
    """
    width = 1
    if len(time) > 1:
        width = max(1, round(_SMOOTH / float(np.median(np.diff(time)))))
    ones = np.ones(width)
    means = np.empty_like(values)
    for joint, column in enumerate(values.T):
        count = np.convolve(used[:, joint].astype(float), ones, "same")[: len(values)]
        total = np.convolve(column, ones, "same")[: len(values)]
        means[:, joint] = total / np.maximum(count, width / 3.0)
    return means


def _true_runs(mask: NDArray[np.bool_]) -> Iterator[slice]:
    """Yield the slices of consecutive true elements of a mask (K,)."""
    edges = np.flatnonzero(np.diff(np.pad(mask.view(np.int8), 1)))
    yield from map(slice, edges[::2].tolist(), edges[1::2].tolist())


def left_out_note(name: str, joint_names: Sequence[str], stretch: Stretch) -> Finding:
    """Return the note of a check that a stretch is left out."""
    text = f"something touched the arm, or a sensor failed, {_when(joint_names, stretch)}: left out"
    return Finding(name, Level.NOTE, text, is_left_out=True)


def recurring_finding(
    name: str, joint_names: Sequence[str], stretches: Sequence[Stretch]
) -> Finding:
    """Return the warning of a check that too much of a log would have to be left out."""
    text = (
        f"something touches the arm, or a sensor fails, {len(stretches)} times, first "
        f"{_when(joint_names, stretches[0])}: too much to leave out; record again without it"
    )
    return Finding(name, Level.WARN, text)


def _when(joint_names: Sequence[str], stretch: Stretch) -> str:
    """Return a phrase with the time of a stretch and its joints."""
    names = ", ".join(joint_names[joint] for joint in sorted(stretch.joints))
    return f"from {stretch.start:.2f} s to {stretch.stop:.2f} s ({names})"

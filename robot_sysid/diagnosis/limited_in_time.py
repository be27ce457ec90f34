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
from dataclasses import replace
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.diagnosis import Finding
from robot_sysid.diagnosis.log_fit import LogRows, log_rows
from robot_sysid.estimate.fit import equations_of, solve
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question, arm_question, friction_columns
from robot_sysid.estimate.rows import Recording
from robot_sysid.estimate.terms import ArmTerms
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.records.messages import Level, count_text
from robot_sysid.signals.frozen import equal_runs, frozen_positions, true_runs
from robot_sysid.signals.process import LogPiece
from robot_sysid.signals.resampling import slice_samples

FAR = 20.0
"""Mean residual over ``_SMOOTH``, in ordinary sizes of the joint's, of a stretch that is left out:
right logs of real arms reach 18."""
ORDINARY = 4.0
"""Mean residual at which a stretch that is left out ends."""
MOST_STRETCHES = 5
"""Number of stretches above which a fault comes back, and is not limited in time."""
MOST_SHARE = 0.5
"""Share of a log above which a fault is not limited in time."""
# Time over which residuals are averaged [s].
_SMOOTH = 0.3
# Residual above which a row has no weight in the fit, in ordinary sizes.
_OUTLYING = 6.0
# Least ordinary size of a residual, as a share of the joint's typical torque.
_LEAST_SIZE = 0.005
# Dry friction that sizes the priors of friction, as a share of a joint's torque.
_DRY = 0.1
# Number of fits, each with the weights of the one before.
_ROUNDS = 6
# Number of rows that count as one observation against the prior: residuals are correlated.
_CORRELATED = 5.0
MANY_VALUES = 100
"""Number of different values below which a channel has coarse steps, which repeat by chance."""
# Least mean speed of an arm that moves [rad/s].
_MOVING = 0.05


class Stretch(NamedTuple):
    """A stretch of a log with a fault: its check, begin and end [s], which joints (n,) show it."""

    check: str
    start: float
    stop: float
    joints: NDArray[np.bool_]


def failed_sensors(pieces: Sequence[Measurement]) -> Iterator[Stretch]:
    """Yield the stretches in which a position or torque repeats its value while the arm moves."""
    for piece in pieces:
        joints = np.eye(piece.q.shape[1], dtype=bool)
        for joint, q, tau in zip(joints, piece.q.T, piece.tau.T):
            runs = [("held", rows) for rows in frozen_positions(piece.time, q)]
            runs += held_torques(piece, tau)
            for check, rows in runs:
                start, stop = piece.time[[rows.start, rows.stop - 1]].tolist()
                yield Stretch(check, start, stop, joint)


def held_torques(piece: Measurement, tau: Array) -> Iterator[tuple[str, slice]]:
    """Yield (check, rows) where a torque (N,) repeats its value while the arm moves."""
    if len(np.unique(tau)) < MANY_VALUES:
        return
    ends = np.min(tau), np.max(tau)
    for rows in equal_runs(piece.time, tau):
        # The range of positions counts: an arm may return to where it was.
        length = min(float(np.ptp(piece.time[rows])), 1.0)
        if np.max(np.ptp(piece.q[rows], axis=0)) > _MOVING * length:
            yield "saturated" if tau[rows.start] in ends else "held", rows


def unusual_torque(
    robot: RobotModel, recordings: Sequence[Recording], options: EstimationOptions
) -> Iterator[Stretch]:
    """Yield the stretches in which torque is left over that is ordinary at no other time.

    Args:
        robot: the arm with its model.
        recordings: low-passed signals of the log's pieces.
        options: prior uncertainties of the estimate.
    """
    from scipy.ndimage import uniform_filter1d

    arm = ArmTerms(robot, friction=friction_columns(options))
    log = log_rows(arm, recordings, arm.start())
    residual = robust_residual(log, options)
    signals = recordings[0].signals
    width = max(1, round(_SMOOTH * signals.rate / signals.low_pass.step))
    # Time that the low-pass mixes with what happens in a stretch, and that it loses at both ends.
    margin = 0.5 / signals.cutoff
    lost = 2.0 * signals.low_pass.half_width / signals.rate
    first = 0
    for recording in recordings:
        time = recording.motion.time
        window = slice(first, first + len(time))
        first = window.stop
        totals = uniform_filter1d(residual[window], width, axis=0, mode="constant")
        share = uniform_filter1d(log.used[window].astype(float), width, axis=0)
        # Where fewer than a third of the rows are used, the others count as zero.
        size = np.abs(totals) / np.maximum(share, 1.0 / 3.0)
        for rows in true_runs(np.max(size, axis=1) > ORDINARY):
            joints = np.max(size[rows], axis=0) > FAR
            if np.any(joints):
                start = time[rows.start] - (margin if rows.start else lost)
                stop = time[rows.stop - 1]
                stop += margin if rows.stop < len(size) else lost
                yield Stretch("contact", start, stop, joints)


def robust_residual(log: LogRows, options: EstimationOptions) -> Array:
    """Return residuals (K, n) of a robust fit, in ordinary sizes of each joint's; zero if not used.

    The ordinary size is the standard deviation of a normal distribution with the same median.
    """
    typical = log.typical_torque
    torque = log.sums.rms_torque
    question = Question(options, dry=tuple((_DRY * torque).tolist()))
    terms = arm_question(log.arm, question, torque)
    equations = equations_of(log.arm, log.sums, terms, {})
    own = log.columns[:, :, equations.index]
    known = log.columns @ equations.full(np.zeros_like(equations.reference))
    rows = np.concatenate((own, (log.right_sides - known)[:, :, None]), axis=2)
    size = 0.05 * typical
    weights = log.used.astype(float)
    for _ in range(_ROUNDS):
        share = weights / (_CORRELATED * size**2)
        products = np.einsum("kjp,kj,kjq->pq", rows, share, rows, optimize=True)
        values, _ = solve(products + equations.prior, equations.reference)
        left = (rows[:, :, -1] - own @ values) * log.used
        for joint, residual in enumerate(left.T):
            used = np.abs(residual[log.used[:, joint]])
            median = np.median(used) if len(used) else 0.0
            size[joint] = max(1.4826 * median, _LEAST_SIZE * typical[joint])
        distance = np.abs(left / size)
        weights = log.used / np.maximum(1.0, 0.5 * distance)
        weights[distance > _OUTLYING] = 0.0
    return left / size


def leave_out(
    joint_names: Sequence[str],
    pieces: Sequence[Measurement],
    stretches: Sequence[Stretch],
) -> tuple[list[Measurement], list[Finding]]:
    """Return the pieces of a log with the rows of stretches marked as left out, and what to say.

    Positions there are replaced by a smooth motion: the low-pass of the rows beside them must meet
    no jump. Where too much would be left out, the pieces are returned as they are, with a warning.

    Args:
        joint_names: (n,) of the chain.
        pieces: the log without gaps.
        stretches: may overlap.
    """
    kept = []
    notes = []
    left_out_count = 0
    for piece in pieces:
        wrong = np.zeros(piece.q.shape, dtype=bool)
        checks = np.full(len(piece), "contact", dtype=object)
        for check, start, stop, joints in stretches:
            within = (piece.time >= start) & (piece.time <= stop)
            wrong[within] |= joints
            checks[within] = check
        left_out = np.any(wrong, axis=1)
        for rows in true_runs(left_out):
            start, stop = piece.time[[rows.start, rows.stop - 1]].tolist()
            names = ", ".join(compress(joint_names, np.any(wrong[rows], axis=0)))
            text = "something touched the arm, or a sensor failed, "
            text += f"from {start:.2f} s to {stop:.2f} s ({names}): left out"
            notes.append(Finding(Level.SAYS, checks[rows.start], text))
        left_out_count += int(np.sum(left_out))
        if not np.any(left_out):
            kept.append(piece)
        elif not np.all(left_out):
            kept.append(_mark(piece, left_out))
    is_much = left_out_count > MOST_SHARE * sum(map(len, pieces))
    if is_much or len(notes) > MOST_STRETCHES:
        text = f"{notes[0].text}; {count_text(len(notes), 'time')} in all, too much to leave out"
        text = text.replace(": left out", "")
        remedy = "record again without it"
        return list(pieces), [Finding(Level.DOUBTS, notes[0].about, text, remedy)]
    return kept, notes


def _mark(piece: Measurement, left_out: NDArray[np.bool_]) -> LogPiece:
    """Return a piece with rows (N,) marked as left out, and without those of them at its ends."""
    from scipy.interpolate import CubicSpline

    if piece.left_out is not None:
        left_out = left_out | piece.left_out
    kept = np.flatnonzero(~left_out)
    q = piece.q.copy()
    q[left_out] = CubicSpline(piece.time[kept], q[kept])(piece.time[left_out])
    marked = replace(piece, q=q, left_out=left_out)
    return LogPiece.of(slice_samples(marked, kept[0], kept[-1] + 1))

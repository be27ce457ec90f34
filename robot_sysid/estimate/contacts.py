"""Rows that are left out: those in which something touched the arm, and those near turns.

What touched the arm for a moment is torque that is left over at one time and at no other. Residuals
of a fit without the rows of large ones are of ordinary size but for these; where something is wrong
all the time, residuals are ordinarily large, and nothing is left out. Where dry friction does not
turn round at once with a joint, as the model's does, rows near turns are not judged: in a long log
there are turns so slow that they would be taken for a touch.

Throughout, K is the number of rows of all recordings, J that of joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.estimate.fit import ROUNDS, Fit
from robot_sysid.records import Array
from robot_sysid.signals.frozen import Stretch, true_runs
from robot_sysid.signals.process import TURN_TRAVELS, FilteredRecording, Mask

FAR = 20.0
"""Mean residual, in ordinary sizes of the joint's, of a stretch that is left out: right logs of
real arms reach 18."""
LITTLE = 0.02
"""Share of the torque up to which an error is little: that which logs of real arms without faults
leave unexplained."""
MOST_STRETCHES = 5
"""Number of stretches above which a fault comes back, and is not limited in time."""
MOST_SHARE = 0.3
"""Share of the rows above which a fault is not limited in time."""
END = 4.0
"""Mean residual, in ordinary sizes, at which a stretch that is far from ordinary ends."""
SPIKE = 6.0
"""Residual of a single row, in ordinary sizes, that has no weight in the fit."""
WINDOW = 0.3
"""Time over which residuals are averaged [s]: a knock lasts a tenth of it, a push more."""
LEAST_USED = 1.0 / 3.0
"""Share of a window's rows that have to be used; below it the others count as zero."""
AT_TURNS = 1.4
"""Residuals near turns, over those elsewhere, from which on friction turns round late: sensors
behind the gears see little of it, motor currents much."""
LEAST_ORDINARY = 0.005
"""Least ordinary size, as a share of a joint's torque: no joint is more right than that."""
LEAST_TORQUE = 0.02
"""Least torque of a joint of which this is a share, as a share of the strongest joint's."""
DEVIATION_OVER_MEDIAN = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute values."""


def without_contacts(fitted: Fit) -> Fit:
    """Return a fit without the rows of stretches in which torque is left over, if there are any.

    Each recording says which stretches were found in it (``touched``), also where they are too many
    or too long to be left out.
    """
    judged = replace(fitted, recordings=tuple(without_turns(fitted)))
    is_used = np.concatenate([recording.is_used for recording in judged.recordings])
    residuals = np.where(is_used[:, fitted.arm.indices], fitted.residuals, np.nan)
    if fitted.unexplained_share > LITTLE:
        # A long push makes all residuals large.
        residuals = replace(judged, values=without_worst_blocks(fitted)).residuals
    outlying = None
    # Each fit is without the outlying rows of the one before.
    for _ in range(ROUNDS):
        sizes = ordinary_sizes(fitted, residuals)
        if np.max(mean_sizes(judged, sizes), initial=0.0) < 0.5 * FAR:
            return fitted
        is_far = np.any(np.abs(sizes) > SPIKE, axis=1)
        if outlying is not None and np.array_equal(is_far, outlying):
            break
        outlying = is_far
        current = _refit(fitted, [~rows for rows in fitted.split(is_far)])
        # Rows that are not fitted are judged, too.
        residuals = replace(current, recordings=judged.recordings).residuals
    recordings = []
    means = mean_sizes(judged, sizes)
    for recording, own in zip(fitted.recordings, fitted.split(means)):
        touched = (*_stretches(recording, own),)
        recordings.append(recording.with_all_rows(touched=touched))
    marked = replace(fitted, recordings=tuple(recordings))
    kept = [~touched_rows(recording) for recording in recordings]
    count = sum(len(recording.touched) for recording in recordings)
    is_much = np.mean(np.concatenate(kept)) < 1.0 - MOST_SHARE
    if count == 0 or count > MOST_STRETCHES or is_much:
        return marked
    return _refit(marked, kept)


def without_turns(fitted: Fit) -> list[FilteredRecording]:
    """Return recordings without the rows in which dry friction has not turned round with a joint.

    A joint whose friction turns round at once keeps its rows, which tell most of friction. All
    recordings of a joint are judged together: rows that one keeps and another does not would tell a
    difference between them that is none.
    """
    recordings = fitted.recordings
    zones = [
        np.concatenate([recording.at_turns(travel) for recording in recordings])
        for travel in TURN_TRAVELS
    ]
    is_late = np.zeros_like(zones[0])
    for row, joint in enumerate(fitted.arm.indices.tolist()):
        near = [zone[:, joint] for zone in zones]
        is_late[:, joint] = contradicted_zone(near, fitted.residuals[:, row])
    pairs = zip(recordings, fitted.split(is_late))
    return [recording.only(~own) for recording, own in pairs]


def contradicted_zone(zones: Sequence[Mask], residuals: Array) -> Mask:
    """Return the last of zones (K,), one around the other, in which residuals (K,) are large.

    From the narrowest one on, each has clearly larger ones in what it adds than beyond it.
    """
    last = np.zeros(len(residuals), dtype=bool)
    for zone in zones:
        added = mean_square(residuals[zone & ~last])
        if not added > AT_TURNS**2 * mean_square(residuals[~zone]) > 0.0:
            break
        last = zone
    return last


def mean_square(residuals: Array) -> float:
    """Return the mean square of the residuals (m,) of rows that are used; zero of none."""
    squares = residuals[np.isfinite(residuals)] ** 2
    return float(np.mean(squares)) if len(squares) else 0.0


def without_worst_blocks(fitted: Fit) -> Array:
    """Return the estimate (k,) without the blocks whose rows contradict all others most.

    One after the other is left out, as long as the squared residuals of the others fall by half.
    """
    blocks = [*fitted.sums.blocks]
    values = fitted.values
    left_out: list[int] = []

    def size(values: Array, left: Sequence[int]) -> float:
        """Return the sum over joints of the logarithm of what blocks leave."""
        others = [block for block in blocks if block not in left]
        squares = fitted.equations.squared_residuals(values, others)
        return float(np.sum(np.log(squares + 1e-300)))

    current = size(values, left_out)
    while len(left_out) < MOST_SHARE * len(blocks):
        tried = {}
        for block in blocks:
            if block not in left_out:
                left = [*left_out, block]
                estimate = fitted.solution_of(fitted.normal_without(left))
                tried[block] = size(estimate, left), estimate
        block = min(tried, key=lambda b: tried[b][0])
        if tried[block][0] > current - np.log(2.0):
            break
        current, values = tried[block]
        left_out.append(block)
    return values


def ordinary_sizes(fitted: Fit, residuals: Array) -> Array:
    """Return residuals (K, J) in ordinary sizes of each joint's; zero where a row is not used.

    The ordinary size is the standard deviation of a normal distribution with the same median.
    """
    torque = fitted.sums.rms_torque
    least = LEAST_ORDINARY * np.maximum(torque, LEAST_TORQUE * np.max(torque))
    scaled = np.zeros_like(residuals)
    for joint, residual in enumerate(residuals.T):
        is_used = np.isfinite(residual)
        median = np.median(np.abs(residual[is_used])) if np.any(is_used) else 0.0
        size = max(DEVIATION_OVER_MEDIAN * median, least[joint], 1e-300)
        scaled[:, joint] = np.where(is_used, residual, 0.0) / size
    return scaled


def mean_sizes(fitted: Fit, sizes: Array) -> Array:
    """Return the size (K, J) of means over ``WINDOW`` of sizes (K, J) of residuals.

    Where fewer rows than ``LEAST_USED`` are used, the others count as zero.
    """
    means = []
    for recording, own in zip(fitted.recordings, fitted.split(sizes)):
        width = max(1, round(WINDOW * recording.rate / recording.low_pass.step))
        window = np.ones(min(width, len(own))) / width
        is_used = recording.is_used[:, fitted.arm.indices].astype(float)
        totals, shares = (
            np.stack([np.convolve(column, window, "same") for column in each.T], axis=1)
            for each in (own, is_used)
        )
        means.append(np.abs(totals) / np.maximum(shares, LEAST_USED))
    return np.concatenate(means)


def touched_rows(recording: FilteredRecording) -> Mask:
    """Return which rows (K,) of a recording lie in the stretches that were found in it."""
    time = recording.motion.time
    is_touched = np.zeros(len(time), dtype=bool)
    for stretch in recording.touched:
        is_touched |= (time >= stretch.start) & (time <= stretch.stop)
    return is_touched


def _stretches(recording: FilteredRecording, means: Array) -> Iterator[Stretch]:
    """Yield the stretches of a recording whose mean residuals (K, J) are far from ordinary."""
    time = recording.motion.time
    # Time that the low-pass mixes with what happens in a stretch.
    margin = 0.5 / recording.cutoff
    for rows in true_runs(np.max(means, axis=1) > END):
        joints = np.max(means[rows], axis=0) > FAR
        if np.any(joints):
            start, stop = time[[rows.start, rows.stop - 1]].tolist()
            yield Stretch(start - margin, stop + margin, joints)


def _refit(fitted: Fit, kept: Sequence[Mask]) -> Fit:
    """Return the fit of the same question to some rows (K,) of each recording."""
    recordings = [
        recording.only(rows) for recording, rows in zip(fitted.recordings, kept)
    ]
    sums = fitted.arm.sums(recordings, fitted.point, in_blocks=False)
    problem = replace(fitted, recordings=tuple(recordings), sums=sums)
    return problem.refit(fitted.equations.terms)

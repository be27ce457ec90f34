"""Process a measured log into the signals from which regressors are computed.

1. a uniform time grid (``resampling``);
2. one cut-off for everything, chosen from the data (``cutoff``);
3. positions are low-passed and differentiated (``filters``), those without noise differentiated as
   they are; velocity columns of the log are not
   used: a drive filters and delays them in its own way;
4. regressor columns and torques pass the same low-pass and are decimated to its bandwidth. What
   depends on the sign of a speed is computed at the full rate (``filter_columns``);
5. the ends are cut off. Rows over long holes in the log, or over moments at which a joint is too
   slow for its friction to have a sign, are masked (``ProcessedSignals.usable``).

A filtered row mixes all samples under the filter's window, near a reversal also some in which the
direction of friction is not known. Rows with more than ``LARGEST_SLOW_SHARE`` of the filter's
weight on such samples are masked. In a simulated closed loop a mask that only looks at a row's own
instant leaves errors of 3.8 % in viscous friction, this one 0.9 %.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion
from robot_sysid.records.messages import Detail, percent, position_unit
from robot_sysid.signals.filters import REACH, LowPass, derivatives, design_low_pass
from robot_sysid.signals.frozen import equal_runs
from robot_sysid.signals.resampling import SHORTEST_PIECE, UniformSignals

LARGEST_SLOW_SHARE = 0.07
"""Share of the filter's weight that samples inside the deadband, or in long holes of the log, may
have in a row that is used."""


@dataclass(frozen=True)
class ProcessedSignals:
    """Signals of n joints on a uniform grid of N samples: motion low-passed, torque still raw.

    Attributes:
        time: (N,) [s].
        q: (N, n) positions [rad].
        qd: (N, n) velocities [rad/s].
        qdd: (N, n) accelerations [rad/s^2].
        tau: (N, n) torques, uniform but not filtered, so that they pass the low-pass exactly as
            often as the regressor columns do [N m].
        bridged: (N,) whether the motion of a sample was computed from samples over a long hole in
            the log.
        turning: (N, n) whether a joint may be standing because it turns round.
        deadband: (n,) speed below which the direction of a joint's friction is not sure [rad/s].
        low_pass: the filter for columns and torques.
        notes: what a reader should know about the log.
        acceleration_error: expected error of the acceleration over its root mean square; 0 where
            the cut-off was given.
    """

    time: Array
    q: Array
    qd: Array
    qdd: Array
    tau: Array
    bridged: NDArray[np.bool_]
    turning: NDArray[np.bool_]
    deadband: Array
    low_pass: LowPass
    notes: tuple[str, ...] = ()
    acceleration_error: float = 0.0

    def __len__(self) -> int:
        """Return the number N of samples."""
        return len(self.time)

    @property
    def cutoff(self) -> float:
        """Cut-off of the low-pass [Hz]."""
        return self.low_pass.cutoff

    @property
    def rate(self) -> float:
        """Sample rate of the grid [Hz]."""
        return self.low_pass.rate

    def filter_columns(self, make: Callable[[Motion], Array]) -> Array:
        """Return columns (K, ...) that are made from the motion, low-passed and decimated.

        ``make`` takes the motion at m samples and returns its columns (m, ...).
        """
        low_pass = self.low_pass
        reach = len(low_pass.kernel)
        # Decimated rows that are computed at once: bounds memory, changes no result.
        count = 500
        blocks = []
        for first in range(0, len(self) - reach + 1, count * low_pass.step):
            last = first + (count - 1) * low_pass.step + reach
            blocks.append(low_pass.decimate(make(self.motion(slice(first, last)))))
        return np.concatenate(blocks)

    def motion(self, samples: NDArray[np.int64] | slice) -> Motion:
        """Return the motion (m, n) at ``samples``: m indices of samples, or a slice of them, for
        which the arrays are views.
        """
        return Motion(
            self.time[samples], self.q[samples], self.qd[samples], self.qdd[samples]
        )

    def decimated_motion(self) -> Motion:
        """Return the motion (K, n), low-passed once, at the instants of the decimated rows."""
        lost = self.low_pass.half_width
        return self.motion(slice(lost, len(self) - lost, self.low_pass.step))

    def usable(self) -> NDArray[np.bool_]:
        """Return (K, n) whether each decimated row of each joint may be used: the filter's window
        holds little weight of slow samples, and the row is complete.
        """
        is_slow = np.abs(self.qd) < self.deadband
        moving = self.low_pass.weight_shares(is_slow) <= LARGEST_SLOW_SHARE
        return moving & self.is_complete()[:, None]

    def at_turns(self) -> NDArray[np.bool_]:
        """Return (K, n) whether a joint may be standing under a decimated row's window."""
        return self.low_pass.weight_shares(self.turning) > LARGEST_SLOW_SHARE

    def is_complete(self) -> NDArray[np.bool_]:
        """Return (K,) whether the filter's window of each decimated row holds next to no weight of
        bridged samples.
        """
        return self.low_pass.weight_shares(self.bridged) <= LARGEST_SLOW_SHARE


def process(
    uniform: UniformSignals,
    joint_names: Sequence[str],
    cutoff: float | None = None,
    slides: Collection[str] = (),
) -> ProcessedSignals:
    """Return the processed signals of a log: positions low-passed and differentiated.

    Args:
        uniform: the log, as ``resample_uniformly`` returns it.
        joint_names: for the notes.
        cutoff: of the low-pass [Hz]; None chooses it from the data.
        slides: names of the joints that are slides, for the notes.

    Raises:
        InputError: the log is too short, or the cut-off does not fit its sample rate.
    """
    choice = uniform.choice
    if cutoff is not None:
        choice = choice._replace(cutoff=cutoff, expected_error=0.0)
    low_pass = design_low_pass(choice.cutoff, uniform.rate)
    # Positions with so little noise are differentiated as they are.
    kernel = np.ones(1) if choice.noise_share < 1e-3 else low_pass.kernel
    position_filter = replace(low_pass, step=1, kernel=kernel)
    # Samples that positions and their derivatives lose at each end; torques lose more.
    lost = position_filter.half_width + REACH
    shortest = 2 * (lost + low_pass.half_width) + 10 * low_pass.step
    if len(uniform.q) < shortest:
        raise InputError(
            f"the log's {len(uniform.q) / uniform.rate:.3g} s are too short for a cut-off of "
            f"{choice.cutoff:.3g} Hz, which needs {shortest / uniform.rate:.3g} s; record longer"
        )
    inner = slice(lost, len(uniform.q) - lost)
    q = position_filter.decimate(uniform.q)
    qd, qdd = derivatives(q, uniform.rate)
    # The longest hole that a spline bridges is one of four lost samples, and one period of the
    # cut-off: noise of the samples around it is at most three times the usual noise in a row over
    # them, and grows with the square of their number.
    longest_hole = min(5.5 / uniform.rate, 1.0 / choice.cutoff)
    hole_share = position_filter.weight_shares(uniform.gap > longest_hole)
    # A blow reaches the rows within a quarter of a period of the cut-off.
    reach = np.ones(2 * round(0.25 * uniform.rate / choice.cutoff) + 1)
    stops = abrupt_stops(uniform.time, uniform.q)
    stops = np.convolve(stops, reach, "same")[: len(stops)] > 0.0
    stop_share = position_filter.weight_shares(stops)
    # Below this share of its peak speed a joint has hardly left stiction.
    deadband = 0.005 * np.max(np.abs(qd), axis=0)
    signals = ProcessedSignals(
        time=uniform.time[inner],
        q=q[REACH:-REACH],
        qd=qd,
        qdd=qdd,
        tau=uniform.tau[inner],
        bridged=(hole_share + stop_share)[REACH:-REACH] > LARGEST_SLOW_SHARE,
        turning=turning_samples(uniform.q[inner], q[REACH:-REACH], qd),
        deadband=np.maximum(deadband, 1e-3),  # encoder noise alone can look so fast
        low_pass=low_pass,
        acceleration_error=choice.expected_error,
    )
    filter_note = Detail(f"low-pass with a cut-off of {choice.cutoff:.4g} Hz")
    row_notes = _notes(signals, joint_names, slides, longest_hole)
    return replace(signals, notes=(*uniform.notes, filter_note, *row_notes))


def _notes(
    signals: ProcessedSignals,
    joint_names: Sequence[str],
    slides: Collection[str],
    longest_hole: float,
) -> Iterator[str]:
    """Yield sentences for the user on the rows of processed signals; a ``Detail`` is printed on
    demand only.

    Args:
        signals: the processed signals.
        joint_names: names of the joints.
        slides: names of those that are slides.
        longest_hole: length of a hole in the log beyond which rows beside it are not used [s].
    """
    is_complete = signals.is_complete()
    missing = 1.0 - float(np.mean(is_complete))
    if missing > 0.0:
        note = (
            f"{percent(missing)} of the rows lie next to lost samples (gaps of more than "
            f"{1e3 * longest_hole:.3g} ms) or what is left out, and are not used"
        )
        yield note if missing > 0.05 else Detail(note)
    usable = np.count_nonzero(signals.usable(), axis=0)
    shares = usable / max(np.count_nonzero(is_complete), 1)
    for name, share, deadband in zip(joint_names, shares, signals.deadband):
        if share < 0.5:
            unit = position_unit(name in slides)
            yield (
                f"only {percent(share)} of the rows of joint {name} are used: in the others it is "
                f"slower than {deadband:.2g} {unit}/s, where the direction of friction is not sure"
            )


def turning_samples(readings: Array, q: Array, qd: Array) -> NDArray[np.bool_]:
    """Return at which samples (N, n) a joint may be standing while it turns round.

    A joint with dry friction does not turn round at once: it stands until its torque has changed by
    twice the friction, 20 to 60 ms under a stiff controller. Low-passed positions show a smooth
    turn instead, with a speed that has a sign at every moment, and Coulomb friction computed from
    that sign is wrong by up to twice its size, in the direction of the acceleration at every turn:
    it looks like rotor inertia. A joint may be standing until a reading differs clearly from the
    outermost one; a joint that turns round without standing is marked for as long.

    Args:
        readings: (N, n) positions as they were read [rad].
        q: (N, n) low-passed positions [rad].
        qd: (N, n) low-passed velocities, whose sign shows the turns [rad/s].
    """
    is_turning = np.zeros(qd.shape, dtype=bool)
    # The median of the size of a standard normal number is 0.6745. Readings that differ by six
    # deviations do not differ by chance; if they are rounded, that is between one step and two.
    clear = 6.0 * np.median(np.abs(readings - q), axis=0) / 0.6745
    for joint, (reading, speed) in enumerate(zip(readings.T, qd.T)):
        # Around each turn, the samples from the turn before it to the turn after it.
        turns = np.flatnonzero(np.diff(np.sign(speed))) + 1
        edges = [0, *turns.tolist(), len(speed)]
        for start, turn, stop in zip(edges, edges[1:], edges[2:]):
            # 1 where the joint turns at its highest position, -1 at its lowest.
            outward = np.sign(speed[turn - 1] - speed[turn])
            height = outward * reading[start:stop]
            is_away = np.max(height) - height > clear[joint]
            away = start + np.flatnonzero(is_away)
            first = np.max(away[away < turn] + 1, initial=start)
            last = np.min(away[away >= turn], initial=stop)
            is_turning[first:last, joint] = True
    return is_turning


def abrupt_stops(time: Array, readings: Array) -> NDArray[np.bool_]:
    """Return at which samples (N,) a joint stops or starts at once, as at the end of its range.

    Its acceleration there is that of a blow, which no motor makes. From one sample to the next its
    speed is lost, to stand still for a while.

    Args:
        time: (N,) [s].
        readings: (N, n) positions as they were read [rad].
    """
    is_stop = np.zeros(len(readings), dtype=bool)
    for reading in readings.T:
        steps = np.abs(np.diff(reading))
        least = 0.1 * np.max(steps)
        for run in equal_runs(time, reading):
            # A slow joint of a coarse encoder has steps of one count between such of none.
            before = steps[max(run.start - 3, 0) : run.start]
            after = steps[run.stop - 1 : run.stop + 2]
            is_stop[run.start] |= len(before) > 0 and np.min(before) > least
            is_stop[run.stop - 1] |= len(after) > 0 and np.min(after) > least
    return is_stop


def check_losses(recordings: Sequence[ProcessedSignals]) -> None:
    """Raise InputError where lost samples spoil most rows of a log's pieces, and the others last
    less than ``SHORTEST_PIECE``.
    """
    is_complete = np.concatenate([signals.is_complete() for signals in recordings])
    entire_time = sum(len(signals) / signals.rate for signals in recordings)
    used_time = float(np.mean(is_complete)) * entire_time
    if used_time < min(SHORTEST_PIECE, 0.5 * entire_time):
        raise InputError(
            f"only {used_time:.2g} s of {entire_time:.3g} s are free of lost samples, which is too "
            "little for an estimate; record without losses, for example on the computer that "
            "controls the arm"
        )

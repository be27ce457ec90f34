"""Process a measured log into the signals from which regressors are computed.

1. a uniform time grid (``resampling``);
2. one cut-off for everything, chosen from the data (``cutoff``);
3. positions are low-passed and differentiated (``filters``), those without noise differentiated as
   they are; velocity columns of the log are not
   used: a drive filters and delays them in its own way;
4. regressor columns and torques pass the same low-pass and are decimated to its bandwidth. What
   depends on the sign of a speed is computed at the full rate (``filter_columns``);
5. the ends are cut off. Rows over long holes in the log, or over moments at which a joint is too
   slow for its friction to have a sign, are masked (``ProcessedSignals.usable``). Where a joint's
   torque shows that it stands still as it turns round, the rows over its turns are masked too
   (``turning_samples``).

A filtered row mixes all samples under the filter's window, near a reversal also some in which the
direction of friction is not known. Rows with more than ``LARGEST_SLOW_SHARE`` of the filter's
weight on such samples are masked. In a simulated closed loop a mask that only looks at a row's own
instant leaves errors of 3.8 % in viscous friction, this one 0.9 %.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement, Motion
from robot_sysid.records.messages import Detail, percent
from robot_sysid.signals.cutoff import (
    CutoffChoice,
    Spectra,
    acceleration_spectra,
    choose_cutoff,
)
from robot_sysid.signals.filters import REACH, LowPass, derivatives, design_low_pass
from robot_sysid.signals.resampling import (
    SHORTEST_PIECE,
    UniformSignals,
    resample_uniformly,
)

LARGEST_SLOW_SHARE = 0.07
"""Share of the filter's weight that samples inside the deadband, or in long holes of the log, may
have in a row that is used."""
DEADBAND_SHARE = 0.005
"""Deadband over a joint's peak speed: below it the joint has hardly left stiction (chosen)."""
_LEAST_DEADBAND = 1e-3
"""Least deadband [rad/s]: encoder noise alone can look like this speed."""
_LONGEST_HOLE_STEPS = 5.5
"""Longest hole in the log, in sampling periods, that a spline bridges, at most one period of the
cut-off: noise of the samples around
four lost ones is at most three times the usual noise in a row over them, and grows with the
square of their number (tests/signals/test_process.py)."""
_BLOCK = 500
"""Decimated rows that are computed at once: bounds memory, changes no result."""
_EXACT = 1e-3
"""Largest noise of the acceleration, over all frequencies and relative to the motion's, at which
positions are differentiated as they are."""
_NOTED_SHARE = 0.05
"""Share of the rows lost beside holes above which that is printed (chosen)."""
SEPARATION = 6.0
"""Difference of two readings, in standard deviations of their noise, beyond which they do not
differ by chance. For readings that are rounded to steps this is between one step and two
(chosen)."""


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
        deadband: (n,) speed below which the direction of a joint's friction is not sure [rad/s].
        turning: (N, n) whether a joint may be standing because it turns round.
        low_pass: the filter for columns and torques.
        notes: what a reader should know about the log.
        acceleration_error: expected error of the acceleration over its root mean square; 0 where
            the cut-off was given.
        standing: indices of the joints that stand as they turn round, so that their rows over turns
            are not used.
    """

    time: Array
    q: Array
    qd: Array
    qdd: Array
    tau: Array
    bridged: NDArray[np.bool_]
    deadband: Array
    turning: NDArray[np.bool_]
    low_pass: LowPass
    notes: tuple[str, ...] = ()
    acceleration_error: float = 0.0
    standing: tuple[int, ...] = ()

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

    def filter_columns(
        self, make_columns: Callable[[Motion], Iterable[Array]], smooth: bool = False
    ) -> list[Array]:
        """Return arrays (K, ...) that are computed from the motion, low-passed and decimated.

        Args:
            make_columns: takes a motion of m samples and yields arrays (m, ...), the same number
                of arrays in every call.
            smooth: whether the arrays are smooth functions of the motion (no sign of a speed), so
                that they need fewer samples.
        """
        low_pass = self.low_pass
        decimate = low_pass.decimate_smooth if smooth else low_pass.decimate
        n_rows = len(low_pass.centres(len(self)))
        blocks = []
        for start in range(0, n_rows, _BLOCK):
            window = low_pass.window(start, min(_BLOCK, n_rows - start), smooth)
            blocks.append(list(map(decimate, make_columns(self.motion(window)))))
        return list(map(np.concatenate, zip(*blocks)))

    def motion(self, samples: NDArray[np.int64] | slice) -> Motion:
        """Return the motion (m, n) at ``samples``: m indices of samples, or a slice of them, for
        which the arrays are views.
        """
        return Motion(
            self.time[samples], self.q[samples], self.qd[samples], self.qdd[samples]
        )

    def decimated_motion(self) -> Motion:
        """Return the motion (K, n), low-passed once, at the instants of the decimated rows."""
        return self.motion(self.low_pass.centres(len(self)))

    def decimated_time(self) -> Array:
        """Return (K,) the instants of the decimated rows [s]."""
        return self.time[self.low_pass.centres(len(self))]

    def usable(self) -> NDArray[np.bool_]:
        """Return (K, n) whether each decimated row of each joint may be used: the filter's window
        holds little weight of slow or standing samples, and the row is complete.
        """
        moving = self.slow_share() <= LARGEST_SLOW_SHARE
        return moving & self.is_complete()[:, None]

    def slow_share(self) -> Array:
        """Return (K, n) the share of each decimated row's weight that lies on samples inside the
        deadband, or on samples at which a joint stands as it turns round.
        """
        is_slow = np.less(np.abs(self.qd), self.deadband)
        for joint in self.standing:
            is_slow[:, joint] |= self.turning[:, joint]
        return self.low_pass.weight_shares(is_slow)

    def is_complete(self) -> NDArray[np.bool_]:
        """Return (K,) whether the filter's window of each decimated row holds next to no weight of
        bridged samples.
        """
        return self.low_pass.weight_shares(self.bridged) <= LARGEST_SLOW_SHARE


@dataclass(frozen=True)
class LogPiece(Measurement):
    """A piece of a log; what processing needs first is computed once and cached."""

    @classmethod
    def of(cls, measurement: Measurement) -> LogPiece:
        """Return a measurement as a log piece; the argument itself where it is one already."""
        return measurement if isinstance(measurement, cls) else cls(**vars(measurement))

    @cached_property
    def uniform(self) -> UniformSignals:
        """The piece on a uniform grid; InputError where the piece is too short."""
        return resample_uniformly(self)

    @cached_property
    def spectra(self) -> Spectra | None:
        """Spectra that a cut-off is chosen from; None where the piece is too short for them."""
        return acceleration_spectra(self.uniform.q, self.uniform.rate)

    @cached_property
    def choice(self) -> CutoffChoice:
        """The cut-off chosen for the piece; InputError where the piece is too short."""
        if self.spectra is None:
            raise InputError(
                f"{len(self.uniform.q)} samples are too few to choose a cut-off from; record longer"
            )
        return choose_cutoff(self.spectra)


def process(
    measurement: Measurement,
    joint_names: Sequence[str] = (),
    cutoff: float | None = None,
    chosen_by: str = "as given",
) -> ProcessedSignals:
    """Return the processed signals of a log: resampled, positions low-passed and differentiated.

    Args:
        measurement: the log; it is not changed.
        joint_names: for the notes; numbers stand for joints without a name.
        cutoff: of the low-pass [Hz]; None chooses it from the data.
        chosen_by: where a given cut-off comes from, in words.

    Raises:
        InputError: the log is too short, or the cut-off does not fit its sample rate.
    """
    piece = LogPiece.of(measurement)
    uniform = piece.uniform
    expected_error = 0.0
    if cutoff is None:
        cutoff, expected_error, reason = piece.choice
    else:
        reason = f"cut-off {cutoff:.4g} Hz {chosen_by}"
    low_pass = design_low_pass(cutoff, uniform.rate)
    position_filter = replace(low_pass, step=1)
    if piece.spectra is not None and piece.spectra.noise_share < _EXACT:
        position_filter = replace(position_filter, kernel=np.ones(1))
    # Samples that positions and their derivatives lose at each end; torques lose more.
    lost = position_filter.half_width + REACH
    shortest = 2 * (lost + low_pass.half_width) + 10 * low_pass.step
    if len(uniform.q) < shortest:
        raise InputError(
            f"the log's {len(uniform.q) / uniform.rate:.3g} s are too short for a cut-off of "
            f"{cutoff:.3g} Hz, which needs {shortest / uniform.rate:.3g} s; record longer"
        )
    inner = slice(lost, len(uniform.q) - lost)
    q = position_filter.filter(uniform.q)
    qd, qdd = derivatives(q, uniform.rate)
    longest_hole = min(_LONGEST_HOLE_STEPS / uniform.rate, 1.0 / cutoff)
    hole_share = position_filter.weight_shares(uniform.gap > longest_hole)
    turning = np.zeros(qd.shape, dtype=bool)
    if piece.spectra is not None:
        noise = piece.spectra.position_noise
        turning = turning_samples(uniform.q[inner], qd, noise)
    peak_speed = np.max(np.abs(qd), axis=0)
    signals = ProcessedSignals(
        time=uniform.start + np.arange(len(uniform.q))[inner] / uniform.rate,
        q=q[REACH:-REACH],
        qd=qd,
        qdd=qdd,
        tau=uniform.tau[inner],
        bridged=hole_share[REACH:-REACH] > LARGEST_SLOW_SHARE,
        deadband=np.maximum(DEADBAND_SHARE * peak_speed, _LEAST_DEADBAND),
        turning=turning,
        low_pass=low_pass,
        acceleration_error=expected_error,
    )
    row_notes = _notes(signals, joint_names, longest_hole)
    return replace(signals, notes=(*uniform.notes, Detail(reason), *row_notes))


def _notes(
    signals: ProcessedSignals, joint_names: Sequence[str], longest_hole: float
) -> Iterator[str]:
    """Yield sentences for the user on the rows of processed signals; a ``Detail`` is printed on
    demand only.

    Args:
        signals: the processed signals.
        joint_names: numbers stand for joints without a name.
        longest_hole: length of a hole in the log beyond which rows beside it are not used [s].
    """
    usable = signals.usable()
    is_complete = signals.is_complete()
    yield Detail(
        f"signals at {signals.rate:.6g} Hz, decimated to "
        f"{signals.rate / signals.low_pass.step:.4g} Hz: {len(usable)} rows per joint"
    )
    missing = 1.0 - float(np.mean(is_complete))
    if missing > 0.0:
        note = (
            f"{percent(missing)} of the rows lie next to lost samples (gaps of more than "
            f"{1e3 * longest_hole:.3g} ms) or what is left out, and are not used"
        )
        yield note if missing > _NOTED_SHARE else Detail(note)
    if missing == 1.0:
        return
    rows = "rows" if missing == 0.0 else "other rows"
    for joint, share in enumerate(np.mean(usable[is_complete], axis=0)):
        name = joint_names[joint] if joint < len(joint_names) else str(joint + 1)
        if share < 0.5:
            yield (
                f"only {100 * share:.0f} % of the {rows} of joint {name} are used: otherwise it is "
                f"slower than its velocity deadband of {signals.deadband[joint]:.2g} rad/s"
            )


def turning_samples(readings: Array, qd: Array, noise: Array) -> NDArray[np.bool_]:
    """Return at which samples (N, n) a joint may be standing while it turns round.

    A joint with dry friction does not turn round at once: it stands until its torque has changed by
    twice the friction, 20 to 60 ms under a stiff controller. Low-passed positions show a smooth
    turn instead, with a speed that has a sign at every moment, and Coulomb friction computed from
    that sign is wrong by up to twice its size. The error has the direction of the acceleration at
    every turn, so it does not average out: in rehearsals on simulated motors it looked like 10 to
    90 % more rotor inertia. A joint may be standing until a reading differs clearly from the
    outermost one; a joint that turns round without standing is marked for as long.

    Args:
        readings: (N, n) positions as they were read [rad].
        qd: (N, n) low-passed velocities, whose sign shows the turns [rad/s].
        noise: (n,) standard deviation of the readings [rad].
    """
    is_turning = np.zeros(qd.shape, dtype=bool)
    for joint, (reading, speed) in enumerate(zip(readings.T, qd.T)):
        distance = SEPARATION * noise[joint]
        # Around each turn, the samples from the turn before it to the turn after it.
        turns = np.flatnonzero(np.diff(np.sign(speed))) + 1
        edges = [0, *turns.tolist(), len(speed)]
        for start, turn, stop in zip(edges, edges[1:], edges[2:]):
            # 1 where the joint turns at its highest position, -1 at its lowest.
            outward = np.sign(speed[turn - 1] - speed[turn])
            height = outward * reading[start:stop]
            away = start + np.flatnonzero(np.max(height) - height > distance)
            first = np.max(away[away < turn] + 1, initial=start)
            last = np.min(away[away >= turn], initial=stop)
            is_turning[first:last, joint] = True
    return is_turning


def with_delay(signals: ProcessedSignals, delay: float) -> ProcessedSignals:
    """Return the signals with the torque moved ``delay`` [s] earlier, for a torque that lags by
    that much; negative if it leads.

    Samples at the ends for which the shifted torque has no value are cut off.

    Raises:
        InputError: fewer samples are left than the low-pass needs.
    """
    from scipy.ndimage import shift

    samples = delay * signals.rate
    lost = math.ceil(abs(samples)) + _SPLINE_REACH
    if len(signals) - 2 * lost < len(signals.low_pass.kernel):
        raise InputError(f"a delay of {delay:g} s leaves nothing of the log")
    later = shift(signals.tau, (-samples, 0.0), order=5, mode="nearest")
    span = slice(lost, len(signals) - lost)
    names = "time", "q", "qd", "qdd", "bridged", "turning"
    cut = {name: getattr(signals, name)[span] for name in names}
    return replace(signals, tau=later[span], **cut)


_SPLINE_REACH = 24
"""Samples from the end of a log over which a spline of fifth order feels it (chosen)."""


def check_losses(recordings: Sequence[ProcessedSignals]) -> None:
    """Raise InputError where lost samples spoil most rows of a log's pieces, and the others last
    less than ``SHORTEST_PIECE``.
    """
    used_time = 0.0
    entire_time = 0.0
    for signals in recordings:
        is_complete = signals.is_complete()
        period = signals.low_pass.step / signals.rate
        used_time += np.count_nonzero(is_complete) * period
        entire_time += len(is_complete) * period
    if used_time < min(SHORTEST_PIECE, 0.5 * entire_time):
        raise InputError(
            f"only {used_time:.2g} s of {entire_time:.3g} s are free of lost samples, which is too "
            "little for an estimate; record without losses, for example on the computer that "
            "controls the arm"
        )

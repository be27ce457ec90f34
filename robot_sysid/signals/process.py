"""Process a measured log into the signals from which regressors are computed.

1. a uniform time grid (``resampling``);
2. one low-pass for everything, its cut-off chosen from the data (``cutoff``, ``filters``);
3. positions are low-passed and differentiated, those without noise differentiated as they are;
   velocity columns of the log are not used: a drive filters and delays them in its own way;
4. regressor columns and torques pass the same low-pass and are decimated to its bandwidth. What
   depends on the sign of a speed is computed at the full rate
   (``ProcessedSignals.filter_columns``);
5. the ends are cut off. Rows over long holes in the log, over corners of motion without noise, or
   over moments at which a joint is too slow for its friction to have a sign, are masked
   (``ProcessedSignals.usable``). Where a joint's torque shows that it stands still as it turns
   round, the rows over its turns are masked too (``turning_samples``).

A filtered row mixes all samples under the filter's window, near a reversal also some in which the
direction of friction is not known. Rows with more than ``LARGEST_SLOW_SHARE`` of the filter's
weight on such samples are masked. In a simulated closed loop a mask that only looks at a row's own
instant leaves errors of 3.8 % in viscous friction, this one 0.9 % (benchmarks/reversal_masking.py).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
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
    acceleration_noise,
    acceleration_spectra,
    choose_cutoff,
    quantisation_error,
)
from robot_sysid.signals.filters import (
    ATTENUATION,
    CHUNK,
    FINE_REACH,
    REACH,
    Decimator,
    LowPass,
    design_low_pass,
    first_derivative,
    second_derivative,
    shift_samples,
)
from robot_sysid.signals.resampling import (
    SHORTEST_PIECE,
    UniformSignals,
    resample_uniformly,
)

LARGEST_SLOW_SHARE = 0.07
"""Share of the filter's weight that samples inside the deadband, or in long holes of the log, may
have in a row that is used; benchmarks/reversal_masking.py compares it with others."""
DEADBAND_SHARE = 0.005
"""Deadband over a joint's peak speed: below it the joint has hardly left stiction (chosen)."""
LEAST_DIRECTION_SHARE = 0.05
"""Share of the samples in each direction below which a joint is reported (chosen)."""
_LEAST_DEADBAND = 1e-3
"""Least deadband [rad/s]: encoder noise alone can look like this speed."""
_LONGEST_HOLE_STEPS = 5.5
"""Longest hole in the log, in sampling periods, that a spline bridges, at most one period of the
cut-off: noise of the samples around
four lost ones is at most three times the usual noise in a row over them, and grows with the
square of their number (tests/signals/test_process.py)."""
_RIPPLE_SHARE = 0.0045
"""Ripple of the position filter's pass band over the relative noise of the acceleration. With this
ratio the error of a result by the ripple is small beside its error by noise; it is the ratio of the
usual filter at the highest cut-off that noise allows."""
_LARGEST_ATTENUATION = 150.0
"""Largest attenuation of the filter of positions with little noise [dB]; more is lost in
rounding."""
_NOISELESS = 1e-3 / 67.0
"""Largest median difference of second derivatives of orders sixteen and fourteen, relative to the
acceleration, at which positions need no filter. The noise of the acceleration is 67 times this
difference, so at most 1e-3."""
_CORNER_RATIO = 20.0
"""Multiple of its median above which the difference of second derivatives of orders sixteen and
fourteen shows a corner of the motion: a jump of a higher derivative."""
_LEAST_CLEAN_SHARE = 0.5
"""Least share of the log that has to be free of corners for positions to pass no filter."""
_NOTED_SHARE = 0.05
"""Share of the rows lost beside holes or corners above which that is printed (chosen)."""
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
            the log, or across a corner of motion without noise.
        deadband: (n,) speed below which the direction of a joint's friction is not sure [rad/s].
        turning: (N, n) whether a joint may be standing because it turns round.
        low_pass: the filter for regressor columns and torques.
        position_filter: the filter that positions have passed; of one weight where they are free
            of noise.
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
    position_filter: LowPass
    notes: tuple[str, ...]
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
    def is_noiseless(self) -> bool:
        """Whether positions are free of noise and have passed no filter."""
        return self.position_filter.half_width == 0

    @property
    def rate(self) -> float:
        """Sample rate of the grid [Hz]."""
        return self.low_pass.rate

    def filter_columns(
        self,
        make_columns: Callable[[Motion], Iterable[Array]],
        smooth: bool = False,
        chunk: int = CHUNK,
    ) -> list[Array]:
        """Return arrays (K, ...) that are computed from the motion, low-passed and decimated.

        Args:
            make_columns: takes a motion of m samples and yields arrays (m, ...), the same number
                of arrays in every call; called once per chunk, in the order of time.
            smooth: whether the arrays are smooth functions of the motion (no sign of a speed), so
                that they need fewer samples (``LowPass.at_lower_rate``).
            chunk: largest number m of samples at a time; never more than ``CHUNK``.
        """
        stride = self.low_pass.stride if smooth else 1
        low_pass = self.low_pass.at_lower_rate(stride)
        size = min(chunk, CHUNK) * stride
        decimators: defaultdict[int, Decimator]
        decimators = defaultdict(lambda: Decimator(low_pass))
        decimated: defaultdict[int, list[Array]] = defaultdict(list)
        for start in range(0, len(self), size):
            motion = self.motion(slice(start, start + size, stride))
            for number, values in enumerate(make_columns(motion)):
                decimated[number].append(decimators[number].push(values))
        return [np.concatenate(chunks) for chunks in decimated.values()]

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

    def spread_indices(self, count: int) -> NDArray[np.int64]:
        """Return the ascending indices of at most ``count`` samples, spread evenly over the log."""
        indices = np.linspace(0, len(self) - 1, count)
        return np.unique(indices.astype(int))

    def decimated_time(self) -> Array:
        """Return (K,) the instants of the decimated rows [s]."""
        return self.time[self.low_pass.centres(len(self))]

    def slow_share(self) -> Array:
        """Return (K, n) the share of each decimated row's weight that lies on samples inside the
        deadband, or on samples at which a joint stands as it turns round.
        """
        is_slow = np.less(np.abs(self.qd), self.deadband)
        for joint in self.standing:
            is_slow[:, joint] |= self.turning[:, joint]
        return self.low_pass.weight_shares(is_slow)

    def one_way_joints(self, joint_names: Sequence[str]) -> Iterator[str]:
        """Yield a sentence per joint that hardly moves in one of its two directions."""
        forward = np.mean(self.qd > self.deadband, axis=0)
        backward = np.mean(self.qd < -self.deadband, axis=0)
        is_one_way = np.minimum(forward, backward) < LEAST_DIRECTION_SHARE
        for joint in np.flatnonzero(is_one_way).tolist():
            yield (
                f"{joint_names[joint]} moves faster than {self.deadband[joint]:.2g} rad/s in "
                f"{100.0 * forward[joint]:.0f} % of the samples forwards and in "
                f"{100.0 * backward[joint]:.0f} % backwards; to tell Coulomb friction from an "
                "offset, let it move faster and both ways"
            )

    def usable(self) -> NDArray[np.bool_]:
        """Return (K, n) whether each decimated row of each joint may be used: the filter's window
        holds little weight of slow or standing samples, and the row is complete.
        """
        moving = self.slow_share() <= LARGEST_SLOW_SHARE
        return moving & self.is_complete()[:, None]

    def is_complete(self) -> NDArray[np.bool_]:
        """Return (K,) whether the filter's window of each decimated row holds next to no weight of
        bridged samples, and none at all in motion without noise, which is differentiated exactly.
        """
        largest_share = 0.0 if self.is_noiseless else LARGEST_SLOW_SHARE
        return self.low_pass.weight_shares(self.bridged) <= largest_share


@dataclass(frozen=True)
class LogPiece(Measurement):
    """A piece of a log; its spectra are computed once and cached, however often it is processed."""

    @classmethod
    def of(cls, measurement: Measurement) -> LogPiece:
        """Return a measurement as a log piece; the argument itself, with its cached spectra, where
        that is a log piece already.
        """
        return measurement if isinstance(measurement, cls) else cls(**vars(measurement))

    def without_velocities(self) -> LogPiece:
        """Return the piece, its cached spectra included, without the measured velocities."""
        # A copy has the cached values too, which depend on no velocity; a new record would not.
        piece = copy(self)
        object.__setattr__(piece, "qd", None)
        return piece

    @cached_property
    def spectra(self) -> Spectra | None:
        """Spectra that a cut-off is chosen from; None where the piece is too short for them."""
        uniform = resample_uniformly(self)
        # The steps of encoders are found in the raw readings: interpolation rounds them off.
        errors = quantisation_error(self.q, self.joint_time)
        steps = resample_uniformly(replace(self, q=errors)).q
        return acceleration_spectra(uniform.q, uniform.rate, steps)

    @cached_property
    def choice(self) -> CutoffChoice:
        """The cut-off chosen for the piece; InputError where the piece is too short."""
        if self.spectra is None:
            count = len(resample_uniformly(self).q)
            raise InputError(
                f"{count} samples are too few to choose a cut-off from; record longer"
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
    uniform = resample_uniformly(measurement)
    expected_error = 0.0
    piece = LogPiece.of(measurement)
    if cutoff is None:
        cutoff, expected_error, reason = piece.choice
    else:
        reason = f"cut-off {cutoff:.4g} Hz {chosen_by}"
    low_pass = design_low_pass(cutoff, uniform.rate)
    shortest = _fewest_samples(low_pass)
    if len(uniform.q) < shortest:
        raise InputError(
            f"the log's {len(uniform.q) / low_pass.rate:.3g} s are too short for a cut-off of "
            f"{low_pass.cutoff:.3g} Hz, which needs {shortest / low_pass.rate:.3g} s; record longer"
        )
    corners = _corners(uniform, low_pass)
    position_filter = replace(low_pass, kernel=np.ones(1))
    reach = FINE_REACH
    if corners is None:
        position_filter, reach = _position_filter(low_pass, uniform, piece.spectra)
    q = position_filter.filter(uniform.q)
    lost = position_filter.half_width + reach
    longest_hole = min(_LONGEST_HOLE_STEPS / uniform.rate, 1.0 / cutoff)
    is_hole = uniform.gap > longest_hole
    qd = first_derivative(q, uniform.rate, reach)
    qdd = second_derivative(q, uniform.rate, reach)
    peak_speed = np.max(np.abs(qd), axis=0)
    turning = np.zeros(qd.shape, dtype=bool)
    if corners is None and piece.spectra is not None:
        # Of positions without noise any speed has a sign.
        turning = turning_samples(
            uniform.q[lost:-lost], qd, piece.spectra.position_noise
        )
    signals = ProcessedSignals(
        time=uniform.start + np.arange(lost, len(uniform.q) - lost) / uniform.rate,
        q=q[reach:-reach],
        qd=qd,
        qdd=qdd,
        # A view would keep the torque of the whole log.
        tau=uniform.tau[lost:-lost].copy(),
        bridged=_bridged(is_hole, corners, position_filter, reach),
        deadband=np.maximum(DEADBAND_SHARE * peak_speed, _LEAST_DEADBAND),
        turning=turning,
        low_pass=low_pass,
        position_filter=position_filter,
        notes=(),
        acceleration_error=expected_error,
    )
    obstacle = "jumps of the acceleration"
    if np.any(is_hole):
        longest = f"{1e3 * longest_hole:.3g} ms"
        obstacle = f"lost samples (gaps of more than {longest}) or what is left out"
    row_notes = _notes(signals, joint_names, obstacle)
    notes = (*uniform.notes, Detail(reason), *row_notes)
    return replace(signals, notes=notes)


def with_delay(signals: ProcessedSignals, delay: float) -> ProcessedSignals:
    """Return the signals with the torque moved ``delay`` [s] earlier, for a torque that lags by
    that much; negative if it leads.

    Samples at the ends for which the shifted torque has no value are cut off.

    Raises:
        InputError: fewer samples are left than the low-pass needs.
    """
    tau, first = shift_samples(signals.tau, delay * signals.rate)
    if len(tau) < len(signals.low_pass.kernel):
        raise InputError(f"a delay of {delay:g} s leaves nothing of the log")
    span = slice(first, first + len(tau))
    names = "time", "q", "qd", "qdd", "bridged", "turning"
    cut = {name: getattr(signals, name)[span] for name in names}
    return replace(signals, tau=tau, **cut)


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


def _corners(uniform: UniformSignals, low_pass: LowPass) -> NDArray[np.bool_] | None:
    """Return where (N - 2 FINE_REACH,) motion without noise has corners; None where it has noise,
    or too many corners.

    Two orders of a derivative differ by noise and by what the sample rate does not resolve: next to
    nothing in smooth motion, and a lot around a jump of a higher derivative.
    """
    fine = second_derivative(uniform.q, uniform.rate, FINE_REACH)
    largest = np.max(np.sqrt(np.mean(fine**2, axis=0)))
    fine -= second_derivative(uniform.q[1:-1], uniform.rate, FINE_REACH - 1)
    difference = np.max(np.abs(fine), axis=1, initial=0.0)
    steps = np.diff(uniform.q[FINE_REACH - 1 : -FINE_REACH], axis=0)
    moves = np.any(steps != 0.0, axis=1)
    median = np.median(difference[moves]) if np.any(moves) else math.inf
    if median > _NOISELESS * largest:
        return None
    # Two samples more on each side: near a corner the two derivatives may agree by chance.
    is_rough = difference > _CORNER_RATIO * median
    corners = np.convolve(is_rough, np.ones(5), "same") > 0.0
    count = np.concatenate(([0], np.cumsum(corners)))
    width = len(low_pass.kernel)
    is_clean = count[width:] == count[:-width]
    return corners if np.mean(is_clean) >= _LEAST_CLEAN_SHARE else None


def _bridged(
    is_hole: NDArray[np.bool_],
    corners: NDArray[np.bool_] | None,
    position_filter: LowPass,
    reach: int,
) -> NDArray[np.bool_]:
    """Return where the motion comes from samples in holes, or across corners of motion without
    noise.

    Args:
        is_hole: (N,) whether a sample lies in a long hole of the log.
        corners: (N - 2 reach,) where motion without noise has corners; None where it has noise.
        position_filter: the filter of positions.
        reach: of the derivatives [samples].
    """
    if corners is None:
        every_sample = replace(position_filter, step=1)
        shares = every_sample.weight_shares(is_hole)
        return shares[reach : len(shares) - reach] > LARGEST_SLOW_SHARE
    # Nothing damps what a derivative makes of a wrong sample.
    near_hole = np.convolve(is_hole, np.ones(2 * reach + 1), "valid") > 0.0
    return corners | near_hole


def _position_filter(
    low_pass: LowPass, uniform: UniformSignals, spectra: Spectra | None
) -> tuple[LowPass, int]:
    """Return the low-pass for positions and the reach of their derivatives.

    Torques do not pass the filter of positions, so its ripple scales motion, and with it the
    identified parameters, by up to 1 + ripple. The lower the noise of positions, the flatter is the
    filter, at the cost of more samples at the ends.

    Args:
        low_pass: the filter of regressor columns and torques.
        uniform: the log; its length bounds that of the filter.
        spectra: of the log's accelerations; None where it is too short for them.
    """
    noise = acceleration_noise(spectra, low_pass.cutoff)
    ripple = max(_RIPPLE_SHARE * noise, 10.0 ** (-_LARGEST_ATTENUATION / 20.0))
    attenuation = -20.0 * math.log10(min(ripple, 1.0))
    if attenuation <= ATTENUATION:
        return low_pass, REACH
    flat = design_low_pass(low_pass.cutoff, low_pass.rate, attenuation)
    # Samples that the flat filter and its derivatives lose at both ends beyond the usual ones.
    extra_loss = 2 * (flat.half_width - low_pass.half_width + FINE_REACH - REACH)
    fits = extra_loss <= len(uniform.q) - _fewest_samples(low_pass)
    return (flat, FINE_REACH) if fits else (low_pass, REACH)


def _fewest_samples(low_pass: LowPass) -> int:
    """Return the number of samples below which a log is too short for a low-pass: those that
    positions, their derivatives and regressor columns lose at both ends, and ten decimated rows.
    """
    return 4 * low_pass.half_width + 2 * REACH + 10 * low_pass.step


def _notes(
    signals: ProcessedSignals, joint_names: Sequence[str], obstacle: str
) -> Iterator[str]:
    """Yield sentences for the user on the rows of processed signals; a ``Detail`` is printed on
    demand only.

    Args:
        signals: the processed signals.
        joint_names: numbers stand for joints without a name.
        obstacle: what rows that are not complete lie next to.
    """
    usable = signals.usable()
    is_complete = signals.is_complete()
    lost = signals.low_pass.half_width + signals.position_filter.half_width + REACH
    yield Detail(
        f"signals at {signals.rate:.6g} Hz, decimated to "
        f"{signals.rate / signals.low_pass.step:.4g} Hz: {len(usable)} rows per joint; "
        f"{lost / signals.rate:.2g} s cut off at each end"
    )
    if signals.is_noiseless:
        yield Detail(
            "positions have no noise: they are differentiated without a low-pass"
        )
    missing = 1.0 - float(np.mean(is_complete))
    if missing > 0.0:
        note = (
            f"{percent(missing)} of the rows lie next to {obstacle}, and are not used"
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

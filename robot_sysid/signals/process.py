"""From a measured log to signals a regressor can be built on.

1. a uniform time grid (``resampling``);
2. one low-pass for everything, its cut-off chosen from the data (``cutoff``, ``low_pass``);
3. positions are low-passed and differentiated (``differences``), those without noise differentiated
   as they are; velocity columns are not used: a drive filters and delays them in its own way;
4. regressor columns and torques pass the same low-pass and are decimated to its bandwidth, what
   turns with the sign of a speed at the full rate (``ProcessedSignals.passed``);
5. the ends are cut off, and rows over long holes in the log, over corners of motion without noise,
   or over moments in which a joint is too slow for its friction to have a sign, are masked
   (``ProcessedSignals.usable``), and where its torque shows that it stands as it turns round, also
   those over its turns (``turning``, ``estimation.identify.without_standing``).

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
from robot_sysid.records.progress import Detail
from robot_sysid.signals.cutoff import (
    Spectra,
    choose_cutoff,
    encoder_steps,
    noise_share,
    spectra_of,
)
from robot_sysid.signals.filters import (
    ATTENUATION,
    CHUNK,
    FINE_REACH,
    REACH,
    Decimator,
    LowPass,
    advanced,
    design_low_pass,
    first_derivative,
    second_derivative,
)
from robot_sysid.signals.resampling import UniformSignals, is_fresh, resampled
from robot_sysid.signals.turning import turning_samples

LARGEST_SLOW_SHARE = 0.07
"""Share of the filter's weight that samples inside the deadband may have in a row that is used;
benchmarks/reversal_masking.py compares it with others."""
USUAL_DEADBAND = 0.005
"""Share of its own peak speed below which a joint has hardly left stiction (chosen)."""
ENOUGH_EACH_WAY = 0.05
"""Share of the samples in each direction below which a joint is reported (chosen)."""
# Below this speed a joint is at rest [rad/s]: encoder noise moves it as fast.
_LEAST_DEADBAND = 1e-3
# A hole shorter than this part of the cut-off's period is bridged by splines to 0.01 rad/s^2
# (tests/signals/test_process.py).
_HARMLESS_GAP = 0.25
# A pass band's ripple so small beside the noise of single samples is lost in that of a result: the
# usual filter's, beside the noise of a cut-off that is as high as noise allows.
_UNSEEN = 0.0045
# Of the filter of positions with little noise [dB]; more is lost in rounding.
_FLATTEST = 150.0
# Noise of unfiltered acceleration, as a part of it, that positions need no filter for. Derivatives
# of orders sixteen and fourteen differ by a 67th of it.
_NOISELESS = 1e-3 / 67.0
# Where the orders of a derivative differ by so many times the usual, the motion has a corner.
_CORNER = 20.0
# Part of the log that must be free of corners.
_MOSTLY = 0.5


@dataclass(frozen=True)
class ProcessedSignals:
    """Signals on a uniform grid of N samples, motion (N, n) low-passed, torque still raw.

    Attributes:
        tau: (N, n) torques, uniform but not filtered, so that they pass the low-pass exactly as
            often as the regressor columns do [N m].
        bridged: (N,) whether a long hole in the log, or a corner of motion without noise, is near.
        deadband: (n,) speed below which the direction of a joint's friction is not sure [rad/s].
        turning: (N, n) whether a joint may be standing because it turns round.
        flat: the filter that positions have passed; of one weight where they are free of noise.
        acceleration_error: expected, as a part of it; 0 where the cut-off was given.
        standing: numbers of the joints that do stand then, so that these rows are not used.
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
    flat: LowPass
    notes: tuple[str, ...]
    acceleration_error: float = 0.0
    standing: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.time)

    @property
    def cutoff(self) -> float:
        """Cut-off of the low-pass [Hz]."""
        return self.low_pass.cutoff

    @property
    def exact(self) -> bool:
        """Whether positions are free of noise and have passed no filter."""
        return self.flat.half_width == 0

    @property
    def rate(self) -> float:
        """Sample rate of the grid [Hz]."""
        return self.low_pass.rate

    def passed(
        self,
        made: Callable[[Motion], Iterable[Array]],
        smooth: bool = False,
        most: int = CHUNK,
    ) -> list[Array]:
        """Return each (K, ...) of what is made of the motion, through the low-pass and decimated.

        Args:
            made: arrays (m, ...) of the motion at m samples, at most so many at a time.
            smooth: whether they follow the motion without signs of speeds, so that fewer samples
                are enough (``LowPass.at_every``).
        """
        stride = self.low_pass.stride if smooth else 1
        low_pass = self.low_pass.at_every(stride)
        size = min(most, CHUNK) * stride
        parts: defaultdict[int, list[Array]] = defaultdict(list)
        decimators: defaultdict[int, Decimator] = defaultdict(
            lambda: Decimator(low_pass)
        )
        for start in range(0, len(self), size):
            motion = self.motion(slice(start, start + size, stride))
            for number, values in enumerate(made(motion)):
                parts[number].append(decimators[number].push(values))
        return [np.concatenate(each) for each in parts.values()]

    def motion(self, at: NDArray[np.int64] | slice) -> Motion:
        """Return the motion at some samples (m,)."""
        return Motion(self.time[at], self.q[at], self.qd[at], self.qdd[at])

    def decimated_motion(self) -> Motion:
        """Return the motion (K, n), low-passed once, at the instants of the decimated rows."""
        return self.motion(self.low_pass.centres(len(self)))

    @cached_property
    def refiltered(self) -> tuple[NDArray[np.int64], Motion]:
        """Return the motion (R, n) as it might also be, and at which decimated rows but the ends:
        after a second pass of its low-pass; where it passed none, by the next lower derivatives.
        """
        less = FINE_REACH - 1 if self.exact else 0
        low_pass = replace(
            self.low_pass if self.exact else self.flat, step=self.low_pass.step
        )
        reach = low_pass.half_width + less
        centres = self.low_pass.centres(len(self))
        rows = np.flatnonzero((centres >= reach) & (centres < len(self) - reach))
        at = centres[rows]
        whole = slice(at[0] - reach, at[-1] + reach + 1) if len(rows) else slice(0)
        q = self.q[whole]
        qd = self.qd[whole]
        qdd = self.qdd[whole]
        if not self.exact:
            return rows, Motion(self.time[at], *map(low_pass.decimated, (q, qd, qdd)))
        inner = slice(less, len(q) - less)
        first = low_pass.decimated(first_derivative(q, self.rate, less) - qd[inner])
        second = low_pass.decimated(second_derivative(q, self.rate, less) - qdd[inner])
        return rows, Motion(
            self.time[at], self.q[at], self.qd[at] + first, self.qdd[at] + second
        )

    def spread(self, most: int) -> NDArray[np.int64]:
        """Return at most so many samples, spread evenly over the log."""
        return np.unique(np.linspace(0, len(self) - 1, most).astype(int))

    def decimated_time(self) -> Array:
        """Return (K,) the instants of the decimated rows [s]."""
        return self.time[self.low_pass.centres(len(self))]

    def slow_share(self) -> Array:
        """Return (K, n) how much of each decimated row's weight is on samples in the deadband, or
        on those at which a joint stands as it turns round.
        """
        size = np.abs(self.low_pass.kernel)
        weights = replace(self.low_pass, kernel=size / size.sum())
        slow = np.less(np.abs(self.qd), self.deadband)
        for joint in self.standing:
            slow[:, joint] |= self.turning[:, joint]
        return weights.decimated(slow)

    def one_way_joints(self, joint_names: Sequence[str]) -> Iterator[str]:
        """Yield a sentence per joint whose sign(qd) hardly takes both values."""
        forward = np.mean(self.qd > self.deadband, axis=0)
        backward = np.mean(self.qd < -self.deadband, axis=0)
        for joint in np.flatnonzero(
            np.minimum(forward, backward) < ENOUGH_EACH_WAY
        ).tolist():
            yield (
                f"{joint_names[joint]} moves faster than {self.deadband[joint]:.2g} rad/s in "
                f"{100.0 * forward[joint]:.0f} % of the samples forwards and in "
                f"{100.0 * backward[joint]:.0f} % backwards; to tell Coulomb friction from an "
                "offset, let it move faster and both ways"
            )

    def usable(self) -> NDArray[np.bool_]:
        """Return (K, n) whether each joint's decimated row may be used."""
        centres = self.low_pass.centres(len(self))
        moving = self.slow_share() <= LARGEST_SLOW_SHARE
        holes = np.concatenate(([0], np.cumsum(self.bridged)))
        half = self.low_pass.half_width
        whole = holes[centres + half + 1] == holes[centres - half]
        return moving & whole[:, None]


@dataclass(frozen=True)
class LogPiece(Measurement):
    """A piece of a log whose spectra are taken once, however often it is processed."""

    @classmethod
    def of(cls, measurement: Measurement) -> LogPiece:
        """Return a stretch of a log as such a piece."""
        return measurement if isinstance(measurement, cls) else cls(**vars(measurement))

    def without_velocities(self) -> LogPiece:
        """Return the piece, spectra and all, without what is only checked."""
        found = copy(self)
        object.__setattr__(found, "qd", None)
        return found

    @cached_property
    def spectra(self) -> Spectra | None:
        """What a cut-off is chosen from; None where the piece is too short for that."""
        uniform = resampled(self)
        # Steps are seen in the readings themselves; interpolation rounds them off.
        steps = resampled(replace(self, q=_steps(self))).q
        return spectra_of(uniform.q, uniform.rate, steps)

    @cached_property
    def choice(self) -> tuple[float, float, str]:
        """``choose_cutoff`` of the piece; InputError where it is too short."""
        if self.spectra is None:
            few = (
                f"{len(resampled(self).q)} samples are too few to choose a cut-off from"
            )
            raise InputError(
                f"{few}; record longer, or give identify or payload a --cutoff HZ"
            )
        return choose_cutoff(self.spectra)


def process(
    measurement: Measurement,
    joint_names: Sequence[str] = (),
    cutoff: float | None = None,
    chosen_by: str = "as given",
) -> ProcessedSignals:
    """Turn a log into signals, or raise InputError where the cut-off does not fit it.

    Args:
        cutoff: of the low-pass [Hz]; None chooses it from the data.
        chosen_by: where a cut-off that is not chosen here comes from, in words.
    """
    uniform = resampled(measurement)
    expected = 0.0
    piece = LogPiece.of(measurement)
    if cutoff is None:
        cutoff, expected, reason = piece.choice
    else:
        reason = f"cut-off {cutoff:.4g} Hz {chosen_by}"
    low_pass = design_low_pass(cutoff, uniform.rate)
    needed = _needed(low_pass)
    if len(uniform.q) < needed:
        raise InputError(
            f"the log's {len(uniform.q) / low_pass.rate:.3g} s are too short for a cut-off of "
            f"{low_pass.cutoff:.3g} Hz, which needs {needed / low_pass.rate:.3g} s; record longer"
        )
    corners = _corners(uniform, low_pass)
    flat = replace(low_pass, kernel=np.ones(1))
    reach = FINE_REACH
    if corners is None:
        flat, reach = _exact_enough(low_pass, uniform, piece.spectra)
    q = flat.filtered(uniform.q)
    lost = flat.half_width + reach
    # Low-passed motion at each sample leans on those up to lost away.
    holes = np.concatenate(([0], np.cumsum(uniform.gap > _HARMLESS_GAP / cutoff)))
    bridged = holes[2 * lost + 1 :] > holes[: len(holes) - 2 * lost - 1]
    qd = first_derivative(q, uniform.rate, reach)
    qdd = second_derivative(q, uniform.rate, reach)
    slow = np.maximum(USUAL_DEADBAND * np.max(np.abs(qd), axis=0), _LEAST_DEADBAND)
    turning = np.zeros(qd.shape, dtype=bool)
    if corners is None and piece.spectra is not None:
        # Of positions without noise any speed has a sign.
        turning = turning_samples(
            uniform.q[lost:-lost], qd, piece.spectra.position_noise
        )
    time = uniform.start + np.arange(lost, len(uniform.q) - lost) / uniform.rate
    bridged = bridged if corners is None else bridged | corners
    # A view would keep the torque of the whole log.
    q = q[reach:-reach]
    tau = uniform.tau[lost:-lost].copy()
    unsure = bridged, slow, turning
    signals = ProcessedSignals(
        time, q, qd, qdd, tau, *unsure, low_pass, flat, (), expected
    )
    notes = (*uniform.notes, Detail(reason), *_notes(signals, joint_names))
    return replace(signals, notes=notes)


def with_delay(signals: ProcessedSignals, delay: float) -> ProcessedSignals:
    """Return the signals with torque put right that lags by ``delay`` [s]; negative for earlier."""
    tau, first = advanced(signals.tau, delay * signals.rate)
    if len(tau) < len(signals.low_pass.kernel):
        raise InputError(f"a delay of {delay:g} s leaves nothing of the log")
    part = slice(first, first + len(tau))
    names = "time", "q", "qd", "qdd", "bridged", "turning"
    cut = {name: getattr(signals, name)[part] for name in names}
    return replace(signals, tau=tau, **cut)


def _steps(measurement: Measurement) -> Array:
    """Return what encoder steps add to the readings (N, n); zero in rows without a new one."""
    if measurement.joint_time is None:
        return encoder_steps(measurement.q)
    steps = np.zeros_like(measurement.q)
    for joint, stamps in enumerate(measurement.joint_time.T):
        fresh = is_fresh(stamps)
        steps[fresh, joint] = encoder_steps(measurement.q[fresh, joint, None])[:, 0]
    return steps


def _corners(uniform: UniformSignals, low_pass: LowPass) -> NDArray[np.bool_] | None:
    """Return where (N - 2 FINE_REACH,) motion without noise has corners; None where it has noise.

    Two orders of a derivative differ by noise and by what the sample rate does not resolve: next to
    nothing in smooth motion, and a lot around a jump of a higher derivative.
    """
    fine = second_derivative(uniform.q, uniform.rate, FINE_REACH)
    largest = np.max(np.sqrt(np.mean(fine**2, axis=0)))
    fine -= second_derivative(uniform.q[1:-1], uniform.rate, FINE_REACH - 1)
    apart = np.max(np.abs(fine), axis=1, initial=0.0)
    moves = np.any(
        np.diff(uniform.q[FINE_REACH - 1 : -FINE_REACH], axis=0) != 0.0, axis=1
    )
    usual = np.median(apart[moves]) if np.any(moves) else math.inf
    if usual > _NOISELESS * largest:
        return None
    # At the ends of its reach a corner is where the two may agree by chance.
    corners = np.convolve(apart > _CORNER * usual, np.ones(5), "same") > 0.0
    count = np.concatenate(([0], np.cumsum(corners)))
    width = len(low_pass.kernel)
    clean = count[width:] == count[:-width]
    return corners if np.mean(clean) >= _MOSTLY else None


def _exact_enough(
    low_pass: LowPass, uniform: UniformSignals, spectra: Spectra | None
) -> tuple[LowPass, int]:
    """Return the low-pass for positions and the reach of their derivatives.

    Positions pass their filter alone: it scales motion by up to 1 + ripple, and with it what is
    identified. So it is as flat as the noise of positions is low, for more samples at the ends.
    """
    ripple = max(
        _UNSEEN * noise_share(spectra, low_pass.cutoff), 10.0 ** (-_FLATTEST / 20.0)
    )
    wanted = -20.0 * math.log10(min(ripple, 1.0))
    if wanted <= ATTENUATION:
        return low_pass, REACH
    flat = design_low_pass(low_pass.cutoff, low_pass.rate, wanted)
    more = 2 * (flat.half_width - low_pass.half_width + FINE_REACH - REACH)
    fits = more <= len(uniform.q) - _needed(low_pass)
    return (flat, FINE_REACH) if fits else (low_pass, REACH)


def _needed(low_pass: LowPass) -> int:
    return 4 * low_pass.half_width + 2 * REACH + 10 * low_pass.step


def _notes(signals: ProcessedSignals, joint_names: Sequence[str]) -> Iterator[str]:
    usable = signals.usable()
    lost = signals.low_pass.half_width + signals.flat.half_width + REACH
    yield Detail(
        f"signals at {signals.rate:.6g} Hz, decimated to "
        f"{signals.rate / signals.low_pass.step:.4g} Hz: {len(usable)} rows per joint; "
        f"{lost / signals.rate:.2g} s cut off at each end"
    )
    if signals.exact:
        yield Detail(
            "positions have no noise: they are differentiated without a low-pass"
        )
    for joint, share in enumerate(np.mean(usable, axis=0)):
        name = joint_names[joint] if joint < len(joint_names) else str(joint + 1)
        if share < 0.5:
            yield (
                f"only {100 * share:.0f} % of the rows of joint {name} are used: in the others it "
                f"is slower than its velocity deadband of {signals.deadband[joint]:.2g} rad/s"
            )

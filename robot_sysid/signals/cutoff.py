"""Choosing the cut-off frequency from the data.

The error of an acceleration taken from low-passed positions has two parts: motion above the
cut-off, which is lost, and encoder noise below it. Both are read off the spectrum of the raw second
difference of position: the noise is the level at high frequencies, where a second difference of
white noise has the shape (2 - 2 cos(2 pi f T))^2 / T^4, the motion is what stands clearly above it.
A joint that creeps over an encoder's steps is read as a staircase, whose spectrum stands far above
that shape; what it differs from the line through its steps is noise as well (``encoder_steps``).

The chosen cut-off is the highest one whose expected error is small, which keeps most of friction's
sign changes and of the ends of the log. It stays within a multiple of the frequencies that the arm
moves at, beyond which torques hold more and more that is not motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from robot_sysid.records import Array
from robot_sysid.records.figures import percent
from robot_sysid.signals.filters import design_low_pass

# Expected squared error of acceleration, as a part of its mean square, that is no loss yet: it
# biases an inertia by as much, 0.005 %.
_HARMLESS = 5e-5
# Or the least error there is, nearly (chosen: the error is flat around its minimum).
_NEARLY_BEST = 1.25
# The arm moves at frequencies that hold this share of the squared speed; the cut-off is at most so
# many times the highest of them (docs/measurements.md, tests/signals/test_cutoff.py).
_MOSTLY = 0.99
_WIDEST = 15.0
# Share of rows with a new reading below which readings come slower than rows.
_HELD = 0.6
_REGULAR = 0.5
# An octave with less than this part of the squared speed below it is a gap; what the arm's motion
# still has beyond ends at so many times its frequency.
_EMPTY = 1e-4
_WELL_BEYOND = 10.0
# A band counts as motion where it stands this far above the noise, which chance does not.
_CLEARLY = 6.0
# Share of an encoder's steps beside which the reading stays the same, up to which the steps are
# passed so fast that their noise is white.
_HARDLY_EVER = 0.01
# Longer stretches would only resolve frequencies finer than any cut-off needs (chosen) [s].
_LONGEST = 20.0
# Weights of the cosines of that window.
_BLACKMAN_HARRIS = (0.35875, -0.48829, 0.14128, -0.01168)
# Both passes of the filter together may cut off this part of the log (chosen).
_TRIMMED = 0.2
# Samples of a segment, and readings, that a spectrum takes at least (chosen).
_SHORTEST = 64


@dataclass(frozen=True)
class Spectra:
    """Spectra (F,) of all joints' accelerations at F frequencies [Hz]: what is motion, what is not.

    Attributes:
        rate: sample rate of the readings [Hz].
        count, length: of the readings, and of the parts of them that are averaged.
        level: (n,) spectrum of the noise of position.
    """

    rate: float
    count: int
    length: int
    frequency: Array
    motion: Array
    noise: Array
    level: Array

    @property
    def position_noise(self) -> Array:
        """Standard deviation (n,) of the noise of the readings [rad]."""
        return np.asarray(np.sqrt(self.level * self.rate / 2.0))


def choose_cutoff(spectra: Spectra) -> tuple[float, float, str]:
    """Return (one cut-off for all joints [Hz], expected error of acceleration as a part, why)."""
    rate = spectra.rate
    highest = 0.2 * rate
    half_width_times_cutoff = design_low_pass(highest, rate).half_width * highest / rate
    lowest = 4.0 * half_width_times_cutoff / (_TRIMMED * spectra.count / rate)
    candidates = np.geomspace(min(lowest, highest), highest, 40)
    # The highest frequency that the arm moves at; all where it does not move.
    frequency = spectra.frequency
    motion = spectra.motion
    fastest = frequency[_speed_index(frequency, motion) if np.any(motion) else -1]
    candidates = candidates[candidates <= max(candidates[0], _WIDEST * fastest)]
    errors = np.array([_error(c, spectra) for c in candidates])
    fit = np.flatnonzero(errors <= max(_HARMLESS, _NEARLY_BEST * errors.min()))
    best = candidates[fit[-1]]
    sigma = spectra.position_noise
    expected = float(np.sqrt(errors[fit[-1]]))
    reason = f"cut-off {best:.3g} Hz chosen from the data: position noise {sigma.min():.2g} to "
    reason += (
        f"{sigma.max():.2g} rad, expected error of the acceleration {percent(expected)}"
    )
    return float(best), expected, reason


def noise_share(spectra: Spectra | None, cutoff: float) -> float:
    """Return the noise that a cut-off [Hz] leaves in the acceleration, as a part of it.

    Infinite where nothing moves or the log is too short to tell.
    """
    moved = 0.0 if spectra is None else np.sum(spectra.motion)
    if spectra is None or moved <= 0.0:
        return math.inf
    return math.sqrt(np.sum(spectra.noise[spectra.frequency <= cutoff]) / moved)


def spectra_of(q: Array, rate: float, steps: Array) -> Spectra | None:
    """Return the spectra of all joints, of positions (N, n) on a uniform grid and what
    ``encoder_steps`` says of them [rad], at a rate [Hz]; None where there are too few samples.
    """
    q, steps, rate = _without_repeats(q, steps, rate)
    if len(q) < _SHORTEST:
        return None
    length = min((len(q) - 2) // 4, max(_SHORTEST, round(_LONGEST * rate)))
    frequency, power, shape = _acceleration_spectrum(q, rate, length)
    high = (frequency > 0.25 * rate) & (frequency < 0.475 * rate)
    # The median of a chi-square lies a little below its mean; with this many segments by 5 %.
    level = 1.05 * np.median(power[high] / shape[high, None], axis=0)
    noise = level * shape[:, None]
    stairs = np.zeros_like(power)
    stepped = np.any(steps, axis=0)
    if np.any(stepped):
        stairs[:, stepped] = _acceleration_spectrum(steps[:, stepped], rate, length)[1]
    motion = _motion(frequency, power, np.maximum(noise, stairs))
    noise = np.maximum(noise, np.where(motion > 0.0, 0.0, power))
    motion = np.sum(motion, axis=1)
    noise = np.sum(noise, axis=1)
    return Spectra(rate, len(q), length, frequency, motion, noise, level)


def _without_repeats(q: Array, steps: Array, rate: float) -> tuple[Array, Array, float]:
    """Return positions, steps and rate of readings that come slower than the log was written.

    A reading that is held for several rows has images at multiples of its own rate, which look like
    noise at every frequency.
    """
    fresh = np.concatenate(([True], np.any(q[1:] != q[:-1], axis=1)))
    share = float(np.mean(fresh))
    row = np.arange(len(q))
    kept = np.flatnonzero(fresh)
    if share > _HELD or len(kept) < _SHORTEST:
        return q, steps, rate
    waits = np.diff(kept)
    if np.std(waits) > _REGULAR * np.mean(
        waits
    ):  # an encoder that creeps from step to step
        return q, steps, rate
    even = np.linspace(0.0, len(q) - 1.0, len(kept))
    slower = np.column_stack([np.interp(even, row[kept], joint[kept]) for joint in q.T])
    return slower, np.zeros_like(slower), rate * share


def encoder_steps(q: Array) -> Array:
    """Return what readings q (N, n) differ from the line through the middles of their steps (N, n).

    Between two readings that differ, the joint passed the middle of them; in between it moved
    nearly straight on. Zero for a joint whose reading hardly ever stays the same while it moves:
    its steps are too fine to make a staircase.
    """
    steps = np.zeros_like(q)
    sample = np.arange(len(q))
    for joint, reading in enumerate(q.T):
        before = np.flatnonzero(np.diff(reading))
        stayed = np.diff(before, prepend=-1) > 1
        if np.count_nonzero(stayed) > _HARDLY_EVER * len(before):
            middles = 0.5 * (reading[before] + reading[before + 1])
            steps[:, joint] = reading - np.interp(sample, before + 0.5, middles)
    return steps


def _acceleration_spectrum(
    q: Array, rate: float, length: int
) -> tuple[Array, Array, Array]:
    """Return frequency (F,), spectrum of the second difference (F, n) and noise shape (F,).

    The mean over segments of the squared Fourier transform under a Blackman-Harris window, the
    mean taken off (Welch, IEEE Trans. Audio Electroacoust. 15, 1967; Harris, Proc. IEEE 66, 1978).
    """
    turn = 2.0 * np.pi / length * np.arange(length)
    window = np.cos(np.outer(turn, range(4))) @ _BLACKMAN_HARRIS
    starts = range(0, len(q) - 2 - length + 1, length - 3 * length // 4)
    frequency = np.asarray(np.fft.rfftfreq(length, 1.0 / rate))
    power = np.zeros((len(frequency), q.shape[1]))
    for start in starts:
        part = np.diff(q[start : start + length + 2], 2, axis=0) * rate**2
        seen = np.fft.rfft((part - np.mean(part, axis=0)) * window[:, None], axis=0)
        power += seen.real**2 + seen.imag**2
    power *= 2.0 / (rate * np.sum(window**2) * len(starts))
    power[length // 2 :] *= (
        0.5 if length % 2 == 0 else 1.0
    )  # the one bin without a mirror image
    shape = ((2.0 - 2.0 * np.cos(2.0 * np.pi * frequency / rate)) * rate**2) ** 2
    return frequency[1:], power[1:], shape[1:]


def _motion(frequency: Array, power: Array, noise: Array) -> Array:
    """Return the part of the spectrum (F, n) that is motion of the arm.

    Vibration, ripple and noise that is not white make the spectrum of acceleration rise again at
    high frequencies; motion ends where it is lowest.
    """
    motion = np.where(power > _CLEARLY * noise, power - noise, 0.0)
    pooled = np.sum(power, axis=1)
    if not np.any(motion):
        return motion
    moved = np.sum(motion, axis=1)
    slow = _speed_index(frequency, moved)
    rising = slow + int(
        np.argmin(_smooth(pooled)[slow : max(slow + 1, int(0.9 * len(pooled)))])
    )
    gap = frequency[_first_gap(frequency, moved)]
    last = min(rising, int(np.searchsorted(frequency, _WELL_BEYOND * gap)))
    return np.where(np.arange(len(frequency))[:, None] <= last, motion, 0.0)


def _speed_index(frequency: Array, motion: Array) -> int:
    """Return below which frequency index most of the squared speed is, as far as the first gap."""
    speed = _squared_speed(frequency, motion)
    return int(np.searchsorted(speed, _MOSTLY * speed[_first_gap(frequency, motion)]))


def _squared_speed(frequency: Array, motion: Array) -> Array:
    """Return (F,) the squared speed up to each frequency."""
    return np.asarray(np.cumsum(motion / frequency**2))


def _first_gap(frequency: Array, motion: Array) -> int:
    """Return the index of the first octave that adds next to nothing to the squared speed.

    What lies beyond are images of the motion, which repeated samples and jitter in time leave.
    Looked for above the frequency that holds half of the squared speed in the lower half of all
    octaves, which is motion for sure.
    """
    speed = _squared_speed(frequency, motion)
    octave = np.minimum(np.searchsorted(frequency, 2.0 * frequency), len(frequency) - 1)
    empty = speed[octave] - speed < _EMPTY * speed
    sure = speed[int(np.sqrt(len(speed)))]
    empty[: int(np.searchsorted(speed, 0.5 * sure))] = False
    empty[octave == len(frequency) - 1] = False
    return int(np.argmax(empty)) if np.any(empty) else len(frequency) - 1


def _smooth(power: Array) -> Array:
    """Return the mean over a quarter of an octave or so around each frequency (F,)."""
    index = np.arange(len(power))
    width = np.maximum(1, index // 4)
    total = np.concatenate(([0.0], np.cumsum(power)))
    low = np.maximum(0, index - width // 2)
    high = np.minimum(len(power), low + width)
    return (total[high] - total[low]) / (high - low)


def _error(cutoff: float, spectra: Spectra) -> float:
    """Return the expected squared error of acceleration as a part of its mean square."""
    kernel = design_low_pass(cutoff, spectra.rate).kernel
    gain = np.abs(np.fft.rfft(kernel, spectra.length))[1:]
    total = np.sum(spectra.motion)
    wrong = (1.0 - gain) ** 2 @ spectra.motion + gain**2 @ spectra.noise
    return float(wrong / total) if total > 0.0 else float(wrong)

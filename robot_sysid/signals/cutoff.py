"""Choosing the cut-off frequency of the low-pass from the data.

The error of an acceleration that is computed from low-passed positions has two parts: motion above
the cut-off, which is lost, and noise below it. Both are estimated from the spectrum of the second
difference of the raw positions. At high frequencies that spectrum is noise: the second difference
of white noise has the shape (2 - 2 cos(2 pi f T))^2 / T^4. What stands above it, up to where the
spectrum is lowest, is motion; beyond lie vibration, ripple, steps of an encoder, and images of the
motion that repeated readings leave.

The chosen cut-off is the highest one whose expected error is small: it keeps most of the changes of
friction's sign and most rows at the ends of the log. It is at most a multiple of the frequencies at
which the arm moves, because torques above them hold more and more that is not motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from robot_sysid.records import Array
from robot_sysid.records.messages import percent
from robot_sysid.signals.filters import design_low_pass

# Expected squared error of the acceleration, relative to its mean square, that does no harm: it
# biases an identified inertia by the same share, 0.005 %.
_HARMLESS_ERROR = 5e-5
# A cut-off also qualifies if its error is at most this multiple of the least error of all cut-offs:
# the error is flat around its minimum (chosen).
_ERROR_TOLERANCE = 1.25
# The highest frequency at which the arm moves is the one below which this share of the integral of
# the squared speed over all frequencies lies.
_MOTION_SHARE = 0.99
# Largest cut-off over the highest frequency at which the arm moves (docs/measurements.md,
# tests/signals/test_cutoff.py).
_LARGEST_CUTOFF_RATIO = 15.0
# A frequency holds motion where its power is more than this multiple of the noise, which noise
# alone hardly ever reaches.
_MOTION_TO_NOISE = 6.0
# Longest segment whose spectrum is averaged; a longer one would only resolve frequencies finer than
# any cut-off needs (chosen) [s].
_LONGEST_SEGMENT = 20.0
# Weights of the cosines of the Blackman-Harris window.
_BLACKMAN_HARRIS = (0.35875, -0.48829, 0.14128, -0.01168)
# Largest share of the log that is lost at its ends, in the low-pass of positions and in the
# low-pass of regressor columns together (chosen).
_TRIMMED_SHARE = 0.2
# Fewest readings of a log that a spectrum is made from; the bound on the length of its segments, of
# which there are at least four, is no smaller either (chosen).
_SHORTEST_SEGMENT = 64
# Largest share of rows with a new reading at which rows count as more frequent than the readings of
# the encoders.
_FRESH_SHARE = 0.6
# Largest standard deviation of the time between new readings, over its mean, for which the readings
# count as regular.
_REGULARITY = 0.5


@dataclass(frozen=True)
class Spectra:
    """Power spectra of the joints' accelerations at F frequencies, split into motion and noise.

    Attributes:
        rate: sample rate of the readings [Hz].
        count: number of readings.
        length: number of samples of each averaged segment.
        frequency: (F,) [Hz].
        motion: (F,) power density of the motion's acceleration, summed over all joints.
        noise: (F,) power density of the acceleration's noise, summed over all joints.
        level: (n,) power density of the white noise of each joint's position [rad^2/Hz].
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
        return np.sqrt(self.level * self.rate / 2.0)

    @property
    def noise_share(self) -> float:
        """Root mean square of the acceleration's noise, over that of the motion's acceleration."""
        motion = np.sum(self.motion)
        return float(np.sqrt(np.sum(self.noise) / motion)) if motion > 0.0 else np.inf

    @property
    def fastest(self) -> float:
        """Highest frequency at which the arm moves [Hz]; the highest of all for an arm at rest."""
        speed = np.cumsum(self.motion / self.frequency**2)
        if not np.any(speed):
            return float(self.frequency[-1])
        return float(self.frequency[np.searchsorted(speed, _MOTION_SHARE * speed[-1])])


class CutoffChoice(NamedTuple):
    """A cut-off that was chosen from the data.

    Attributes:
        cutoff: for all joints [Hz].
        expected_error: root mean square error of the acceleration, over the acceleration's root
            mean square.
        reason: a sentence on why this cut-off was chosen.
    """

    cutoff: float
    expected_error: float
    reason: str


def choose_cutoff(spectra: Spectra) -> CutoffChoice:
    """Return the highest cut-off whose expected error of the acceleration is small.

    It is at most a fifth of the sample rate and 15 times the highest frequency at which the arm
    moves, and so high that the filters take at most a fifth of the log at its ends.
    """
    rate = spectra.rate
    highest = 0.2 * rate
    # The half width [s] is inversely proportional to the cut-off; the low-pass of positions and
    # that of regressor columns lose one half width each at both ends.
    half_width_times_cutoff = design_low_pass(highest, rate).half_width * highest / rate
    lowest = 4.0 * half_width_times_cutoff / (_TRIMMED_SHARE * spectra.count / rate)
    candidates = np.geomspace(min(lowest, highest), highest, 40)
    bound = max(candidates[0], _LARGEST_CUTOFF_RATIO * spectra.fastest)
    candidates = candidates[candidates <= bound]
    errors = np.array([_squared_error(cutoff, spectra) for cutoff in candidates])
    largest_error = max(_HARMLESS_ERROR, _ERROR_TOLERANCE * errors.min())
    index = np.flatnonzero(errors <= largest_error)[-1]
    cutoff = float(candidates[index])
    expected = float(np.sqrt(errors[index]))
    sigma = spectra.position_noise
    reason = (
        f"cut-off {cutoff:.3g} Hz chosen from the data: position noise {sigma.min():.2g} to "
        f"{sigma.max():.2g} rad, expected error of the acceleration {percent(expected)}"
    )
    return CutoffChoice(cutoff, expected, reason)


def _squared_error(cutoff: float, spectra: Spectra) -> float:
    """Return the expected squared error of the acceleration at a cut-off [Hz], over the mean square
    of the acceleration; where nothing moves, the squared error itself [rad^2/s^4].
    """
    kernel = design_low_pass(cutoff, spectra.rate).kernel
    gain = np.abs(np.fft.rfft(kernel, spectra.length))[1:]
    total = np.sum(spectra.motion)
    error = (1.0 - gain) ** 2 @ spectra.motion + gain**2 @ spectra.noise
    return float(error / total) if total > 0.0 else float(error)


def acceleration_spectra(q: Array, rate: float) -> Spectra | None:
    """Return the spectra of all joints' accelerations; None where there are too few samples.

    Args:
        q: (N, n) positions on a uniform grid [rad].
        rate: of the grid [Hz].
    """
    q, rate = _drop_repeated_readings(q, rate)
    if len(q) < _SHORTEST_SEGMENT:
        return None
    longest = max(_SHORTEST_SEGMENT, round(_LONGEST_SEGMENT * rate))
    # At least four segments; the second difference has two samples less.
    length = min((len(q) - 2) // 4, longest)
    frequency, power = _second_difference_spectrum(q, rate, length)
    phase = 2.0 * np.pi * frequency[:, None] / rate
    # Power density where positions are white noise of unit density.
    shape = ((2.0 - 2.0 * np.cos(phase)) * rate**2) ** 2
    # Frequencies that count as noise alone: from half of the Nyquist frequency to just below it.
    high = (frequency > 0.25 * rate) & (frequency < 0.475 * rate)
    # The median of a chi-square lies a little below its mean; with this many segments by 5 %.
    level = 1.05 * np.median(power[high] / shape[high], axis=0)
    noise = level * shape
    motion = np.where(power > _MOTION_TO_NOISE * noise, power - noise, 0.0)
    motion[_valley(frequency, power, motion) :] = 0.0
    noise = np.maximum(noise, np.where(motion > 0.0, 0.0, power))
    return Spectra(
        rate=rate,
        count=len(q),
        length=length,
        frequency=frequency,
        motion=np.sum(motion, axis=1),
        noise=np.sum(noise, axis=1),
        level=level,
    )


def _valley(frequency: Array, power: Array, motion: Array) -> int:
    """Return the index from which on power is no motion: behind the lowest power above the motion.

    The search begins at the frequency below which half of the squared speed of the lower half of
    all octaves lies, where power is motion for certain; the last tenth of the spectrum is not
    searched.

    Args:
        frequency: (F,) [Hz].
        power: (F, n) spectrum of the acceleration.
        motion: (F, n) what of it stands above white noise.
    """
    speed = np.cumsum(np.sum(motion, axis=1) / frequency**2)
    # On a logarithmic scale of evenly spaced frequencies the square root is half way.
    lower_half = speed[int(np.sqrt(len(speed)))]
    start = int(np.searchsorted(speed, 0.5 * lower_half))
    end = max(start + 1, int(0.9 * len(power)))
    # Averaged over a band around each frequency, as wide as a quarter of the frequency.
    index = np.arange(start, end)
    width = np.maximum(1, index // 4)
    low = index - width // 2
    high = np.minimum(len(power), low + width)
    total = np.concatenate(([0.0], np.cumsum(np.sum(power, axis=1))))
    smooth = (total[high] - total[low]) / (high - low)
    return start + int(np.argmin(smooth)) + 1


def _second_difference_spectrum(
    q: Array, rate: float, length: int
) -> tuple[Array, Array]:
    """Return the spectrum of the second difference of positions, an acceleration.

    It is the mean over segments of the squared Fourier transform under a Blackman-Harris window,
    after subtraction of the segment's mean (Welch, IEEE Trans. Audio Electroacoust. 15, 1967;
    Harris, Proc. IEEE 66, 1978).

    Args:
        q: (N, n) positions on a uniform grid [rad].
        rate: of the grid [Hz].
        length: samples of a segment.

    Returns:
        Frequencies (F,) [Hz], zero left out, and power densities (F, n).
    """
    angle = 2.0 * np.pi / length * np.arange(length)
    window = np.cos(np.outer(angle, range(4))) @ _BLACKMAN_HARRIS
    last_start = len(q) - 2 - length
    # Successive segments overlap by three quarters.
    starts = range(0, last_start + 1, length - 3 * length // 4)
    frequency = np.asarray(np.fft.rfftfreq(length, 1.0 / rate))
    power = np.zeros((len(frequency), q.shape[1]))
    for start in starts:
        segment = np.diff(q[start : start + length + 2], 2, axis=0) * rate**2
        deviation = segment - np.mean(segment, axis=0)
        transform = np.fft.rfft(deviation * window[:, None], axis=0)
        power += transform.real**2 + transform.imag**2
    power *= 2.0 / (rate * np.sum(window**2) * len(starts))
    if length % 2 == 0:
        # The Nyquist frequency, which an even length has, is the one bin without a mirror image.
        power[-1] *= 0.5
    return frequency[1:], power[1:]


def _drop_repeated_readings(q: Array, rate: float) -> tuple[Array, float]:
    """Return positions (M, n) and the mean rate [Hz] of the M new readings alone, interpolated at
    even intervals.

    A reading that is held for several rows has images at multiples of its own rate, which look like
    noise at every frequency. Where most rows are new, or new readings are few or come irregularly,
    the arguments are returned unchanged.

    Args:
        q: (N, n) positions on a uniform grid [rad].
        rate: of the grid [Hz].
    """
    is_new = np.any(np.diff(q, axis=0), axis=1)
    new_rows = np.concatenate(([0], np.flatnonzero(is_new) + 1))
    share = len(new_rows) / len(q)
    if share > _FRESH_SHARE or len(new_rows) < _SHORTEST_SEGMENT:
        return q, rate
    waits = np.diff(new_rows)
    if np.std(waits) > _REGULARITY * np.mean(waits):
        # An encoder that creeps from step to step.
        return q, rate
    even = np.linspace(0.0, len(q) - 1.0, len(new_rows))
    fresh = [np.interp(even, new_rows, reading[new_rows]) for reading in q.T]
    return np.column_stack(fresh), rate * share

"""Choosing the cut-off frequency of the low-pass from the data.

The error of an acceleration that is computed from low-passed positions has two parts: motion above
the cut-off, which is lost, and noise below it. Both are estimated from the spectrum of the second
difference of the raw positions. At high frequencies that spectrum is noise: the second difference
of white noise has the shape (2 - 2 cos(2 pi f T))^2 / T^4. What stands above it, up to where the
spectrum is lowest, is motion; beyond lie vibration, ripple, steps of an encoder, and images of the
motion that repeated readings leave.

The chosen cut-off is the highest one whose expected error is small: it keeps most of the changes of
friction's sign and most rows at the ends of the log. It is at most a multiple of the frequencies at
which the arm moves, because torques above them hold more and more that is not motion, and of coarse
positions at least a smaller multiple.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from robot_sysid.records import Array
from robot_sysid.signals.filters import design_low_pass

FEWEST_SAMPLES = 64
"""Fewest samples of a log that a spectrum is made from (chosen)."""


LONGEST_SEGMENT = 20.0
"""Length of segments [s]: longer ones only resolve frequencies finer than any cut-off needs."""
HIGHEST_CUTOFF = 0.2
"""Highest cut-off over the sample rate."""
MOST_LOST = 0.2
"""Share of the log that the filters may take at its ends."""
FASTEST_SHARE = 0.99
"""Share of the squared speed below the highest frequency at which the arm moves."""
HIGHEST_RATIO = 15.0
"""Largest ratio of cut-off to that frequency that is of use: docs/evidence.md,
tests/signals/test_cutoff.py."""
LOWEST_RATIO = 4.0
"""Smallest ratio: below it, links that move fast are told from friction no more, and one that is
too heavy is found heavier still, most of all with coarse and slow positions."""
BEARABLE_ERROR = 2.5e-3
"""Expected squared error up to which a cut-off is raised to the smallest ratio: it biases an
inertia by 0.25 %."""
HARMLESS_ERROR = 5e-5
"""Expected squared error that does no harm, as it biases an identified inertia by 0.005 %."""
FLAT = 1.25
"""Ratio to the least error up to which errors count as equal: around its minimum it is flat."""
BEST_SHARE = 0.6
"""Share of the highest cut-off with a small error at which other data are predicted best: torques
hold more that is not motion the higher the frequency (docs/evidence.md)."""
NOISE_BAND = 0.25, 0.475
"""Frequencies over the sample rate that count as noise alone: from half of the Nyquist frequency to
just below it."""
MEAN_TO_MEDIAN = 1.05
"""The median of a chi-square lies a little below its mean; with this many segments by 5 %."""
ABOVE_NOISE = 6.0
"""Multiple of the noise that noise alone hardly ever reaches."""
SEARCHED_SHARE = 0.9
"""Share of the spectrum in which the end of the motion is looked for."""
BLACKMAN_HARRIS = 0.35875, -0.48829, 0.14128, -0.01168
"""Coefficients of the window (Harris, Proc. IEEE 66, 1978)."""


class CutoffChoice(NamedTuple):
    """A cut-off that was chosen from the data.

    Attributes:
        cutoff: for all joints [Hz].
        expected_error: root mean square error of the acceleration, over the acceleration's root
            mean square.
        noise_share: root mean square of the acceleration's noise over all frequencies, over that
            of the motion's acceleration.
        joint_noise: (n,) mean square noise of each joint's acceleration behind the low-pass, over
            the mean square of the acceleration of all joints.
    """

    cutoff: float
    expected_error: float
    noise_share: float
    joint_noise: Array


def choose_cutoff(q: Array, rate: float) -> CutoffChoice:
    """Return the highest cut-off whose expected error of the acceleration is small.

    It is at most a fifth of the sample rate and 15 times the highest frequency at which the arm
    moves, at least 4 times that frequency where the error there is bearable, and so high that the
    filters take at most a fifth of the log at its ends.

    Args:
        q: (N, n) positions on a uniform grid [rad].
        rate: of the grid [Hz].
    """
    longest = max(FEWEST_SAMPLES, round(LONGEST_SEGMENT * rate))
    # At least four segments; the second difference has two samples less.
    length = min((len(q) - 2) // 4, longest)
    frequency = np.asarray(np.fft.rfftfreq(length, 1.0 / rate))[1:]
    joint_motion, joint_noise = _acceleration_spectra(q, length, frequency / rate)
    motion = np.sum(joint_motion, axis=1)
    noise = np.sum(joint_noise, axis=1)
    highest = HIGHEST_CUTOFF * rate
    # The half width [s] is inversely proportional to the cut-off; the low-pass of positions and
    # that of regressor columns lose one half width each at both ends.
    half_width_times_cutoff = design_low_pass(highest, rate).half_width * highest / rate
    lowest = 4.0 * half_width_times_cutoff / (MOST_LOST * len(q) / rate)
    candidates = np.geomspace(min(lowest, highest), highest, 40)
    speed = np.cumsum(motion / frequency**2)
    # The highest frequency at which the arm moves.
    fastest = frequency[np.searchsorted(speed, FASTEST_SHARE * speed[-1])]
    bound = max(candidates[0], HIGHEST_RATIO * fastest)
    candidates = candidates[candidates <= bound]

    def gain_of(cutoff: float) -> Array:
        """Return what the low-pass leaves (F,) at each frequency."""
        kernel = design_low_pass(cutoff, rate).kernel
        return np.abs(np.fft.rfft(kernel, length))[1:]

    def error(cutoff: float) -> float:
        """Return the expected squared error of the acceleration, over its mean square."""
        gain = gain_of(cutoff)
        return float((1.0 - gain) ** 2 @ motion + gain**2 @ noise)

    errors = np.array([*map(error, candidates)])
    largest_error = max(HARMLESS_ERROR, FLAT * errors.min())
    accurate_cutoffs = candidates[errors <= largest_error]
    cutoff = float(max(BEST_SHARE * accurate_cutoffs[-1], candidates[0]))
    least = min(LOWEST_RATIO * fastest, highest)
    if cutoff < least and error(least) < BEARABLE_ERROR:
        cutoff = float(least)
    noise_share = np.sqrt(np.sum(noise))
    gain = gain_of(cutoff)
    left = max(float(gain**2 @ (motion + noise)), 1e-99)
    return CutoffChoice(
        cutoff, float(np.sqrt(error(cutoff))), noise_share, gain**2 @ joint_noise / left
    )


def _acceleration_spectra(
    q: Array, length: int, frequency: Array
) -> tuple[Array, Array]:
    """Return power spectra (F, n) of the motion's acceleration, which adds up to one over all
    joints, and of the acceleration's noise.

    Args:
        q: (N, n) positions on a uniform grid [rad].
        length: number of samples of each segment over which spectra are averaged.
        frequency: (F,) those of a segment, zero left out, over the sample rate.
    """
    power = _second_difference_spectrum(q, length)
    # Power where positions are white noise of unit power.
    shape = (2.0 - 2.0 * np.cos(2.0 * np.pi * frequency[:, None])) ** 2
    low_end, high_end = NOISE_BAND
    high = (frequency > low_end) & (frequency < high_end)
    level = MEAN_TO_MEDIAN * np.median(power[high] / shape[high], axis=0)
    noise = level * shape
    motion = np.where(power > ABOVE_NOISE * noise, power - noise, 0.0)
    motion[_valley(frequency, power, motion) :] = 0.0
    noise = np.maximum(noise, np.where(motion > 0.0, 0.0, power))
    total = max(float(np.sum(motion)), 1e-99)
    return motion / total, noise / total


def _valley(frequency: Array, power: Array, motion: Array) -> int:
    """Return the index from which on power is no motion: behind the lowest power above the motion.

    The search begins where the arm moves fastest, in the lower half of all octaves; the last tenth
    of the spectrum is not searched.

    Args:
        frequency: (F,), in any unit.
        power: (F, n) spectrum of the acceleration.
        motion: (F, n) what of it stands above white noise.
    """
    speed = np.sum(motion, axis=1) / frequency**2
    # On a logarithmic scale of evenly spaced frequencies the square root is half way.
    start = int(np.argmax(speed[: math.isqrt(len(speed))]))
    end = max(start + 1, int(SEARCHED_SHARE * len(power)))
    # Averaged over a band around each frequency, as wide as a quarter of the frequency.
    index = np.arange(start, end)
    width = np.maximum(1, index // 4)
    low = index - width // 2
    high = np.minimum(len(power), low + width)
    total = np.concatenate(([0.0], np.cumsum(np.sum(power, axis=1))))
    smooth = (total[high] - total[low]) / (high - low)
    return start + int(np.argmin(smooth)) + 1


def _second_difference_spectrum(q: Array, length: int) -> Array:
    """Return the power spectrum (F, n) of the second difference of positions, an acceleration.

    It is the mean over segments of the squared Fourier transform under a Blackman-Harris window,
    after subtraction of the segment's mean (Welch, IEEE Trans. Audio Electroacoust. 15, 1967;
    Harris, Proc. IEEE 66, 1978). The frequency zero is left out.

    Args:
        q: (N, n) positions on a uniform grid [rad].
        length: samples of a segment.
    """
    angle = 2.0 * np.pi / length * np.arange(length)
    cosines = np.cos(np.outer(angle, range(4)))
    window = cosines @ BLACKMAN_HARRIS
    # Successive segments overlap by three quarters.
    segments = sliding_window_view(np.diff(q, 2, axis=0), length, axis=0)
    powers = []
    for segment in segments[:: length - 3 * length // 4]:
        deviation = segment - np.mean(segment, axis=-1, keepdims=True)
        powers.append(np.abs(np.fft.rfft(deviation * window)) ** 2)
    return np.mean(powers, axis=0).T[1:]

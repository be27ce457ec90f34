"""Error of the acceleration from an encoder's positions, for several ways to differentiate.

    python -m benchmarks.accuracy.differentiation_accuracy

Sums of sines up to 0.6 Hz, 15 s, a 1e-4 rad encoder or none. Printed: root mean square error of the
acceleration as a part of its own root mean square, away from the ends.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import butter, savgol_filter, sosfiltfilt

from robot_sysid.signals.cutoff import choose_cutoff
from robot_sysid.signals.filters import derivatives, design_low_pass

OMEGA = 2.0 * np.pi * np.array([0.13, 0.29, 0.43, 0.59])
DURATION = 15.0
EDGE = 2.0


def motion(
    rate: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time, position and exact acceleration."""
    time = np.arange(round(DURATION * rate)) / rate
    amplitude = rng.uniform(0.1, 0.4, 4)
    phase = rng.uniform(0.0, 6.0, 4)
    waves = amplitude * np.sin(np.outer(time, OMEGA) + phase)
    return time, waves.sum(axis=1), -(waves * OMEGA**2).sum(axis=1)


def estimates(q: np.ndarray, rate: float, cutoff: float) -> dict[str, np.ndarray]:
    """Return acceleration by each method, NaN where it has none."""
    low_pass = design_low_pass(cutoff, rate)
    smooth = replace(low_pass, step=1).decimate(q)
    pair = sosfiltfilt(butter(4, cutoff, fs=rate, output="sos"), q)
    window = max(7, int(1.2 * rate / cutoff) | 1)
    frequency = 2.0 * np.pi * np.fft.rfftfreq(len(smooth), 1.0 / rate)
    spectral = np.fft.irfft(-(frequency**2) * np.fft.rfft(smooth), len(smooth))
    accelerations = {
        "window + 16th order": derivatives(smooth, rate)[1],
        "window + central": np.diff(smooth, 2) * rate**2,
        "window + Fourier": spectral,
        "Butterworth pair + 16th order": derivatives(pair, rate)[1],
        "Savitzky-Golay on raw": savgol_filter(q, window, 4, deriv=2, delta=1.0 / rate),
        "raw second difference": np.diff(q, 2) * rate**2,
    }
    return {name: pad(values, len(q)) for name, values in accelerations.items()}


def pad(values: np.ndarray, length: int) -> np.ndarray:
    """Return values centred in an array of NaN."""
    lost = (length - len(values)) // 2
    return np.pad(values, (lost, length - len(values) - lost), constant_values=np.nan)


def main() -> None:
    """Print the table."""
    for rate in (200.0, 500.0, 1000.0):
        for resolution in (0.0, 1e-4):
            time, q, exact = motion(rate, np.random.default_rng(0))
            readings = np.round(q / resolution) * resolution if resolution else q
            cutoff = (
                choose_cutoff(readings[:, None], rate).cutoff if resolution else 10.0
            )
            inner = (time > EDGE) & (time < DURATION - EDGE)
            print(f"{rate:g} Hz, encoder {resolution:g} rad, cut-off {cutoff:.1f} Hz")
            for name, values in estimates(readings, rate, cutoff).items():
                error = np.sqrt(
                    np.mean((values - exact)[inner] ** 2) / np.mean(exact[inner] ** 2)
                )
                print(f"    {name:30s} {error:.1e}")


if __name__ == "__main__":
    main()

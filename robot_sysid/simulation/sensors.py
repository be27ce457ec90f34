"""What a simulated arm's sensors make of the truth: noise, encoder steps, late torques.

An ideal sensor changes nothing. Anything that spoils the positions also removes velocities and
accelerations from the record, because an arm with only encoders would have to compute them from
those same positions; torques may be spoiled while the motion stays exactly known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from robot_sysid.records import Array, Measurement
from robot_sysid.records.options import PerJoint
from robot_sysid.simulation.options import SimulatedArmOptions

_WHOLE = 1e-9


class Sensors:
    """Reads exact measurements the way imperfect sensors would, chunk by chunk.

    Args:
        sample_rate: of the measurements, evenly spaced [Hz].
        rng: source of randomness. Each channel gets a generator of its own from it, so that the
            readings do not depend on how the stream is cut into chunks.
    """

    def __init__(
        self, options: SimulatedArmOptions, sample_rate: float, rng: np.random.Generator
    ) -> None:
        self._options, self._sample_rate = options, sample_rate
        self._seeds = rng.integers(2**63, size=(2, 4))

    def read(self, measurements: Iterable[Measurement]) -> Iterator[Measurement]:
        """Yield what the sensors report; the same stream gives the same readings each time."""
        options = self._options
        torque, position = (np.random.default_rng(seed) for seed in self._seeds)
        delay = TorqueDelay(options.torque_delay * self._sample_rate)
        for exact in measurements:
            tau = _noisy(delay.apply(exact.tau), options.noise_torque, torque)
            spoiled = replace(exact, tau=tau)
            if not options.exact_positions:
                q = _noisy(exact.q, options.noise_position, position)
                q = quantised(q, options.encoder_resolution)
                spoiled = replace(spoiled, q=q, qd=None, qdd=None)
            yield spoiled


def _noisy(values: Array, sigma: PerJoint, rng: np.random.Generator) -> Array:
    """Return values (N, n) plus white noise; the generator advances whatever sigma is."""
    return values + np.asarray(sigma) * rng.standard_normal(values.shape)


def quantised(values: Array, step: float) -> Array:
    """Return the nearest multiples of ``step``; values unchanged where it is 0."""
    return values if step == 0.0 else np.round(values / step) * step


class TorqueDelay:
    """Delays a stream of evenly spaced samples by any number of sample periods.

    Whole periods are exact. In between stands the cubic through four neighbouring samples
    (Lagrange), whose error is at most 3/128 h^4 max|tau''''| for delays above one period h and
    1/24 h^4 max|tau''''| below, where only older samples are at hand: 1e-7 N m for a torque of
    10 N m at 2 Hz, sampled at 1 kHz. A jump, such as that of dry friction where a joint reverses,
    is spread over the four samples around it. Before its first sample the torque is taken to have
    been constant.
    """

    def __init__(self, periods: float) -> None:
        nearest = round(periods)
        is_whole = abs(periods - nearest) < _WHOLE
        first = max(math.floor(periods) - 1, 0)
        self._taps = np.array([nearest]) if is_whole else first + np.arange(4)
        others = [np.delete(self._taps, i) for i in range(len(self._taps))]
        pairs = zip(self._taps, others)
        self._weights = [float(np.prod((periods - o) / (tap - o))) for tap, o in pairs]
        self._history: Array | None = None

    def apply(self, values: Array) -> Array:
        """Return the delayed samples (N, n) of the next chunk (N, n)."""
        longest = int(self._taps[-1])
        if self._history is None:
            self._history = np.repeat(values[:1], longest, axis=0)
        stream = np.concatenate((self._history, values))
        size = len(values)
        self._history = stream[size:]
        delayed = np.zeros(values.shape)
        for tap, weight in zip(self._taps, self._weights):
            delayed += weight * stream[longest - tap : longest - tap + size]
        return delayed

"""What a simulated arm's sensors make of the truth: noise, encoder steps, late torques.

An ideal sensor changes nothing. Anything that spoils the positions also removes velocities and
accelerations from the record, because an arm with only encoders would have to compute them from
those same positions; torques may be spoiled while the motion stays exactly known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement
from robot_sysid.records.options import PerJoint, require_positive

LONGEST_DELAY = 1.0
"""Longest torque delay that is accepted [s]; more is surely a slip of the unit."""
_WHOLE = 1e-9


@dataclass(frozen=True)
class SensorOptions:
    """How good the sensors of a simulated arm are; the defaults are perfect ones.

    Attributes:
        noise_torque: standard deviation of white torque noise [N m], one number for all joints or
            one per joint.
        noise_position: standard deviation of white position noise before quantisation [rad], one
            number or one per joint.
        encoder_resolution: step of the position reading [rad]; 0 for none.
        torque_delay: how much later than positions torques arrive [s].
        noise_velocity: standard deviation of white noise on a velocity sensor of its own [rad/s];
            None for an arm that measures positions only.
    """

    noise_torque: PerJoint = 0.0
    noise_position: PerJoint = 0.0
    encoder_resolution: float = 0.0
    torque_delay: float = 0.0
    noise_velocity: float | None = None

    def __post_init__(self) -> None:
        _require_not_negative(self.noise_torque, "--noise-torque")
        _require_not_negative(self.noise_position, "--noise-position")
        _require_not_negative(self.encoder_resolution, "--encoder-resolution")
        _require_not_negative(self.torque_delay, "--torque-delay")
        if self.torque_delay > LONGEST_DELAY:
            raise InputError(
                f"--torque-delay is given in seconds and may be at most {LONGEST_DELAY:g} "
                f"(got {self.torque_delay:g})"
            )
        if self.noise_velocity is not None:
            _require_not_negative(self.noise_velocity, "noise_velocity")

    @property
    def exact_positions(self) -> bool:
        """Whether positions come through unchanged."""
        return not np.any(self.noise_position) and self.encoder_resolution == 0.0

    @property
    def exact(self) -> bool:
        """Whether nothing at all is changed."""
        perfect_torque = not np.any(self.noise_torque) and self.torque_delay == 0.0
        return self.exact_positions and perfect_torque and self.noise_velocity is None

    def require_joints(self, joints: tuple[str, ...]) -> None:
        """Raise InputError where a list of noise levels does not fit the arm's joints."""
        named = (("--noise-torque", self.noise_torque), ("--noise-position", self.noise_position))
        for option, value in named:
            if np.ndim(value) == 1 and len(np.atleast_1d(value)) != len(joints):
                raise InputError(
                    f"{option} has {len(np.atleast_1d(value))} values for {len(joints)} joints; "
                    f"give one for all or one for each of {', '.join(joints)}"
                )


def _require_not_negative(value: PerJoint, option: str) -> None:
    for number in np.atleast_1d(value):
        if not (number >= 0.0 and math.isfinite(number)):
            raise InputError(f"{option} must be a number that is not negative (got {number:g})")


def parse_levels(text: str, option: str) -> PerJoint:
    """Return the noise levels in an option's text: one number, or several between commas.

    Raises:
        InputError: there is something else in it.
    """
    try:
        levels = tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(
            f"{option} {text!r} is neither a number nor a list like 0.1,0.1,0.05"
        ) from error
    return levels[0] if len(levels) == 1 else levels


class Sensors:
    """Reads exact measurements the way imperfect sensors would, chunk by chunk.

    Args:
        options: how good the sensors are.
        sample_rate: of the measurements, evenly spaced [Hz].
        rng: source of randomness. Each channel gets a generator of its own from it, so that the
            readings do not depend on how the stream is cut into chunks.

    Raises:
        InputError: the sample rate is not positive.
    """

    def __init__(
        self, options: SensorOptions, sample_rate: float, rng: np.random.Generator
    ) -> None:
        require_positive(sample_rate, "--sample-rate")
        self._options = options
        self._sample_rate = sample_rate
        self._seeds = rng.integers(2**63, size=(3, 4))

    def read(self, measurements: Iterable[Measurement]) -> Iterator[Measurement]:
        """Yield what the sensors report; the same stream gives the same readings each time."""
        torque, position, velocity = (np.random.default_rng(seed) for seed in self._seeds)
        delay = TorqueDelay(self._options.torque_delay * self._sample_rate)
        for exact in measurements:
            tau = _noisy(delay.apply(exact.tau), self._options.noise_torque, torque)
            spoiled = replace(exact, tau=tau)
            if not self._options.exact_positions:
                spoiled = replace(spoiled, q=self._position(exact.q, position), qd=None, qdd=None)
            if self._options.noise_velocity is not None and exact.qd is not None:
                qd = _noisy(exact.qd, self._options.noise_velocity, velocity)
                spoiled = replace(spoiled, qd=qd, qdd=None)
            yield spoiled

    def _position(self, q: Array, rng: np.random.Generator) -> Array:
        noisy = _noisy(q, self._options.noise_position, rng)
        return quantised(noisy, self._options.encoder_resolution)


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

    Args:
        periods: delay in sample periods.
    """

    def __init__(self, periods: float) -> None:
        nearest = round(periods)
        is_whole = abs(periods - nearest) < _WHOLE
        first = max(math.floor(periods) - 1, 0)
        self._taps = np.array([nearest]) if is_whole else first + np.arange(4)
        self._weights = np.ones(1) if is_whole else _lagrange_weights(self._taps, periods)
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


def _lagrange_weights(nodes: NDArray[np.int64], at: float) -> Array:
    """Return the weights (K,) that interpolate values at nodes (K,) to the point ``at``."""
    weights = np.ones(len(nodes))
    for i, node in enumerate(nodes):
        others = np.delete(nodes, i)
        weights[i] = np.prod((at - others) / (node - others))
    return weights

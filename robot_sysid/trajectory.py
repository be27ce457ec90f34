"""Excitation trajectories: sums of sinusoids with exact derivatives, at rest at both ends.

Joint j follows q_j(t) = c_j + w(t) s_j(t) with s_j(t) = sum_k a_jk sin(2 pi f_jk t + phi_jk) and a
window w that rises smoothly from 0 to 1 and falls back. All of it is evaluated lazily, so that a
long trajectory takes no memory. Limits are met by scaling amplitudes, never by clamping.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Callable

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, MotionPlan, RobotModel, check_arrays
from robot_sysid.records.option_fields import TOP_FREQUENCY_HZ, TrajectoryOptions

POSITION_MARGIN = 0.02
"""Share of the range kept free at each position limit."""
TORQUE_MARGIN = 0.95
"""Share of the torque limits that the motion may use."""
UNLIMITED_RANGE = {False: 2.0 * np.pi, True: 0.3}
"""Whether a joint without limits is a slide to the range that is assumed for it [rad; m for a
slide]."""
LONGEST_FADE = 2.5
"""Longest time in which the window rises, and in which it falls [s]."""
SPEED_SHARE = 0.99
"""Share of the speed limits that a random trajectory uses: its speed is sampled, and between
samples a 0.6 Hz motion exceeds its sampled peak by less than 0.1 %."""
LEAST_SPEED_RATE_HZ = 50.0
"""Least rate at which it is sampled [Hz]."""
TERMINAL_SHARE = 0.7
"""Share of its range that a random trajectory uses of the terminal joint."""
OTHER_SHARE = 0.1
"""Share of its range that a random trajectory uses of another joint."""
BAND_HZ = (0.1, TOP_FREQUENCY_HZ)
"""Lowest and highest frequency of random sinusoids [Hz]."""
MOST_SINUSOIDS = 5
"""Largest number of random sinusoids of a joint."""
SLOT_MIDDLE = (0.1, 0.9)
"""Part of its slot of the band in which each frequency lies, so that no two are nearly the same."""
LEAST_WEIGHT = 0.4
"""Least amplitude of a random sinusoid, over the largest that there may be."""
GOING_TIME = 1.0
"""Length of path between two stops of a motion that stops on its way [s of the path]."""
STANDING_TIME = 0.5
"""Time that it stands at a stop [s]: a servo comes to rest within it, and its sag shows."""
STOPPING_TIME = 0.25
"""Shortest time in which it stops, and starts again [s]. Shorter ones show no more at 30 Hz."""
SLOW_SHARE = 0.15
"""Share of the path, at its end, that is slow: friction and play show at turns without inertia."""
SLOW_RATE = 0.2
"""Speed of the slow part, over that of the path."""
CHUNK = 2048
"""Samples of a motion that are evaluated at a time."""

TorqueFunction = Callable[[Motion], Array]
"""Returns the joint torques (N, n) along a motion of N samples [N m]."""


@dataclass(frozen=True)
class SineTrajectory:
    """A sum of K sinusoids per joint under a common window.

    Attributes:
        center: (n,) position at rest [rad].
        amplitude: (n, K) of the sinusoids [rad]; 0 for unused ones.
        frequency_hz: (n, K) of the sinusoids [Hz].
        phase: (n, K) of the sinusoids at time 0 [rad].
        duration: length [s].
        fade: time the window takes to rise, and to fall [s].

    Raises:
        InputError: the fade is not positive, or longer than half of the duration.
    """

    center: Array
    amplitude: Array
    frequency_hz: Array
    phase: Array
    duration: float
    fade: float

    def __post_init__(self) -> None:
        shape = (np.shape(self.center)[0], np.shape(self.amplitude)[1])
        check_arrays(
            self, center=shape[:1], amplitude=shape, frequency_hz=shape, phase=shape
        )
        if not 0.0 < 2.0 * self.fade <= self.duration:
            raise InputError(
                f"fade {self.fade} s does not fit twice into {self.duration} s"
            )

    def scale_amplitudes(self, factor: Array | float) -> SineTrajectory:
        """Return the trajectory with each joint's amplitudes times ``factor`` (n,) or a number."""
        return replace(self, amplitude=self.amplitude * np.reshape(factor, (-1, 1)))

    @cached_property
    def _waves(self) -> tuple[Array, Any]:
        """Frequencies (F,) [rad/s] that occur, and the complex amplitudes (F, n) of the joints."""
        used = np.nonzero(self.amplitude)
        omega, row = np.unique(self.frequency_hz[used], return_inverse=True)
        factors = np.zeros((len(omega), len(self.center)), dtype=complex)
        waves = self.amplitude[used] * np.exp(1j * self.phase[used])
        np.add.at(factors, (np.ravel(row), used[0]), waves)
        return 2.0 * np.pi * omega, factors

    def evaluate(self, time: Array) -> Motion:
        """Return position, velocity and acceleration at times (N,) [s], by the product rule."""
        time = np.asarray(time, dtype=float)
        omega, factors = self._waves
        waves = np.exp(1j * np.outer(time, omega))
        rates = 1j * omega[:, None]
        s, ds, dds = ((waves @ (factors * rates**k)).imag for k in range(3))
        edge = window(time, self.duration, self.fade)
        w, dw, ddw = (factor[:, None] for factor in edge)
        qdd = ddw * s + 2.0 * dw * ds + w * dds
        return Motion(time, self.center + w * s, dw * s + w * ds, qdd)


Series = tuple[Array, Array, Array]
"""M functions of time at N instants (N, M), or one (N,), with first and second derivatives."""


def window(time: Array, duration: float, fade: float) -> Series:
    """Return w, w' and w'' (N,) of a window that rises from 0 to 1 and falls back to 0 at the end.

    Args:
        time: (N,) from 0 to the duration [s].
        duration: of the window [s].
        fade: time it takes to rise, and to fall [s].
    """
    is_rising = time < 0.5 * duration
    from_end = np.where(is_rising, time, duration - time)
    w, dw, ddw = smooth_step(np.clip(from_end / fade, 0.0, 1.0))
    dw = dw / fade
    # In the falling half the step runs backwards in time, which turns the sign of w' only.
    return w, np.where(is_rising, dw, -dw), ddw / fade**2


def smooth_step(x: Array) -> Series:
    """Return w, w' and w'' (N,) of 35 x^4 - 84 x^5 + 70 x^6 - 20 x^7 for x (N,) in 0 ... 1.

    It rises from 0 to 1, and its first three derivatives vanish at both ends: motion starts and
    ends without a jerk.
    """
    w = x**4 * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x)))
    bell = x * (1.0 - x)
    return w, 140.0 * bell**3, 420.0 * bell**2 * (1.0 - 2.0 * x)


@dataclass(frozen=True)
class StoppingTrajectory:
    """The path of a trajectory with another timing: moves between stops, and a slow last part.

    It is p(s(t)) with the rate s'(t) between 0 and 1, so that it passes the very positions of the
    path p, never faster. The jerky starts and stops tell delay, damping and inertia of a servo
    apart, standing shows its sag, and slow turns its friction and play.

    Attributes:
        path: the trajectory p.
        stopping_time: time in which the rate changes [s].
    """

    path: SineTrajectory
    stopping_time: float = STOPPING_TIME

    @cached_property
    def _rate_steps(self) -> tuple[Array, Array]:
        """Times (M,) at which the rate begins to change [s], and by how much (M,)."""
        n_moves = max(1, round((1.0 - SLOW_SHARE) * self.path.duration / GOING_TIME))
        going = (1.0 - SLOW_SHARE) * self.path.duration / n_moves
        starts = np.arange(n_moves) * (going + STANDING_TIME)
        slow_start = n_moves * (going + STANDING_TIME)
        end = slow_start + SLOW_SHARE * self.path.duration / SLOW_RATE
        time = np.concatenate((starts, starts + going, [slow_start, end]))
        is_start = np.repeat([1.0, -1.0], n_moves)
        return time, np.concatenate((is_start, [SLOW_RATE, -SLOW_RATE]))

    @property
    def duration(self) -> float:
        """Length [s]."""
        return float(self._rate_steps[0][-1]) + self.stopping_time

    def evaluate(self, time: Array) -> Motion:
        """Return position, velocity and acceleration at times (N,) [s], by the chain rule."""
        time = np.asarray(time, dtype=float)
        begins, changes = self._rate_steps
        x = (time[:, None] - begins) / self.stopping_time
        inside = np.clip(x, 0.0, 1.0)
        w, dw, _ = smooth_step(inside)
        # The integral of the step, which goes on as a straight line behind it.
        integral = inside**5 * (7.0 + inside * (-14.0 + inside * (10.0 - 2.5 * inside)))
        s = self.stopping_time * (integral + np.maximum(x - 1.0, 0.0)) @ changes
        rate = (w @ changes)[:, None]
        rate_slope = (dw @ changes)[:, None] / self.stopping_time
        along = self.path.evaluate(np.clip(s, 0.0, self.path.duration))
        qdd = along.qdd * rate**2 + along.qd * rate_slope
        return Motion(time, along.q, along.qd * rate, qdd)


def sample_times(
    duration: float, sample_rate: float, chunk: int = CHUNK
) -> Iterator[Array]:
    """Yield the sample times k / rate [s] from 0 up to the duration, ``chunk`` at a time."""
    count = sample_count(duration, sample_rate)
    for first in range(0, count, chunk):
        time = np.arange(first, min(first + chunk, count)) / sample_rate
        yield np.minimum(time, duration)


def sample_count(duration: float, sample_rate: float) -> int:
    """Return the number of sample times k / rate from 0 up to the duration [s], at a rate [Hz]."""
    return int(np.floor(duration * sample_rate + 1e-6)) + 1


def motion_chunks(plan: MotionPlan, sample_rate: float) -> Iterator[Motion]:
    """Yield the motion of a plan from begin to end at a sample rate [Hz], chunk by chunk."""
    for time in sample_times(plan.duration, sample_rate):
        yield plan.evaluate(time)


def generate_excitation_trajectory(
    robot: RobotModel,
    rng: np.random.Generator,
    duration: float = TrajectoryOptions.duration,
) -> SineTrajectory:
    """Draw a random trajectory that moves the terminal joint widely and the others a little.

    Args:
        robot: the arm; its limits of positions and speeds are obeyed.
        rng: source of randomness.
        duration: length [s].
    """
    fade = min(LONGEST_FADE, duration / 4.0)
    center, reach = _center_and_reach(robot)
    frequency, phase, weight = _draw_sinusoids(rng, robot.n_joints)
    shape = SineTrajectory(center, weight, frequency, phase, duration, fade)
    # The reach is compared with the sum of the amplitudes, a bound for all times. Speed is sampled:
    # a short motion is mostly window, and still gets 64 samples per rise.
    total = np.sum(np.abs(shape.amplitude), axis=1)
    times = sample_times(duration, max(LEAST_SPEED_RATE_HZ, 256 / duration))
    peaks = [np.max(np.abs(shape.evaluate(time).qd), axis=0) for time in times]
    usable_speed = SPEED_SHARE * robot.limits.velocity
    factor = np.minimum(reach / total, usable_speed / np.max(peaks, axis=0))
    return shape.scale_amplitudes(factor)


def assumed_reach(robot: RobotModel) -> Array:
    """Return how far joints without limits may move from their reference (n,) [rad or m]."""
    ranges = np.where(robot.is_slide, UNLIMITED_RANGE[True], UNLIMITED_RANGE[False])
    return 0.5 * ranges


def _center_and_reach(robot: RobotModel) -> tuple[Array, Array]:
    """Return each joint's position at rest (n,), and how far it may move from there (n,) [rad; m
    for slides].
    """
    limits = robot.limits.around(robot.reference, assumed_reach(robot))
    share = np.full(robot.n_joints, OTHER_SHARE)
    share[-1] = TERMINAL_SHARE
    reach = limits.span * share
    center = robot.reference.copy()
    if robot.limits.has_range[-1]:
        center[-1] = limits.center[-1]
    margin = 2.0 * POSITION_MARGIN * limits.span
    lower = limits.lower + reach + margin
    return np.clip(center, lower, limits.upper - reach - margin), reach


def random_sinusoids(joints: int, time: Array, rng: np.random.Generator) -> Motion:
    """Return sums of sinusoids of ``BAND_HZ`` about zero (N, joints), of size one, at times (N,).

    They have no window: they neither start nor end at rest, and nothing plays them.
    """
    frequency, phase, weight = _draw_sinusoids(rng, joints)
    rate = 2.0 * np.pi * frequency
    angle = time[:, None, None] * rate + phase
    sine, cosine = weight * np.sin(angle), weight * np.cos(angle)
    q, qd, qdd = (
        np.sum(part, axis=2) for part in (sine, rate * cosine, -(rate**2) * sine)
    )
    return Motion(time, q, qd, qdd)


def _draw_sinusoids(
    rng: np.random.Generator, joints: int
) -> tuple[Array, Array, Array]:
    """Return random frequencies [Hz], phases [rad] and relative amplitudes, (joints, K) each.

    A joint has three to ``MOST_SINUSOIDS`` sinusoids, with frequencies in ``BAND_HZ``.
    """
    # The band is cut into one slot per sinusoid, so that no two frequencies of the arm coincide;
    # within its slot a frequency is a random real number, so ratios are not small fractions and the
    # motion does not repeat.
    n_terms = rng.integers(3, MOST_SINUSOIDS + 1, size=joints)
    is_used = np.arange(MOST_SINUSOIDS) < n_terms[:, None]
    slots = rng.permutation(joints * MOST_SINUSOIDS).reshape(joints, MOST_SINUSOIDS)
    position = (slots + rng.uniform(*SLOT_MIDDLE, size=slots.shape)) / slots.size
    lowest, highest = BAND_HZ
    frequency = lowest + (highest - lowest) * position
    phase = rng.uniform(0.0, 2.0 * np.pi, size=slots.shape)
    weight = np.where(is_used, rng.uniform(LEAST_WEIGHT, 1.0, size=slots.shape), 0.0)
    return frequency, phase, weight

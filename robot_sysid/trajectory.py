"""Excitation trajectories: sums of sinusoids with exact derivatives, at rest at both ends.

Joint j follows q_j(t) = c_j + w(t) s_j(t) with s_j(t) = sum_k a_jk sin(2 pi f_jk t + phi_jk) and a
window w that rises smoothly from 0 to 1 and falls back. All of it is evaluated lazily, so that a
long trajectory takes no memory. Limits are met by scaling amplitudes, never by clamping.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Callable

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, MotionPlan, RobotModel, check_arrays
from robot_sysid.records.option_fields import TrajectoryOptions

FREQUENCY_BAND_HZ = (0.1, 0.6)
TERMS_PER_JOINT = (3, 5)
TERMINAL_SHARE = 0.7
OTHER_SHARE = 0.1
"""Share of its range that the terminal joint's motion uses, and that of every other joint."""
POSITION_MARGIN = 0.02
"""Share of the range kept free at each position limit."""
TORQUE_MARGIN = 0.95
"""Share of the torque limits that the motion may use."""
UNLIMITED_RANGE = {False: 2.0 * np.pi, True: 0.3}
"""Range assumed for a joint without limits: hinge [rad], slide [m]."""
LONGEST_FADE = 2.5
_SPEED_CHECK_HZ = 50.0
_TORQUE_CHECK_HZ = 25.0
_FEWEST_CHECKS = 256
_SMALLEST_FACTOR = 2.0**-30
CHUNK = 2048

TorqueFunction = Callable[[Motion], Array]


@dataclass(frozen=True)
class SineTrajectory:
    """A sum of sinusoids per joint under a common window.

    Attributes:
        center: (n,) position at rest [rad].
        amplitude, frequency_hz, phase: (n, K) of the sinusoids [rad, Hz, rad]; unused ones have
            amplitude 0.
        duration: length [s].
        fade: time the window takes to rise and to fall [s].
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

    def scaled(self, factor: Array | float) -> SineTrajectory:
        """Return the trajectory with each joint's amplitudes times ``factor`` (n,) or a number."""
        return replace(self, amplitude=self.amplitude * np.reshape(factor, (-1, 1)))

    def evaluate(self, time: Array) -> Motion:
        """Return position, velocity and acceleration at times (N,) [s], by the product rule."""
        time = np.asarray(time, dtype=float)
        used = np.nonzero(self.amplitude)
        omega = 2.0 * np.pi * self.frequency_hz[used]
        joints = np.eye(len(self.center))[used[0]]
        angle = np.outer(time, omega) + self.phase[used]
        size = self.amplitude[used]
        sine = size * np.sin(angle)
        cosine = size * np.cos(angle)
        s = sine @ joints
        ds = (omega * cosine) @ joints
        dds = -(omega**2 * sine) @ joints
        s, ds, dds = faded(window(time, self.duration, self.fade), (s, ds, dds))
        return Motion(time, self.center + s, ds, dds)


Series = tuple[Array, Array, Array]
"""Functions of time (N, M), or one (N,), with their first and second derivatives."""


def window(time: Array, duration: float, fade: float) -> Series:
    """Return w, w' and w'' (N,): a smooth step up, ones, and down again."""
    rising = time < 0.5 * duration
    w, dw, ddw = smooth_step(
        np.clip(np.where(rising, time, duration - time) / fade, 0.0, 1.0)
    )
    dw = dw / fade
    return w, np.where(rising, dw, -dw), ddw / fade**2


def smooth_step(x: Array) -> Series:
    """Return w, w' and w'' (N,) of 35 x^4 - 84 x^5 + 70 x^6 - 20 x^7, which rises from 0 to 1.

    Its first three derivatives vanish at both ends: motion starts and ends without a jerk.
    """
    w = x**4 * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x)))
    return (
        w,
        140.0 * (x * (1.0 - x)) ** 3,
        420.0 * (x * (1.0 - x)) ** 2 * (1.0 - 2.0 * x),
    )


def faded(edge: Series, series: Series) -> Series:
    """Return w s (N, M) and its derivatives; a window (N,) and series (N, M) come with theirs."""
    w, dw, ddw = (value[:, None] for value in edge)
    s, ds, dds = series
    return w * s, dw * s + w * ds, ddw * s + 2.0 * dw * ds + w * dds


def sample_times(
    duration: float, sample_rate: float, start: float = 0.0, end: float = np.inf
) -> Iterator[Array]:
    """Yield the sample times k / rate from 0 to the duration, both included, in chunks [s].

    Only those from ``start`` to ``end`` [s], with the next one outside, where these are given.
    """
    count = int(
        min(sample_count(duration, sample_rate), np.ceil(end * sample_rate) + 1)
    )
    for first in range(int(start * sample_rate), count, CHUNK):
        time = np.arange(first, min(first + CHUNK, count)) / sample_rate
        yield np.minimum(time, duration)


def sample_count(duration: float, sample_rate: float) -> int:
    """Return the number of samples of a trajectory, both ends included."""
    return int(np.floor(duration * sample_rate + 1e-6)) + 1


def motion_chunks(plan: MotionPlan, sample_rate: float) -> Iterator[Motion]:
    """Yield the whole motion of a plan at a sample rate [Hz], chunk by chunk."""
    for time in sample_times(plan.duration, sample_rate):
        yield plan.evaluate(time)


def spread_motion(plan: MotionPlan, most: int, rate: float = 200.0) -> Motion:
    """Return the motion at instants spread over it: ``rate`` [Hz], or ``most`` where that is fewer.

    Where they are few they follow the golden ratio, which no period of the motion can fall in step
    with.
    """
    count = sample_count(plan.duration, rate)
    if count <= most:
        return plan.evaluate(np.minimum(np.arange(count) / rate, plan.duration))
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    return plan.evaluate(np.sort(plan.duration * np.mod(golden * np.arange(most), 1.0)))


def generate_excitation_trajectory(
    robot: RobotModel,
    rng: np.random.Generator,
    duration: float = TrajectoryOptions.duration,
    torque: TorqueFunction | None = None,
) -> tuple[SineTrajectory, tuple[str, ...]]:
    """Draw a random trajectory that moves the terminal joint widely and the others a little.

    Args:
        robot: the arm; its limits are obeyed.
        rng: source of randomness.
        duration: length [s].
        torque: joint torques (N, n) along a motion; None leaves torque limits unchecked.

    Returns:
        (trajectory, notes): notes name limits that made it smaller or that cannot be met.
    """
    fade = min(LONGEST_FADE, 0.25 * duration)
    center, reach = _center_and_reach(robot)
    frequency, phase, weight = _draw_sinusoids(rng, robot.n_joints)
    shape = SineTrajectory(center, weight, frequency, phase, duration, fade)
    # The reach is compared with the sum of the amplitudes, a bound for all times. Speed is sampled;
    # between samples a 0.6 Hz motion exceeds its sampled peak by less than 0.1 %, which the 1 %
    # reserve covers. A short motion is mostly window, and still gets 64 samples per rise.
    total = np.sum(np.abs(shape.amplitude), axis=1)
    speed = _peak(shape, _SPEED_CHECK_HZ, lambda motion: motion.qd)
    factor = np.minimum(reach / total, 0.99 * robot.limits.velocity / speed)
    return _fit_torque(shape.scaled(factor), robot, torque)


def _center_and_reach(robot: RobotModel) -> tuple[Array, Array]:
    """Return where each joint rests and how far it may go from there (n,), (n,)."""
    lower = robot.limits.lower
    upper = robot.limits.upper
    limited = np.isfinite(lower) & np.isfinite(upper)
    assumed = np.where(robot.is_slide, UNLIMITED_RANGE[True], UNLIMITED_RANGE[False])
    span = np.where(limited, upper - lower, assumed)
    share = np.full(robot.n_joints, OTHER_SHARE)
    share[-1] = TERMINAL_SHARE
    reach = 0.5 * span * share
    center = robot.reference.copy()
    if limited[-1]:
        center[-1] = 0.5 * (lower[-1] + upper[-1])
    margin = POSITION_MARGIN * span
    return np.clip(center, lower + reach + margin, upper - reach - margin), reach


def _draw_sinusoids(
    rng: np.random.Generator, joints: int
) -> tuple[Array, Array, Array]:
    """Return frequencies, phases and relative amplitudes (joints, K)."""
    # The band is cut into as many slots as there are sinusoids and each gets a slot of its own, so
    # that no two frequencies of the whole arm coincide; within its slot a frequency is a random
    # real number, so ratios are not small fractions and the motion does not repeat.
    most = TERMS_PER_JOINT[1]
    terms = rng.integers(TERMS_PER_JOINT[0], most + 1, size=joints)
    used = np.arange(most) < terms[:, None]
    slots = rng.permutation(joints * most).reshape(joints, most)
    position = (slots + rng.uniform(0.1, 0.9, size=slots.shape)) / slots.size
    low, high = FREQUENCY_BAND_HZ
    frequency = low + (high - low) * position
    phase = rng.uniform(0.0, 2.0 * np.pi, size=slots.shape)
    weight = np.where(used, rng.uniform(0.4, 1.0, size=slots.shape), 0.0)
    return frequency, phase, weight


def _peak(plan: MotionPlan, rate: float, quantity: TorqueFunction) -> Array:
    """Return (n,) largest absolute value of a quantity along a plan sampled at ``rate`` Hz."""
    times = sample_times(plan.duration, max(rate, _FEWEST_CHECKS / plan.duration))
    peaks = [np.max(np.abs(quantity(plan.evaluate(time))), axis=0) for time in times]
    return np.max(peaks, axis=0)


def _fit_torque(
    trajectory: SineTrajectory, robot: RobotModel, torque: TorqueFunction | None
) -> tuple[SineTrajectory, tuple[str, ...]]:
    """Shrink the whole motion until the torque limits hold."""
    # A joint whose weight and dry friction alone exceed its limit cannot be helped by a smaller
    # motion; it is named in a note and left out of the search.
    if torque is None or not np.any(np.isfinite(robot.limits.torque)):
        return trajectory, ()
    allowed = TORQUE_MARGIN * robot.limits.torque

    def excess(factor: float) -> Array:
        return _peak(trajectory.scaled(factor), _TORQUE_CHECK_HZ, torque) / allowed

    hopeless = excess(_SMALLEST_FACTOR) > 1.0
    notes = tuple(
        f"even the smallest motion takes more than the torque limit of {robot.limits.torque[j]:g} "
        f"at joint {robot.joint_names[j]}; this motion does not keep it"
        for j in np.flatnonzero(hopeless)
    )
    if not np.any(excess(1.0)[~hopeless] > 1.0):
        return trajectory, notes
    low = np.log2(_SMALLEST_FACTOR)
    high = 0.0
    for _ in range(12):
        middle = 0.5 * (low + high)
        fits = not np.any(excess(2.0**middle)[~hopeless] > 1.0)
        low, high = (middle, high) if fits else (low, middle)
    factor = float(2.0**low)
    note = f"motion scaled to {100.0 * factor:.2g} % to stay within the torque limits"
    return trajectory.scaled(factor), (*notes, note)

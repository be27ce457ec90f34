"""Kinds of trajectories beside random sinusoids: Fourier series, poses, and sweeps.

Of a Fourier series joint j follows q_j(t) = r_j + w(t) (o_j + sum_k a_jk sin(k W t) + b_jk cos(k W
t)), W = 2 pi f0, as in Swevers, Ganseman, Tukel, De Schutter, Van Brussel, "Optimal robot
excitation and identification", IEEE Trans. Robotics and Automation 13(5), 1997, eq. 5. Rest at both
ends comes from one of two places:

- faded: a window w rises smoothly from 0 to 1 and falls back (``trajectory.window``);
- periodic (fade = 0): w = 1, and the coefficients obey sum b = -o, sum k a = 0, sum k^2 b = 0, so
  that the motion can be repeated without a stop.

Because q is linear in (o, a, b), so are velocity and acceleration, and all joints share one matrix
of basis functions. Poses and sweeps follow straight lines in joint space; poses rest, sweeps keep
their speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, checked_array
from robot_sysid.trajectory import Series, faded, smooth_step, window

END_TOLERANCE = 1e-9
"""Largest velocity and acceleration a periodic trajectory may have at its ends [rad/s, rad/s^2]."""
PEAK_SPEED, PEAK_ACCELERATION = 2.1875, 7.5132
"""Largest first and second derivative of a smooth step from 0 to 1 in unit time."""
PEAK_OF_RAMP = 1.875
"""Largest derivative of the rise of a sweep's speed from 0 to 1 in unit time."""


@dataclass(frozen=True)
class FourierBasis:
    """The functions a Fourier series trajectory is made of: 1, sin(k W t), cos(k W t), k = 1..K.

    Attributes:
        duration: length [s].
        base_frequency_hz: frequency f0 of the first harmonic [Hz].
        harmonics: number of harmonics K.
        fade: time the window takes to rise and to fall [s]; 0 for a periodic trajectory.
    """

    duration: float
    base_frequency_hz: float
    harmonics: int
    fade: float

    def __post_init__(self) -> None:
        if not (0.0 < self.duration < np.inf and 0.0 < self.base_frequency_hz < np.inf):
            raise InputError("a Fourier series needs a finite positive duration and base frequency")
        least = 1 if self.fade > 0.0 else 3
        if self.harmonics < least:
            raise InputError(
                f"--harmonics {self.harmonics} is too few: a trajectory that is at rest at both "
                f"ends this way needs at least {least}"
            )
        if not 0.0 <= 2.0 * self.fade <= self.duration:
            raise InputError(f"fade {self.fade} s does not fit twice into {self.duration} s")
        periods = self.duration * self.base_frequency_hz
        if self.fade == 0.0 and (
            round(periods) < 1 or abs(periods - round(periods)) > 1e-12 * (1.0 + periods)
        ):
            raise InputError(
                f"--base-frequency {self.base_frequency_hz:g}: a periodic trajectory of "
                f"{self.duration:g} s must hold a whole number of periods (it holds {periods:g})"
            )

    @property
    def size(self) -> int:
        """Number of functions 2 K + 1."""
        return 2 * self.harmonics + 1

    @property
    def top_frequency_hz(self) -> float:
        """Frequency of the last harmonic [Hz]."""
        return self.harmonics * self.base_frequency_hz

    @property
    def order(self) -> Array:
        """Harmonic numbers k = 1..K."""
        return np.arange(1.0, self.harmonics + 1.0)

    @property
    def rates(self) -> Array:
        """What each derivative multiplies exp(i k W t) by, k = 0..K (K + 1,) [1/s]."""
        return np.asarray(2j * np.pi * self.base_frequency_hz * np.arange(self.harmonics + 1.0))

    def waves(self, time: Array) -> Array:
        """Return exp(i k W t) (N, K + 1), by products: far cheaper than sines."""
        first = np.exp(2j * np.pi * self.base_frequency_hz * np.asarray(time, dtype=float))
        return np.vander(first, self.harmonics + 1, increasing=True)

    def evaluate(self, time: Array) -> Series:
        """Return the functions and their first and second derivatives (N, 2 K + 1)."""
        turned = (self.waves(time) * self.rates**k for k in range(3))
        s, ds, dds = (np.hstack((w.real[:, :1], w.imag[:, 1:], w.real[:, 1:])) for w in turned)
        return self.at_rest(time, (s, ds, dds))

    def at_rest(self, time: Array, series: Series) -> Series:
        """Return a series (N, M) and its derivatives under the window, where there is one."""
        if self.fade == 0.0:
            return series
        return faded(window(np.asarray(time, dtype=float), self.duration, self.fade), series)

    def free_directions(self) -> Array:
        """Return (2 K + 1, M) orthonormal directions that keep both ends at rest.

        All of them where a window does that; otherwise those of o + sum b = 0, sum k a = 0,
        sum k^2 b = 0.
        """
        if self.fade > 0.0:
            return np.eye(self.size)
        k, none = self.order / self.harmonics, np.zeros(self.harmonics)
        ends = (([1.0], none, none + 1.0), ([0.0], k, none), ([0.0], none, k**2))
        return np.linalg.svd([np.concatenate(row) for row in ends])[2][3:].T


@dataclass(frozen=True)
class FourierTrajectory:
    """A Fourier series per joint, starting and ending at rest in the same configuration.

    Attributes:
        rest: (n,) position at both ends [rad].
        coefficients: (n, 2 K + 1) per joint offset, K sine and K cosine coefficients [rad].
    """

    basis: FourierBasis
    rest: Array
    coefficients: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "rest", checked_array(self.rest, (None,), "rest"))
        shape = (len(self.rest), self.basis.size)
        value = checked_array(self.coefficients, shape, "Fourier coefficients")
        object.__setattr__(self, "coefficients", value)
        # Without a window the coefficients must start at rest; 0 at time 0 is 0 after each period.
        for row in self.basis.evaluate(np.zeros(1)) if self.basis.fade == 0.0 else ():
            worst = float(np.max(np.abs(row @ self.coefficients.T)))
            if worst > END_TOLERANCE:
                raise InputError(
                    f"the coefficients of a periodic trajectory do not start at rest (off by "
                    f"{worst:.1e}); use a trajectory with a fade, or design it again"
                )

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.basis.duration

    @property
    def cycle(self) -> tuple[float, float]:
        """Period after which it repeats itself, but for so much time at both ends [s]."""
        return 1.0 / self.basis.base_frequency_hz, self.basis.fade

    def evaluate(self, time: Array) -> Motion:
        """Return position, velocity and acceleration at times (N,) [s]."""
        offset, a, b = np.split(self.coefficients, (1, 1 + self.basis.harmonics), axis=1)
        wave, turned = self.basis.waves(time), np.hstack((1j * offset, a + 1j * b))
        # All joints in one product each, before any window.
        s, ds, dds = ((wave @ (self.basis.rates**k * turned).T).imag for k in range(3))
        s, ds, dds = self.basis.at_rest(time, (s, ds, dds))
        return Motion(np.asarray(time, dtype=float), self.rest + s, ds, dds)


@dataclass(frozen=True)
class LineTrajectory:
    """Straight lines in joint space; the arm is at rest in every point.

    Attributes:
        points: (P, n) [rad].
        moves: (P - 1,) how long the way from each point to the next takes [s].
        dwells: (P,) how long the arm stays in each point [s].
        ramps: (P - 1,) [s] in which the speed rises smoothly to what it stays at, and falls again,
            at most half the way each; None where each way is one smooth step.
    """

    points: Array
    moves: Array
    dwells: Array
    ramps: Array | None = None

    def __post_init__(self) -> None:
        points = checked_array(self.points, (None, None), "points")
        moves = checked_array(self.moves, (len(points) - 1,), "moves")
        dwells = checked_array(self.dwells, (len(points),), "dwells")
        if len(points) < 2 or np.any(moves <= 0.0) or np.any(dwells < 0.0):
            raise InputError("moves between poses take time, and rests are not negative")
        fields = {"points": points, "moves": moves, "dwells": dwells}
        if self.ramps is not None:
            ramps = fields["ramps"] = checked_array(self.ramps, (len(moves),), "ramps")
            if np.any(ramps <= 0.0) or np.any(2.0 * ramps > moves):
                raise InputError("a sweep takes time, and its ramps fit into it twice")
        self.__dict__.update(fields)

    @property
    def duration(self) -> float:
        """Length [s]."""
        return float(np.sum(self.moves) + np.sum(self.dwells))

    @property
    def arrivals(self) -> Array:
        """When each point is reached (P,) [s]."""
        return np.concatenate(([0.0], np.cumsum(self.dwells[:-1] + self.moves)))

    @property
    def speeds(self) -> Array:
        """Constant part of each line's velocity (P - 1, n), where there are ramps [rad/s]."""
        assert self.ramps is not None
        return np.asarray(np.diff(self.points, axis=0) / (self.moves - self.ramps)[:, None])

    def evaluate(self, time: Array) -> Motion:
        """Return the motion at times (N,) [s]; exact derivatives."""
        time = np.asarray(time, dtype=float)
        at = np.clip(np.searchsorted(self.arrivals, time, side="right") - 1, 0, len(self.moves) - 1)
        length = self.moves[at]
        gone = np.clip(time - self.arrivals[at] - self.dwells[at], 0.0, length)
        if self.ramps is None:
            step = np.diff(self.points, axis=0)[at]
            w, dw, ddw = smooth_step(gone / length)
            dw, ddw = dw / length, ddw / length**2
        else:
            step = self.speeds[at]
            w, dw, ddw = _cruise(gone, length, self.ramps[at])
        w, dw, ddw = w[:, None], dw[:, None], ddw[:, None]
        return Motion(time, self.points[at] + w * step, dw * step, ddw * step)


def straight_way(begin: Array, end: Array) -> LineTrajectory:
    """Return the motion from one pose (n,) to another in a straight line, at about 1 rad/s."""
    seconds = max(1.0, float(np.max(np.abs(end - begin))))
    return LineTrajectory(np.stack((begin, end)), np.array([seconds]), np.zeros(2))


def _cruise(gone: Array, length: Array, ramp: Array) -> Series:
    """Return way [s], speed and its change [1/s] (N,) at unit speed, ``gone`` [s] after the start.

    A way takes ``length`` [s], rising and falling ``ramp`` [s] each; ramps count half.
    """
    near = np.minimum(gone, length - gone)
    rise, speed, bend = _rise(np.minimum(near / ramp, 1.0))
    way, falls = ramp * rise + np.maximum(near - ramp, 0.0), gone > near
    return np.where(falls, length - ramp - way, way), speed, np.where(falls, -bend, bend) / ramp


def _rise(x: Array) -> Series:
    """Return integral, value and slope (N,) of 10 x^3 - 15 x^4 + 6 x^5, which rises from 0 to 1."""
    integral = x**4 * (2.5 + x * (x - 3.0))
    return integral, x**3 * (10.0 + x * (6.0 * x - 15.0)), 30.0 * (x * (1.0 - x)) ** 2

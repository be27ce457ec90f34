"""Whether positions, velocities and torques of a motor are scaled as its registers say.

They are scaled by numbers stored in the motor. If one is wrong, every value is wrong by the same
factor and nothing else seems odd.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.records import Array

# Long beside a cycle and short beside a swing; ten of them give a scatter [s].
_WINDOW = 0.2
_LEAST_WINDOWS = 10
# How far the slope may be from 1: two types' VMAX differ by a tenth or more (45 and 50).
_SLOPE_TOLERANCE = 0.03
# Within one window: how far a joint may come beside its velocity, plus a share of that way [rad].
_LEAST_SLIP = 0.02
_SLIP_SHARE = 0.05
# Where a mean speed may be so much more than the last one of a cycle, slip cannot be told.
_COARSE = 1.3


@dataclass(frozen=True)
class Slip:
    """A joint that came another way than its velocity says, within one window.

    Attributes:
        joint: which one.
        integral: what its velocities added up to [rad].
        change: how far it came [rad].
        speed: how fast it left its velocity [rad/s].
    """

    joint: int
    integral: float
    change: float
    speed: float


class VelocityScalingCheck:
    """Tells whether the velocity channel integrates to the position channel.

    The slope of position change against integrated velocity, over short windows, has to be 1. How
    well it can be known depends on the scatter and on the steps (n,) of the velocity channel
    [rad/s]: an error of up to half a step, the same all through a window, is allowed for.

    Velocities are sampled at the end of each command's time, when a joint of little inertia has
    slowed down. Without any it is v = v_des + k (p_des - p), k = kp / kd, so that in steady motion
    the mean over a cycle T is (exp(kT) - 1) / (kT) times the last velocity; with inertia it is
    between 1 and this. ``fades`` (n,) is kT.

    Attributes:
        explained: (n,) the largest mean velocity of a cycle over its last one.
    """

    def __init__(self, velocity_step: Array, fades: Array) -> None:
        n_joints = len(velocity_step)
        self.explained: Array = np.expm1(fades) / fades
        self._rounding = 0.5 * velocity_step * _WINDOW
        self._last: tuple[Array, Array, Array] | None = None
        self._begin_time = np.zeros(n_joints)
        self._begin_q = np.zeros(n_joints)
        self._sum = np.zeros(n_joints)
        self._path = np.zeros(n_joints)
        # Per joint: count and sums of x, y, xx, xy, yy.
        self._sums = np.zeros((6, n_joints))

    def add(self, time: Array, q: Array, qd: Array) -> Slip | None:
        """Add one sample (n,) per joint [s, rad, rad/s]; NaN where a joint did not answer.

        Returns a joint that slipped in a window which this sample completes.
        """
        fresh = np.isfinite(time) & np.isfinite(q)
        if self._last is None:
            if np.all(fresh):
                self._last = time, q, qd
                self._begin_time = time
                self._begin_q = q
            return None
        last_time, last_q, last_qd = self._last
        step = np.where(fresh, 0.5 * (qd + last_qd) * (time - last_time), 0.0)
        self._sum += step
        self._path += np.abs(step)
        time = np.where(fresh, time, last_time)
        q = np.where(fresh, q, last_q)
        self._last = time, q, np.where(fresh, qd, last_qd)
        full = fresh & (time - self._begin_time >= _WINDOW)
        if not np.any(full):
            return None
        x = np.where(full, self._sum, 0.0)
        y = np.where(full, q - self._begin_q, 0.0)
        slip = self._slip(x, y, np.where(full, self._path, 0.0))
        self._sums += np.stack([full.astype(float), x, y, x * x, x * y, y * y])
        self._sum = np.where(full, 0.0, self._sum)
        self._path = np.where(full, 0.0, self._path)
        self._begin_time = np.where(full, time, self._begin_time)
        self._begin_q = np.where(full, q, self._begin_q)
        return slip

    def _slip(self, integral: Array, change: Array, path: Array) -> Slip | None:
        """Return the joint that slipped, of integrals, changes and lengths of paths (n,) [rad]."""
        fastest = integral * self.explained
        lower = np.minimum(integral, fastest)
        upper = np.maximum(integral, fastest)
        mismatch = change - np.clip(change, lower, upper)
        # Where a joint slows down within a cycle, its mean speed is known less well.
        doubt = _SLIP_SHARE + 0.5 * (self.explained - 1.0)
        tolerance = _LEAST_SLIP + doubt * path + 2.0 * self._rounding
        tolerance = np.where(self.explained > _COARSE, np.inf, tolerance)
        j = int(np.argmax(np.abs(mismatch) - tolerance))
        if abs(mismatch[j]) <= tolerance[j]:
            return None
        return Slip(
            j, float(integral[j]), float(change[j]), float(mismatch[j] / _WINDOW)
        )

    def worst(self) -> tuple[int, float] | None:
        """Return (joint, slope) of a joint whose slope is surely off, or None.

        The doubt is three standard errors plus the largest effect of rounded velocities.
        """
        count, x, y, xx, xy, yy = self._sums
        n = np.maximum(count, 1.0)
        cxx = xx - x * x / n
        cxy = xy - x * y / n
        cyy = yy - y * y / n
        spread = np.sqrt(np.maximum(cxx, 0.0) / n)
        moved = (count >= _LEAST_WINDOWS) & (spread > self._rounding)
        variation = np.where(moved, cxx, 1.0)
        slope = np.where(moved, cxy / variation, 1.0)
        residual = np.maximum(cyy - slope * cxy, 0.0) / np.maximum(count - 2.0, 1.0)
        error = 3.0 * np.sqrt(residual / variation)
        doubt = error + self._rounding / np.where(moved, spread, 1.0)
        unexplained = slope / np.clip(slope, 1.0, self.explained)
        worst = _farthest_from_one(
            unexplained, np.where(moved, doubt, np.inf), _SLOPE_TOLERANCE
        )
        return None if worst is None else (worst[0], float(slope[worst[0]]))


def _farthest_from_one(
    ratio: Array, doubt: Array, tolerance: float
) -> tuple[int, float] | None:
    excess = np.abs(ratio - 1.0) - doubt
    j = int(np.argmax(excess))
    return (j, float(ratio[j])) if excess[j] > tolerance else None


# A tenth of a second at 250 Hz.
_ENOUGH_SAMPLES = 25
# Torque is an estimate from the current; but both directions use the same constant. Two types' TMAX
# differ by a fifth or more (10 and 12).
_RATIO_TOLERANCE = 0.15
# Half the speed on the way to the first point [rad/s].
_SLOW = 0.1


class TorqueScalingCheck:
    """Tells whether motors report the torque they were commanded to make.

    A motor makes kp (p - q) + kd (v - qd) + t and reports what it makes. Both numbers are known in
    each cycle, so their ratio is; a motor whose TMAX is another than its register says, or that
    counts before its gear, shows by it, and so would every mass identified from it.

    Both arguments are (n,) [N m]; beyond its peak torque a motor does not do as commanded.
    """

    def __init__(self, torque_step: Array, peak: Array) -> None:
        self._peak = 0.9 * peak
        self._doubt = np.maximum(4.0 * torque_step, 0.005 * peak)
        # Per joint: count and sums of xx, xy.
        self._sums = np.zeros((3, len(peak)))

    def add(self, commanded: Array, measured: Array, qd: Array) -> None:
        """Add one sample (n,) per joint [N m, N m, rad/s]; NaN where a joint did not answer.

        Samples of a joint that moves fast are left out, because a velocity that is wrong or late
        would make ``commanded`` wrong.
        """
        usable = (
            np.isfinite(measured)
            & (np.abs(commanded) < self._peak)
            & (np.abs(qd) < _SLOW)
        )
        x = np.where(usable, commanded, 0.0)
        y = np.where(usable, measured, 0.0)
        self._sums += np.stack([usable.astype(float), x * x, x * y])

    def worst(self) -> tuple[int, float] | None:
        """Return (joint, ratio) of a joint that surely reports another torque, or None.

        The doubt of a ratio is what rounding makes of the size of the torques seen so far.
        """
        count, xx, xy = self._sums
        size = np.sqrt(xx / np.maximum(count, 1.0))
        enough = (count >= _ENOUGH_SAMPLES) & (size > 2.0 * self._doubt)
        ratio = np.where(enough, xy / np.where(enough, xx, 1.0), 1.0)
        doubt = np.where(enough, self._doubt / np.maximum(size, 1e-9), np.inf)
        return _farthest_from_one(ratio, doubt, _RATIO_TOLERANCE)

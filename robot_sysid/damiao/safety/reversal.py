"""Which motor turns against its command: its torque, or what its encoder says, has the other sign.

The position control of such a motor drives its joint away from the reference, faster and faster,
and more of it only makes that worse: the motor has to be switched off, while the others carry the
arm. The joint of a weak motor, or one that somebody pushes, leaves its path as well, and that motor
has to hold on.

The two are told apart by how the joint goes. Of a sound motor the torque tau beyond the one that
the reference needs, e, slows the joint down. Where the torque has the other sign, the joint's
inertia I gets both, I (v - v_ref)' = -tau - e. Where the encoder counts backwards, the joint seems
to get I (v - v_ref)' = -tau + e. The signs are known and so are tau and e, so that one number, 1/I,
has to explain the speed at all times since the joint began to leave its path; and it has to be as
the arm's.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from robot_sysid.damiao.joints import DamiaoJoint, no_load_speeds, peak_torques
from robot_sysid.damiao.safety.holding import torque_doubt
from robot_sysid.damiao.safety.plausibility import FASTEST, Mask
from robot_sysid.records import Array

_SPAN = 0.5
"""Time before the last sample in which a joint has begun to leave its path [s]."""
_SETTLING = 0.15
"""Time after which joints are at rest that were moved by a motor's windings [s]."""
_LEAST_SAMPLES = 4
"""Number of samples from which on it is judged: two are explained by any signs."""
_LEAST_RISE = 0.5
"""By how much its speed has left its reference's [rad/s]: rounding and friction make less."""
_MOST = 0.7
"""Share of its present speed that has to be explained: a short time is explained by any signs."""
_MISFIT = 0.1
"""Root mean square of what is not explained, over that of the speed. A push that grows with the
square of time leaves 0.2 and more."""
_BRAKED = 0.3
"""Share of a motor's no-load speed from which on a joint that goes against its motor's torque is
better off without it: by data sheets its shorted windings then brake with about the peak torque
(DM8009, DM10010L) or twice that (DM4310, DM4340)."""
_SAME_WAY = 0.3
"""By how much the way of the positions may differ from that of the speeds, as a share."""
_SHARES = 0.5, 4.0
"""Least and most acceleration over that of the joint's inertia, which is half of what it is by the
arm's model or twice as much: that of a weak motor's joint, by the wrong signs, is a third and
less, and of what a blow moves it is more."""


class Reversal:
    """Searches the last samples of n joints for a motor that turns against its command.

    Args:
        joints: of the arm, base to terminal.
    """

    def __init__(self, joints: Sequence[DamiaoJoint]) -> None:
        self._peak = peak_torques(joints)
        self._doubt = torque_doubt(joints)
        self._braked = _BRAKED * no_load_speeds(joints)
        # Rows of time, and of distance from the reference, speed, speed of the reference, torque
        # and needed torque (n,) each.
        self._samples: deque[tuple[float, Array, Array, Array, Array, Array]] = deque()
        self._ready_at = -np.inf

    def add(self, time: float, off: Array, *signals: Array) -> None:
        """Take a sample.

        Args:
            time: of the sample [s].
            off: (n,) position of the joints minus that of their reference [rad].
            signals: (n,) speed of the joints and of their reference [rad/s], the torque that the
                motors make by their commands, and that which sound joints need to follow the
                reference [N m].
        """
        if time < self._ready_at:
            return
        speed, led, torque, needed = signals
        limited = np.clip(torque, -self._peak, self._peak)
        self._samples.append((time, off, speed, led, limited, needed))
        while time - self._samples[0][0] > _SPAN:
            self._samples.popleft()

    def search(self, inertia: Array) -> Mask:
        """Return which joint (n,) is driven by a motor that turns against its command, if any.

        It is one at most: the joints beside it are pushed by its torque, and only seem to. That
        motor gives more power than the others take.

        Args:
            inertia: (n,) of each joint with those behind it [kg m^2].
        """
        found = np.zeros(len(self._peak), bool)
        if len(self._samples) < _LEAST_SAMPLES:
            return found
        time, off, speed, led, torque, needed = map(np.array, zip(*self._samples))
        beyond = speed - led
        passed = np.diff(time, prepend=time[0])[:, None]
        # What acts on the joints by either sign: its integral (2, N, n) since the first sample.
        acting = np.stack([-torque - needed, -torque + needed])
        momentum = np.cumsum(passed * acting, axis=1)
        mobility, misfit = _fits_from_each_sample(momentum, beyond)
        # The way that the speeds tell, since each sample (N, n).
        steps = passed * beyond
        way = _sums_to_the_last(steps) - steps
        agrees = np.abs(off[-1] - off - way) < _SAME_WAY * np.abs(way)
        # By how much each joint has become faster, away from its reference.
        away = np.sign(beyond[-1])
        rise = away * (beyond[-1] - beyond)
        # A model may lack the rotor's inertia; no joint accelerates faster than ``FASTEST``.
        share = mobility * np.maximum(inertia, self._peak / FASTEST)
        least, most = _SHARES
        fits = (misfit < _MISFIT) & (share > least) & (share < most)
        fits &= (rise > _LEAST_RISE) & (rise > _MOST * np.abs(beyond[-1])) & agrees
        is_against = np.any(fits[:, : 1 - _LEAST_SAMPLES], axis=(0, 1))
        # Faster and faster, and too fast for its motor.
        pace = np.abs(speed)
        is_against |= (pace[-1] > self._braked) & (pace[-1] > pace[-_LEAST_SAMPLES])
        # The control pulls it back, by more than friction could need.
        pulling = away * (needed - torque)[-_LEAST_SAMPLES:]
        is_pulled = np.all(pulling > self._doubt, axis=0)
        is_pulled &= np.abs(beyond[-1]) > _LEAST_RISE
        # Of all of these, also of those that nothing explains yet.
        power = np.where(is_pulled, -torque[-1] * beyond[-1], 0.0)
        j = int(np.argmax(power))
        found[j] = power[j] > 0.0 and is_against[j]
        return found

    def restart(self, time: float, after: float = _SETTLING) -> None:
        """Forget all samples, and take none for some time [s]: what moves then was moved before.

        Where a motor is switched off its windings brake, and that throws the joints beside it.
        """
        self._samples.clear()
        self._ready_at = time + after


def _fits_from_each_sample(momentum: Array, speed: Array) -> tuple[Array, Array]:
    """Return mobilities (2, N, n) [1/(kg m^2)] and misfits of speeds since each sample.

    The k-th is of the fit speed - speed[k] = mobility (momentum - momentum[k]) over all samples
    from the k-th to the last one.

    Args:
        momentum: (2, N, n) by either sign [N m s].
        speed: (N, n) [rad/s].
    """
    count = np.arange(len(speed), 0.0, -1.0)[:, None]
    of_momentum = _sums_to_the_last(momentum)
    of_speed = _sums_to_the_last(speed)
    square = (
        _sums_to_the_last(momentum**2)
        - 2.0 * momentum * of_momentum
        + count * momentum**2
    )
    cross = (
        _sums_to_the_last(momentum * speed) - momentum * of_speed - speed * of_momentum
    )
    cross = cross + count * momentum * speed
    size = _sums_to_the_last(speed**2) - 2.0 * speed * of_speed + count * speed**2
    tiny = np.finfo(float).tiny
    mobility = cross / np.maximum(square, tiny)
    left = np.maximum(size - mobility * cross, 0.0)
    return mobility, np.sqrt(left / np.maximum(size, tiny))


def _sums_to_the_last(values: Array) -> Array:
    """Return, for each row of values (..., N, n), the sum from it to the last one."""
    return np.flip(np.cumsum(np.flip(values, -2), axis=-2), -2)

"""What stops a run: somebody's wish, a reply out of order, numbers that mean something else.

Positions, velocities and torques are scaled by numbers stored in the motor. If one is wrong, every
value is wrong by the same factor and nothing else seems odd.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.protocol.codec import MitCommand
from robot_sysid.damiao.protocol.frames import ENABLED, describe
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.references import torque_doubt
from robot_sysid.damiao.session import NO_STATUS, Replies
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort
from robot_sysid.interrupts import heard_by
from robot_sysid.records import Array

# One key press may arrive twice: from the terminal, and passed on by a program that started us.
# Longer than a busy computer takes to pass it on, shorter than pressing a key twice on purpose [s].
_SAME_WISH = 0.2


class StopRequest:
    """Remembers whether somebody wants the run to end, and whether he insists.

    The first wish brings the arm to rest before it is disabled. Only a person who asks again is
    taken to mean "at once, even if the arm drops": hang-ups and terminations come in bursts when a
    terminal is closed or a computer shuts down. ``reason`` is the first wish in words.
    """

    def __init__(self) -> None:
        self.count = 0
        self.reason = ""
        self.insisted = False
        self._interrupted_at = float("inf")

    def __call__(self, reason: str, insist: bool = False) -> None:
        """Ask for a stop."""
        self.count += 1
        self.reason = self.reason or reason
        self.insisted |= insist

    def on_signals(self) -> AbstractContextManager[None]:
        """Return a block in which signals that ask a program to end are wishes."""
        return heard_by(self._handle)

    def _handle(self, number: int, frame: Any) -> None:
        again = False
        if number == signal.SIGINT:
            now = time.monotonic()
            self._interrupted_at = min(self._interrupted_at, now)
            again = now - self._interrupted_at > _SAME_WISH
        self(f"stopped by {signal.Signals(number).name}", again)


# What an arm's joints do at most from one sample to the next, beside going on as they were:
# judgements [rad, rad/s^2, share]. 200 rad/s^2 is 7 N m (a DM4310) on a light 0.035 kg m^2; a slip
# of 0.15 rad, as in the table of faults in docs/damiao.md, has to be seen.
_LEAST_JUMP, _TOP_ACCELERATION, _SPEED_DOUBT = 0.05, 200.0, 0.5
# Both velocities compared may be off by a quantisation step.
_STEPS = 2.0
# Cycles without an answer per unanswered command that is allowed: a motor whose answer is missing
# is told nothing for four cycles, see ``session.PAUSE``, so commands alone would count too slowly.
_SILENT_CYCLES = 2


# How far a joint that is to stand still may sag, by what its rated torque does to its stiffness: an
# arm half a radian from the first point, or with a new load, takes up half of that. Half as far the
# way that its feed-forward torque pushes: no load makes it go there.
_SAG, _PUSHED = 2.0, 0.5
_DRIVEN = (
    "drives it off; a motor turns the other way than its joint, two ids are swapped, or the file "
    "is for another pose or arm: see 'motors map'"
)
_SINKS = (
    "does not carry it; the trajectory's torque lacks gravity, two ids are swapped, or the arm is "
    "far heavier than its model"
)


class Supervisor:
    """Checks every cycle's replies against the settings' limits.

    ``velocity_step`` (n,) is one quantisation step of each joint's velocity [rad/s].
    """

    def __init__(
        self, joints: Sequence[DamiaoJoint], settings: PlaySettings, velocity_step: Array
    ) -> None:
        self._joints, self._settings = joints, settings
        self._speed_limit = settings.max_speed_error + _STEPS * velocity_step
        self._doubt = torque_doubt(joints)
        rated = np.array([j.spec.rated_torque * j.torque_ratio for j in joints])
        stiffness = np.maximum(settings.kp, 1e-9)
        self._sag = np.minimum(_SAG * rated / stiffness, settings.max_tracking_error)
        self._torque_limit = np.array(settings.max_torque_error)
        self._last: tuple[Array, ...] | None = None
        # Commands without an answer in time, and cycles without one, in a row.
        self.missed, self.silent, self.total_missed = np.zeros((3, len(joints)), dtype=int)
        self.worst_tracking = np.zeros(len(joints))
        self.failed = np.zeros(len(joints), dtype=bool)

    def update(self, replies: Replies) -> None:
        """Count missed replies and note which motors no longer drive."""
        unanswered = replies.asked & ~replies.answered
        self.missed = np.where(replies.answered, 0, self.missed + unanswered)
        self.silent = np.where(replies.answered, 0, self.silent + 1)
        self.total_missed += unanswered
        status = replies.feedback.status
        self.failed |= (status != ENABLED) & (status != NO_STATUS)

    def check(
        self, replies: Replies, acted: MitCommand, standing: bool = False, rising: bool = False
    ) -> None:
        """Raise HardwareAbort naming the first thing that is out of order; after ``update``.

        ``acted`` is the command in force when the replies were sampled; while ``standing`` nothing
        is to move. While gains are ``rising`` an arm that takes up a new load swings about where it
        will settle, with twice the torque: how far it sinks tells enough.
        """
        feedback, answered = replies.feedback, replies.answered
        path_limit = np.full(len(self._joints), self._settings.max_tracking_error)
        torque_limit = np.inf * self._torque_limit if rising else self._torque_limit
        self._check_states(replies)
        self._check_jump(replies)
        if standing:
            self._check_standing(replies, acted)
        for words, value, wanted, limit in (
            ("rad off its path", feedback.position, acted.position, path_limit),
            ("rad/s off its speed", feedback.velocity, acted.velocity, self._speed_limit),
            ("N m off its torque", feedback.torque, acted.torque, torque_limit),
        ):
            error = np.where(answered, np.abs(value - wanted), 0.0)
            if limit is path_limit:
                self.worst_tracking = np.maximum(self.worst_tracking, error)
            for j in np.flatnonzero(error > limit)[:1]:
                said = f"is {error[j]:.3f} {words}, limit {limit[j]:g}"
                raise HardwareAbort(f"{self._joints[j].label} {said}")

    def has_left(self, q: Array, place: Array, fed: Array) -> NDArray[np.bool_]:
        """Tell which joints (n,) have left a place where they are to stand still."""
        limit = np.where(self.is_pushed(q, place, fed), _PUSHED, 1.0) * self._sag
        return np.asarray(np.abs(q - place) > limit)

    def is_pushed(self, q: Array, place: Array, fed: Array) -> NDArray[np.bool_]:
        """Tell which joints (n,) are on the side of their place to which torque fed pushes them."""
        return np.asarray(((q - place) * fed > 0.0) & (np.abs(fed) > self._doubt))

    def _check_standing(self, replies: Replies, acted: MitCommand) -> None:
        q, qd = replies.feedback.position, replies.feedback.velocity
        place, fed = acted.position, acted.torque
        left, pushed = self.has_left(q, place, fed), self.is_pushed(q, place, fed)
        self._stop_where(
            replies.answered & (left | (np.abs(qd) > self._speed_limit)),
            lambda j: (
                f"is {q[j] - place[j]:.3f} rad off, at {qd[j]:.2f} rad/s, while it should stand "
                f"still: its feed-forward torque of {round(fed[j], 1) + 0.0:g} N m "
                f"{_DRIVEN if pushed[j] else _SINKS}"
            ),
        )

    def _check_states(self, replies: Replies) -> None:
        feedback, limits = replies.feedback, self._settings
        self._stop_where(
            replies.answered & (feedback.status != ENABLED),
            lambda j: f"reports {describe(int(feedback.status[j]))}",
        )
        self._stop_where(
            (self.missed >= limits.max_missed)
            | (self.silent >= _SILENT_CYCLES * limits.max_missed),
            lambda j: f"did not answer in time for {self.silent[j]} cycles",
        )
        hot = np.maximum(feedback.temperature_mos, feedback.temperature_rotor)
        self._stop_where(
            replies.answered & (hot > limits.max_temperature),
            lambda j: f"is at {hot[j]} deg C, limit {limits.max_temperature:g}",
        )

    def _check_jump(self, replies: Replies) -> None:
        """Compare how far each joint came with how fast it says that it was."""
        now = replies.time, replies.feedback.position, replies.feedback.velocity
        before = self._last or now
        self._last = tuple(np.where(replies.answered, *pair) for pair in zip(now, before))
        passed = now[0] - before[0]
        way = 0.5 * (now[2] + before[2]) * passed
        jump = np.abs(now[1] - before[1] - way)
        allowed = _LEAST_JUMP + _SPEED_DOUBT * np.abs(way) + 0.5 * _TOP_ACCELERATION * passed**2
        self._stop_where(
            np.nan_to_num(jump) > np.nan_to_num(allowed, nan=np.inf),
            lambda j: (
                f"jumped by {jump[j]:.3f} rad between two samples: its encoder or its mounting "
                "is not sound"
            ),
        )

    def _stop_where(self, bad: NDArray[np.bool_], what: Callable[[int], str]) -> None:
        for j in np.flatnonzero(bad)[:1]:
            raise HardwareAbort(f"{self._joints[j].label} {what(j)}")


# Long beside a cycle and short beside a swing; ten of them give a scatter [s].
_WINDOW = 0.2
_LEAST_WINDOWS = 10
# How far the slope may be from 1: two types' VMAX differ by a tenth or more (45 and 50).
_SLOPE_TOLERANCE = 0.03


class VelocityScalingCheck:
    """Tells whether the velocity channel integrates to the position channel.

    The slope of position change against integrated velocity, over short windows, has to be 1. How
    well it can be known depends on the scatter and on the steps (n,) of the velocity channel
    [rad/s]: an error of up to half a step, the same all through a window, is allowed for.

    Velocities are sampled at the end of each command's time, when a joint of little inertia has
    slowed down. Without any it is v = v_des + k (p_des - p), k = kp / kd, so that in steady motion
    the mean over a cycle T is (exp(kT) - 1) / (kT) times the last velocity; with inertia it is
    between 1 and this. ``fades`` (n,) is kT.
    """

    def __init__(self, velocity_step: Array, fades: Array) -> None:
        n_joints = len(velocity_step)
        self._explained = np.expm1(fades) / fades
        self._rounding = 0.5 * velocity_step * _WINDOW
        self._last: tuple[Array, ...] | None = None
        self._begin = np.zeros((2, n_joints))
        self._integral = np.zeros(n_joints)
        # Per joint: count and sums of x, y, xx, xy, yy.
        self._sums = np.zeros((6, n_joints))

    def add(self, time: Array, q: Array, qd: Array) -> None:
        """Add one sample (n,) per joint [s, rad, rad/s]; NaN where a joint did not answer."""
        fresh = np.isfinite(time) & np.isfinite(q)
        if self._last is None:
            if np.all(fresh):
                self._last = time, q, qd
                self._begin = np.stack([time, q])
            return
        t0, _, v0 = self._last
        self._integral += np.where(fresh, 0.5 * (qd + v0) * (time - t0), 0.0)
        self._last = tuple(np.where(fresh, *pair) for pair in zip((time, q, qd), self._last))
        full = fresh & (time - self._begin[0] >= _WINDOW)
        if not np.any(full):
            return
        x = np.where(full, self._integral, 0.0)
        y = np.where(full, self._last[1] - self._begin[1], 0.0)
        self._sums += np.stack([full.astype(float), x, y, x * x, x * y, y * y])
        self._integral = np.where(full, 0.0, self._integral)
        self._begin = np.where(full, np.stack(self._last[:2]), self._begin)

    def worst(self) -> tuple[int, float] | None:
        """Return (joint, slope) of a joint whose slope is surely off, or None.

        The doubt is three standard errors plus the largest effect of rounded velocities.
        """
        count, x, y, xx, xy, yy = self._sums
        n = np.maximum(count, 1.0)
        cxx, cxy, cyy = xx - x * x / n, xy - x * y / n, yy - y * y / n
        spread = np.sqrt(np.maximum(cxx, 0.0) / n)
        moved = (count >= _LEAST_WINDOWS) & (spread > self._rounding)
        safe = np.where(moved, cxx, 1.0)
        slope = np.where(moved, cxy / safe, 1.0)
        residual = np.maximum(cyy - slope * cxy, 0.0) / np.maximum(count - 2.0, 1.0)
        doubt = 3.0 * np.sqrt(residual / safe) + self._rounding / np.where(moved, spread, 1.0)
        unexplained = slope / np.clip(slope, 1.0, self._explained)
        found = _farthest_from_one(unexplained, np.where(moved, doubt, np.inf), _SLOPE_TOLERANCE)
        return found and (found[0], float(slope[found[0]]))


def _farthest_from_one(ratio: Array, doubt: Array, tolerance: float) -> tuple[int, float] | None:
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
    """Tells whether motors report the torque they were told to make.

    A motor makes kp (p - q) + kd (v - qd) + t and reports what it makes. Both numbers are known in
    each cycle, so their ratio is; a motor whose TMAX is another than its register says, or that
    counts before its gear, shows by it, and so would every mass identified from it.

    Both arguments are (n,) [N m]; beyond its peak torque a motor does not do as told.
    """

    def __init__(self, torque_step: Array, peak: Array) -> None:
        self._peak, self._doubt = 0.9 * peak, np.maximum(4.0 * torque_step, 0.005 * peak)
        # Per joint: count and sums of xx, xy.
        self._sums = np.zeros((3, len(peak)))

    def add(self, told: Array, measured: Array, qd: Array) -> None:
        """Add one sample (n,) per joint [N m, N m, rad/s]; NaN where a joint did not answer.

        Samples of a joint that moves fast are left out, because a velocity that is wrong or late
        would make ``told`` wrong.
        """
        known = np.isfinite(measured) & (np.abs(told) < self._peak) & (np.abs(qd) < _SLOW)
        x, y = np.where(known, told, 0.0), np.where(known, measured, 0.0)
        self._sums += np.stack([known.astype(float), x * x, x * y])

    def worst(self) -> tuple[int, float] | None:
        """Return (joint, ratio) of a joint that surely reports another torque, or None.

        The doubt is what rounding makes of the size of the torques seen so far.
        """
        count, xx, xy = self._sums
        size = np.sqrt(xx / np.maximum(count, 1.0))
        seen = (count >= _ENOUGH_SAMPLES) & (size > 2.0 * self._doubt)
        ratio = np.where(seen, xy / np.where(seen, xx, 1.0), 1.0)
        doubt = np.where(seen, self._doubt / np.maximum(size, 1e-9), np.inf)
        return _farthest_from_one(ratio, doubt, _RATIO_TOLERANCE)

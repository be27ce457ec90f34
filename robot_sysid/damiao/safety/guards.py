"""Plausibility of motors' answers, checks of their scaling, and bounds of commands.

Serial adapters have no checksum between the bus and the computer, so one damaged character can make
a position wrong by radians or a healthy motor look faulty. ``SampleFilter`` believes a sample that
is plausible after the last believed one: the change of position agrees with the velocities, the
velocity changed no faster than a motor can change it, and the reported torque changed as the
command did. An implausible sample is not used, unless the next sample confirms it.

Positions, velocities and torques are scaled by numbers stored in the motor. If one of these is
wrong, every value is wrong by a constant factor, which the two scaling checks detect.

Every command to a motor has to keep to ``CommandBounds``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao import protocol
from robot_sysid.damiao.protocol import ENABLED, MitCommand
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array

NO_STATUS = -1
"""Status of a joint that sent no believed answer in a cycle."""
Mask = NDArray[np.bool_]
"""One truth value for each of n joints."""
Counts = NDArray[np.int64]
"""One number for each of n joints."""

# Judgements: a slip of 0.15 rad has to be noticed.
_LEAST_JUMP = 0.05
"""Distance from the position expected by velocity that is always plausible [rad]."""
_TOP_ACCELERATION = 200.0
"""Largest plausible acceleration [rad/s^2]: 7 N m (a DM4310) on a light joint, 0.035 kg m^2."""
_SPEED_DOUBT = 0.5
"""Further accepted error of a position, as a share of the change of position that is expected."""
_LEAST_SPEED_CHANGE = 1.0
"""Change of velocity that is always plausible [rad/s]: by a blow or a stop in a cycle of 4 ms."""
_TORQUE_DOUBT = 0.3
"""Largest plausible change of reported minus commanded torque, as a share of the peak torque."""
_HEAT_CHANGE = 5.0
"""Largest plausible change of temperature [deg C]: windings warm up by a degree in seconds."""


def _no_joints() -> Any:
    """Return an empty array (0,), which ``Replies`` replaces by zeros (n,) when it is made."""
    return np.zeros(0, int)


@dataclass(frozen=True)
class Replies:
    """Answers of n joints in one control cycle.

    Attributes:
        answered: (n,) whether the joint's answer came in time and is believed.
        time: (n,) time of each joint's sample in the link's clock [s]: when its command was on the
            bus where the adapter reports that, else when the reply arrived; NaN without an answer.
        feedback: state that the joints reported, each field (n,), in joint space; without a
            believed answer the status is ``NO_STATUS`` and the quantities are NaN.
        requested: (n,) whether the joint was sent a command or a request.
        command: command in force now as the motors read it, or None.
        doubted: (n,) whether an answer came that is not believed.
        jump: (n,) change of position that two samples in a row confirm although no joint can move
            so fast [rad]; 0 where there is none.
        surplus: (n,) number of answers beyond the one that was due.
        foreign: (n,) number of commands that another program sent to this joint's motor.
    """

    answered: Mask
    time: Array
    feedback: protocol.Feedback
    requested: Mask
    command: protocol.MitCommand | None = None
    doubted: Mask = field(default_factory=_no_joints)
    jump: Array = field(default_factory=_no_joints)
    surplus: Counts = field(default_factory=_no_joints)
    foreign: Counts = field(default_factory=_no_joints)

    def __post_init__(self) -> None:
        """Set the fields that were left out to zeros (n,): nothing doubted, no jump, no counts."""
        types = {"doubted": bool, "jump": float, "surplus": int, "foreign": int}
        for name, dtype in types.items():
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.zeros(len(self.answered), dtype))


class _Samples(NamedTuple):
    """One sample per joint; every field is (n,).

    Attributes:
        time: time of the sample [s].
        q: position [rad].
        qd: velocity [rad/s].
        torque_error: reported torque minus commanded torque [N m].
        enabled: whether the motor reports that it is enabled.
        heat: the higher of the motor's two temperatures [deg C].
    """

    time: Array
    q: Array
    qd: Array
    torque_error: Array
    enabled: Mask
    heat: Array

    def where(self, selected: Mask, other: _Samples) -> _Samples:
        """Return these samples for joints ``selected`` (n,), and ``other`` for the others."""
        return _Samples._make(map(partial(np.where, selected), self, other))


class _Change(NamedTuple):
    """Plausibility of the changes of n joints between two samples.

    Attributes:
        jumps: (n,) whether the position changed by more than a joint can move.
        bends: (n,) whether reported minus commanded torque changed by more than plausible.
        is_plausible: (n,) whether position, velocity, torque and temperature all are plausible.
    """

    jumps: Mask
    bends: Mask
    is_plausible: Mask


class SampleFilter:
    """Decides which answers of n joints are believed; holds the last believed samples.

    A joint's last answer that was not believed is suspect: the next one may confirm it.

    Args:
        peak_torque: (n,) peak torque of each joint [N m].
        velocity_step: (n,) one quantisation step of each joint's velocity [rad/s].
    """

    def __init__(self, peak_torque: Array, velocity_step: Array) -> None:
        self._peak = peak_torque
        self._velocity_step = velocity_step
        n_joints = len(peak_torque)
        unknown = np.full(n_joints, np.nan)
        enabled = np.ones(n_joints, dtype=bool)
        self._last = _Samples(unknown, unknown, unknown, unknown, enabled, unknown)
        self._suspect = self._last
        self._is_suspected = np.zeros(n_joints, dtype=bool)

    @property
    def q(self) -> Array:
        """Last believed positions (n,) [rad]."""
        return self._last.q

    @property
    def qd(self) -> Array:
        """Last believed velocities (n,) [rad/s]."""
        return self._last.qd

    def start(self, time: float, q: Array) -> None:
        """Take q (n,) [rad] at zero velocity as the last believed sample, of ``time`` [s]."""
        zero_speed = np.zeros_like(q)
        times = zero_speed + time
        self._last = self._last._replace(time=times, q=q.copy(), qd=zero_speed)

    def believe(self, replies: Replies, acted: protocol.MitCommand | None) -> Replies:
        """Return replies without implausible answers, which are in ``doubted``, and with ``jump``.

        The believed answers become the last samples, to which the next answers are compared.

        Args:
            replies: answers of a cycle as they arrived.
            acted: command in force when the samples were taken, fields (n,); None if unknown, then
                torques are not judged.
        """
        feedback = replies.feedback
        q = feedback.position
        qd = feedback.velocity
        tau = feedback.torque
        expected = tau if acted is None else acted.motor_torque(q, qd)
        error = tau - np.clip(expected, -self._peak, self._peak)
        hotter = np.maximum(feedback.temperature_mos, feedback.temperature_rotor)
        heat = hotter.astype(float)
        now = _Samples(replies.time, q, qd, error, feedback.status == ENABLED, heat)
        came = replies.answered
        # An answer is believed if it follows the last believed one, or repeats the suspect one. A
        # motor that was enabled and reports that it is not has to say so twice.
        change = self._compare(self._last, now)
        follows = change.is_plausible & (now.enabled | ~self._last.enabled)
        repeated = self._compare(self._suspect, now).is_plausible & self._is_suspected
        repeated &= now.enabled == self._suspect.enabled
        # A repeated jump is not believed where the torque does not match the new position, which
        # the motor's own control then does not measure, nor where the motor is disabled.
        repeated &= ~(change.jumps & (change.bends | ~now.enabled))
        believed = came & (follows | repeated)
        jumped = believed & ~follows & change.jumps
        jump = np.where(jumped, q - self._last.q, 0.0)
        self._is_suspected = np.where(came, ~believed, self._is_suspected)
        self._suspect = now.where(came, self._suspect)
        self._last = now.where(believed, self._last)
        return replace(
            replies,
            answered=believed,
            # Joints that did not answer are hidden already.
            feedback=hide_answers(feedback, (q, qd, tau), ~came | believed),
            doubted=came & ~believed,
            jump=np.nan_to_num(jump),
        )

    def _compare(self, previous: _Samples, now: _Samples) -> _Change:
        """Return how plausible the samples ``now`` are after ``previous`` ones.

        A quantity that is NaN in either of them is not compared, and counts as plausible.
        """
        passed = np.maximum(np.nan_to_num(now.time - previous.time), 0.0)
        expected_change = 0.5 * (now.qd + previous.qd) * passed
        distance = np.abs(now.q - previous.q - expected_change)
        accelerated = _TOP_ACCELERATION * passed
        tolerance = _LEAST_JUMP + _SPEED_DOUBT * np.abs(expected_change)
        tolerance += 0.5 * accelerated * passed
        jumps = distance > tolerance
        speed_change = np.abs(now.qd - previous.qd)
        most_change = _LEAST_SPEED_CHANGE + 4.0 * self._velocity_step + accelerated
        accelerates = speed_change > most_change
        torque_change = np.abs(now.torque_error - previous.torque_error)
        bends = torque_change > _TORQUE_DOUBT * self._peak
        heats = np.abs(now.heat - previous.heat) > _HEAT_CHANGE
        return _Change(jumps, bends, ~(jumps | accelerates | bends | heats))


def hide_answers(
    feedback: protocol.Feedback, measured: Sequence[Array], is_kept: Mask
) -> protocol.Feedback:
    """Return feedback of n joints in which only the answers of joints ``is_kept`` (n,) are left.

    The other joints have ``NO_STATUS`` and NaN. ``measured`` are position, velocity and torque of
    the result, each (n,) [rad, rad/s, N m].
    """
    q, qd, tau = np.where(is_kept, measured, np.nan)
    status = np.where(is_kept, feedback.status, NO_STATUS)
    return replace(feedback, status=status, position=q, velocity=qd, torque=tau)


_WINDOW = 0.2
"""Time over which velocity is integrated [s]: long against a cycle, short against a swing."""
_LEAST_WINDOWS = 10
"""Least number of windows from which a slope is judged."""
_SLOPE_TOLERANCE = 0.03
"""Error of a slope that is accepted: VMAX of two types differ by a tenth or more (45 and 50)."""
_LEAST_SLIP = 0.02
"""Difference of position change and integrated velocity that is accepted in a window [rad]."""
_SLIP_SHARE = 0.05
"""Share of the path's length in a window by which this difference may be larger."""
_COARSE = 1.3
"""Ratio of a cycle's mean velocity to its last one above which slip cannot be judged."""


@dataclass(frozen=True)
class Slip:
    """A joint whose change of position disagrees with its integrated velocity in one window.

    Attributes:
        joint: index of the joint.
        integral: integral of the reported velocity over the window [rad].
        change: change of the reported position over the window [rad].
        speed: unexplained part of the change, divided by the window's length [rad/s].
    """

    joint: int
    integral: float
    change: float
    speed: float

    @property
    def description(self) -> str:
        """What the joint does: the end of a sentence that begins with the joint's name."""
        if abs(self.integral + self.change) < 0.3 * abs(self.change):
            return "moves against the velocity that it reports: the sign of one is reversed"
        return (
            f"moves {abs(self.speed):.2f} rad/s beside the velocity that it reports: its gear or "
            "its encoder slips"
        )


class VelocityScalingCheck:
    """Checks whether the velocities that n joints report integrate to their positions.

    The slope of position change against integrated velocity, over short windows, has to be 1. Its
    uncertainty depends on the scatter and on the quantisation of velocity: a constant error of half
    a step throughout a window is allowed for.

    Velocities are sampled at the end of each control cycle, when a joint of little inertia has
    slowed down. A joint without inertia has the velocity v = v_des + k (p_des - p), k = kp / kd; in
    steady motion its mean over a cycle T is (exp(kT) - 1) / (kT) times the last velocity. With
    inertia the ratio is between 1 and this.

    Args:
        velocity_step: (n,) one quantisation step of velocity [rad/s].
        fades: (n,) the product kT, above 0.

    Attributes:
        explained: (n,) largest possible ratio of a cycle's mean velocity to its last one.
    """

    def __init__(self, velocity_step: Array, fades: Array) -> None:
        n_joints = len(velocity_step)
        self.explained: Array = np.expm1(fades) / fades
        self._rounding = 0.5 * velocity_step * _WINDOW
        # Time, position and velocity (3, n) of each joint's last sample.
        self._last: Array | None = None
        # Time and position (2, n) at which each joint's window begins.
        self._begin = np.zeros((2, n_joints))
        # Integrals (2, n) of velocity and of its absolute value since then [rad].
        self._integrals = np.zeros((2, n_joints))
        # Of each joint's windows: count and sums of x, y, xx, xy, yy, with x the integrated
        # velocity and y the change of position [rad].
        self._sums = np.zeros((6, n_joints))

    def add(self, time: Array, q: Array, qd: Array) -> Slip | None:
        """Add one sample per joint; return a joint that slipped in a window that ends now, or None.

        ``time``, ``q`` and ``qd`` are (n,) [s, rad, rad/s], NaN where a joint did not answer.
        """
        is_fresh = np.isfinite(time) & np.isfinite(q)
        now = np.stack([time, q, qd])
        if self._last is None:
            if np.all(is_fresh):
                self._last = now
                self._begin = now[:2]
            return None
        last_time, _, last_qd = self._last
        step = np.where(is_fresh, 0.5 * (qd + last_qd) * (time - last_time), 0.0)
        self._integrals += np.stack([step, np.abs(step)])
        self._last = np.where(is_fresh, now, self._last)
        begin_time, begin_q = self._begin
        is_full = is_fresh & (time - begin_time >= _WINDOW)
        if not np.any(is_full):
            return None
        x, path = np.where(is_full, self._integrals, 0.0)
        y = np.where(is_full, q - begin_q, 0.0)
        slip = self._slip(x, y, path)
        self._sums += np.stack([is_full, x, y, x * x, x * y, y * y])
        self._integrals = np.where(is_full, 0.0, self._integrals)
        self._begin = np.where(is_full, now[:2], self._begin)
        return slip

    def _slip(self, integral: Array, change: Array, path: Array) -> Slip | None:
        """Return the joint whose position change is farthest beyond its tolerance, or None.

        Args:
            integral: (n,) integrated velocity in the window [rad]; 0 for joints not to be judged.
            change: (n,) change of position [rad].
            path: (n,) integrated absolute velocity [rad].
        """
        # Sampling late in each cycle explains any change from the integral to ``fastest``.
        fastest = integral * self.explained
        lower = np.minimum(integral, fastest)
        upper = np.maximum(integral, fastest)
        mismatch = change - np.clip(change, lower, upper)
        # Where a joint slows down within a cycle, its mean speed is known less well. Twice the
        # rounding is an error of one velocity step throughout the window.
        doubt = _SLIP_SHARE + 0.5 * (self.explained - 1.0)
        tolerance = _LEAST_SLIP + doubt * path + 2.0 * self._rounding
        tolerance = np.where(self.explained > _COARSE, np.inf, tolerance)
        j = int(np.argmax(np.abs(mismatch) - tolerance))
        if abs(mismatch[j]) <= tolerance[j]:
            return None
        speed = float(mismatch[j] / _WINDOW)
        return Slip(j, float(integral[j]), float(change[j]), speed)

    def worst(self) -> tuple[int, float] | None:
        """Return index and slope of the joint whose slope is significantly off 1, or None.

        A slope's uncertainty is three standard errors plus the largest effect of rounding.
        """
        count, x, y, xx, xy, yy = self._sums
        # Sums of squares and products about the means give a straight line by least squares.
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
        # A slope from 1 to ``explained`` is due to sampling late in each cycle.
        unexplained = slope / np.clip(slope, 1.0, self.explained)
        doubt = np.where(moved, doubt, np.inf)
        worst = _farthest_from_one(unexplained, doubt, _SLOPE_TOLERANCE)
        return None if worst is None else (worst[0], float(slope[worst[0]]))


def _farthest_from_one(
    ratio: Array, doubt: Array, tolerance: float
) -> tuple[int, float] | None:
    """Return index and ratio of the joint whose ratio (n,) exceeds its doubt (n,) the most.

    None where no ratio differs from 1 by more than its uncertainty ``doubt`` plus ``tolerance``.
    """
    excess = np.abs(ratio - 1.0) - doubt
    j = int(np.argmax(excess))
    return (j, float(ratio[j])) if excess[j] > tolerance else None


_ENOUGH_SAMPLES = 25
"""Least number of samples from which a ratio is judged: a tenth of a second at 250 Hz."""
_RATIO_TOLERANCE = 0.15
"""Error of a torque ratio that is accepted: TMAX of two types differ by a fifth (10 and 12)."""
_SLOW = 0.1
"""Velocity below which samples are used [rad/s]: half the default approach speed."""


class TorqueScalingCheck:
    """Checks whether n motors report the torque that they were commanded to make.

    A motor is commanded to make kp (p - q) + kd (v - qd) + t and reports the torque that it makes.
    The ratio of reported to commanded torque differs from 1 where a motor's TMAX is not the value
    of its register or it reports torque before its gear; identified masses would be wrong by it.

    Args:
        torque_step: one quantisation step (n,) [N m].
        peak: peak torque (n,) [N m]; above nine tenths of it a motor may fail to follow commands.
    """

    def __init__(self, torque_step: Array, peak: Array) -> None:
        self._peak = 0.9 * peak
        # Error of a single torque: by rounding, or half a percent of the peak torque.
        self._doubt = np.maximum(4.0 * torque_step, 0.005 * peak)
        # Per joint: count and sums of xx, xy, with x the commanded torque and y the reported one.
        self._sums = np.zeros((3, len(peak)))

    def add(self, commanded: Array, measured: Array, qd: Array) -> None:
        """Add one sample (n,) per joint [N m, N m, rad/s]; NaN where a joint did not answer.

        Samples of a joint that moves fast are left out, because a velocity that is wrong or late
        would make ``commanded`` wrong.
        """
        is_weak = np.abs(commanded) < self._peak
        usable = np.isfinite(measured) & is_weak & (np.abs(qd) < _SLOW)
        x = np.where(usable, commanded, 0.0)
        y = np.where(usable, measured, 0.0)
        self._sums += np.stack([usable, x * x, x * y])

    def worst(self) -> tuple[int, float] | None:
        """Return index and ratio of the joint whose ratio is significantly off 1, or None.

        A ratio's uncertainty is the rounding error divided by the rms of the commanded torques.
        """
        count, xx, xy = self._sums
        size = np.sqrt(xx / np.maximum(count, 1.0))
        enough = (count >= _ENOUGH_SAMPLES) & (size > 2.0 * self._doubt)
        ratio = np.where(enough, xy / np.where(enough, xx, 1.0), 1.0)
        doubt = np.where(enough, self._doubt / np.maximum(size, 1e-9), np.inf)
        return _farthest_from_one(ratio, doubt, _RATIO_TOLERANCE)


_ROUNDING = 1e-6
"""Relative error of a command at its bound after conversion to frames and back."""


class BeyondBounds(HardwareAbort):
    """A command was not sent because it is beyond the bounds of a joint."""


@dataclass(frozen=True)
class CommandRange:
    """Positions and speeds that commands of n joints may have, each (n,).

    Attributes:
        lower: least position [rad], from the model's range or else the trajectory's.
        upper: greatest position [rad].
        speed: greatest rate of change of a commanded position, and commanded velocity [rad/s].
    """

    lower: Array
    upper: Array
    speed: Array

    def within(self, other: CommandRange) -> CommandRange:
        """Return the intersection of this range and another one."""
        lower = np.maximum(self.lower, other.lower)
        upper = np.minimum(self.upper, other.upper)
        return CommandRange(lower, upper, np.minimum(self.speed, other.speed))


@dataclass(frozen=True)
class CommandBounds:
    """Bounds of every command of n joints, each (n,).

    Attributes:
        command_range: range of positions and speeds.
        torque: largest sum of kp times position error and feed-forward torque [N m].
        position_step: one quantisation step of a commanded position [rad].
        velocity_step: one quantisation step of a commanded velocity [rad/s].
        torque_step: one quantisation step of a commanded torque [N m].
    """

    command_range: CommandRange
    torque: Array
    position_step: Array
    velocity_step: Array
    torque_step: Array

    def including(self, q: Array) -> CommandBounds:
        """Return the bounds, widened to include the positions q (n,) of an arm [rad]."""
        current = self.command_range
        lower = np.fmin(current.lower, q)
        upper = np.fmax(current.upper, q)
        return replace(self, command_range=CommandRange(lower, upper, current.speed))

    def _reach(self, last: Array, elapsed: Array) -> tuple[Array, Array]:
        """Return the least and the greatest position (n,) [rad] that may be commanded now.

        ``last`` (n,) are the positions commanded last [rad], ``elapsed`` (n,) the time since [s].
        """
        current = self.command_range
        reach = current.speed * elapsed
        last = np.clip(last, current.lower, current.upper)
        lowest = np.maximum(current.lower, last - reach)
        return lowest, np.minimum(current.upper, last + reach)

    def require(
        self,
        labels: Sequence[str],
        command: MitCommand,
        last: Array,
        elapsed: Array,
        q: Array,
    ) -> None:
        """Raise BeyondBounds for the first joint whose command is beyond its bounds.

        Args:
            labels: names of the n joints, for messages.
            command: command that is to be sent, fields (n,), in joint space.
            last: (n,) positions commanded last [rad].
            elapsed: (n,) time since the last command [s].
            q: (n,) last believed positions [rad]; NaN where a joint has never answered.

        """
        lowest, highest = self._reach(last, elapsed)
        slack = self.position_step + _ROUNDING
        below = lowest - slack - command.position
        beyond = np.maximum(below, command.position - highest - slack)
        # Written so that a NaN counts as too much.
        for j in np.flatnonzero(~(beyond <= 0.0)).tolist():
            raise BeyondBounds(
                f"{labels[j]} would be sent to {command.position[j]:.3f} rad; from the last "
                f"command it may go from {lowest[j]:.3f} to {highest[j]:.3f}"
            )
        top_speed = self.command_range.speed + self.velocity_step
        too_fast = ~(np.abs(command.velocity) <= top_speed)
        for j in np.flatnonzero(too_fast).tolist():
            limit = self.command_range.speed[j]
            raise BeyondBounds(
                f"{labels[j]} would be told {command.velocity[j]:.2f} rad/s, limit {limit:.2f}"
            )
        # A joint that has never answered has an unknown position error: only its torque counts.
        error = np.nan_to_num(command.position - q)
        requested = np.abs(command.kp * error + command.torque)
        available = self.torque + self.torque_step + command.kp * self.position_step
        for j in np.flatnonzero(~(requested <= available * (1.0 + _ROUNDING))).tolist():
            raise BeyondBounds(
                f"{labels[j]} would be asked for {requested[j]:.1f} N m and makes "
                f"{self.torque[j]:.1f} at most: something holds the arm back, or it needs "
                "more than this motor has (see plan --for weight)"
            )

    def confine(
        self, command: MitCommand, last: Array, elapsed: Array, q: Array
    ) -> MitCommand:
        """Return the command limited to the bounds; arguments as for ``require``.

        Stiffness is reduced where it alone would exceed the torque bound, the feed-forward torque
        where the sum would. Damping stays. A position that is not finite becomes the last one, a
        velocity or torque that is NaN becomes 0.
        """
        lowest, highest = self._reach(last, elapsed)
        position = np.where(np.isfinite(command.position), command.position, last)
        position = np.clip(position, lowest, highest)
        top_speed = self.command_range.speed
        velocity = np.clip(np.nan_to_num(command.velocity), -top_speed, top_speed)
        error = np.nan_to_num(position - q)
        most_stiffness = self.torque / np.maximum(np.abs(error), 1e-9)
        stiffness = np.minimum(command.kp, most_stiffness)
        pull = stiffness * error
        fed = np.clip(np.nan_to_num(command.torque), -self.torque, self.torque)
        fed = np.clip(fed, -self.torque - pull, self.torque - pull)
        return MitCommand(position, velocity, stiffness, command.kd, fed)

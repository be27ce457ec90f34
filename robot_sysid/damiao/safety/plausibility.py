"""Plausibility of motors' answers, and bounds of commands.

Serial adapters have no checksum between the bus and the computer, so one damaged character can make
a position wrong by radians or a healthy motor look faulty. ``SampleFilter`` believes a sample that
is plausible after the last believed one: the change of position agrees with the velocities, the
velocity changed no faster than a motor can change it, and the reported torque changed as the
command did. An implausible sample is not used, unless the next sample confirms it.

Every command to a motor has to keep its joint's ``Limits`` (``confine``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.protocol import ENABLED, Codes, Feedback, MitCommand
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array, Limits
from robot_sysid.wording import option_setting

NO_STATUS = -1
"""Status of a joint that sent no believed answer in a cycle."""
Mask = NDArray[np.bool_]
"""One truth value for each of n joints."""


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
    feedback: Feedback
    requested: Mask
    command: MitCommand | None
    doubted: Mask
    jump: Array
    surplus: Codes
    foreign: Codes


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


class SampleFilter:
    """Decides which answers of n joints are believed; holds the last believed samples.

    A joint's last answer that was not believed is suspect: the next one may confirm it.

    Args:
        peak_torque: (n,) peak torque of each joint [N m].
        velocity_step: (n,) one quantisation step of each joint's velocity [rad/s].

    Attributes:
        last: last believed samples; NaN before the first.
    """

    def __init__(self, peak_torque: Array, velocity_step: Array) -> None:
        self._peak = peak_torque
        self._velocity_step = velocity_step
        n_joints = len(peak_torque)
        unknown = np.full(n_joints, np.nan)
        enabled = np.ones(n_joints, dtype=bool)
        self.last = _Samples(unknown, unknown, unknown, unknown, enabled, unknown)
        self._suspect = self.last
        self._is_suspected = np.zeros(n_joints, dtype=bool)

    def start(self, time: float, q: Array) -> None:
        """Take q (n,) [rad] at zero velocity as the last believed sample, of ``time`` [s]."""
        self.last = self.last._replace(
            time=np.full_like(q, time), q=q.copy(), qd=np.zeros_like(q)
        )

    def believe(
        self, came: Mask, time: Array, feedback: Feedback, acted: MitCommand | None
    ) -> tuple[Mask, Array]:
        """Return which answers are believed (n,), and the ``jump`` (n,) of ``Replies``.

        The believed answers become the last samples, to which the next answers are compared.

        Args:
            came: whether each joint (n,) has answered.
            time: time (n,) of each sample [s].
            feedback: answers of a cycle, in joint space.
            acted: command in force when the samples were taken, fields (n,); None if unknown, then
                torques are not judged.
        """
        q = feedback.position
        qd = feedback.velocity
        tau = feedback.torque
        expected = tau if acted is None else acted.motor_torque(q, qd)
        error = tau - np.clip(expected, -self._peak, self._peak)
        heat = feedback.temperature.astype(float)
        now = _Samples(time, q, qd, error, feedback.status == ENABLED, heat)
        # An answer is believed if it follows the last believed one, or repeats the suspect one. A
        # motor that was enabled and reports that it is not has to say so twice.
        jumps, bends, is_plausible = self._compare(self.last, now)
        follows = is_plausible & (now.enabled | ~self.last.enabled)
        *_, repeats = self._compare(self._suspect, now)
        repeated = repeats & self._is_suspected
        repeated &= now.enabled == self._suspect.enabled
        # A repeated jump is not believed where the torque does not match the new position, which
        # the motor's own control then does not measure, nor where the motor is disabled.
        repeated &= ~(jumps & (bends | ~now.enabled))
        believed = came & (follows | repeated)
        jumped = believed & ~follows & jumps
        jump = np.where(jumped, np.nan_to_num(q - self.last.q), 0.0)
        self._is_suspected = np.where(came, ~believed, self._is_suspected)
        self._suspect = now.where(came, self._suspect)
        self.last = now.where(believed, self.last)
        return believed, jump

    def _compare(self, previous: _Samples, now: _Samples) -> tuple[Mask, Mask, Mask]:
        """Return how plausible the samples ``now`` are after ``previous`` ones, three masks (n,).

        The first says whether the position changed by more than a joint can move, the second
        whether reported minus commanded torque changed by more than plausible, and the third
        whether position, velocity, torque and temperature all are plausible. A quantity that is NaN
        in either of them is not compared, and counts as plausible.
        """
        passed = np.maximum(np.nan_to_num(now.time - previous.time), 0.0)
        expected_change = 0.5 * (now.qd + previous.qd) * passed
        distance = np.abs(now.q - previous.q - expected_change)
        # The largest plausible acceleration [rad/s^2]: 7 N m (a DM4310) on 0.035 kg m^2.
        accelerated = 200.0 * passed
        # Judgements: a slip of 0.15 rad has to be noticed.
        tolerance = 0.05 + 0.5 * np.abs(expected_change)
        tolerance += 0.5 * accelerated * passed
        jumps = distance > tolerance
        # A blow or a stop changes the velocity by 1 rad/s in a cycle of 4 ms.
        most_change = 1.0 + 4.0 * self._velocity_step + accelerated
        accelerates = np.abs(now.qd - previous.qd) > most_change
        torque_change = np.abs(now.torque_error - previous.torque_error)
        bends = torque_change > 0.3 * self._peak
        # Windings warm up by a degree [deg C] in seconds.
        heats = np.abs(now.heat - previous.heat) > 5.0
        return jumps, bends, ~(jumps | accelerates | bends | heats)


def confine(
    command: MitCommand, limits: Limits, last: Array, elapsed: Array, q: Array
) -> MitCommand:
    """Return the command within limits.

    Stiffness is reduced where it alone would exceed the torque limit, the feed-forward torque
    where the sum would. Damping stays. A position that is not finite becomes the last one, a
    velocity or torque that is NaN becomes 0.

    Args:
        command: command, fields (n,), in joint space.
        limits: of commanded positions, of their rates of change and commanded velocities, and of
            the sum of kp times position error and feed-forward torque.
        last: (n,) positions commanded last [rad].
        elapsed: (n,) time since the last command [s].
        q: (n,) last believed positions [rad]; NaN where a joint has never answered.
    """
    top_speed = limits.velocity
    reach = top_speed * elapsed
    start = np.clip(last, limits.lower, limits.upper)
    lowest = np.maximum(limits.lower, start - reach)
    highest = np.minimum(limits.upper, start + reach)
    position = np.where(np.isfinite(command.position), command.position, last)
    position = np.clip(position, lowest, highest)
    velocity = np.clip(np.nan_to_num(command.velocity), -top_speed, top_speed)
    error = np.nan_to_num(position - q)
    most_stiffness = limits.torque / np.maximum(np.abs(error), 1e-9)
    stiffness = np.minimum(command.kp, most_stiffness)
    spring = stiffness * error
    fed = np.clip(np.nan_to_num(command.torque), -limits.torque, limits.torque)
    fed = np.clip(fed, -limits.torque - spring, limits.torque - spring)
    return MitCommand(position, velocity, stiffness, command.kd, fed)


def require_allowed(
    labels: Sequence[str],
    command: MitCommand,
    allowed: MitCommand,
    q: Array,
    steps: tuple[Array, ...],
) -> None:
    """Raise HardwareAbort for the first joint whose command is beyond what is allowed.

    Args:
        labels: names of the n joints, for messages.
        command: command that is to be sent, fields (n,), in joint space.
        allowed: this command, limited to the bounds by ``confine``.
        q: (n,) last believed positions [rad]; NaN where a joint has never answered.
        steps: one quantisation step (n,) of position, velocity and torque [rad, rad/s, N m], by
            which a command may exceed what is allowed.
    """
    # A joint that has never answered has an unknown position error: only its torque counts.
    with np.errstate(over="ignore"):
        asked, makes = (
            given.kp * np.nan_to_num(given.position - q) + given.torque
            for given in (command, allowed)
        )
    position_step, velocity_step, torque_step = steps
    torque_slack = torque_step + command.kp * position_step
    weighing = option_setting("for_", "weight")
    for wanted, limited, slack, text in (
        (
            command.position,
            allowed.position,
            position_step,
            "be sent to {:.3f} rad; from the last command it may go to {:.3f}",
        ),
        (
            command.velocity,
            allowed.velocity,
            velocity_step,
            "be told {:.2f} rad/s, limit {:.2f}",
        ),
        (
            asked,
            makes,
            torque_slack,
            "be asked for {:.1f} N·m and makes {:.1f} at most: something holds the arm back, "
            f"or it needs more than this motor has (see {weighing} of plan)",
        ),
    ):
        # A command at its bound is rounded by its conversion to frames and back.
        tolerance = slack + 1e-6 * (1.0 + np.abs(limited))
        # Written so that a NaN counts as too much.
        beyond = ~(np.abs(wanted - limited) <= tolerance)
        for j in np.flatnonzero(beyond).tolist():
            raise HardwareAbort(
                f"{labels[j]} would {text.format(wanted[j], limited[j])}"
            )

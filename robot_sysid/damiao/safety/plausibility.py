"""Plausibility of motors' answers, and bounds of commands.

Serial adapters have no checksum between the bus and the computer, so one damaged character can make
a position wrong by radians or a healthy motor look faulty. ``SampleFilter`` believes a sample that
is plausible after the last believed one: the change of position agrees with the velocities, the
velocity changed no faster than a motor can change it, and the reported torque changed as the
command did. An implausible velocity, torque, status or temperature is not used, unless the next
sample confirms it. An implausible position is never used, however often it is repeated and however
long ago the last believed one is: the reported speeds carry the believed position on, and a
position that disagrees with it stays refused until the run ends.

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
        followed: (n,) whether an answer that is not believed has a speed that is, by which the
            believed position was carried on.
        jump: (n,) refused change of position that the motor's own control follows, as its torque
            or two samples in a row say [rad]; 0 where there is none.
        surplus: (n,) number of answers beyond the one that was due.
        foreign: (n,) number of commands that another program sent to this joint's motor.
        late: (n,) number of answers, since the last cycle, that no command of their cycle awaited:
            late ones, or those of a second motor.
        reported: (n,) status code in the answer that came, believed or not; ``NO_STATUS`` where
            none came.
    """

    answered: Mask
    time: Array
    feedback: Feedback
    requested: Mask
    command: MitCommand | None
    doubted: Mask
    followed: Mask
    jump: Array
    surplus: Codes
    foreign: Codes
    late: Codes
    reported: Codes


def without_nan(values: Array) -> Array:
    """Return values with 0 where they are NaN; in a control cycle ``nan_to_num`` takes too long."""
    known = np.array(values)
    known[np.isnan(known)] = 0.0
    return known


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
        if selected.all():
            return self
        return _Samples._make(map(partial(np.where, selected), self, other))


class _Doubts(NamedTuple):
    """What is implausible in samples after earlier ones; every field is (n,).

    Attributes:
        jumps: the position changed by more than a joint can move.
        accelerates: the velocity changed by more than a blow explains.
        bends: reported minus commanded torque changed by more than a motor may be off.
        heats: the temperature changed faster than a winding's.
    """

    jumps: Mask
    accelerates: Mask
    bends: Mask
    heats: Mask

    @property
    def is_plausible(self) -> Mask:
        """Whether nothing is implausible (n,)."""
        return ~(self.jumps | self.accelerates | self.bends | self.heats)


FASTEST = 200.0
"""Largest plausible acceleration [rad/s^2]: 7 N m (a DM4310) on 0.035 kg m^2."""
LONGEST_SPURT = 0.025
"""Time for which a joint may accelerate like that [s]: it then moves at 5 rad/s, a motor's no-load
speed. Time that passes beyond it makes no position more credible."""
SLACK = 0.05
"""By how much a position may leave the way of its speed [rad]: a slip of 0.15 has to be seen."""
BLOW = 1.0
"""By how much a blow or a stop changes the velocity in a cycle of 4 ms [rad/s]."""
MOST_BEND = 0.3
"""By which share of the peak torque a sound motor's torque may leave its command at once."""
MOST_HEATING = 5.0
"""By how much two temperatures in a row may differ [deg C]; windings take seconds for a degree."""


class SampleFilter:
    """Decides which answers of n joints are believed; holds the last believed samples.

    A joint's last answer that was not believed is suspect: the next one may confirm it, but for its
    position.

    Args:
        peak_torque: (n,) peak torque of each joint [N m].
        velocity_step: (n,) one quantisation step of each joint's velocity [rad/s].

    Attributes:
        last: last believed samples; NaN before the first. The position of a joint whose answers
            are refused is carried on by their speed, as far as that is plausible.
        is_misled: (n,) whether the motor's own control uses a position that was refused: its
            stiffness would push the joint by as much as that is off.
    """

    def __init__(self, peak_torque: Array, velocity_step: Array) -> None:
        self._peak = peak_torque
        self._velocity_step = velocity_step
        n_joints = len(peak_torque)
        unknown = np.full(n_joints, np.nan)
        enabled = np.ones(n_joints, dtype=bool)
        self.last = _Samples(unknown, unknown, unknown, unknown, enabled, unknown)
        self.is_misled = np.zeros(n_joints, dtype=bool)
        self._suspect = self.last
        self._is_suspected = np.zeros(n_joints, dtype=bool)

    def start(self, time: float, q: Array) -> None:
        """Take q (n,) [rad] at zero velocity as the last believed sample, of ``time`` [s]."""
        self.last = self.last._replace(
            time=np.full_like(q, time), q=q.copy(), qd=np.zeros_like(q)
        )

    def position_at(self, now: float) -> Array:
        """Return where the joints (n,) are at a time, carried on by their last speed [rad].

        A command acts a cycle after the last sample: at 50 Hz a joint at 1.5 rad/s is then 0.03 rad
        farther, which a stiffness of 100 N m/rad would take for 3 N m. No further than that an old
        speed says anything.
        """
        passed = (now - self.last.time).clip(0.0, LONGEST_SPURT)
        return self.last.q + self.last.qd * passed

    def believe(
        self, came: Mask, time: Array, feedback: Feedback, acted: MitCommand | None
    ) -> tuple[Mask, Mask, Array]:
        """Return which answers are believed (n,), and ``followed`` and ``jump`` of ``Replies``.

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
        heat = feedback.temperature.astype(float)
        error = self._torque_error(acted, feedback, q)
        now = _Samples(time, q, qd, error, feedback.status == ENABLED, heat)
        # An answer is believed if it follows the last believed one, or repeats the suspect one. A
        # motor that was enabled and reports that it is not has to say so twice.
        last = self.last
        doubts = self._compare(last, now)
        believed = came & doubts.is_plausible & (now.enabled | ~last.enabled)
        repeated = self._is_suspected
        if repeated.any():
            repeated = repeated & self._compare(self._suspect, now).is_plausible
            repeated &= now.enabled == self._suspect.enabled
            believed |= came & repeated & ~doubts.jumps
        doubted = came & ~believed
        self._is_suspected = np.where(came, doubted, self._is_suspected)
        self._suspect = now.where(came, self._suspect)
        self.last = now.where(believed, last)
        if not doubted.any():
            return believed, doubted, np.zeros_like(q)

        # A blow that is too hard to be believed is one where the next sample has that speed, too.
        followed = doubted & (repeated | ~doubts.accelerates)
        reckoned = _reckoned_positions(last, now)
        carried = last._replace(time=time, q=reckoned, qd=qd)
        self.last = carried.where(followed, self.last)
        # The torque tells which position the motor's own control uses: the reported one, or that
        # to which the speed leads.
        elsewhere = self._torque_error(acted, feedback, reckoned)
        bend_there = np.abs(elsewhere - last.torque_error)
        bend_here = np.abs(error - last.torque_error)
        # No position that jumped is believed.
        is_elsewhere = doubted & doubts.jumps & now.enabled
        self.is_misled |= is_elsewhere & (bend_here < bend_there)
        is_obvious = bend_there > MOST_BEND * self._peak
        is_jump = is_elsewhere & ~doubts.bends & (repeated | is_obvious)
        jump = np.where(is_jump, without_nan(q - last.q), 0.0)
        return believed, followed, jump

    def _torque_error(
        self, acted: MitCommand | None, feedback: Feedback, q: Array
    ) -> Array:
        """Return reported minus commanded torque (n,) [N m], were the joints at q (n,) [rad]."""
        if acted is None:
            return np.zeros_like(q)
        expected = acted.motor_torque(q, feedback.velocity)
        return feedback.torque - expected.clip(-self._peak, self._peak)

    def _compare(self, previous: _Samples, now: _Samples) -> _Doubts:
        """Return what is implausible in the samples ``now`` after ``previous`` ones.

        A quantity that is NaN in either of them is not compared, and counts as plausible.
        """
        passed = np.fmax(now.time - previous.time, 0.0)
        expected_change = 0.5 * (now.qd + previous.qd) * passed
        distance = np.abs(now.q - previous.q - expected_change)
        spurt = np.minimum(passed, LONGEST_SPURT)
        accelerated = FASTEST * spurt
        tolerance = SLACK + 0.5 * np.abs(expected_change) + 0.5 * accelerated * spurt
        most_change = BLOW + 4.0 * self._velocity_step + accelerated
        torque_change = np.abs(now.torque_error - previous.torque_error)
        return _Doubts(
            jumps=distance > tolerance,
            accelerates=np.abs(now.qd - previous.qd) > most_change,
            bends=torque_change > MOST_BEND * self._peak,
            heats=np.abs(now.heat - previous.heat) > MOST_HEATING,
        )


def _reckoned_positions(last: _Samples, now: _Samples) -> Array:
    """Return the positions (n,) to which speeds have led since the last samples [rad]."""
    passed = np.fmax(now.time - last.time, 0.0)
    return last.q + 0.5 * (last.qd + now.qd) * passed


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
        q: (n,) believed positions [rad]; NaN where a joint has never answered.
    """
    top_speed = limits.velocity
    reach = top_speed * elapsed
    start = last.clip(limits.lower, limits.upper)
    lowest = np.maximum(limits.lower, start - reach)
    highest = np.minimum(limits.upper, start + reach)
    position = np.where(np.isfinite(command.position), command.position, last)
    position = position.clip(lowest, highest)
    velocity = without_nan(command.velocity).clip(-top_speed, top_speed)
    error = without_nan(position - q)
    most_stiffness = limits.torque / np.maximum(np.abs(error), 1e-9)
    stiffness = np.minimum(command.kp, most_stiffness)
    spring = stiffness * error
    fed = without_nan(command.torque).clip(-limits.torque, limits.torque)
    fed = fed.clip(-limits.torque - spring, limits.torque - spring)
    return MitCommand(position, velocity, stiffness, command.kd, fed)


# Why a command is not sent: what it would be, then what is allowed.
_SENT_TOO_FAR = "be sent to {:.3f} rad; from the last command it may go to {:.3f}"
_TOLD_TOO_FAST = "be told {:.2f} rad/s, limit {:.2f}"
_ASKED_TOO_MUCH = (
    "be asked for {:.1f} N·m and makes {:.1f} at most: something holds the arm back, or it needs "
    "more than this motor has (see {weighing} of plan)"
)


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
        q: (n,) believed positions [rad]; NaN where a joint has never answered.
        steps: one quantisation step (n,) of position, velocity and torque [rad, rad/s, N m], by
            which a command may exceed what is allowed.
    """
    # A joint that has never answered has an unknown position error: only its torque counts. What is
    # told to go too far is refused by its position, whatever torque that makes.
    with np.errstate(over="ignore", invalid="ignore"):
        asked, makes = (
            given.kp * without_nan(given.position - q) + given.torque
            for given in (command, allowed)
        )
    position_step, velocity_step, torque_step = steps
    torque_slack = torque_step + command.kp * position_step
    for wanted, limited, slack, text in (
        (command.position, allowed.position, position_step, _SENT_TOO_FAR),
        (command.velocity, allowed.velocity, velocity_step, _TOLD_TOO_FAST),
        (asked, makes, torque_slack, _ASKED_TOO_MUCH),
    ):
        # A command at its bound is rounded by its conversion to frames and back.
        tolerance = slack + 1e-6 * (1.0 + np.abs(limited))
        # Written so that a NaN counts as too much.
        is_allowed = np.abs(wanted - limited) <= tolerance
        if not is_allowed.all():
            j = int(is_allowed.argmin())
            weighing = option_setting("for_", "weight")
            reason = text.format(wanted[j], limited[j], weighing=weighing)
            raise HardwareAbort(f"{labels[j]} would {reason}")

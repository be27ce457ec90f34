"""Commanding motors: enable, one exchange per cycle, and disable on every way out."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.damiao import protocol
from robot_sysid.damiao.bus import GuardedLink
from robot_sysid.damiao.joints import DamiaoJoint, JointSpace
from robot_sysid.damiao.protocol import ENABLED, Address, Frame
from robot_sysid.damiao.safety.guards import (
    NO_STATUS,
    CommandBounds,
    CommandRange,
    Mask,
    Replies,
    SampleFilter,
)
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array

# A frame may be lost; five in a row are not, and 2 ms lets a full queue of 14 frames empty [s].
_DISABLE_REPEATS = 5
_DISABLE_SPACING = 2e-3
# Far more than the slowest adapter takes (16 ms) [s].
_CONFIRM_TIMEOUT = 0.02
# A bus that comes back within this time still gets its motors disabled.
_CONFIRM_PATIENCE = 0.5
_ENABLE_TRIES = 3
# An arm that nobody drives yet stays this near to where it was between two questions [rad].
_SAME_PLACE = 0.02
# However long nothing was sent, a command goes no farther than in this time [s].
_LONGEST_PAUSE = 0.2
# How late a cycle may be, see ``PlaySettings.max_lateness`` [s].
_MOST_CREDIT = 0.02


PAUSE = 4
"""Cycles of silence after which a missing answer counts as lost: 16 ms at 250 Hz, the latest that
a slow adapter was seen to deliver."""


class Outstanding:
    """Assigns answers to the commands of n motors, although answers carry no number.

    Each command is answered once, in order. Where an answer is missing at the end of its cycle, the
    next thing heard from that motor may be it, late, or the answer to the next command. So it gets
    no new command until the missing answer has come or is long overdue: what a slow adapter holds
    back is out of the way then, and each answer that is believed belongs to the command before it.

    Attributes:
        surplus: number (n,) of answers in this cycle that no command had asked for; the caller sets
            it to zero.
    """

    def __init__(self, n: int) -> None:
        self._owed = np.zeros(n, int)
        self._silent = np.zeros(n, int)
        self._commanded = np.zeros(n, bool)
        self.surplus = np.zeros(n, int)

    def may_be_commanded(self, motors: Mask) -> Mask:
        """Begin a cycle: return which of the motors (n,) get a command in it."""
        self._silent = np.where(self._commanded, 0, self._silent + 1)
        self._owed[self._silent >= PAUSE] = 0
        self._commanded = np.asarray(motors & (self._owed == 0))
        self._owed += self._commanded
        return self._commanded

    def take_answer(self, j: int) -> bool:
        """Count an answer of motor j; return whether it answers the command of this cycle."""
        is_timely = bool(self._commanded[j] and self._owed[j] == 1)
        self.surplus[j] += self._owed[j] == 0
        self._owed[j] = max(self._owed[j] - 1, 0)
        self._silent[j] = 0
        return is_timely


class MotorSession:
    """The n motors of an arm, for as long as they may be enabled.

    A context manager: however the block is left, every motor that could be enabled is commanded
    five times to disable, and has to confirm it. Before ``enable`` nothing is sent on the way out.

    Commands and measurements are in joint space, see ``JointSpace``. The scaling is that of the
    motors' registers; half a quantisation step is added to what they measure, because motors drop
    the fraction. Every command passes ``CommandBounds``, and every answer ``SampleFilter``.

    Args:
        link: of the motors' buses.
        joints: one per motor.
        scaling: of the motors' registers.
        command_range: where commands may go; None as far and as fast as frames can carry.

    Attributes:
        clock, joints, scaling: as given; ``n_joints`` is n.
        space: mounting of the motors.
        steps: one quantisation step (n,) of position, velocity and torque [rad, rad/s, N m].
        peak_torque: (n,) of each joint [N m].
        last_replies: of the last exchange, also where an error cut it short.
        unconfirmed: joints whose motors could be enabled and have not confirmed that they are off.
    """

    def __init__(
        self,
        link: GuardedLink,
        joints: Sequence[DamiaoJoint],
        scaling: protocol.Scaling,
        command_range: CommandRange | None = None,
    ) -> None:
        self._link = link
        self.clock = link.clock
        self.joints = tuple(joints)
        self.scaling = scaling
        self.n_joints = len(joints)
        self._labels = [joint.label for joint in joints]
        self.space = JointSpace.of(joints)
        position_step, velocity_step, torque_step = scaling.steps
        self.steps = position_step, velocity_step, torque_step * self.space.ratio
        # A frame cannot say more than the scale's end either.
        peaks = np.minimum([j.spec.peak_torque for j in joints], scaling.limits[:, 2])
        self.peak_torque: Array = peaks * self.space.ratio
        self.unconfirmed: tuple[DamiaoJoint, ...] = ()
        self.last_replies: Replies | None = None
        self._command: protocol.MitCommand | None = None
        scale = self._scale()
        # In a stop a command that fits into no frame would not be sent at all.
        sendable = scale if command_range is None else command_range.within(scale)
        self._bounds = CommandBounds(sendable, self.peak_torque, *self.steps)
        self._sent_position = np.full(self.n_joints, np.nan)
        self._sent_at = np.full(self.n_joints, -np.inf)
        self._credit = np.zeros(self.n_joints)
        self._sent_data: dict[int, bytes] = {}
        self._filter = SampleFilter(self.peak_torque, velocity_step)
        self._outstanding = Outstanding(self.n_joints)
        self._foreign = np.zeros(self.n_joints, int)
        # Whether answers count that belong to no command of this cycle.
        self._takes_any_answer = True
        self._by_reply = {
            (joint.bus, joint.master_id): j for j, joint in enumerate(joints)
        }
        self._by_command = {joint.address: j for j, joint in enumerate(joints)}

    def _scale(self) -> CommandRange:
        """Return the positions and speeds that frames can carry."""
        limit = self.scaling.limits.T
        ends = [self.space.joint_position(sign * limit[0]) for sign in (-1.0, 1.0)]
        return CommandRange(np.minimum(*ends), np.maximum(*ends), limit[1])

    @property
    def believed_motion(self) -> tuple[Array, Array]:
        """Positions and velocities (n,) as believed last, NaN where never heard [rad, rad/s]."""
        return self._filter.q, self._filter.qd

    @property
    def command_range(self) -> CommandRange:
        """Positions and speeds within which commands stay."""
        return self._bounds.command_range

    @property
    def sent_position(self) -> Array:
        """Positions (n,) that were commanded last, at first where the arm stood [rad]."""
        return self._sent_position

    def open_range(self) -> None:
        """Let positions go as far as frames can carry, no faster than before.

        For lowering an arm of which no model tells how far its load may take it.
        """
        scale = self._scale()
        self._bounds = self._bounds.including(scale.lower).including(scale.upper)

    def is_off(self, motor: Address) -> bool:
        """Tell whether a motor was never enabled or has confirmed that it is disabled."""
        return motor not in [joint.address for joint in self.unconfirmed]

    def __enter__(self) -> MotorSession:
        return self

    def __exit__(
        self, error_type: object, error: BaseException | None, trace: object
    ) -> None:
        if not self.unconfirmed:
            return
        self.disable()
        if self.unconfirmed:
            motors = ", ".join(joint.label for joint in self.unconfirmed)
            cause = f"{error}; " if error is not None else ""
            raise HardwareAbort(
                f"{cause}no confirmation that these motors are disabled: {motors}. Cut their power"
            ) from error

    def enable(self) -> Array:
        """Enable every motor, or raise HardwareAbort; return where each was then (n,) [rad].

        Where a motor stands is believed when two of its answers agree.
        """
        self.unconfirmed = self.joints
        requests = [protocol.refresh_frame(joint.address) for joint in self.joints]
        answers = [self._ask(j, request) for j, request in enumerate(requests)]
        position = np.empty(self.n_joints)
        for j, joint in enumerate(self.joints):
            position[j] = self._enable_one(j, joint, *answers[j])
        now = self.clock.now()
        self._filter.start(now, position)
        self._bounds = self._bounds.including(position)
        self._sent_position = position.copy()
        self._sent_at = np.full(self.n_joints, now)
        return position

    def _enable_one(
        self, j: int, joint: DamiaoJoint, status: int, position: float
    ) -> float:
        """Enable motor j, whose last answer is given; return where it stands [rad].

        HardwareAbort where it has a fault, does not answer, or its answers disagree.
        """
        for _ in range(_ENABLE_TRIES):
            last_status = status
            last_position = position
            status, position = self._ask(j, protocol.enable_frame(joint.address))
            agree = abs(position - last_position) <= _SAME_PLACE
            if status == ENABLED and agree:
                return position
            if protocol.is_fault(status) and status == last_status != NO_STATUS:
                break
        reason = "no answer" if status == NO_STATUS else protocol.status_text(status)
        if status == ENABLED:
            reason = f"its answers disagree, {last_position:.3f} and {position:.3f} rad"
        raise HardwareAbort(f"{joint.label} did not enable: {reason}")

    def _ask(self, j: int, request: Frame) -> tuple[int, float]:
        """Send a request to a motor; return the status and the position [rad] it answers."""
        self._link.drain()
        self._link.send(request)
        this_motor = np.arange(self.n_joints) == j
        feedback = self._collect(
            this_motor, self.clock.now() + _CONFIRM_TIMEOUT
        ).feedback
        return int(feedback.status[j]), float(feedback.position[j])

    def exchange(
        self,
        command: protocol.MitCommand,
        until: float,
        joints: Mask | None = None,
        braking: bool = False,
    ) -> Replies:
        """Command joints and return their replies, each the state before its command acted.

        Args:
            command: for all n joints.
            until: when replies have to be there, in the clock's time [s].
            joints: which joints (n,) are commanded; None for all.
            braking: whether joints are commanded also where answers are missing, see
                ``Outstanding``, and a command beyond the bounds is confined to them.

        Raises:
            BeyondBounds: the command exceeds the bounds; nothing was sent.
            InputError: it does not fit into a frame; nothing was sent.
            LinkError: the bus does not work.
        """
        self.last_replies = None
        self._takes_any_answer = braking
        self._outstanding.surplus[:] = 0
        self._foreign[:] = 0
        motors = np.ones(self.n_joints, bool) if joints is None else joints
        # What has arrived since the last exchange is late, but it is known whose answer it was.
        while (frame := self._link.receive(self.clock.now())) is not None:
            self._note_foreign(frame)
            if (sender := self._sender(frame)) is not None:
                self._outstanding.take_answer(sender)
        now = self.clock.now()
        command = self._bound(command, now, braking)
        packed = protocol.encode_mit(
            self.space.command_to_motors(command), self.scaling
        )
        commanded = motors if braking else self._outstanding.may_be_commanded(motors)
        # As the motors read it; one that gets no command stays under its old one.
        new = self.space.command_to_joints(protocol.decode_mit(packed, self.scaling))
        acted = self._command
        old = acted or new
        in_force = (np.where(commanded, *pair) for pair in zip(new, old))
        self._command = protocol.MitCommand(*in_force)
        used = (
            np.abs(new.position - self._sent_position)
            / self._bounds.command_range.speed
        )
        unused = np.clip(
            self._time_to_move(now) - np.nan_to_num(used), 0.0, _MOST_CREDIT
        )
        self._credit = np.where(commanded, unused, self._credit)
        self._sent_position = np.where(commanded, new.position, self._sent_position)
        self._sent_at = np.where(commanded, now, self._sent_at)
        for j in np.flatnonzero(commanded).tolist():
            bus, can_id = self.joints[j].address
            self._sent_data[j] = packed[j].tobytes()
            self._link.send(Frame(can_id, self._sent_data[j], bus=bus))
        return self._collect(commanded, until, self._command, acted, believe=True)

    def _time_to_move(self, now: float) -> Array:
        """Return the time (n,) in which each commanded position may move from its last one [s].

        A cycle that began late is followed by one that begins sooner after it than their references
        are apart; what the late one did not use counts for that, up to how late a cycle may be.
        """
        return np.minimum(now - self._sent_at, _LONGEST_PAUSE) + self._credit

    def _bound(
        self, command: protocol.MitCommand, now: float, braking: bool
    ) -> protocol.MitCommand:
        """Return a command within the bounds, or raise BeyondBounds unless ``braking``."""
        last = np.where(
            np.isnan(self._sent_position), command.position, self._sent_position
        )
        elapsed = self._time_to_move(now)
        if braking:
            return self._bounds.confine(command, last, elapsed, self._filter.q)
        self._bounds.require(self._labels, command, last, elapsed, self._filter.q)
        return command

    def switch_off(self, joints: Mask) -> None:
        """Command the motors of joints (n,) to disable; ``disable`` has it confirmed at the end."""
        for j in np.flatnonzero(joints).tolist():
            self._send_disable(self.joints[j])

    def disable(self) -> None:
        """Disable every motor; ``unconfirmed`` names those that did not confirm it.

        An error of one motor, or of the bus, does not keep the others from being commanded.
        """
        self._takes_any_answer = True
        for repeat in range(_DISABLE_REPEATS):
            if repeat:
                self.clock.sleep_until(self.clock.now() + _DISABLE_SPACING)
            for joint in self.joints:
                self._send_disable(joint)
        self._confirm()

    def _send_disable(self, joint: DamiaoJoint) -> None:
        """Send one disable frame, whatever the bus raises."""
        # The next of the five attempts, and the confirmation, tell whether it worked.
        with contextlib.suppress(BaseException):
            self._link.send(protocol.disable_frame(joint.address))

    def _confirm(self) -> None:
        """Ask motors to disable until each has confirmed it, or time is up; set ``unconfirmed``."""
        running = np.ones(self.n_joints, bool)
        patience = self.clock.now() + _CONFIRM_PATIENCE
        while np.any(running) and self.clock.now() < patience:
            try:
                self._link.drain()
                for j in np.flatnonzero(running):
                    self._send_disable(self.joints[j])
                replies = self._collect(running, self.clock.now() + _CONFIRM_TIMEOUT)
                running &= ~replies.answered | (replies.feedback.status == ENABLED)
            except BaseException:
                # Whatever a driver raises, SystemExit and KeyboardInterrupt included: it may
                # recover, and the other motors still listen.
                self.clock.sleep_until(self.clock.now() + _DISABLE_SPACING)
            self.unconfirmed = tuple(self.joints[j] for j in np.flatnonzero(running))

    def _collect(
        self,
        motors: Mask,
        until: float,
        command: protocol.MitCommand | None = None,
        acted: protocol.MitCommand | None = None,
        believe: bool = False,
    ) -> Replies:
        """Return the replies of motors (n,) that come ``until`` then [s], also ``last_replies``.

        Args:
            command: that the replies answer.
            acted: the command in force when the samples were taken.
            believe: whether the sample filter judges the replies.
        """
        raw = np.zeros((self.n_joints, 8), dtype=np.uint8)
        received = np.full(self.n_joints, np.nan)
        sent = np.full(self.n_joints, np.nan)
        missing = int(np.count_nonzero(motors))
        try:
            while missing and (frame := self._link.receive(until)) is not None:
                missing -= self._take(frame, motors, raw, received, sent)
        finally:
            answered = np.isfinite(received)
            decoded = protocol.decode_feedback(raw, self.scaling, half_step=True)
            measured = self.space.to_joints(
                decoded.position, decoded.velocity, decoded.torque
            )
            q, qd, tau = np.where(answered, measured, np.nan)
            status = np.where(answered, decoded.status, NO_STATUS)
            feedback = replace(
                decoded, status=status, position=q, velocity=qd, torque=tau
            )
            stamps = np.where(answered & np.isfinite(sent), sent, received)
            replies = Replies(answered, stamps, feedback, motors, command)
            if believe:
                surplus = self._outstanding.surplus.copy()
                counted = replace(
                    replies, surplus=surplus, foreign=self._foreign.copy()
                )
                replies = self._filter.believe(counted, acted)
            self.last_replies = replies
        return replies

    def _take(
        self,
        frame: Frame,
        motors: Mask,
        raw: protocol.Bytes,
        received: Array,
        sent: Array,
    ) -> bool:
        """Sort a frame into the arrays; return whether it is a missing answer of a motor (n,).

        ``raw`` (n, 8) takes an answer's data, ``received`` (n,) the time at which it came and
        ``sent`` (n,) the time at which a command was on the bus [s].
        """
        commanded = self._by_command.get(Address(frame.bus, frame.id))
        if frame.echo and commanded is not None:
            sent[commanded] = frame.time
        self._note_foreign(frame)
        j = self._sender(frame)
        if j is None:
            return False
        is_timely = self._outstanding.take_answer(j)
        counts = is_timely or self._takes_any_answer
        if not motors[j] or np.isfinite(received[j]) or not counts:
            return False
        raw[j] = np.frombuffer(frame.data, dtype=np.uint8)
        received[j] = frame.time
        return True

    def _note_foreign(self, frame: Frame) -> None:
        """Count a command to one of our motors that is not what we sent it last."""
        j = self._by_command.get(Address(frame.bus, frame.id))
        if j is not None and not frame.echo and frame.data != self._sent_data.get(j):
            self._foreign[j] += 1

    def _sender(self, frame: Frame) -> int | None:
        """Return the joint whose feedback a frame is, or None."""
        if frame.error or frame.echo or len(frame.data) != 8:
            return None
        j = self._by_reply.get((frame.bus, frame.id))
        if j is None or frame.data[0] & 0xF != self.joints[j].can_id & 0xF:
            return None
        return j

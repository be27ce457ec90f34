"""Commanding motors: enable, one exchange per cycle, and disable on every way out.

Arrays have one entry for each of the n joints, base to terminal; j is the index of a joint. Joint
space means positions, velocities and torques of the joints, as a model of the arm has them; motor
space means those that the frames carry. ``Mounting`` converts one into the other.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from robot_sysid.damiao.bus import GuardedLink
from robot_sysid.damiao.joints import DamiaoJoint, Mounting, peak_torques
from robot_sysid.damiao.protocol import (
    DISABLE,
    ENABLE,
    ENABLED,
    REFRESH,
    Bytes,
    CanFrame,
    Codes,
    Feedback,
    MitCommand,
    Scaling,
    decode_feedback,
    decode_mit,
    encode_mit,
    register_frame,
    special_frame,
    status_text,
)
from robot_sysid.damiao.safety.plausibility import (
    NO_STATUS,
    Mask,
    Replies,
    SampleFilter,
    confine,
    require_allowed,
)
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array, Limits

# Time between two disable commands to a motor [s], in which a full queue of 14 frames empties.
_DISABLE_SPACING = 2e-3
# Longest wait for the answer to a single request [s]: adapters take up to 16 ms.
_CONFIRM_TIMEOUT = 0.02
REPLY_SHARE = 0.9
"""Share of a control cycle for which replies are waited for; the rest is for the checks.

Motors get this time even if the computer began the cycle late; then the next cycle is skipped.
"""
PATIENCE = 4
"""Number of cycles after which a missing answer counts as lost.

It is 16 ms at 250 Hz, the largest delay that has been observed with a slow adapter.
"""
_LEADING_BACK = 0.1
"""Time in which a joint that missed commands is led back to its reference [s]: what it lags behind
needs no more than the motors' damping takes, and what holds an arm back is found 0.1 s later."""
_LONGEST_GAP = 0.2
"""Longest time since the last command in which a reference may have moved on [s]. Watchdogs of the
usual length have ended by then; with more, one command could send a joint far at once."""
_LATEST_MOVE = 0.02
"""Longest time that one command leaves for the next one to move in [s]: as much as it may be late,
by ``PlaySettings.max_lateness``."""
_SAME_POSITION = 0.02
"""By how much two answers of an arm that is not driven yet may disagree about its position [rad]:
it stands, or sinks slowly, and a damaged answer is off by more."""
_NO_DATA = bytes(8)
"""What stands for the data of a motor's answer that has not come."""
_DISABLE_PATIENCE = 0.5
"""How long motors are told again to disable until they have confirmed it [s]: a bus that fails may
work again by then."""


class Outstanding:
    """Assigns answers to the commands of n motors, although answers carry no number.

    Each command is answered once, in order. Where an answer is missing at the end of its cycle, it
    is late or lost, and the motor's next answer may be the missing one or that to the next command.
    A cycle without a command tells: what comes in it is late. So the motor gets no command in the
    cycle after the first missing answer, and then one in each cycle, because meanwhile it holds an
    old one; and once it has answered, none until the missing answer can no more be on its way: if
    that was late, the next one is, too, and comes now. Where two come in a cycle, the last one
    belongs to the command of that cycle, as adapters keep their order.

    Attributes:
        surplus: number (n,) of answers in this cycle that no command had requested.
        late: number (n,) of answers in this cycle, or since the last one, that do not answer a
            command of the cycle in which they came.
        owed: number (n,) of answers that may still come.
    """

    def __init__(self, n: int) -> None:
        self.owed = np.zeros(n, int)
        # Number of commands in a row to which no answer has come, and number of cycles since the
        # last one of these.
        self._unanswered, self._waited = np.zeros((2, n), int)
        # Whether the motor got a command in the last cycle; whether in the cycle that is not over;
        # and whether that has not been answered.
        self._commanded, self._is_open, self._awaited = np.zeros((3, n), bool)
        self.surplus, self.late = np.zeros((2, n), int)

    def end_cycle(self) -> None:
        """End a cycle: its numbers become zero, and answers that come from now on are late."""
        self.surplus, self.late = np.zeros((2, len(self.owed)), int)
        self._unanswered += self._awaited
        self._waited = np.where(self._awaited, 0, self._waited + 1)
        self._is_open, self._awaited = np.zeros((2, len(self.owed)), bool)

    def may_be_commanded(self, motors: Mask) -> Mask:
        """Begin a cycle; count and return the motors (n,) that may get a command in it.

        ``motors`` (n,) says which motors are to get a command. The result is a subset of these:
        those of whose answers it is known that none is late. The caller must not change the
        returned array.
        """
        self.owed *= self._waited < PATIENCE
        falls_silent = self._commanded & (self._unanswered == 1)
        may_be_late = (self.owed > 0) & (self._unanswered == 0)
        self._commanded = motors & ~falls_silent & ~may_be_late
        self._is_open = self._commanded
        self._awaited = self._commanded.copy()
        self.owed += self._commanded
        return self._commanded

    def take_answer(self, j: int) -> bool:
        """Count an answer of motor j; return whether it may answer the command of this cycle.

        An answer that no command awaits is counted in ``surplus``.
        """
        is_of_this_cycle = bool(self._is_open[j] and self.owed[j])
        is_first = bool(self._awaited[j])
        self.late[j] += not (is_of_this_cycle and is_first)
        self.surplus[j] += not self.owed[j]
        self.owed[j] = max(self.owed[j] - 1, 0)
        self._unanswered[j] = 0
        self._awaited[j] = False
        return is_of_this_cycle


class MotorSession:
    """The n motors of an arm, for as long as they may be enabled.

    A context manager: however the block is left, every motor that may be enabled is commanded five
    times to disable, and has to confirm this. If ``enable`` was not called, nothing is sent.

    Commands and measurements are in joint space, see ``Mounting``. Half a quantisation step is
    added to measured values, because motors truncate them. Every command is checked by
    ``confine`` and every answer by ``SampleFilter``.

    Args:
        link: link of the motors' bus.
        joints: joints with their motors, n in all.
        scaling: range of position, velocity and torque in each motor's frames, from its registers
            PMAX, VMAX and TMAX.
        limits: of positions and speeds of commands, as far as frames carry them.

    Attributes:
        clock: clock of the link.
        joints: as given.
        scaling: as given.
        n_joints: number n of joints.
        steps: one quantisation step (n,) of position, velocity and torque [rad, rad/s, N m].
        limits: within which commands stay.
        sent_position: positions (n,) commanded last, or those of the arm when it was enabled [rad];
            NaN before. Callers must not change them.
        unconfirmed: joints whose motors may be enabled: they have not confirmed to be disabled.
    """

    def __init__(
        self,
        link: GuardedLink,
        joints: Sequence[DamiaoJoint],
        scaling: Scaling,
        limits: Limits,
    ) -> None:
        self._link = link
        self.clock = link.clock
        self.joints = tuple(joints)
        self.scaling = scaling
        self.n_joints = len(joints)
        self._labels = [joint.label for joint in joints]
        self._mounting = Mounting.of(joints)
        self.steps = scaling.steps
        self._frames = self._mounting.frame_limits(scaling.limits)
        peaks = Limits(torque=peak_torques(joints))
        # In a stop commands are limited to these, which must not exceed what frames can carry.
        self.limits = Limits.of(limits, peaks, self._frames)
        self.unconfirmed: tuple[DamiaoJoint, ...] = ()
        # Command in force as the motors read it, in joint space; None before the first.
        self._command: MitCommand | None = None
        self.sent_position = np.full(self.n_joints, np.nan)
        # Time up to which each joint's commands have moved it: that of the last command, minus
        # what this left unused [s].
        self._moved_until = np.full(self.n_joints, -np.inf)
        # Time up to which each joint that missed commands is led back [s].
        self._led_back_until = np.full(self.n_joints, -np.inf)
        # Data of each motor's last command, by joint.
        self._sent_data: dict[int, bytes] = {}
        self._filter = SampleFilter(self.limits.torque, self.steps[1])
        self._outstanding = Outstanding(self.n_joints)
        # Number of commands in this cycle that another program sent to each motor.
        self._foreign = np.zeros(self.n_joints, int)
        # Whether answers count that belong to no command of this cycle.
        self._takes_any_answer = True
        # Joints by the arbitration ids of their motor's replies, and of their commands.
        self._by_reply = {joint.master_id: j for j, joint in enumerate(joints)}
        self._by_command = {joint.can_id: j for j, joint in enumerate(joints)}

    @property
    def believed_motion(self) -> tuple[Array, Array]:
        """Positions and velocities (n,) [rad, rad/s] of the last answers that the filter believed.

        A refused position is replaced by that to which the speed has led. They are NaN before the
        first answer, and must not be changed.
        """
        return self._filter.last.q, self._filter.last.qd

    @property
    def position_now(self) -> Array:
        """Where the joints (n,) are by now: the believed positions, carried on by their speed."""
        return self._filter.position_at(self.clock.now())

    @property
    def torque_deviation(self) -> Array:
        """Reported torque minus the commanded one (n,) of these answers [N m]."""
        return self._filter.last.torque_error

    @property
    def is_misled(self) -> Mask:
        """Whether each motor's own control (n,) uses a position that was refused."""
        return self._filter.is_misled

    @property
    def error_frames(self) -> int:
        """Number of error frames on the bus so far, as far as the adapter reports them."""
        return self._link.error_frames

    def open_range(self) -> None:
        """Widen the range of commanded positions to that of the frames; speeds stay limited.

        This is for lowering an arm without a model, whose end position is unknown.
        """
        frames = self._frames
        self.limits = self.limits.with_positions(frames.lower).with_positions(
            frames.upper
        )

    def __enter__(self) -> MotorSession:
        """Return the session; no motor is enabled by this."""
        return self

    def __exit__(
        self, error_type: object, error: BaseException | None, trace: object
    ) -> None:
        """Disable all motors if one may be enabled; HardwareAbort names those that do not confirm.

        The ``error`` that ended the block, if any, is the cause of that HardwareAbort.
        """
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
        """Enable every motor and return the joint positions (n,) [rad].

        The sample filter starts from these positions, and the bounds of commands are widened to
        include them. HardwareAbort where, after three commands, a motor has a fault or has not said
        that it is enabled where it was before.
        """
        # From here on every motor may be enabled.
        self.unconfirmed = self.joints
        # The state of all motors before the first one is enabled.
        state = self._request(partial(register_frame, REFRESH))
        position = state.position
        is_enabled = np.zeros(self.n_joints, bool)
        for _ in range(3):
            last_status = state.status
            state = self._request(partial(special_frame, ENABLE))
            agrees = np.abs(state.position - position) <= _SAME_POSITION
            is_settled = is_enabled | np.isnan(state.position)
            position = np.where(is_settled, position, state.position)
            is_enabled |= (state.status == ENABLED) & agrees
            # One report of a fault may be a damaged frame; two equal ones are the motor's own.
            has_fault = (state.status > ENABLED) & (state.status == last_status)
            if np.all(is_enabled) or np.any(has_fault):
                break
        for j in np.flatnonzero(~is_enabled)[:1]:
            reason = "its answers are missing or disagree about its position"
            if state.status[j] not in (ENABLED, NO_STATUS):
                reason = status_text(state.status[j])
            raise HardwareAbort(f"{self.joints[j].label} did not enable: {reason}")
        now = self.clock.now()
        self._filter.start(now, position)
        self.limits = self.limits.with_positions(position)
        self.sent_position = position.copy()
        self._moved_until = np.full(self.n_joints, now)
        return position

    def _request(self, frame_to: Callable[[int], CanFrame]) -> Feedback:
        """Send every motor a request and return their answers, see ``_receive``.

        ``frame_to`` returns the request to the motor with a CAN id. Frames that came before are
        discarded.
        """
        self._link.drain()
        for joint in self.joints:
            self._link.send(frame_to(joint.can_id))
        everyone = np.ones(self.n_joints, bool)
        _, feedback = self._receive(everyone, self.clock.now() + _CONFIRM_TIMEOUT)
        return feedback

    def exchange(
        self, command: MitCommand, until: float, joints: Mask, braking: bool
    ) -> Replies:
        """Command joints and return their replies, each the state before its command acted.

        Args:
            command: command of all n joints, fields (n,), in joint space.
            until: time in the clock at which replies are no longer waited for [s].
            joints: whether each joint (n,) is commanded.
            braking: whether joints are commanded even if answers are missing, see
                ``Outstanding``, and commands are limited to the bounds instead of refused.

        Raises:
            HardwareAbort: the command exceeds the bounds; nothing was sent.
            InputError: the command does not fit into a frame; nothing was sent.
            LinkError: the bus does not work.
        """
        self._takes_any_answer = braking
        self._outstanding.end_cycle()
        self._foreign[:] = 0
        # Answers that have come since the last exchange are counted, but not used.
        while (frame := self._link.receive(self.clock.now())) is not None:
            self._answering_joint(frame)
        now = self.clock.now()
        # It includes time that the last command did not use: after a cycle that began late, the
        # next one follows in less time than there is between two positions of the trajectory.
        elapsed = np.minimum(now - self._moved_until, _LONGEST_GAP)
        q = self.position_now
        allowed = confine(command, self.limits, self.sent_position, elapsed, q)
        if braking:
            command = allowed
        else:
            # A joint that missed commands lags behind: what its motor makes leads it back.
            is_led_back = now < self._led_back_until
            if is_led_back.any():
                pairs = zip(allowed, command)
                command = MitCommand(*(np.where(is_led_back, *pair) for pair in pairs))
            require_allowed(self._labels, command, allowed, q, self.steps)
        packed = encode_mit(self._mounting.command(command), self.scaling)
        commanded = joints if braking else self._outstanding.may_be_commanded(joints)
        self._led_back_until[joints & ~commanded] = now + _LEADING_BACK
        # Replies are sampled before this command acts, while the last one is in force.
        acted = self._command
        self._put_in_force(packed, commanded, now)
        for j in commanded.nonzero()[0].tolist():
            self._sent_data[j] = packed[j].tobytes()
            self._link.send(CanFrame(self.joints[j].can_id, self._sent_data[j]))
        awaited = np.where(braking, 1, self._outstanding.owed)
        time, feedback = self._receive(commanded, until, awaited)
        came = feedback.status != NO_STATUS
        believed, followed, jump = self._filter.believe(came, time, feedback, acted)
        return Replies(
            answered=believed,
            time=time,
            feedback=_feedback_of(believed, feedback),
            requested=commanded,
            command=self._command,
            doubted=came & ~believed,
            followed=followed,
            jump=jump,
            surplus=self._outstanding.surplus.copy(),
            foreign=self._foreign.copy(),
            # A stop awaits no answer before the next command.
            late=(not braking) * self._outstanding.late,
            reported=feedback.status,
        )

    def _put_in_force(self, packed: Bytes, commanded: Mask, now: float) -> None:
        """Store a command that is about to be sent: its position, time, and the time left unused.

        Args:
            packed: data (n, 8) of the command's frames, from which motors read rounded values.
            commanded: whether each motor (n,) gets its frame; the others keep their old command.
            now: time of the command [s].
        """
        read = decode_mit(packed, self.scaling)
        new = self._mounting.inverse.command(read)
        old = self._command or new
        self._command = MitCommand(
            *(np.where(commanded, *pair) for pair in zip(new, old))
        )
        moved = np.abs(new.position - self.sent_position)
        used = moved / self.limits.velocity
        moved_until = (self._moved_until + used).clip(now - _LATEST_MOVE, now)
        self._moved_until = np.where(commanded, moved_until, self._moved_until)
        self.sent_position = np.where(commanded, new.position, self.sent_position)

    def switch_off(self, joints: Mask) -> None:
        """Command the motors of joints (n,) to disable, once, whatever the bus raises."""
        for j in np.flatnonzero(joints):
            with contextlib.suppress(BaseException):
                self._link.send(special_frame(DISABLE, self.joints[j].can_id))

    def disable(self) -> None:
        """Disable every motor; ``unconfirmed`` then has the joints whose motors did not confirm.

        Each motor is commanded five times, and then until it has confirmed it or half a second is
        over. An error of one motor, or of the bus, does not prevent commands to the others.
        """
        self._takes_any_answer = True
        running = np.ones(self.n_joints, bool)
        # Single frames may be lost, five are not.
        for _ in range(5):
            self.switch_off(running)
            self.clock.sleep_until(self.clock.now() + _DISABLE_SPACING)
        patience = self.clock.now() + _DISABLE_PATIENCE
        while np.any(running) and self.clock.now() < patience:
            try:
                self._link.drain()
                self.switch_off(running)
                until = self.clock.now() + _CONFIRM_TIMEOUT
                _, feedback = self._receive(running, until)
                running &= np.isin(feedback.status, (ENABLED, NO_STATUS))
            except BaseException:
                # Whatever a driver raises, SystemExit and KeyboardInterrupt included: it may
                # recover, and the other motors still listen.
                self.clock.sleep_until(self.clock.now() + _DISABLE_SPACING)
            self.unconfirmed = tuple(self.joints[j] for j in np.flatnonzero(running))

    def _receive(
        self, motors: Mask, until: float, awaited: Codes | int = 1
    ) -> tuple[Array, Feedback]:
        """Wait for the answers of motors, at most until a time in the clock [s].

        Returns the time (n,) of each joint's sample [s], and the feedback in joint space, fields
        (n,); where no answer came they are NaN and ``NO_STATUS``.

        Args:
            motors: (n,) whose answers are waited for.
            until: when waiting ends [s].
            awaited: (n,) how many answers each of them may send; the last one counts.
        """
        data = [_NO_DATA] * self.n_joints
        # Time at which each command was on the bus, and at which each answer came [s].
        sent, received = ([np.nan] * self.n_joints for _ in range(2))
        waits = motors.tolist()
        missing = int(np.sum(motors * awaited))
        while missing > 0 and (frame := self._link.receive(until)) is not None:
            if frame.echo:
                if frame.id in self._by_command:
                    sent[self._by_command[frame.id]] = frame.time
                continue
            j = self._answering_joint(frame)
            if j is not None and waits[j]:
                data[j] = frame.data
                received[j] = frame.time
                missing -= 1
        raw = np.frombuffer(b"".join(data), dtype=np.uint8).reshape(-1, 8)
        decoded = decode_feedback(raw, self.scaling)
        q, qd, tau = self._mounting.inverse.signals(
            decoded.position, decoded.velocity, decoded.torque
        )
        feedback = replace(decoded, position=q, velocity=qd, torque=tau)
        came = np.isfinite(received)
        time = np.where(came & np.isfinite(sent), sent, received)
        return time, _feedback_of(came, feedback)

    def _answering_joint(self, frame: CanFrame) -> int | None:
        """Count a received frame; return the joint (its index) that answers by it, or None.

        A frame to a motor that this session did not send is another program's. In feedback the
        motor's arbitration id, and the lowest four bits of its CAN id in the data, must match.
        """
        if frame.echo:
            return None
        commanded = self._by_command.get(frame.id)
        if commanded is not None and frame.data != self._sent_data.get(commanded):
            self._foreign[commanded] += 1
        j = self._by_reply.get(frame.id)
        if j is None or len(frame.data) != 8:
            return None
        if frame.data[0] & 0xF != self.joints[j].can_id & 0xF:
            return None
        is_timely = self._outstanding.take_answer(j)
        return j if is_timely or self._takes_any_answer else None


def _feedback_of(joints: Mask, feedback: Feedback) -> Feedback:
    """Return the feedback of some joints (n,); of the others it is ``NO_STATUS`` and NaN."""
    if joints.all():
        return feedback
    measured = feedback.position, feedback.velocity, feedback.torque
    q, qd, tau = np.where(joints, measured, np.nan)
    status = np.where(joints, feedback.status, NO_STATUS)
    return replace(feedback, status=status, position=q, velocity=qd, torque=tau)

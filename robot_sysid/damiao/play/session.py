"""Commanding motors: enable, one exchange per cycle, and disable on every way out."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.bus.link import GuardedLink, LinkError
from robot_sysid.damiao.protocol.codec import (
    Bytes,
    Feedback,
    MitCommand,
    Scaling,
    decode_feedback,
    decode_mit,
    encode_mit,
)
from robot_sysid.damiao.protocol.frames import Frame, disable_frame, enable_frame
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.protocol.registers import DISABLED, ENABLED, describe
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array

_DISABLE_REPEATS = 5
_DISABLE_SPACING = 2e-3
_CONFIRM_TIMEOUT = 0.02
# A bus that comes back within this time still gets its motors disabled.
_CONFIRM_PATIENCE = 0.5
_ENABLE_TRIES = 3
NO_STATUS = -1


@dataclass(frozen=True)
class Replies:
    """What came back in one cycle.

    Attributes:
        answered: (n,) which joints answered.
        time: (n,) when each joint took its sample, in the link's clock [s]: when its command was
            on the bus where the adapter reports that, else when the reply arrived. NaN where the
            joint did not answer.
        feedback: all joints; status -1 and NaN values where a joint did not answer.
        command: what was sent, as the motors read it; None where it was no MIT command.
    """

    answered: NDArray[np.bool_]
    time: Array
    feedback: Feedback
    command: MitCommand | None = None


class MotorSession:
    """The motors of an arm, for as long as they may be enabled.

    A context manager: however the block is left, every motor that could be enabled is told five
    times to disable, and has to confirm it. Before ``enable`` nothing is sent on the way out.

    Args:
        link: the bus.
        clock: for deadlines.
        joints: the motors, base to terminal.
        scaling: PMAX, VMAX, TMAX read from their registers.
        half_step: whether half a quantisation step is added to what they measure.

    Attributes:
        last_replies: what the last exchange collected, also where it was cut short by an error.
    """

    def __init__(
        self,
        link: GuardedLink,
        clock: Clock,
        joints: Sequence[DamiaoJoint],
        scaling: Scaling,
        half_step: bool,
    ) -> None:
        self._link, self._clock = link, clock
        self.joints, self.scaling, self._half_step = tuple(joints), scaling, half_step
        self._armed = False
        self.last_replies: Replies | None = None
        self._by_reply = {joint.master_id: j for j, joint in enumerate(joints)}
        self._by_command = {joint.can_id: j for j, joint in enumerate(joints)}

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joints)

    def __enter__(self) -> MotorSession:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if not self._armed:
            return
        unconfirmed = self.disable()
        if unconfirmed:
            motors = ", ".join(str(can_id) for can_id in unconfirmed)
            cause = f"{error}; " if error is not None else ""
            raise HardwareAbort(
                f"{cause}no confirmation that these motors are disabled: CAN id {motors}. "
                "Cut their power"
            ) from error

    def enable(self) -> Array:
        """Enable every motor and return where each one was just then (n,) [rad].

        Raises:
            HardwareAbort: a motor did not enable; names it.
        """
        self._armed = True
        position = np.empty(self.n_joints)
        for j, joint in enumerate(self.joints):
            feedback = self._enable_one(j, joint)
            status = int(feedback.status[j])
            if status != ENABLED:
                said = "no answer" if status == NO_STATUS else describe(status)
                raise HardwareAbort(f"motor {joint.can_id} (joint {j}) did not enable: {said}")
            position[j] = feedback.position[j]
        return position

    def exchange(
        self, command: MitCommand, until: float, joints: NDArray[np.bool_] | None = None
    ) -> Replies:
        """Command joints and collect their replies.

        The reply to a command is the state before that command acted.

        Args:
            command: for all n joints.
            until: when to stop waiting for replies [s].
            joints: (n,) which ones to command; None means all.

        Raises:
            InputError: a value does not fit into its frame; nothing is sent then.
            LinkError: the bus does not work.
        """
        self.last_replies = None
        frames = encode_mit(command, self.scaling)
        wanted = np.ones(self.n_joints, bool) if joints is None else joints
        self._link.drain()
        for j in np.flatnonzero(wanted):
            self._link.send(Frame(self.joints[j].can_id, frames[j].tobytes()))
        return self._collect(wanted, until, decode_mit(frames, self.scaling))

    def disable(self) -> tuple[int, ...]:
        """Disable every motor; return the CAN ids that did not confirm it.

        A bus that fails does not stop the other motors from being told.
        """
        for repeat in range(_DISABLE_REPEATS):
            if repeat:
                self._clock.sleep_until(self._clock.now() + _DISABLE_SPACING)
            for joint in self.joints:
                # The next of the five attempts, and the confirmation, tell whether it worked.
                with contextlib.suppress(LinkError):
                    self._link.send(disable_frame(joint.can_id))
        stopped = self._confirmed()
        self._armed = not np.all(stopped)
        return tuple(joint.can_id for joint, ok in zip(self.joints, stopped) if not ok)

    def _confirmed(self) -> NDArray[np.bool_]:
        stopped = np.zeros(self.n_joints, bool)
        patience = self._clock.now() + _CONFIRM_PATIENCE
        while not np.all(stopped) and self._clock.now() < patience:
            try:
                self._link.drain()
                for j in np.flatnonzero(~stopped):
                    self._link.send(disable_frame(self.joints[j].can_id))
                replies = self._collect(~stopped, self._clock.now() + _CONFIRM_TIMEOUT)
                stopped |= replies.answered & (replies.feedback.status != ENABLED)
            except LinkError:
                self._clock.sleep_until(self._clock.now() + _DISABLE_SPACING)
        return stopped

    def _enable_one(self, j: int, joint: DamiaoJoint) -> Feedback:
        only = np.arange(self.n_joints) == j
        for _ in range(_ENABLE_TRIES):
            self._link.drain()
            self._link.send(enable_frame(joint.can_id))
            replies = self._collect(only, self._clock.now() + _CONFIRM_TIMEOUT)
            if replies.feedback.status[j] not in (NO_STATUS, DISABLED):
                break
        return replies.feedback

    def _collect(
        self, wanted: NDArray[np.bool_], until: float, command: MitCommand | None = None
    ) -> Replies:
        raw = np.zeros((self.n_joints, 8), dtype=np.uint8)
        received = np.full(self.n_joints, np.nan)
        sent = np.full(self.n_joints, np.nan)
        missing = int(np.count_nonzero(wanted))
        try:
            while missing and (frame := self._link.receive(until)) is not None:
                missing -= self._take(frame, wanted, raw, received, sent)
        finally:
            self.last_replies = self._replies(raw, received, sent, command)
        return self.last_replies

    def _take(
        self, frame: Frame, wanted: NDArray[np.bool_], raw: Bytes, received: Array, sent: Array
    ) -> bool:
        """File a frame where it belongs; return whether it is an answer that was missing."""
        if frame.echo:
            if frame.id in self._by_command:
                sent[self._by_command[frame.id]] = frame.time
            return False
        j = self._sender(frame)
        if j is None or not wanted[j] or np.isfinite(received[j]):
            return False
        raw[j] = np.frombuffer(frame.data, dtype=np.uint8)
        received[j] = frame.time
        return True

    def _sender(self, frame: Frame) -> int | None:
        """Return the joint whose feedback a frame is, or None."""
        if frame.error or len(frame.data) != 8:
            return None
        j = self._by_reply.get(frame.id)
        if j is None or frame.data[0] & 0xF != self.joints[j].can_id & 0xF:
            return None
        return j

    def _replies(
        self, raw: Bytes, received: Array, sent: Array, command: MitCommand | None
    ) -> Replies:
        answered = np.isfinite(received)
        feedback = decode_feedback(raw, self.scaling, self._half_step)
        for values in (feedback.position, feedback.velocity, feedback.torque):
            values[~answered] = np.nan
        feedback.status[~answered] = NO_STATUS
        stamped = answered & np.isfinite(sent)
        return Replies(answered, np.where(stamped, sent, received), feedback, command)

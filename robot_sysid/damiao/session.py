"""Commanding motors: enable, one exchange per cycle, and disable on every way out."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.damiao.bus import GuardedLink
from robot_sysid.damiao.protocol import codec, frames
from robot_sysid.damiao.protocol.frames import DISABLED, ENABLED, Address, Frame
from robot_sysid.damiao.protocol.joints import DamiaoJoint, JointSpace
from robot_sysid.errors import HardwareAbort
from robot_sysid.records import Array

# A frame may be lost; five in a row are not, and 2 ms lets a full queue of 14 frames empty [s].
_DISABLE_REPEATS, _DISABLE_SPACING = 5, 2e-3
# Far more than the slowest adapter takes (16 ms, see docs/damiao.md) [s].
_CONFIRM_TIMEOUT = 0.02
# A bus that comes back within this time still gets its motors disabled.
_CONFIRM_PATIENCE = 0.5
_ENABLE_TRIES = 3
NO_STATUS = -1
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Replies:
    """What came back in one cycle; status -1 and NaN values where a joint did not answer.

    ``time`` (n,) is when each joint took its sample, in the link's clock [s]: when its command was
    on the bus where the adapter reports that, else when the reply arrived. ``command`` is what each
    joint is under now, as the motors read it; ``asked`` are those that were sent something.
    """

    answered: Mask
    time: Array
    feedback: codec.Feedback
    asked: Mask
    command: codec.MitCommand | None = None


PAUSE = 4
"""Cycles of silence after which a missing answer counts as lost: 16 ms at 250 Hz, the latest that
a slow adapter was seen to deliver (docs/damiao.md)."""


class Outstanding:
    """Which answer belongs to which command of n motors, although answers carry no number.

    Each command is answered once, in order. Where an answer is missing at the end of its cycle, the
    next thing heard from that motor may be it, late, or the answer to the next command. So it is
    told nothing new until the missing answer has come or is long overdue: what a slow adapter holds
    back is out of the way then, and each answer that is believed belongs to the command before it.
    """

    def __init__(self, n: int) -> None:
        self._owed, self._silent = np.zeros(n, int), np.zeros(n, int)
        self._told = np.zeros(n, bool)

    def may_be_told(self, wanted: Mask) -> Mask:
        """Begin a cycle: return which of the motors ``wanted`` (n,) get a command in it."""
        self._silent = np.where(self._told, 0, self._silent + 1)
        self._owed[self._silent >= PAUSE] = 0
        self._told = np.asarray(wanted & (self._owed == 0))
        self._owed += self._told
        return self._told

    def heard(self, j: int) -> bool:
        """Note an answer; return whether it is that to the command of this cycle."""
        timely = bool(self._told[j] and self._owed[j] == 1)
        self._owed[j] = max(self._owed[j] - 1, 0)
        self._silent[j] = 0
        return timely


class MotorSession:
    """The motors of an arm, for as long as they may be enabled.

    A context manager: however the block is left, every motor that could be enabled is told five
    times to disable, and has to confirm it. Before ``enable`` nothing is sent on the way out.

    Commands and measurements are in joint space, see ``JointSpace``. The scaling is that of the
    motors' registers; half a quantisation step is added to what they measure, because motors drop
    the fraction. ``steps`` and ``peak_torque`` (n,) are in [rad, rad/s, N m]; ``last_replies`` is
    what the last exchange collected, also where an error cut it short; ``unconfirmed`` are the
    joints whose motors could be enabled and have not said that they are off.
    """

    def __init__(
        self, link: GuardedLink, joints: Sequence[DamiaoJoint], scaling: codec.Scaling
    ) -> None:
        self._link, self.clock = link, link.clock
        self.joints, self.scaling = tuple(joints), scaling
        self.n_joints, self.space = len(joints), JointSpace.of(joints)
        position, velocity, torque = scaling.steps
        self.steps = position, velocity, torque * self.space.ratio
        # A frame cannot say more than the scale's end either.
        peaks = np.minimum([j.spec.peak_torque for j in joints], scaling.limits[:, 2])
        self.peak_torque: Array = peaks * self.space.ratio
        self.unconfirmed: tuple[DamiaoJoint, ...] = ()
        self.last_replies: Replies | None = None
        self._command: codec.MitCommand | None = None
        self._outstanding = Outstanding(self.n_joints)
        self._regardless = True
        self._by_reply = {(joint.bus, joint.master_id): j for j, joint in enumerate(joints)}
        self._by_command = {joint.address: j for j, joint in enumerate(joints)}

    def clipped(self, q: Array, qd: Array, tau: Array) -> tuple[Array, ...]:
        """Return the nearest values (n,) that the joints' frames carry [rad, rad/s, N m]."""
        limits = self.scaling.limits.T
        return self.space.to_joints(*np.clip(self.space.to_motors(q, qd, tau), -limits, limits))

    def is_off(self, motor: Address) -> bool:
        """Tell whether a motor was never enabled or has confirmed that it is disabled."""
        return motor not in [joint.address for joint in self.unconfirmed]

    def __enter__(self) -> MotorSession:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
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
        """Enable every motor, or raise HardwareAbort; return where each was then (n,) [rad]."""
        self.unconfirmed = self.joints
        position = np.empty(self.n_joints)
        for j, joint in enumerate(self.joints):
            feedback = self._enable_one(j, joint)
            status = int(feedback.status[j])
            if status != ENABLED:
                said = "no answer" if status == NO_STATUS else frames.describe(status)
                raise HardwareAbort(f"{joint.label} did not enable: {said}")
            position[j] = feedback.position[j]
        return position

    def exchange(
        self,
        command: codec.MitCommand,
        until: float,
        joints: Mask | None = None,
        regardless: bool = False,
    ) -> Replies:
        """Command joints (n,), or all, and collect their replies ``until`` then [s].

        The reply to a command is the state before that command acted. ``regardless`` commands also
        where answers are missing, see ``Outstanding``, as braking has to. InputError, before
        anything is sent, where a value does not fit into its frame; LinkError from the bus.
        """
        self.last_replies, self._regardless = None, regardless
        packed = codec.encode_mit(self.space.command_to_motors(command), self.scaling)
        wanted = np.ones(self.n_joints, bool) if joints is None else joints
        # What has arrived since the last exchange is late, but it is known whose answer it was.
        while (frame := self._link.receive(self.clock.now())) is not None:
            if (sender := self._sender(frame)) is not None:
                self._outstanding.heard(sender)
        told = wanted if regardless else self._outstanding.may_be_told(wanted)
        # As the motors read it; one that is told nothing stays under its old command.
        new = self.space.command_to_joints(codec.decode_mit(packed, self.scaling))
        old = self._command or new
        self._command = codec.MitCommand(*(np.where(told, *pair) for pair in zip(new, old)))
        for j in np.flatnonzero(told):
            bus, can_id = self.joints[j].address
            self._link.send(Frame(can_id, packed[j].tobytes(), bus=bus))
        return self._collect(told, until, self._command)

    def disable(self) -> None:
        """Disable every motor; ``unconfirmed`` tells which ones did not confirm it.

        Nothing that goes wrong with one motor, or with the bus, keeps the others from being told.
        """
        self._regardless = True
        for repeat in range(_DISABLE_REPEATS):
            if repeat:
                self.clock.sleep_until(self.clock.now() + _DISABLE_SPACING)
            for joint in self.joints:
                self._tell_off(joint)
        self._confirm()

    def _tell_off(self, joint: DamiaoJoint) -> None:
        # The next of the five attempts, and the confirmation, tell whether it worked.
        with contextlib.suppress(BaseException):
            self._link.send(frames.disable_frame(joint.address))

    def _confirm(self) -> None:
        running = np.ones(self.n_joints, bool)
        patience = self.clock.now() + _CONFIRM_PATIENCE
        while np.any(running) and self.clock.now() < patience:
            try:
                self._link.drain()
                for j in np.flatnonzero(running):
                    self._tell_off(self.joints[j])
                replies = self._collect(running, self.clock.now() + _CONFIRM_TIMEOUT)
                running &= ~replies.answered | (replies.feedback.status == ENABLED)
            except BaseException:
                # Whatever a driver raises, SystemExit and KeyboardInterrupt included: it may
                # recover, and the other motors still listen.
                self.clock.sleep_until(self.clock.now() + _DISABLE_SPACING)
            self.unconfirmed = tuple(self.joints[j] for j in np.flatnonzero(running))

    def _enable_one(self, j: int, joint: DamiaoJoint) -> codec.Feedback:
        only = np.arange(self.n_joints) == j
        for _ in range(_ENABLE_TRIES):
            self._link.drain()
            self._link.send(frames.enable_frame(joint.address))
            replies = self._collect(only, self.clock.now() + _CONFIRM_TIMEOUT)
            if replies.feedback.status[j] not in (NO_STATUS, DISABLED):
                break
        return replies.feedback

    def _collect(
        self, wanted: Mask, until: float, command: codec.MitCommand | None = None
    ) -> Replies:
        raw = np.zeros((self.n_joints, 8), dtype=np.uint8)
        received, sent = np.full((2, self.n_joints), np.nan)
        missing = int(np.count_nonzero(wanted))
        try:
            while missing and (frame := self._link.receive(until)) is not None:
                missing -= self._take(frame, wanted, raw, received, sent)
        finally:
            answered = np.isfinite(received)
            told = codec.decode_feedback(raw, self.scaling, half_step=True)
            measured = self.space.to_joints(told.position, told.velocity, told.torque)
            q, qd, tau = np.where(answered, measured, np.nan)
            status = np.where(answered, told.status, NO_STATUS)
            feedback = replace(told, status=status, position=q, velocity=qd, torque=tau)
            stamps = np.where(answered & np.isfinite(sent), sent, received)
            self.last_replies = Replies(answered, stamps, feedback, wanted, command)
        return self.last_replies

    def _take(
        self, frame: Frame, wanted: Mask, raw: codec.Bytes, received: Array, sent: Array
    ) -> bool:
        """File a frame where it belongs; return whether it is an answer that was missing."""
        told = self._by_command.get(Address(frame.bus, frame.id))
        if frame.echo and told is not None:
            sent[told] = frame.time
        j = self._sender(frame)
        if j is None:
            return False
        timely = self._outstanding.heard(j)
        if not wanted[j] or np.isfinite(received[j]) or not (timely or self._regardless):
            return False
        raw[j] = np.frombuffer(frame.data, dtype=np.uint8)
        received[j] = frame.time
        return True

    def _sender(self, frame: Frame) -> int | None:
        """Return the joint whose feedback a frame is, or None."""
        if frame.error or frame.echo or len(frame.data) != 8:
            return None
        j = self._by_reply.get((frame.bus, frame.id))
        its_own = j is not None and frame.data[0] & 0xF == self.joints[j].can_id & 0xF
        return j if its_own else None

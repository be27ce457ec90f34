"""CAN bus access: clocks, a link that refuses harmful frames, real-time priority, and registers.

Registers and states of motors are only requested while no commands are streamed. Register replies
and feedback of a motor have the same arbitration id, so only one request is outstanding at a time;
a register reply is recognised by its data, which repeats CAN id, operation and register number.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from robot_sysid.damiao.protocol import (
    READ,
    REFRESH,
    SCALING,
    WRITE,
    CanFrame,
    Feedback,
    Register,
    Scaling,
    bytes_from_value,
    decode_feedback,
    is_harmful,
    register_frame,
    value_from_bytes,
)
from robot_sysid.errors import HardwareAbort, SysidError

_BUSY_THREAD_TIME = 2e-4
"""Time after which a busy thread of this program gives way to the control loop [s]: Python's own,
5 ms, is longer than a control cycle."""
_REFRESH_TIMEOUT = 0.1
"""Longest wait for the answers of all motors, requested at once [s]: later ones are of no use to a
control loop, and a watchdog of the usual length has ended by then."""
_ANSWER_TIMEOUT = 0.03
"""Longest wait for the answer to a single request before a run [s]: twice the delay of a slow
adapter, 16 ms."""
_LISTENING_TIME = 0.05
"""How long is listened for frames that nobody requested [s]: it shows programs that send at 40 Hz
or more."""


class SystemClock:
    """The computer's monotonic clock; ``live`` is whether time passes while this program runs."""

    live = True

    def now(self) -> float:
        """Return the time since an arbitrary moment [s]."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Return at ``moment`` [s], or at once if it has passed."""
        delay = moment - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)


class SimulatedClock(SystemClock):
    """A clock whose time only advances, without waiting, when the program sleeps."""

    live = False

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Return the simulated time [s]."""
        return self._now

    def sleep_until(self, moment: float) -> None:
        """Set the time to ``moment`` [s], unless that has passed."""
        self._now = max(self._now, moment)


class LinkError(HardwareAbort):
    """The bus itself does not work (adapter unplugged, bus-off state, buffer full)."""


class Link(Protocol):
    """One end of a CAN bus; times are in the clock with which it was opened."""

    @property
    def error_frames(self) -> int:
        """Number of error frames that the adapter has reported so far."""

    def send(self, frame: CanFrame) -> None:
        """Send a frame, or raise LinkError."""

    def receive(self, until: float) -> CanFrame | None:
        """Return the next frame, or None if none has come at ``until`` [s]; may raise LinkError."""


class OpenLink(Link, Protocol):
    """A link that was opened and has to be closed."""

    def close(self) -> None:
        """Close the bus; it raises nothing, which would hide errors about motors."""


@dataclass(frozen=True)
class GuardedLink:
    """A link that refuses harmful frames.

    Attributes:
        link: link on which frames are sent and received.
        clock: clock of the link.
        fd: whether frames are sent as CAN-FD, whatever ``CanFrame.fd`` says.
        refuses: tells of each frame to be sent whether it must not be.
    """

    link: Link
    clock: SystemClock
    fd: bool = False
    refuses: Callable[[CanFrame], bool] = is_harmful

    def send(self, frame: CanFrame) -> None:
        """Send a frame; SysidError for one that is refused, LinkError where the bus fails."""
        if self.refuses(frame):
            raise SysidError(f"refused to send {frame.data.hex(' ')} to {frame.id:#x}")
        self.link.send(frame._replace(fd=self.fd))

    def receive(self, until: float) -> CanFrame | None:
        """Return the next frame, or None if none has come at ``until`` [s]; may raise LinkError."""
        return self.link.receive(until)

    @property
    def error_frames(self) -> int:
        """Number of error frames that the adapter has reported so far."""
        return self.link.error_frames

    def drain(self) -> None:
        """Discard all frames that have already arrived."""
        while self.receive(self.clock.now()) is not None:
            pass


@contextlib.contextmanager
def undisturbed_processor(live: bool = True) -> Iterator[None]:
    """Keep garbage collection, other threads and other programs from pausing a ``with`` block.

    On Linux the block has real-time priority, unless the system refuses it or the user has chosen a
    scheduling policy already (by chrt). A block with real-time priority has to sleep now and then,
    because no other program can run on its processor while the block computes.

    Args:
        live: ask for real-time priority; False for a block that runs in simulated time.
    """
    switch_interval = sys.getswitchinterval()
    gc.collect()
    gc.disable()
    sys.setswitchinterval(_BUSY_THREAD_TIME)
    takes_priority = (
        live and sys.platform == "linux" and os.sched_getscheduler(0) == os.SCHED_OTHER
    )
    try:
        if takes_priority:
            # Below the kernel's own threads (50). This program's other threads go before other
            # programs, because one that is interrupted while it holds Python's lock delays the
            # control loop too.
            _schedule(os.SCHED_FIFO, 20, 10)
        yield
    finally:
        if takes_priority:
            # Threads that were started in the block have inherited the priority.
            _schedule(os.SCHED_OTHER, 0, 0)
        sys.setswitchinterval(switch_interval)
        gc.enable()


def _schedule(policy: int, priority: int, aside: int) -> None:
    """Set the policy of all threads, the priority of the calling one and that of the others."""
    current = threading.get_native_id()
    for thread in threading.enumerate():
        is_current = thread.native_id == current
        # No right to it, or the thread has ended.
        with contextlib.suppress(OSError):
            os.sched_setscheduler(
                thread.native_id or current,
                policy,
                os.sched_param(priority if is_current else aside),
            )


@dataclass(frozen=True)
class RegisterClient:
    """Reads and writes registers of motors over a link.

    Attributes:
        link: link of the motors' bus.
    """

    link: GuardedLink

    def read(self, can_id: int, register: int) -> float | None:
        """Return the value of a motor's register; None if three requests get no answer."""
        answers = self.answers(register_frame(READ, can_id, register))
        return next((value for value, _ in answers), None)

    def write(self, can_id: int, register: int, value: float) -> None:
        """Write a value to a motor's register; it is lost at power-off unless stored.

        Raises:
            InputError: the value does not fit into the register; nothing was sent.
            HardwareAbort: the motor did not answer, or refused the value.
        """
        raw = bytes_from_value(register, value)
        name = Register(register).name
        for stored, _ in self.answers(register_frame(WRITE, can_id, register, raw)):
            if bytes_from_value(register, stored) == raw:
                return
            raise HardwareAbort(
                f"motor {can_id} refused {name} = {value:g} and keeps {stored:g}"
            )
        raise HardwareAbort(f"motor {can_id} did not answer to writing {name}")

    def refresh(self, can_id: int, master_id: int) -> CanFrame | None:
        """Request a motor's feedback frame, up to three times, and return it; None without answer.

        ``master_id`` is the arbitration id of the motor's replies. The request has no other effect.
        """
        # Feedback has the low four bits of the CAN id in its first byte.
        answers = self._answers(
            register_frame(REFRESH, can_id),
            lambda frame: frame.id == master_id and (frame.data[0] ^ can_id) & 0xF == 0,
        )
        return next(answers, None)

    def state_of(self, motor: InspectedMotor) -> Feedback | None:
        """Request a motor's state, fields (1,), and return it; None without answer.

        It is also None where the motor's scaling limits are unknown. The request has no other
        effect on the motor.
        """
        frame = self.refresh(motor.can_id, motor.reply_ids[0])
        if frame is None or min(motor.limits) <= 0.0:
            return None
        data = np.frombuffer(frame.data, np.uint8)
        return decode_feedback(data[None], Scaling([motor.limits]))

    def seconds_to_refresh(self, reply_ids: Mapping[int, int]) -> dict[int, float]:
        """Return the time until each motor, all requested at once, has answered [s], by CAN id.

        ``reply_ids`` are the motors' reply ids by CAN id. NaN for one that does not answer within
        0.1 s. Frames that have come earlier are discarded.
        """
        self.link.drain()
        start = self.link.clock.now()
        for can_id in reply_ids:
            self.link.send(register_frame(REFRESH, can_id))
        seconds = dict.fromkeys(reply_ids, np.nan)
        missing = set(reply_ids.values())
        until = start + _REFRESH_TIMEOUT
        while missing and (frame := self.link.receive(until)) is not None:
            if frame.echo or frame.id not in missing:
                continue
            missing.remove(frame.id)
            elapsed = self.link.clock.now() - start
            # Motors that share an id cannot be told apart.
            same = [can_id for can_id in reply_ids if reply_ids[can_id] == frame.id]
            seconds.update(dict.fromkeys(same, elapsed))
        return seconds

    def answers(self, request: CanFrame) -> Iterator[tuple[float, int]]:
        """Yield value and arbitration id of each reply to a register request, as ``_answers``."""
        # Requests and replies have the CAN id (two bytes), operation, register and value (four).
        # Most firmware answers a write with 0x55 (WRITE), some with 0x33 (READ).
        data = request.data
        heads = [data[:2] + bytes([kind, data[3]]) for kind in (READ, data[2])]
        for frame in self._answers(request, lambda frame: frame.data[:4] in heads):
            yield value_from_bytes(data[3], frame.data[4:8]), frame.id

    def _answers(
        self, request: CanFrame, is_answer: Callable[[CanFrame], bool]
    ) -> Iterator[CanFrame]:
        """Send a request and yield the 8-byte frames that answer it, as long as the caller asks.

        Motors that share an id send several. Frames that have come earlier are discarded, and so
        are echoes of this program's own frames. Without any answer the request is sent again, up to
        three times in all, as a frame may be lost where another program just used the bus.
        """
        for _ in range(3):
            self.link.drain()
            self.link.send(request)
            until = self.link.clock.now() + _ANSWER_TIMEOUT
            is_answered = False
            while frame := self.link.receive(until):
                if not frame.echo and len(frame.data) == 8 and is_answer(frame):
                    is_answered = True
                    yield frame
            if is_answered:
                return


@dataclass(frozen=True, eq=False)
class InspectedMotor:
    """Answers of one motor (or of several with one CAN id) to an inspection of the bus.

    Attributes:
        can_id: CAN id to which the requests were sent.
        reply_ids: arbitration ids of the replies; several if several motors have this CAN id.
        registers: value of each register that was answered, by its number.
        feedback: state of the motor, fields (1,); None without answer or scaling limits.
        answer_times: time from each request of all motors' states to this one's answer [s], NaN
            where none came; empty where states were not asked for again.
    """

    can_id: int
    reply_ids: tuple[int, ...]
    registers: Mapping[int, float]
    feedback: Feedback | None
    answer_times: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        """Name in messages: "motor" and its CAN id."""
        return f"motor {self.can_id}"

    @property
    def master_id(self) -> int:
        """Reply id in register MST_ID, or else the arbitration id of the motor's first reply."""
        return int(self.registers.get(Register.MST_ID, self.reply_ids[0]))

    @property
    def limits(self) -> tuple[float, ...]:
        """PMAX, VMAX and TMAX in the motor's registers [rad, rad/s, N m]; 0 where unknown."""
        return tuple(self.registers.get(number, 0.0) for number in SCALING)

    @property
    def position(self) -> float:
        """Position of the motor [rad]; NaN where unknown."""
        return self.feedback.position[0] if self.feedback else np.nan


@dataclass(frozen=True)
class Inspection:
    """Answers of all motors on the bus.

    Attributes:
        motors: answers of each motor by its CAN id, in ascending order.
        unsolicited: number of frames that came within 0.05 s before anything was requested.
        round_trip: 90th percentile of the time in which all motors, requested at once, answer [s];
            NaN where more than a tenth ended without some motor's answer, or a state is unknown.
        error_frames: number of error frames that the adapter reported meanwhile.
    """

    motors: Mapping[int, InspectedMotor]
    unsolicited: int
    round_trip: float
    error_frames: int = 0


# Number of times that the states of all motors are requested, and which one of the sorted times is
# their 90th percentile.
_N_ROUNDS = 20
_PERCENTILE_90 = 17


def inspect_bus(link: GuardedLink) -> Inspection:
    """Request registers and state of every CAN id (1 to 15) on a bus; return the answers.

    No motor is enabled or changed.
    """
    error_frames = link.error_frames
    until = link.clock.now() + _LISTENING_TIME
    unsolicited = 0
    while (frame := link.receive(until)) is not None:
        unsolicited += not frame.echo
    client = RegisterClient(link)
    motors = {}
    # Feedback has four bits for them.
    for can_id in range(1, 16):
        answers = client.answers(register_frame(READ, can_id, Register.ESC_ID))
        reply_ids = tuple(reply_id for _, reply_id in answers)
        if reply_ids:
            values = [(number, client.read(can_id, number)) for number in Register]
            registers = {int(k): value for k, value in values if value is not None}
            motor = InspectedMotor(can_id, reply_ids, registers, feedback=None)
            motors[can_id] = replace(motor, feedback=client.state_of(motor))
    round_trip = np.nan
    if all(motor.feedback for motor in motors.values()):
        # Measured under the conditions of a run, for which the time matters.
        first_ids = {can_id: motor.reply_ids[0] for can_id, motor in motors.items()}
        with undisturbed_processor(live=link.clock.live):
            rounds = [client.seconds_to_refresh(first_ids) for _ in range(_N_ROUNDS)]
        slowest = [np.max([0.0, *seconds.values()]) for seconds in rounds]
        # NaN comes last.
        round_trip = np.sort(slowest)[_PERCENTILE_90]
        for can_id, motor in motors.items():
            answer_times = tuple(seconds[can_id] for seconds in rounds)
            motors[can_id] = replace(motor, answer_times=answer_times)
    errors_meanwhile = link.error_frames - error_frames
    return Inspection(motors, unsolicited, round_trip, errors_meanwhile)

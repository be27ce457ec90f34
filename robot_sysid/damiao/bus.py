"""The bus: clocks, the guard that every sent frame passes, real-time priority, and asking motors.

Motors are asked for registers and state, without any effect on them, and never while commands
stream. Register replies and feedback come on the same id. They are told apart by the one request
that is outstanding: a reply repeats its motor's id, an operation and the register's number.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple, Protocol

import numpy as np

from robot_sysid.damiao import protocol
from robot_sysid.damiao.protocol import (
    Feedback,
    Frame,
    Scaling,
    decode_feedback,
    refuse_harmful,
)
from robot_sysid.errors import HardwareAbort


class SystemClock:
    """The computer's monotonic clock: live, it moves whatever this program does."""

    live = True

    def now(self) -> float:
        """Return the time [s]; only differences mean anything."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Return at ``moment`` [s], or at once if it has passed."""
        left = moment - time.monotonic()
        if left > 0.0:
            time.sleep(left)


class SimulatedClock(SystemClock):
    """A clock that moves only when someone sleeps."""

    live = False

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Return the simulated time [s]."""
        return self._now

    def sleep_until(self, moment: float) -> None:
        """Move to ``moment`` [s], unless it has passed."""
        self._now = max(self._now, moment)


class LinkError(HardwareAbort):
    """The bus itself does not work (unplugged, bus-off, buffer full)."""


class Link(Protocol):
    """One end of a CAN bus. Its frames' times are in the same clock as ``until``."""

    def send(self, frame: Frame) -> None:
        """Send a frame, or raise LinkError."""

    def receive(self, until: float) -> Frame | None:
        """Return the next frame, or None at the time ``until`` [s]; may raise LinkError."""

    def close(self) -> None:
        """Release the bus."""


class GuardedLink:
    """Passes frames on, refuses the harmful ones, and shows each one to an observer.

    ``refuse`` raises for frames that must not be sent; ``channels`` are the names of the buses. The
    observer is called with every frame and whether it was sent; it must not raise.
    """

    def __init__(
        self,
        link: Link,
        clock: SystemClock,
        fd: bool = False,
        channels: Sequence[str] = ("",),
        refuse: Callable[[Frame], None] = refuse_harmful,
    ) -> None:
        self._refuse = refuse
        self._link = link
        self._fd = fd
        self.clock = clock
        self.channels = tuple(channels)
        self.observer: Callable[[Frame, bool], None] | None = None

    def send(self, frame: Frame) -> None:
        """Send a frame that is not harmful."""
        self._refuse(frame)
        frame = frame._replace(fd=self._fd)
        self._link.send(frame)
        if self.observer:
            self.observer(frame._replace(time=self.clock.now()), True)

    def receive(self, until: float) -> Frame | None:
        """Return the next frame or None at ``until`` [s]."""
        frame = self._link.receive(until)
        if frame is not None and self.observer and not frame.echo:
            self.observer(frame, False)
        return frame

    def drain(self) -> None:
        """Drop what has already arrived."""
        while self.receive(self.clock.now()) is not None:
            pass


PRIORITY = 20
"""Real-time priority of the thread that keeps time: below the kernel's own threads (50)."""
# The other threads wait for the one that keeps time, but for no other program: whichever of them
# holds Python's lock when it is interrupted holds up the control loop too.
_PRIORITY_ASIDE = 10
# A busy thread gives way after this long [s]; Python's own default is more than a control cycle.
_SWITCH_INTERVAL = 2e-4


@contextlib.contextmanager
def undisturbed_processor(live: bool = True) -> Iterator[bool]:
    """Keep garbage collection, other threads and other programs from pausing the block.

    A ``live`` block keeps to the computer's clock. It has to wait now and then: nothing else runs
    on its processor meanwhile. It is told whether it has real-time priority; where the system
    refuses that, or knows none, the rest still holds.
    """
    collects_garbage = gc.isenabled()
    switch_interval = sys.getswitchinterval()
    gc.collect()
    gc.disable()
    sys.setswitchinterval(_SWITCH_INTERVAL)
    try:
        with (
            _real_time_priority()
            if live
            else contextlib.nullcontext(False) as is_granted
        ):
            yield is_granted
    finally:
        sys.setswitchinterval(switch_interval)
        if collects_garbage:
            gc.enable()


@contextlib.contextmanager
def _real_time_priority() -> Iterator[bool]:
    """Give the threads of this program real-time priority, where it is allowed, and take it back.

    A policy that somebody has chosen already (by chrt) is left as it is.
    """
    policy = os.sched_getscheduler(0) if sys.platform == "linux" else None
    if policy is None or policy != os.SCHED_OTHER:
        yield policy is not None and policy in (os.SCHED_FIFO, os.SCHED_RR)
        return
    try:
        is_granted = _schedule(0, os.SCHED_FIFO, PRIORITY)
        for thread_id in _other_threads() if is_granted else ():
            _schedule(thread_id, os.SCHED_FIFO, _PRIORITY_ASIDE)
        yield is_granted
    finally:
        # Threads that were started meanwhile have inherited it.
        for thread_id in (0, *_other_threads()):
            _schedule(thread_id, os.SCHED_OTHER, 0)


def lacks_priority() -> bool:
    """Tell whether this system has real-time priority but has not given it to this thread."""
    if sys.platform != "linux":
        return False
    return os.sched_getscheduler(0) not in (os.SCHED_FIFO, os.SCHED_RR)


def _schedule(thread_id: int, policy: int, priority: int) -> bool:
    """Set how a thread is scheduled, 0 for the calling one; return whether it was allowed."""
    try:
        os.sched_setscheduler(thread_id, policy, os.sched_param(priority))
    except OSError:
        # No right to it, or the thread has ended.
        return False
    return True


def _other_threads() -> list[int]:
    """Return the system's numbers of the threads beside the calling one."""
    current = threading.get_native_id()
    ids = [thread.native_id for thread in threading.enumerate()]
    return [thread_id for thread_id in ids if thread_id not in (None, current)]


# A frame may be lost on a bus that another program has just left.
_TRIES = 3
# Answers that take longer are of no use to a control loop [s].
_LONGEST_CYCLE = 0.1


class RegisterReply(NamedTuple):
    """A register's value and the id it was answered on."""

    value: float
    reply_id: int


class RegisterClient:
    """Talks about registers over a link; an answer may take ``timeout`` [s]."""

    def __init__(self, link: GuardedLink, timeout: float = 0.02) -> None:
        self._link = link
        self._clock = link.clock
        self._timeout = timeout
        self.error_frames = 0

    def read(self, motor: protocol.Address, register: int) -> RegisterReply | None:
        """Return a register's value, or None where the motor does not answer."""
        return next(iter(self.answers(protocol.read_frame(motor, register), 1)), None)

    def write(
        self, motor: protocol.Address, register: int, value: float, heard: bool = True
    ) -> None:
        """Write a register (lost at power-off), or raise HardwareAbort.

        A motor refuses a value by answering with the old one, so the answer is compared; unless it
        cannot be ``heard`` any more.
        """
        raw = protocol.bytes_from_value(register, value)
        name = protocol.NAMES[register]
        request = protocol.write_frame(motor, register, raw)
        if not heard:
            return self._link.send(request)
        replies = self.answers(request, 1)
        if not replies:
            raise HardwareAbort(
                f"motor {motor.can_id} did not answer to writing {name}"
            )
        stored = replies[0].value
        if protocol.bytes_from_value(register, stored) != raw:
            raise HardwareAbort(
                f"motor {motor.can_id} refused {name} = {value:g} and keeps {stored:g}"
            )

    def refresh(self, motor: protocol.Address, master_id: int) -> protocol.Frame | None:
        """Return a feedback frame without any effect on the motor, or None."""
        for _ in range(_TRIES):
            for frame in self._frames_after(protocol.refresh_frame(motor)):
                if frame.id == master_id and frame.data[0] & 0xF == motor.can_id & 0xF:
                    return frame
        return None

    def state_of(self, motor: InspectedMotor) -> Feedback | None:
        """Ask a motor for its state, without any effect on it; None where it does not tell."""
        frame = self.refresh(motor.address, motor.reply_ids[0])
        return None if frame is None else motor.meaning(frame.data)

    def seconds_to_refresh(
        self, motors: Sequence[tuple[protocol.Address, int]]
    ) -> float | None:
        """Return the time until all motors, asked at once, have answered [s], or None."""
        self._link.drain()
        start = self._clock.now()
        for motor, _ in motors:
            self._send(protocol.refresh_frame(motor))
        missing = {(motor.bus, reply_id) for motor, reply_id in motors}
        while (
            missing
            and (frame := self._link.receive(start + _LONGEST_CYCLE)) is not None
        ):
            if not frame.echo and not frame.error:
                missing.discard((frame.bus, frame.id))
        return None if missing else self._clock.now() - start

    def answers(
        self, request: protocol.Frame, limit: int | None = None
    ) -> list[RegisterReply]:
        """Return up to ``limit`` answers; more than one tells that motors share an id."""
        tries = (list(islice(self._replies(request), limit)) for _ in range(_TRIES))
        return next(filter(None, tries), [])

    def _replies(self, request: protocol.Frame) -> Iterator[RegisterReply]:
        # Most firmware answers a write with 0x55, some with 0x33.
        codes = (
            (protocol.READ, protocol.WRITE)
            if request.data[2] == protocol.WRITE
            else (protocol.READ,)
        )
        heads = [request.data[:2] + bytes([code, request.data[3]]) for code in codes]
        for frame in self._frames_after(request):
            if frame.data[:4] in heads:
                value = protocol.value_from_bytes(request.data[3], frame.data[4:8])
                yield RegisterReply(value, frame.id)

    def _frames_after(self, request: protocol.Frame) -> Iterator[protocol.Frame]:
        """Send a request and yield what motors say until the timeout."""
        self._link.drain()
        self._send(request)
        until = self._clock.now() + self._timeout
        while (frame := self._link.receive(until)) is not None:
            self.error_frames += frame.error
            sound = not frame.error and not frame.echo and len(frame.data) == 8
            if sound and frame.bus == request.bus:
                yield frame

    def _send(self, request: protocol.Frame) -> None:
        """Send a request, again where a busy computer or adapter did not take it in time."""
        for _ in range(_TRIES - 1):
            with contextlib.suppress(LinkError):
                return self._link.send(request)
        self._link.send(request)


@contextlib.contextmanager
def watchdogs_set_to(
    client: RegisterClient,
    motors: Sequence[InspectedMotor],
    seconds: float,
    is_off: Callable[[protocol.Address], bool],
) -> Iterator[None]:
    """Write the watchdog register of each motor, and its old value when the block ends.

    A motor that may still be running keeps the new value: without a watchdog it would go on for
    ever. Nothing is stored to flash: after a power cycle the motors have their own values again.
    ``is_off`` tells, at the end, whether a motor is surely disabled.
    """
    old_values = {motor.address: motor.registers[protocol.TIMEOUT] for motor in motors}
    try:
        for address in old_values:
            client.write(
                address, protocol.TIMEOUT, float(round(seconds / protocol.TIMEOUT_UNIT))
            )
        yield
    finally:
        for address in filter(is_off, old_values):
            # A motor that does not answer any more keeps the safer value until power-off.
            with contextlib.suppress(BaseException):
                client.write(address, protocol.TIMEOUT, old_values[address])


_ALL_IDS = range(1, 16)
# A program that streams at 40 Hz or more is heard in this time; a slow adapter answers in half of
# the other (16 ms, see docs/damiao.md) [s].
_LISTEN = 0.05
_ASK_TIMEOUT = 0.03
# How often all motors are asked at once, to know how long nine of ten times take.
_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class InspectedMotor:
    """What one motor said; several ids on which answers came mean several motors.

    Only registers that were answered are there; feedback is None where it does not answer a
    refresh, and the channel is named where there are several.
    """

    address: protocol.Address
    reply_ids: tuple[int, ...]
    registers: Mapping[int, float]
    feedback: Feedback | None
    channel: str = ""

    @property
    def can_id(self) -> int:
        """Id it was asked under."""
        return self.address.can_id

    @property
    def name(self) -> str:
        """How messages call it."""
        return f"motor {self.can_id}" + (f" on {self.channel}" if self.channel else "")

    @property
    def master_id(self) -> int:
        """The reply id its register names."""
        return int(self.registers.get(protocol.MST_ID, self.reply_ids[0]))

    @property
    def limits(self) -> tuple[float, float, float]:
        """(PMAX, VMAX, TMAX) from its registers; 0 where it does not tell."""
        position, velocity, torque = (
            self.registers.get(k, 0.0) for k in protocol.SCALING
        )
        return position, velocity, torque

    def meaning(self, feedback: bytes) -> Feedback | None:
        """What a frame of its feedback says; None where its scaling is not known."""
        if min(self.limits) <= 0.0:
            return None
        raw = np.frombuffer(feedback, dtype=np.uint8)[None]
        return decode_feedback(raw, Scaling([self.limits]))

    @property
    def position(self) -> float:
        """Where it is [rad]; NaN where it does not tell."""
        return float(self.feedback.position[0]) if self.feedback else np.nan


@dataclass(frozen=True)
class Inspection:
    """What the motors on a bus said; ``unsolicited`` frames came before anything was asked.

    Asked at once, all have answered within ``round_trip`` [s], nearly always; None if some did not.
    """

    motors: Mapping[protocol.Address, InspectedMotor]
    unsolicited: int
    error_frames: int
    round_trip: float | None = None


def inspect_bus(link: GuardedLink) -> Inspection:
    """Ask every id on every bus for its registers and state; enables nothing."""
    until = link.clock.now() + _LISTEN
    unsolicited = 0
    while (frame := link.receive(until)) is not None:
        unsolicited += not frame.echo
    client = RegisterClient(link, timeout=_ASK_TIMEOUT)
    motors = {}
    for address in (
        protocol.Address(bus, i) for bus in range(len(link.channels)) for i in _ALL_IDS
    ):
        answers = client.answers(protocol.read_frame(address, protocol.ESC_ID))
        if not answers:
            continue
        replies = {number: client.read(address, number) for number in protocol.LOGGED}
        registers = {
            number: reply.value
            for number, reply in replies.items()
            if reply is not None
        }
        reply_ids = tuple(answer.reply_id for answer in answers)
        channel = link.channels[address.bus] if len(link.channels) > 1 else ""
        motor = InspectedMotor(address, reply_ids, registers, None, channel)
        motors[address] = replace(motor, feedback=client.state_of(motor))
    round_trip = None
    if all(motor.feedback for motor in motors.values()):
        addresses = [(motor.address, motor.reply_ids[0]) for motor in motors.values()]
        # As in the run that it is for.
        with undisturbed_processor(link.clock.live):
            times = [client.seconds_to_refresh(addresses) for _ in range(_ROUNDS)]
        answered = [time for time in times if time is not None]
        if len(answered) > _ROUNDS // 2:
            round_trip = float(np.percentile(answered, 90.0))
    return Inspection(motors, unsolicited, client.error_frames, round_trip)

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
    """The computer's monotonic clock; ``live`` because it moves whatever this program does."""

    live = True

    def now(self) -> float:
        """Return the time [s]; only differences mean anything."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Return at ``moment`` [s], or at once if it has passed."""
        delay = moment - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)


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

    The block gets whether it has real-time priority; where the system refuses that, or has none,
    garbage collection and threads are kept off all the same. A block that is not ``live`` asks for
    no priority: it runs in simulated time. One that has priority has to wait now and then, because
    nothing else runs on its processor meanwhile.
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
    """Reads and writes registers of motors over a link; an answer may take ``timeout`` [s].

    ``error_frames`` counts the error frames that it received.
    """

    def __init__(self, link: GuardedLink, timeout: float = 0.02) -> None:
        self._link = link
        self._clock = link.clock
        self._timeout = timeout
        self.error_frames = 0

    def read(self, motor: protocol.Address, register: int) -> RegisterReply | None:
        """Return a register's first reply, or None where the motor does not answer."""
        replies = self.answers(protocol.read_frame(motor, register), 1)
        return replies[0] if replies else None

    def write(
        self, motor: protocol.Address, register: int, value: float, verify: bool = True
    ) -> None:
        """Write a register (lost at power-off), or raise HardwareAbort.

        A motor refuses a value by answering with the old one, so the answer is compared, unless
        ``verify`` is false: a motor whose bit rate changes can be heard no more.
        """
        raw = protocol.bytes_from_value(register, value)
        name = protocol.NAMES[register]
        request = protocol.write_frame(motor, register, raw)
        if not verify:
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
        """Ask a motor for its state, without any effect on it; None where it does not answer."""
        frame = self.refresh(motor.address, motor.reply_ids[0])
        return None if frame is None else motor.decode_feedback(frame.data)

    def seconds_to_refresh(
        self, motors: Sequence[tuple[protocol.Address, int]]
    ) -> float | None:
        """Return the time until all motors (address, reply id), asked at once, answered [s].

        None where one does not answer within a tenth of a second.
        """
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
        """Return up to ``limit`` replies to a request; motors that share an id send several."""
        for _ in range(_TRIES):
            replies = list(islice(self._replies(request), limit))
            if replies:
                return replies
        return []

    def _replies(self, request: protocol.Frame) -> Iterator[RegisterReply]:
        """Send a request about a register and yield its replies until the timeout."""
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
        """Send a request and yield the sound frames on its bus until the timeout."""
        self._link.drain()
        self._send(request)
        until = self._clock.now() + self._timeout
        while (frame := self._link.receive(until)) is not None:
            self.error_frames += frame.error
            is_sound = not frame.error and not frame.echo and len(frame.data) == 8
            if is_sound and frame.bus == request.bus:
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
# the other (16 ms) [s].
_LISTEN = 0.05
_ASK_TIMEOUT = 0.03
# How often all motors are asked at once, to know how long nine of ten times take.
_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class InspectedMotor:
    """Answers of one motor to an inspection.

    Attributes:
        address: under which it was asked.
        reply_ids: ids on which answers came; several mean that several motors share its id.
        registers: values by number, of the registers that it answered for.
        feedback: its state; None where it did not answer or its scaling is unknown.
        channel: name of its bus where there are several, else "".
    """

    address: protocol.Address
    reply_ids: tuple[int, ...]
    registers: Mapping[int, float]
    feedback: Feedback | None
    channel: str = ""

    @property
    def can_id(self) -> int:
        """CAN id under which it was asked."""
        return self.address.can_id

    @property
    def name(self) -> str:
        """What messages call it: its id, and its bus where there are several."""
        return f"motor {self.can_id}" + (f" on {self.channel}" if self.channel else "")

    @property
    def master_id(self) -> int:
        """Reply id in its register MST_ID; where that is unknown, the id of its first answer."""
        return int(self.registers.get(protocol.MST_ID, self.reply_ids[0]))

    @property
    def limits(self) -> tuple[float, float, float]:
        """(PMAX, VMAX, TMAX) in its registers [rad, rad/s, N m]; 0 for one that is unknown."""
        position, velocity, torque = (
            self.registers.get(number, 0.0) for number in protocol.SCALING
        )
        return position, velocity, torque

    def decode_feedback(self, feedback: bytes) -> Feedback | None:
        """Return the state in a feedback frame; None where its scaling is not known."""
        if min(self.limits) <= 0.0:
            return None
        raw = np.frombuffer(feedback, dtype=np.uint8)[None]
        return decode_feedback(raw, Scaling([self.limits]))

    @property
    def position(self) -> float:
        """Its position [rad]; NaN where that is unknown."""
        return float(self.feedback.position[0]) if self.feedback else np.nan


@dataclass(frozen=True)
class Inspection:
    """Answers of all motors on the buses.

    Attributes:
        motors: by address, in the order of buses and ids.
        unsolicited: number of frames that came before anything was asked.
        error_frames: number of error frames.
        round_trip: time within which all motors, asked at once, answer nine times of ten [s]; None
            if some did not.
    """

    motors: Mapping[protocol.Address, InspectedMotor]
    unsolicited: int
    error_frames: int
    round_trip: float | None = None


def inspect_bus(link: GuardedLink) -> Inspection:
    """Ask every id on every bus for registers and state; no motor is enabled or changed."""
    until = link.clock.now() + _LISTEN
    unsolicited = 0
    while (frame := link.receive(until)) is not None:
        unsolicited += not frame.echo
    client = RegisterClient(link, timeout=_ASK_TIMEOUT)
    motors = {}
    for bus, bus_name in enumerate(link.channels):
        channel = bus_name if len(link.channels) > 1 else ""
        for can_id in _ALL_IDS:
            motor = _inspect_motor(client, protocol.Address(bus, can_id), channel)
            if motor is not None:
                motors[motor.address] = motor
    round_trip = None
    if all(motor.feedback for motor in motors.values()):
        addresses = [(motor.address, motor.reply_ids[0]) for motor in motors.values()]
        # As in the run that it is for.
        with undisturbed_processor(link.clock.live):
            times = [client.seconds_to_refresh(addresses) for _ in range(_ROUNDS)]
        complete = [seconds for seconds in times if seconds is not None]
        if len(complete) > _ROUNDS // 2:
            round_trip = float(np.percentile(complete, 90.0))
    return Inspection(motors, unsolicited, client.error_frames, round_trip)


def _inspect_motor(
    client: RegisterClient, address: protocol.Address, channel: str
) -> InspectedMotor | None:
    """Return a motor's registers and state; None where nothing answers at an address."""
    answers = client.answers(protocol.read_frame(address, protocol.ESC_ID))
    if not answers:
        return None
    registers = {}
    for number in protocol.LOGGED:
        reply = client.read(address, number)
        if reply is not None:
            registers[number] = reply.value
    reply_ids = tuple(answer.reply_id for answer in answers)
    motor = InspectedMotor(address, reply_ids, registers, None, channel)
    return replace(motor, feedback=client.state_of(motor))

"""CAN adapters: opening and reading them through python-can, and the maker's own serial adapter.

The latter (921600 baud) takes 30 bytes per frame, numbers little endian: 55 AA, the length 1E, 03
for "send", number of repetitions in four bytes (1), pause between them in four bytes (10), id type
(0 for 11 bits), CAN id in four bytes, frame type (0 for data), number of data bytes, two filters
(0), eight bytes of data, and a check byte that the adapter ignores (0).

It sends 16 bytes per frame: AA, type of packet (11 for a received frame), format, CAN id in four
bytes little endian, eight bytes of data, 55.
"""

from __future__ import annotations

import contextlib
import errno
import math
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from robot_sysid.damiao.bus import Link, LinkError, SystemClock
from robot_sysid.damiao.protocol import BusTiming, Frame
from robot_sysid.errors import InputError, error_text
from robot_sysid.records.installation import install_hint
from robot_sysid.records.option_fields import OptionRecord, option

INTERFACES = (
    *("socketcan", "slcan", "gs_usb", "pcan", "kvaser", "vector", "ixxat"),
    *("canalystii", "cantact", "seeedstudio", "damiao", "virtual"),
)
"""Kinds of adapters that may be opened: none that puts motor commands on a network."""


@dataclass(frozen=True)
class BusAddress(OptionRecord):
    """Options that say by which adapter and channels the buses are reached."""

    interface: str = option(
        "socketcan",
        "kind of adapter: " + ", ".join(INTERFACES),
        "NAME",
        choices=INTERFACES,
    )
    channel: tuple[str, ...] = option(
        (),
        "the bus, for instance can0 or /dev/ttyACM0; once per bus; left=/dev/ttyACM0 where the "
        "joint map calls it left",
        "CHANNEL",
        repeats=True,
    )
    bus_option: tuple[str, ...] = option(
        (),
        "hand an option of the adapter's own to python-can, for instance f_clock_mhz=80",
        "NAME=VALUE",
        repeats=True,
    )

    @property
    def buses(self) -> Mapping[str, str]:
        """Channel of each bus, by its name in joint maps (files with the motor of each joint).

        A bus without a name has its channel as its name. InputError where a name or a channel is
        given twice: a motor might then get the commands for a motor of another arm.
        """
        names = []
        channels = []
        for text in self.channel:
            match = _NAMED_CHANNEL.fullmatch(text)
            if match:
                names.append(match["name"] or match["channel"])
                channels.append(match["channel"])
        for labels in (names, channels):
            for label in labels:
                if labels.count(label) > 1:
                    problem = f"--channel names {label} twice"
                    raise InputError(f"{problem}; give each bus once")
        return dict(zip(names, channels))


_NAMED_CHANNEL = re.compile(r"(?:(?P<name>[\w.-]+)=)?(?P<channel>.*)")
"""A channel with or without a name before it.

An address such as spy://COM3?file=log has no name, although it contains an equals sign.
"""
SERIAL_ADAPTER = "damiao"
"""Interface name of the maker's serial adapter."""
_SEND_TIMEOUT = 0.05
"""Longest time for which a driver may wait to send a frame [s].

It is more than a busy computer makes a program wait (a cycle may be 20 ms late), and less than
motors on another bus can wait for their next command: watchdogs take 0.1 s or more.
"""
_FULL_PATIENCE = 1.5e-3
"""Time for which a frame is offered again to a full queue [s].

A queue that is full for longer does not empty within a control cycle.
"""
_FULL_PAUSE = 2e-4
"""Time between two attempts to send to a full queue [s]."""
_FULL = (
    "the CAN bus takes no more frames because nobody acknowledges them: check the motors' power, "
    "the wiring and the termination (60 ohm between the two wires)"
)
_MOST_GARBLED = 3
"""Number of damaged lines within ``_GARBLED_TIME`` that are an error; fewer are lost frames.

Serial lines have no checksum, so a damaged line may be noticed only because it is no frame.
"""
_GARBLED_TIME = 1.0
"""Time in which damaged lines are counted [s]."""
_GARBLED = (
    f"the adapter sent {_MOST_GARBLED} lines within a second that are no CAN frames; check its "
    "cable and that nothing else reads from its port"
)
_PLAUSIBLE_AGE = 1.0
"""Age of a frame above which its time stamp must be of another clock [s]."""
_FD_CLOCK = 80_000_000
"""Clock frequency of PCAN's and Kvaser's CAN-FD controllers [Hz]."""


def import_can() -> Any:
    """Return the python-can module; InputError with the command that installs it if missing."""
    try:
        import can
    except ImportError:
        hint = install_hint("python-can", "can")
        raise InputError(f"talking to motors {hint}") from None
    return can


def _driver_text(error: BaseException) -> str:
    """Return the message of a driver's exception; some drivers raise SystemExit, as programs do."""
    return repr(error) if isinstance(error, SystemExit) else error_text(error)


def can_message(can: Any, frame: Frame, **stamp: Any) -> Any:
    """Return a frame as a Message of the python-can module ``can``.

    ``stamp`` are further fields of the Message: timestamp [s], is_rx and channel.
    """
    fd = {"is_fd": frame.fd, "bitrate_switch": frame.fd}
    flags = {"is_extended_id": False, "is_error_frame": frame.error, **fd}
    return can.Message(arbitration_id=frame.id, data=frame.data, **flags, **stamp)


_LOOK = 0.1
"""Time between two looks at the driver's present call [s]."""
_LOOKS_TO_SAY = 10
"""Number of looks at one call after which it is reported."""
_LOOKS_TO_END = 50
"""Number of looks at one call after which it is reported for the last time.

By then no motor drives any more: the longest watchdog that a run allows is 5 s.
"""
_OPENING = 50
"""Number of further looks that opening an adapter may take: 5 s (python-can's slcan takes 2 s)."""
StallReport = Callable[[str, bool], None]
"""Takes a message about a driver that does not return, and whether it is the last message."""


class DriverWatch:
    """Reports calls of adapters' drivers that do not return, because they stop everything else.

    Looks at the present call are counted rather than seconds, so that no driver is reported after a
    computer was asleep.

    Args:
        tell: called from a thread of the watch when a driver's call has lasted for 1 s, and a last
            time at 5 s; the watch has then ended, and the program should end. None watches nothing.
    """

    def __init__(self, tell: StallReport | None = None) -> None:
        self._tell = tell
        # The present call of a driver, a new object for each call; None between calls.
        self._call: object | None = None
        self._looks = 0
        self._closed = threading.Event()
        if tell is not None:
            threading.Thread(target=self._look, daemon=True).start()

    @contextlib.contextmanager
    def during(self, more_looks: int = 0) -> Iterator[None]:
        """Watch the driver's call in a ``with`` block, which must not be nested in another one.

        ``more_looks`` is the number of looks, of 0.1 s each, by which reports come later.
        """
        self._call = object()
        self._looks = -more_looks
        try:
            yield
        finally:
            self._call = None

    def close(self) -> None:
        """Stop watching, and end the thread."""
        self._closed.set()

    def _look(self) -> None:
        """Look at the present call every 0.1 s until closed; report a call that does not return."""
        assert self._tell is not None
        last_call = None
        while self._looks < _LOOKS_TO_END and not self._closed.wait(_LOOK):
            if last_call is not None and self._call is last_call:
                self._looks += 1
            last_call = self._call
            if last_call is not None and self._looks in (_LOOKS_TO_SAY, _LOOKS_TO_END):
                self._tell(
                    f"the adapter's driver has not returned for {_LOOK * self._looks:.0f} s, and "
                    "nothing can be sent meanwhile: motors that were enabled are stopped by their "
                    "watchdogs; cut their power, and unplug the adapter and plug it in again",
                    self._looks == _LOOKS_TO_END,
                )


_PAUSE = 1e-4
"""Time between two rounds in which several buses are asked for frames [s]."""


class BusLink:
    """A link over one or several open buses of python-can.

    Args:
        buses: the open buses; ``Frame.bus`` is an index into them. They are closed by ``close``.
        clock: clock in which the times of frames and deadlines are given.
        watch: reports drivers that do not return; None watches nothing.
    """

    def __init__(
        self, buses: Sequence[Any], clock: SystemClock, watch: DriverWatch | None = None
    ) -> None:
        self._can = import_can()
        self._buses = buses
        self._clock = clock
        self._watch = watch or DriverWatch()
        self._garbled_at: deque[float] = deque(maxlen=_MOST_GARBLED)

    def send(self, frame: Frame) -> None:
        """Send a frame on its bus, tried for 1.5 ms while the queue is full; else LinkError."""
        message = can_message(self._can, frame)
        patience = self._clock.now() + _FULL_PATIENCE
        while True:
            try:
                with self._watch.during():
                    return self._buses[frame.bus].send(message, timeout=_SEND_TIMEOUT)
            except (Exception, SystemExit) as error:
                # Whatever a driver raises: the caller has to go on with the other motors.
                # ENOBUFS: the queue is full. Drivers have the code in either attribute.
                attributes = "error_code", "errno"
                codes = [getattr(error, name, None) for name in attributes]
                if errno.ENOBUFS not in codes:
                    reason = f"the CAN bus does not take frames: {_driver_text(error)}"
                    raise LinkError(reason) from error
                if self._clock.now() >= patience:
                    raise LinkError(_FULL) from error
            self._clock.sleep_until(self._clock.now() + _FULL_PAUSE)

    def receive(self, until: float) -> Frame | None:
        """Return the next frame with a standard id of any bus; None if none came by ``until`` [s].

        ``until`` is in the link's clock. LinkError where a bus cannot be read.
        """
        while True:
            for index, bus in enumerate(self._buses):
                # One bus can be waited for; several are looked at in turn.
                wait = until if len(self._buses) == 1 else min(self._clock.now(), until)
                message = self._next(bus, wait)
                if message is not None:
                    return self._frame(message, index)
            if self._clock.now() >= until:
                return None
            self._clock.sleep_until(min(self._clock.now() + _PAUSE, until))

    def _next(self, bus: Any, until: float) -> Any:
        """Return a bus's next python-can message with a standard id; None if none by ``until`` [s].

        LinkError where the bus cannot be read, or the adapter sends too many damaged lines.
        """
        while True:
            try:
                with self._watch.during():
                    message = bus.recv(max(until - self._clock.now(), 0.0))
            except (ValueError, IndexError) as error:
                self._note_garbled(error)
                message = None
            except (Exception, SystemExit) as error:
                reason = f"the CAN bus cannot be read: {_driver_text(error)}"
                raise LinkError(reason) from error
            if message is None and self._clock.now() >= until:
                return None
            if message is not None and not message.is_extended_id:
                return message

    def _note_garbled(self, error: Exception) -> None:
        """Count a line whose parsing raised ``error``; LinkError at the third within a second."""
        now = self._clock.now()
        self._garbled_at.append(now)
        is_full = len(self._garbled_at) == _MOST_GARBLED
        if is_full and now - self._garbled_at[0] < _GARBLED_TIME:
            raise LinkError(f"{_GARBLED} ({error_text(error)})") from error

    def close(self) -> None:
        """Close all buses; drivers' exceptions are dropped: they would hide errors about motors."""
        for bus in self._buses:
            with contextlib.suppress(BaseException), self._watch.during():
                bus.shutdown()
        self._watch.close()

    def _frame(self, message: Any, bus: int) -> Frame:
        """Return python-can's message as a frame of the bus with index ``bus``.

        The message's time stamp, in seconds since 1970, is converted to the clock of this link. If
        the adapter stamps by another clock, the frame gets the present time.
        """
        age = time.time() - message.timestamp
        if not 0.0 <= age < _PLAUSIBLE_AGE:
            age = 0.0
        return Frame(
            id=message.arbitration_id,
            data=bytes(message.data),
            time=self._clock.now() - age,
            fd=message.is_fd,
            error=message.is_error_frame,
            echo=not message.is_rx,
            bus=bus,
        )


def open_bus(
    address: BusAddress,
    timing: BusTiming,
    clock: SystemClock,
    tell: StallReport | None = None,
) -> Link:
    """Open all buses of an address and return a link over them.

    InputError if a bus cannot be opened; those opened before are closed again.

    Args:
        address: kind of adapter, channels and options.
        timing: frame format and bit rates; socketcan has its own, set by ``ip link``.
        clock: clock of the link.
        tell: takes messages about a driver that does not return, see ``DriverWatch``.
    """
    if timing.fd and address.interface == SERIAL_ADAPTER:
        raise InputError(
            "the maker's serial adapter sends classic CAN frames only; leave --fd off"
        )
    buses: list[Any] = []
    watch = DriverWatch(tell)
    link = BusLink(buses, clock, watch)
    try:
        for channel in address.buses.values():
            with watch.during(_OPENING):
                buses.append(_open_one(address, channel, timing))
    except BaseException:
        link.close()
        raise
    return link


def _open_one(address: BusAddress, channel: str, timing: BusTiming) -> Any:
    """Open one channel of an address and return python-can's bus.

    InputError if this fails, or an option in ``address.bus_option`` is not NAME=VALUE.
    """
    can = import_can()
    interface = address.interface
    options = _bus_options(can, interface, timing)
    for text in address.bus_option:
        name, equals, value = text.partition("=")
        if not equals or not name.isidentifier():
            raise InputError(f"--bus-option takes NAME=VALUE, got {text!r}")
        options[name] = can.util.cast_from_string(value)
    try:
        if interface == SERIAL_ADAPTER:
            return SerialAdapter(channel, **options)
        bus = can.Bus(
            channel=channel, interface=interface, ignore_config=True, **options
        )
        if interface == "slcan":
            is_alone = len(address.buses) == 1
            read_in_pieces(bus, alone=is_alone, write_timeout=_SEND_TIMEOUT)
        return bus
    except (Exception, SystemExit) as error:
        # Each adapter's driver raises what it likes.
        problem = f"cannot open {interface} channel {channel}: {_driver_text(error)}"
        raise InputError(problem) from error


def _bus_options(can: Any, interface: str, timing: BusTiming) -> dict[str, Any]:
    """Return the keyword arguments that open an adapter's bus in python-can with given timing.

    They set the bit rates and, where this is an option, that sent frames are received as echoes.
    """
    if interface == SERIAL_ADAPTER:
        return {}
    if interface == "socketcan":
        return {"receive_own_messages": True, "fd": timing.fd}
    if interface == "virtual":
        protocol = can.CanProtocol.CAN_FD if timing.fd else can.CanProtocol.CAN_20
        return {"receive_own_messages": True, "protocol": protocol}
    if not timing.fd:
        return {"bitrate": int(timing.bitrate)}
    rates = {
        "nom_bitrate": int(timing.bitrate),
        "data_bitrate": int(timing.data_bitrate),
    }
    # Sample points in percent of a bit.
    points = {"nom_sample_point": 80.0, "data_sample_point": 75.0}
    bit_timing = can.BitTimingFd.from_sample_point(f_clock=_FD_CLOCK, **rates, **points)
    return {"timing": bit_timing}


_HEAD = bytes([0x55, 0xAA, 30, 0x03, 1, 0, 0, 0, 10, 0, 0, 0, 0])
"""First bytes of a packet to the maker's adapter, up to the type of id."""
_RECEIVED = 16
"""Length of a packet from the adapter [bytes]."""
_A_FRAME = b"\x11"
"""Type of a packet from the adapter that holds a received frame."""
_PACKET = re.compile(rb"\xaa(.).(.{4})(.{8})\x55", re.DOTALL)
"""A packet from the adapter: its type, CAN id and data."""
_DATA = 8
"""Most data bytes of a classic CAN frame."""


def packet(identifier: int, data: bytes) -> bytes:
    """Return the 30 bytes with which the maker's adapter sends a classic frame.

    ValueError where ``identifier`` has more than 11 bits or ``data`` more than eight bytes.
    """
    if len(data) > _DATA or not 0 <= identifier <= 0x7FF:
        raise ValueError(
            "the adapter sends classic frames with 11-bit ids and up to 8 bytes"
        )
    body = identifier.to_bytes(4, "little") + bytes([0, len(data), 0, 0])
    return _HEAD + body + data.ljust(_DATA, b"\0") + b"\0"


class PacketReader:
    """Finds the packets of the maker's adapter in a stream of bytes, of which some may be lost."""

    def __init__(self) -> None:
        self._incomplete = b""

    def take(self, piece: bytes) -> list[Frame]:
        """Return the frames (id, data) that end in ``piece``, the next bytes of the stream.

        Bytes of a packet that has not ended yet are stored for the next call.
        """
        line = self._incomplete + piece
        frames = []
        # A packet may be incomplete if it begins in the last 15 bytes.
        end = max(len(line) - (_RECEIVED - 1), 0)
        for match in _PACKET.finditer(line):
            packet_type, can_id, data = match.groups()
            end = max(end, match.end())
            if packet_type == _A_FRAME:
                frames.append(Frame(int.from_bytes(can_id, "little"), data))
        self._incomplete = line[end:]
        return frames


BAUD = 921_600
"""Speed of the maker's serial adapter [bit/s]."""
_WRITE_TIMEOUT = 0.02
"""Longest time for the serial line to take a packet [s]: well below the motors' watchdogs."""
_PATIENCE = 1e-3
"""Time for which a serial port waits for a byte before it is asked again [s]."""


class SerialAdapter:
    """The maker's adapter as a bus: classic CAN over a serial line; its bit rate is set in it.

    It has the methods of python-can's buses that ``BusLink`` calls.

    Args:
        device: path of the serial port.
        baudrate: speed of the serial line [bit/s].
        write_timeout: longest time for the line to take a packet [s].
    """

    def __init__(
        self, device: str, baudrate: int = BAUD, write_timeout: float = _WRITE_TIMEOUT
    ) -> None:
        import serial

        self._can = import_can()
        self._port = serial.Serial(
            device, baudrate, timeout=0, write_timeout=write_timeout
        )
        self._reader = PacketReader()
        self._waiting = deque[Frame]()

    def send(self, message: Any, timeout: float) -> None:
        """Send a frame; the adapter does not report when the frame was on the bus."""
        self._port.write(packet(message.arbitration_id, bytes(message.data)))

    def recv(self, timeout: float) -> Any:
        """Return the next message, or None after ``timeout`` [s]."""
        until = time.monotonic() + timeout
        while not self._waiting:
            self._port.timeout = max(until - time.monotonic(), 0.0)
            # The rest of what has come already, or the first byte of what comes next.
            piece = self._port.read(max(self._port.in_waiting, 1))
            self._waiting.extend(self._reader.take(piece))
            if time.monotonic() >= until and not self._waiting:
                return None
        frame = self._waiting.popleft()
        return can_message(self._can, frame, timestamp=time.time())

    def shutdown(self) -> None:
        """Close the serial line."""
        self._port.close()


class LineReader:
    """Reads an slcan adapter's lines for python-can, whose own loop asks for every single byte.

    python-can's loop also waits a millisecond, a quarter of a control cycle, for the first byte
    where only bytes that have already come are wanted; this class does not.

    Args:
        fetch: takes the time left [s] and returns all bytes that have come; where none have and
            this time is positive, it waits for the first one, but may return none before the end.
    """

    def __init__(self, fetch: Callable[[float], bytes]) -> None:
        self._fetch = fetch
        self._received = b""

    def __call__(self, timeout: float | None) -> str | None:
        """Return the next line with its end, or None after ``timeout`` [s] (None: no limit)."""
        until = math.inf if timeout is None else time.monotonic() + timeout
        while (end := _LINE_END.search(self._received)) is None:
            patience = min(max(until - time.monotonic(), 0.0), _LONGEST_LOOK)
            piece = self._fetch(patience)
            self._received += piece
            if not piece and patience == 0.0:
                return None
        line = self._received[: end.end()]
        self._received = self._received[end.end() :]
        # python-can gives up at a byte that is no text.
        return line.decode("ascii", "ignore")


_LONGEST_LOOK = 1.0
"""Longest time for which bytes are waited for at once [s]."""
_LINE_END = re.compile(rb"[\r\a]")
"""End of a line of slcan: a carriage return, or a bell where it refuses a command."""


def read_in_pieces(bus: Any, alone: bool, write_timeout: float) -> None:
    """Make python-can's slcan bus read all bytes at once that have come.

    Args:
        bus: open slcan bus; its port's time-outs and its method of reading lines are replaced.
        alone: whether it is the only open bus; only then bytes are waited for, because waiting
            for a silent bus would delay the other buses.
        write_timeout: longest time to write a line [s].
    """
    port = bus.serialPortOrig
    port.timeout = _PATIENCE if alone else 0.0
    port.write_timeout = write_timeout
    # Setting a port's time-out takes long, so it is not set for each reading.
    bus._read = LineReader(lambda left: port.read(port.in_waiting or int(left > 0.0)))

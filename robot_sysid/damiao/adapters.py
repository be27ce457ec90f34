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
import re
import time
from collections import deque
from collections.abc import Callable
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
    """Options that say by which adapter and channel the bus is reached."""

    interface: str = option(
        "socketcan",
        "kind of adapter: " + ", ".join(INTERFACES),
        "NAME",
        choices=INTERFACES,
    )
    channel: str | None = option(
        None,
        "the bus, for instance can0 or /dev/ttyACM0; left=/dev/ttyACM0 where the joint map calls "
        "it left",
        "CHANNEL",
    )
    bus_option: tuple[str, ...] = option(
        (),
        "hand an option of the adapter's own to python-can, for instance f_clock_mhz=80",
        "NAME=VALUE",
        repeats=True,
    )

    @property
    def named_channel(self) -> tuple[str | None, str]:
        """The bus's name in joint maps, which is the channel by default, and its channel.

        The name is None, and the channel "", where none was given.
        """
        # An address such as spy://COM3?file=log has no name, although it has an equals sign.
        match = re.fullmatch(r"([\w.-]+)=(.*)", self.channel or "")
        return (match[1], match[2]) if match else (self.channel, self.channel or "")


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


def can_message(frame: Frame, **stamp: Any) -> Any:
    """Return a frame as a Message of python-can.

    ``stamp`` are further fields of the Message: timestamp [s], is_rx and channel.
    """
    fd = {"is_fd": frame.fd, "bitrate_switch": frame.fd}
    identifier = {"arbitration_id": frame.id, "is_extended_id": False}
    return import_can().Message(data=frame.data, **identifier, **fd, **stamp)


class BusLink:
    """A link over an open bus of python-can.

    Args:
        bus: the open bus, which ``close`` closes.
        clock: clock in which the times of frames and deadlines are given.
    """

    def __init__(self, bus: Any, clock: SystemClock) -> None:
        self._bus = bus
        self._clock = clock

    def send(self, frame: Frame) -> None:
        """Send a frame, tried for 1.5 ms while the queue is full; else LinkError."""
        message = can_message(frame)
        patience = self._clock.now() + _FULL_PATIENCE
        while True:
            try:
                return self._bus.send(message, timeout=_SEND_TIMEOUT)
            except (Exception, SystemExit) as error:
                # Whatever a driver raises: the caller has to go on with the other motors.
                # ENOBUFS: the queue is full. Drivers have the code in either attribute.
                attributes = "error_code", "errno"
                codes = [getattr(error, name, None) for name in attributes]
                if errno.ENOBUFS not in codes:
                    raise LinkError(
                        f"the CAN bus does not take frames: {_driver_text(error)}"
                    ) from error
                if self._clock.now() >= patience:
                    raise LinkError(_FULL) from error
            self._clock.sleep_until(self._clock.now() + _FULL_PAUSE)

    def receive(self, until: float) -> Frame | None:
        """Return the next data frame with a standard id; None if none came by ``until`` [s].

        ``until`` is in the link's clock. A line of a serial adapter that is no frame is a lost
        frame. LinkError where the bus cannot be read.
        """
        while True:
            message = None
            try:
                message = self._bus.recv(max(until - self._clock.now(), 0.0))
            except (ValueError, IndexError):
                pass
            except (Exception, SystemExit) as error:
                raise LinkError(
                    f"the CAN bus cannot be read: {_driver_text(error)}"
                ) from error
            if message is None and self._clock.now() >= until:
                return None
            if message is None or message.is_extended_id or message.is_error_frame:
                continue
            return self._frame(message)

    def close(self) -> None:
        """Close the bus; a driver's exceptions are dropped: they would hide errors about motors."""
        with contextlib.suppress(BaseException):
            self._bus.shutdown()

    def _frame(self, message: Any) -> Frame:
        """Return python-can's message as a frame.

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
            echo=not message.is_rx,
        )


def open_bus(address: BusAddress, timing: BusTiming, clock: SystemClock) -> Link:
    """Open the bus of an address and return a link over it.

    InputError if this fails, or an option in ``address.bus_option`` is not NAME=VALUE.

    Args:
        address: kind of adapter, channel and options.
        timing: frame format and bit rates; socketcan has its own, set by ``ip link``.
        clock: clock of the link.
    """
    can = import_can()
    interface = address.interface
    _, channel = address.named_channel
    if timing.fd and interface == SERIAL_ADAPTER:
        raise InputError(
            "the maker's serial adapter sends classic CAN frames only; leave --fd off"
        )
    options = _bus_options(can, interface, timing)
    for text in address.bus_option:
        name, equals, value = text.partition("=")
        if not equals or not name.isidentifier():
            raise InputError(f"--bus-option takes NAME=VALUE, got {text!r}")
        options[name] = can.util.cast_from_string(value)
    try:
        if interface == SERIAL_ADAPTER:
            return BusLink(SerialAdapter(channel, **options), clock)
        bus = can.Bus(
            channel=channel, interface=interface, ignore_config=True, **options
        )
    except (Exception, SystemExit) as error:
        # Each adapter's driver raises what it likes.
        raise InputError(
            f"cannot open {interface} channel {channel}: {_driver_text(error)}"
        ) from error
    if interface == "slcan":
        read_in_pieces(bus)
    return BusLink(bus, clock)


def _bus_options(can: Any, interface: str, timing: BusTiming) -> dict[str, Any]:
    """Return the keyword arguments that open an adapter's bus in python-can with given timing.

    They set the bit rates and, where this is an option, that sent frames are received as echoes.
    """
    if interface == SERIAL_ADAPTER:
        return {}
    if interface in ("socketcan", "virtual"):
        return {"receive_own_messages": True, "fd": timing.fd}
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


def packet(identifier: int, data: bytes) -> bytes:
    """Return the 30 bytes with which the maker's adapter sends a classic frame."""
    body = identifier.to_bytes(4, "little") + bytes([0, len(data), 0, 0])
    return _HEAD + body + data.ljust(8, b"\0") + b"\0"


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
        self, device: str, baudrate: int = 921_600, write_timeout: float = _SEND_TIMEOUT
    ) -> None:
        import serial

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
        return can_message(frame, timestamp=time.time())

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

    def __call__(self, timeout: float) -> str | None:
        """Return the next line with its end, or None after ``timeout`` [s]."""
        until = time.monotonic() + timeout
        while (end := _LINE_END.search(self._received)) is None:
            time_left = max(until - time.monotonic(), 0.0)
            piece = self._fetch(time_left)
            self._received += piece
            if not piece and time_left == 0.0:
                return None
        line = self._received[: end.end()]
        self._received = self._received[end.end() :]
        # python-can gives up at a byte that is no text.
        return line.decode("ascii", "ignore")


_LINE_END = re.compile(rb"[\r\a]")
"""End of a line of slcan: a carriage return, or a bell where it refuses a command."""


def read_in_pieces(bus: Any) -> None:
    """Make python-can's open slcan bus read all bytes at once that have come."""
    port = bus.serialPortOrig
    # Setting a port's time-out takes long, so it is not set for each reading.
    port.timeout = _PATIENCE
    port.write_timeout = _SEND_TIMEOUT
    bus._read = LineReader(lambda left: port.read(port.in_waiting or int(left > 0.0)))

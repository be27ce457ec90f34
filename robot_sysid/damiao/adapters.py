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
import re
import struct
import time
from dataclasses import dataclass
from typing import Any, Optional

from robot_sysid.damiao.bus import LinkError, SystemClock
from robot_sysid.damiao.protocol import BusTiming, CanFrame
from robot_sysid.errors import InputError, error_text
from robot_sysid.records.installation import missing_library
from robot_sysid.records.option_fields import OptionRecord, option
from robot_sysid.wording import option_name

INTERFACES = (
    "socketcan",
    "slcan",
    "gs_usb",
    "pcan",
    "kvaser",
    "vector",
    "ixxat",
    "canalystii",
    "cantact",
    "seeedstudio",
    "damiao",
    "virtual",
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
    channel: Optional[str] = option(
        None, "the bus, for instance can0 or /dev/ttyACM0", "CHANNEL"
    )
    bus_option: tuple[str, ...] = option(
        (),
        "hand an option of the adapter's own to python-can, for instance f_clock_mhz=80",
        "NAME=VALUE",
        repeats=True,
    )


SERIAL_ADAPTER = "damiao"
"""Interface name of the maker's serial adapter."""
# Longest time for which a driver may wait to send a frame [s].
#
# It is more than a busy computer makes a program wait, and less than
# motors on another bus can wait for their next command: watchdogs take 0.1 s or more.
_SEND_TIMEOUT = 0.05
_QUEUE_PATIENCE = 1.5e-3
"""How long a frame is tried that the adapter's queue does not take [s]: a queue that is full for
longer does not empty within a control cycle of 4 ms, and the other motors wait meanwhile."""
_QUEUE_PAUSE = 2e-4
"""Pause between two such tries [s]: about what a frame takes on a classic bus (0.135 ms)."""


def import_can() -> Any:
    """Return the python-can module; InputError with the command that installs it if missing."""
    try:
        import can
    except ImportError:
        raise missing_library("talking to motors", "python-can", "can") from None
    return can


def _driver_text(error: BaseException) -> str:
    """Return the message of a driver's exception; some drivers raise SystemExit, as programs do."""
    return repr(error) if isinstance(error, SystemExit) else error_text(error)


def can_message(frame: CanFrame, **stamp: Any) -> Any:
    """Return a frame as a Message of python-can.

    ``stamp`` are further fields of the Message: timestamp [s], is_rx and channel.
    """
    return import_can().Message(
        arbitration_id=frame.id,
        is_extended_id=False,
        data=frame.data,
        is_fd=frame.fd,
        bitrate_switch=frame.fd,
        **stamp,
    )


class BusLink:
    """A link over an open bus of python-can.

    Args:
        bus: the open bus, which ``close`` closes.
        clock: clock in which the times of frames and deadlines are given.

    Attributes:
        bus: as given.
        clock: as given.
        error_frames: number of error frames so far. SocketCAN's adapters report them; the serial
            ones do not.
    """

    def __init__(self, bus: Any, clock: SystemClock) -> None:
        self.bus = bus
        self.clock = clock
        self.error_frames = 0

    def send(self, frame: CanFrame) -> None:
        """Send a frame; LinkError where the bus does not take it for 1.5 ms."""
        message = can_message(frame)
        patience = self.clock.now() + _QUEUE_PATIENCE
        while (error := self._try_to_send(message)) is not None:
            if self.clock.now() >= patience:
                raise LinkError(
                    f"the CAN bus does not take frames: {_driver_text(error)}; check the adapter, "
                    "the motors' power, the wiring and the termination (60 ohm between the two "
                    "wires)"
                ) from error
            self.clock.sleep_until(self.clock.now() + _QUEUE_PAUSE)

    def _try_to_send(self, message: Any) -> BaseException | None:
        """Hand a message to the driver; return what it raises, or None once it has taken it.

        Whatever a driver raises: the caller has to go on with the other motors.
        """
        try:
            self.bus.send(message, timeout=_SEND_TIMEOUT)
        except (Exception, SystemExit) as error:
            return error
        return None

    def receive(self, until: float) -> CanFrame | None:
        """Return the next data frame with a standard id; None if none came by ``until`` [s].

        ``until`` is in the link's clock. A line of a serial adapter that is no frame is a lost
        frame. LinkError where the bus cannot be read.
        """
        while True:
            message = self._next_message(max(until - self.clock.now(), 0.0))
            if message is None:
                if self.clock.now() >= until:
                    return None
            elif message.is_error_frame:
                self.error_frames += 1
            elif not message.is_extended_id:
                return self._frame(message)

    def _next_message(self, timeout: float) -> Any:
        """Return python-can's next message, or None if none comes within ``timeout`` [s].

        It is also None for a line that is no frame. LinkError where the bus cannot be read.
        """
        try:
            return self.bus.recv(timeout)
        except (ValueError, IndexError):
            return None
        except (Exception, SystemExit) as error:
            raise LinkError(
                f"the CAN bus cannot be read: {_driver_text(error)}"
            ) from error

    def close(self) -> None:
        """Close the bus; a driver's exceptions are dropped: they would hide errors about motors."""
        with contextlib.suppress(BaseException):
            self.bus.shutdown()

    def _frame(self, message: Any) -> CanFrame:
        """Return python-can's message as a frame.

        The message's time stamp, in seconds since 1970, is converted to the clock of this link. If
        the adapter stamps by another clock, the frame gets the present time.
        """
        age = time.time() - message.timestamp
        # An older frame is stamped by another clock.
        stamp = self.clock.now() - (age if 0.0 <= age < 1.0 else 0.0)
        data = bytes(message.data)
        is_echo = not message.is_rx
        return CanFrame(message.arbitration_id, data, stamp, message.is_fd, is_echo)


def open_bus(address: BusAddress, timing: BusTiming, clock: SystemClock) -> BusLink:
    """Open the bus of an address and return a link over it.

    InputError if this fails, or an option in ``address.bus_option`` is not NAME=VALUE.

    Args:
        address: kind of adapter, channel and options.
        timing: frame format and bit rates; socketcan has its own, set by ``ip link``.
        clock: clock of the link.
    """
    can = import_can()
    interface = address.interface
    channel = address.channel
    if timing.fd and interface == SERIAL_ADAPTER:
        raise InputError(
            "the maker's serial adapter sends classic CAN frames only; leave "
            f"{option_name('fd')} off"
        )
    options: dict[str, Any] = {}
    # Where this is an option, sent frames are received as echoes.
    if interface in ("socketcan", "virtual"):
        options.update(receive_own_messages=True, fd=timing.fd)
    elif interface != SERIAL_ADAPTER:
        options["bitrate"] = int(timing.bitrate)
        if timing.fd:
            options.update(fd=True, data_bitrate=int(timing.data_bitrate))
    for text in address.bus_option:
        name, equals, value = text.partition("=")
        if not equals or not name.isidentifier():
            raise InputError(
                f"{option_name('bus_option')} takes NAME=VALUE, got {text!r}"
            )
        options[name] = can.util.cast_from_string(value)
    try:
        if interface == SERIAL_ADAPTER:
            bus: Any = SerialAdapter.open(str(channel), **options)
        else:
            bus = can.Bus(channel, interface, ignore_config=True, **options)
    except (Exception, SystemExit) as error:
        # Each adapter's driver raises what it likes.
        raise InputError(
            f"cannot open {interface} channel {channel}: {_driver_text(error)}"
        ) from error
    if interface == "slcan":
        read_in_pieces(bus)
    return BusLink(bus, clock)


# End of a line of slcan: a carriage return, or a bell where it refuses a command.
_LINE_END = re.compile(rb"[\r\a]")
_BYTE_TIMEOUT = 1e-3
"""Time for which a serial port waits for a byte before it is asked again [s]: a quarter of a usual
control cycle, so that a deadline is overshot by no more."""
PACKET = re.compile(rb"\xaa.{14}\x55", re.DOTALL)
"""A packet from the maker's adapter."""


class SerialReader:
    """Reads all bytes at once that have come from a serial adapter, and divides them.

    python-can's own loop asks for every single byte of slcan. It also waits a millisecond, a
    quarter of a control cycle, for the first byte where only bytes that have already come are
    wanted.

    Args:
        port: open serial port.
        end: pattern of a whole packet, or of the end of a line.
    """

    def __init__(self, port: Any, end: re.Pattern[bytes]) -> None:
        # Setting a port's time-out takes long, so it is not set for each reading.
        port.timeout = _BYTE_TIMEOUT
        port.write_timeout = _SEND_TIMEOUT
        self._port = port
        self._end = end
        self._received = b""

    def __call__(self, timeout: float) -> bytes | None:
        """Return the bytes up to the next end of the pattern, or None after ``timeout`` [s]."""
        until = time.monotonic() + timeout
        while (end := self._end.search(self._received)) is None:
            time_left = max(until - time.monotonic(), 0.0)
            piece = self._port.read(self._port.in_waiting or int(time_left > 0.0))
            # No line or packet of a serial adapter has as many bytes.
            self._received = self._received[-256:] + piece
            if not piece and time_left == 0.0:
                return None
        line = self._received[: end.end()]
        self._received = self._received[end.end() :]
        return line


def read_in_pieces(bus: Any) -> None:
    """Make python-can's open slcan bus read all bytes at once that have come."""
    reader = SerialReader(bus.serialPortOrig, _LINE_END)

    def read_line(timeout: float) -> str | None:
        """Return the next line with its end, or None after ``timeout`` [s]."""
        line = reader(timeout)
        # python-can gives up at a byte that is no text.
        return None if line is None else line.decode("ascii", "ignore")

    bus._read = read_line


class SerialAdapter:
    """The maker's adapter as a bus: classic CAN over a serial line; its bit rate is set in it.

    It has the methods of python-can's buses that ``BusLink`` calls.

    Args:
        port: the serial port, open.
    """

    def __init__(self, port: Any) -> None:
        self._port = port
        self._read = SerialReader(port, PACKET)

    @classmethod
    def open(cls, device: str, baudrate: int = 921_600) -> SerialAdapter:
        """Open the serial port at a path, with a speed [bit/s], and return the adapter at it."""
        import serial

        return cls(serial.Serial(device, baudrate))

    def send(self, message: Any, timeout: float) -> None:
        """Send a frame; the adapter does not report when the frame was on the bus."""
        data = bytes(message.data)
        head = bytes([0x55, 0xAA, 30, 0x03])
        numbers = 1, 10, message.arbitration_id, len(data)
        self._port.write(struct.pack("<4sIIxIxBxx8sx", head, *numbers, data))

    def recv(self, timeout: float) -> Any:
        """Return the next message, or None; it waits for at most ``timeout`` [s]."""
        line = self._read(timeout)
        if line is None:
            return None
        kind, can_id, data = struct.unpack("<xBxI8sx", line[-16:])
        # Other packets hold no received frame.
        if kind != 0x11:
            return None
        return can_message(CanFrame(can_id, data), timestamp=time.time())

    def shutdown(self) -> None:
        """Close the serial line."""
        self._port.close()

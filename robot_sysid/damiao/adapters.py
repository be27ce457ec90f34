"""CAN adapters: opening and reading them through python-can, and the maker's own serial adapter.

python-can finds ``DamiaoSerialBus`` (``interface="damiao"``) by its entry point; the class is made
on first use, because python-can is an extra. The adapter (921600 baud) takes 30 bytes per frame,
numbers little endian: 55 AA, the length 1E, 03 for "send", how often (4 bytes: 1), the pause
between in four bytes (10), id type (0 for 11 bits), CAN id in four bytes, frame type (0 for data),
number of data bytes, two filters (0), eight bytes of data, and a check byte that is not looked at
(0).

It sends 16 bytes per frame: AA, type of packet (11 for a received frame), format, CAN id in four
bytes little endian, eight bytes of data, 55.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import re
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from robot_sysid.damiao.bus import Link, LinkError, SystemClock
from robot_sysid.damiao.protocol import BusTiming, Frame
from robot_sysid.errors import InputError, error_text
from robot_sysid.records.option_fields import OptionRecord, option

# Adapters on this computer only: nothing here may put motor commands on a network.
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
        """Name of each bus, as in joint maps, to its channel; InputError for one twice."""
        matches = [_NAMED.fullmatch(channel) for channel in self.channel]
        pairs = [(match[1] or match[2], match[2]) for match in matches if match]
        # One that fell out would leave its arm to the other's trajectory.
        for names in zip(*pairs):
            for name in names:
                if names.count(name) > 1:
                    raise InputError(
                        f"--channel names {name} twice; give each bus once"
                    )
        return dict(pairs)


# A name before the channel: not the "=" that ends an address such as spy://COM3?file=log.
_NAMED = re.compile(r"(?:([\w.-]+)=)?(.*)")
SERIAL_ADAPTER = "damiao"
# More than a busy computer keeps a program waiting (a cycle may be 20 ms late), and less than
# motors on another bus can wait for their next command: watchdogs take 0.1 s or more [s].
_SEND_TIMEOUT = 0.05
# A queue that is full for longer than this is not going to empty within a control cycle.
_FULL_PATIENCE = 1.5e-3
_FULL_PAUSE = 2e-4
_FULL = (
    "the CAN bus takes no more frames because nobody acknowledges them: check the motors' power, "
    "the wiring and the termination (60 ohm between the two wires)"
)
# Serial lines have no check sum. A line that was damaged on its way is a lost frame; so many of
# them within that time [s] are a bad cable.
_MOST_GARBLED = 3
_GARBLED_TIME = 1.0
_GARBLED = (
    f"the adapter sent {_MOST_GARBLED} lines within a second that are no CAN frames; check its "
    "cable and that nothing else reads from its port"
)
# Older than any frame that waited for us: stamped by another clock [s].
_PLAUSIBLE_AGE = 1.0
# A clock that PCAN's and Kvaser's CAN-FD controllers can be set to [Hz].
_FD_CLOCK = 80_000_000


def import_can() -> Any:
    """Return the python-can module, or raise InputError saying how to get it."""
    try:
        import can
    except ImportError:
        raise InputError(
            'talking to motors needs python-can: pip install "robot-sysid[can]"'
        ) from None
    return can


def _driver_text(error: BaseException) -> str:
    """Return the message of whatever a driver raised."""
    return repr(error) if isinstance(error, SystemExit) else error_text(error)


def can_message(can: Any, frame: Frame, **stamp: Any) -> Any:
    """Return python-can's message for a frame; further fields of it by keyword."""
    fd = {"is_fd": frame.fd, "bitrate_switch": frame.fd}
    flags = {"is_extended_id": False, "is_error_frame": frame.error, **fd}
    return can.Message(arbitration_id=frame.id, data=frame.data, **flags, **stamp)


# How often the watch looks [s], and after how many looks at the same call it reports it, and ends.
# The longest watchdog that a run allows is 5 s: by then no motor drives any more.
_LOOK = 0.1
_LOOKS_TO_SAY = 10
_LOOKS_TO_END = 50
# What opening an adapter may take in addition: python-can's slcan sleeps for 2 s [looks].
_OPENING = 50
StallReport = Callable[[str, bool], None]
"""Takes a message about a driver that does not return, and whether it is the last one."""


class DriverWatch:
    """Watches the calls of adapters' drivers, because one that does not return stops everything.

    ``tell`` is called from a thread of its own, twice at most; at the second call nothing can be
    sent any more, and the program should end. None watches nothing. Looks are counted and not
    seconds, so that a computer that was asleep accuses no driver.
    """

    def __init__(self, tell: StallReport | None = None) -> None:
        self._tell = tell
        # Each call is an object of its own.
        self._call: object | None = None
        self._looks = 0
        self._closed = threading.Event()
        if tell is not None:
            threading.Thread(target=self._look, daemon=True).start()

    @contextlib.contextmanager
    def during(self, more_looks: int = 0) -> Iterator[None]:
        """Watch the call in the block, which may take ``more_looks`` beyond the usual limits."""
        self._call = object()
        self._looks = -more_looks
        try:
            yield
        finally:
            self._call = None

    def close(self) -> None:
        """Stop watching."""
        self._closed.set()

    def _look(self) -> None:
        """Look at the present call again and again, and tell of one that does not return."""
        assert self._tell is not None
        last_call = None
        while self._looks < _LOOKS_TO_END and not self._closed.wait(_LOOK):
            self._looks += self._call is last_call is not None
            last_call = self._call
            if last_call is not None and self._looks in (_LOOKS_TO_SAY, _LOOKS_TO_END):
                self._tell(
                    f"the adapter's driver has not returned for {_LOOK * self._looks:.0f} s, and "
                    "nothing can be sent meanwhile: motors that were enabled are stopped by their "
                    "watchdogs; cut their power, and unplug the adapter and plug it in again",
                    self._looks == _LOOKS_TO_END,
                )


# How long to leave several buses alone between two looks at them [s].
_PAUSE = 1e-4


class BusLink:
    """Open python-can buses in the order of ``Frame.bus``, as one link in ``clock``'s time."""

    def __init__(
        self, buses: Sequence[Any], clock: SystemClock, watch: DriverWatch | None = None
    ) -> None:
        self._can = import_can()
        self._buses = buses
        self._clock = clock
        self._watch = watch or DriverWatch()
        self._garbled_at: deque[float] = deque(maxlen=_MOST_GARBLED)

    def send(self, frame: Frame) -> None:
        """Send a frame, or raise LinkError."""
        message = can_message(self._can, frame)
        patience = self._clock.now() + _FULL_PATIENCE
        while True:
            try:
                with self._watch.during():
                    return self._buses[frame.bus].send(message, timeout=_SEND_TIMEOUT)
            except (Exception, SystemExit) as error:
                # Whatever a driver raises: the caller has to go on with the other motors.
                names = "error_code", "errno"
                codes = [getattr(error, name, None) for name in names]
                if errno.ENOBUFS not in codes:
                    reason = f"the CAN bus does not take frames: {_driver_text(error)}"
                    raise LinkError(reason) from error
                if self._clock.now() >= patience:
                    raise LinkError(_FULL) from error
            self._clock.sleep_until(self._clock.now() + _FULL_PAUSE)

    def receive(self, until: float) -> Frame | None:
        """Return the next standard frame of any bus, or None at ``until`` [s]."""
        while True:
            for number, bus in enumerate(self._buses):
                # One bus can be waited for; several are looked at in turn.
                wait = until if len(self._buses) == 1 else min(self._clock.now(), until)
                message = self._next(bus, wait)
                if message is not None:
                    return self._frame(message, number)
            if self._clock.now() >= until:
                return None
            self._clock.sleep_until(min(self._clock.now() + _PAUSE, until))

    def _next(self, bus: Any, until: float) -> Any:
        """Return the next python-can message with a standard id, or None at ``until`` [s]."""
        while True:
            try:
                with self._watch.during():
                    message = bus.recv(max(until - self._clock.now(), 0.0))
            except (ValueError, IndexError) as error:
                self._note_garbled(error)
                message = None
            except (Exception, SystemExit) as error:
                raise LinkError(
                    f"the CAN bus cannot be read: {_driver_text(error)}"
                ) from error
            if message is None and self._clock.now() >= until:
                return None
            if message is not None and not message.is_extended_id:
                return message

    def _note_garbled(self, error: Exception) -> None:
        """Count a damaged line; LinkError where there were too many within a second."""
        now = self._clock.now()
        self._garbled_at.append(now)
        if (
            len(self._garbled_at) == _MOST_GARBLED
            and now - self._garbled_at[0] < _GARBLED_TIME
        ):
            raise LinkError(f"{_GARBLED} ({error_text(error)})") from error

    def close(self) -> None:
        """Release the adapters; one that has been unplugged is gone anyway.

        Whatever a driver raises, it does not take the place of what happened to the motors.
        """
        for bus in self._buses:
            with contextlib.suppress(BaseException), self._watch.during():
                bus.shutdown()
        self._watch.close()

    def _frame(self, message: Any, bus: int) -> Frame:
        """Return python-can's message as a frame of a bus, its time in this link's clock."""
        age = time.time() - message.timestamp
        # Where the adapter has another clock, a frame counts as just come.
        sent_at = self._clock.now() - (age if 0.0 <= age < _PLAUSIBLE_AGE else 0.0)
        return Frame(
            message.arbitration_id,
            bytes(message.data),
            sent_at,
            message.is_fd,
            message.is_error_frame,
            not message.is_rx,
            bus,
        )


def open_bus(
    address: BusAddress,
    timing: BusTiming,
    clock: SystemClock,
    tell: StallReport | None = None,
) -> Link:
    """Open one CAN bus or several as one link; InputError where that is not possible.

    ``tell`` takes messages about a driver that does not return, see ``DriverWatch``. The bit rates
    of socketcan are not set here: ``ip link`` does that.
    """
    if timing.fd and address.interface == SERIAL_ADAPTER:
        raise InputError(
            "the maker's serial adapter sends classic CAN frames only; leave --fd off"
        )
    buses: list[Any] = []
    watch = DriverWatch(tell)
    link = BusLink(buses, clock, watch)
    with contextlib.ExitStack() as opened:
        opened.callback(link.close)
        for channel in address.buses.values():
            with watch.during(_OPENING):
                buses.append(_open_one(address, channel, timing))
        opened.pop_all()
    return link


def _open_one(address: BusAddress, channel: str, timing: BusTiming) -> Any:
    """Return the python-can bus of one channel, or raise InputError."""
    can = import_can()
    interface = address.interface
    options = _bus_options(can, interface, timing)
    for text in address.bus_option:
        name, equals, value = text.partition("=")
        if not equals or not name.isidentifier():
            raise InputError(f"--bus-option takes NAME=VALUE, got {text!r}")
        options[name] = _parse_value(value)
    try:
        if interface == SERIAL_ADAPTER:
            return _bus_class()(channel, **options)
        bus = can.Bus(
            channel=channel, interface=interface, ignore_config=True, **options
        )
        if interface == "slcan":
            read_in_pieces(bus, len(address.buses) == 1, _SEND_TIMEOUT)
        return bus
    except (Exception, SystemExit) as error:
        # Each adapter's driver raises what it likes.
        reason = _driver_text(error)
        raise InputError(
            f"cannot open {interface} channel {channel}: {reason}"
        ) from error


def _parse_value(text: str) -> Any:
    """Return the number, True or False that a text stands for, or the text itself."""
    for number_type in (int, float):
        with contextlib.suppress(ValueError):
            return number_type(text)
    return {"true": True, "false": False}.get(text.lower(), text)


def _bus_options(can: Any, interface: str, timing: BusTiming) -> dict[str, Any]:
    """Return python-can's options for bit rates and echoes on an adapter."""
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
    points = {"nom_sample_point": 80.0, "data_sample_point": 75.0}
    return {
        "timing": can.BitTimingFd.from_sample_point(
            f_clock=_FD_CLOCK, **rates, **points
        )
    }


_HEAD = bytes([0x55, 0xAA, 30, 0x03, 1, 0, 0, 0, 10, 0, 0, 0, 0])
_RECEIVED = 16
_A_FRAME = b"\x11"
_PACKET = re.compile(rb"\xaa(.).(.{4})(.{8})\x55", re.DOTALL)
_DATA = 8


def packet(identifier: int, data: bytes) -> bytes:
    """Return the 30 bytes that send a frame of up to eight bytes, or raise ValueError."""
    if len(data) > _DATA or not 0 <= identifier <= 0x7FF:
        raise ValueError(
            "the adapter sends classic frames with 11-bit ids and up to 8 bytes"
        )
    body = identifier.to_bytes(4, "little") + bytes([0, len(data), 0, 0])
    return _HEAD + body + data.ljust(_DATA, b"\0") + b"\0"


class PacketReader:
    """Finds the maker's packets in bytes from the line, also after garbage or a packet's loss."""

    def __init__(self) -> None:
        self._incomplete = b""

    def take(self, piece: bytes) -> list[Frame]:
        """Return the frames that are complete with this piece of the line."""
        line = self._incomplete + piece
        frames = []
        end = max(len(line) - _RECEIVED + 1, 0)
        for match in _PACKET.finditer(line):
            end = max(end, match.end())
            if match[1] == _A_FRAME:
                frames.append(Frame(int.from_bytes(match[2], "little"), match[3]))
        self._incomplete = line[end:]
        return frames


BAUD = 921_600
# Longest wait for the line to take a packet: longer, and the motors' watchdogs are near [s].
_WRITE_TIMEOUT = 0.02
# How long a serial port waits for a byte before it is asked whether to go on [s].
_PATIENCE = 1e-3


def __getattr__(name: str) -> Any:
    if name == "DamiaoSerialBus":
        return _bus_class()
    raise AttributeError(name)


@cache
def _bus_class() -> Any:
    """Return the class DamiaoSerialBus, made on first use because python-can is an extra."""
    import can
    import serial

    class DamiaoSerialBus(can.BusABC):
        """Classic CAN over the adapter's serial line; the bit rate is set in the adapter."""

        def __init__(
            self,
            channel: str,
            baudrate: int = BAUD,
            write_timeout: float = _WRITE_TIMEOUT,
            **bus_options: Any,
        ) -> None:
            self._port = serial.Serial(
                channel, baudrate, timeout=0, write_timeout=write_timeout
            )
            self._reader = PacketReader()
            self._waiting = deque[Any]()
            self.channel_info = f"Damiao serial adapter at {channel}"
            super().__init__(channel=channel, **bus_options)

        def send(self, msg: Any, timeout: float | None = None) -> None:
            """Send a frame; the adapter does not say when it was on the bus."""
            self._port.write(packet(msg.arbitration_id, bytes(msg.data)))

        def _recv_internal(self, timeout: float | None) -> tuple[Any, bool]:
            until = None if timeout is None else time.monotonic() + timeout
            while not self._waiting:
                self._port.timeout = until and max(until - time.monotonic(), 0.0)
                # The rest of what has come already, or the first byte of what comes next.
                piece = self._port.read(max(self._port.in_waiting, 1))
                self._waiting.extend(self._reader.take(piece))
                if (
                    not self._waiting
                    and until is not None
                    and time.monotonic() >= until
                ):
                    return None, False
            frame = self._waiting.popleft()
            message = can.Message(
                timestamp=time.time(),
                arbitration_id=frame.id,
                is_extended_id=False,
                data=frame.data,
            )
            return message, False

        def shutdown(self) -> None:
            """Close the serial line."""
            super().shutdown()
            self._port.close()

    return DamiaoSerialBus


class _LineReader:
    """Reads an slcan adapter's lines for python-can, whose own loop asks for each byte.

    It waits no longer than it is asked to: python-can's waits a millisecond for the first byte also
    where only what has come is wanted, a quarter of a control cycle. ``fetch`` returns all bytes
    that have come, and waits for the first one as long as it is told [s].
    """

    def __init__(self, fetch: Callable[[float], bytes]) -> None:
        self._fetch = fetch
        self._received = b""

    def __call__(self, timeout: float | None) -> str | None:
        """Return the next line with its end, or None after ``timeout`` [s]."""
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


# A wait without end is made of looks as long as this [s].
_LONGEST_LOOK = 1.0
# slcan ends a line with a carriage return, or with a bell where it refuses a command.
_LINE_END = re.compile(rb"[\r\a]")


def read_in_pieces(bus: Any, alone: bool, write_timeout: float) -> None:
    """Let python-can's slcan read what has come at once; wait for it only on a bus that is alone.

    Where there are several, a wait for one that is silent keeps the others waiting.
    """
    port = bus.serialPortOrig
    port.timeout = _PATIENCE if alone else 0.0
    port.write_timeout = write_timeout
    # Setting a port's time-out configures it anew, so it stays what it is.
    bus._read = _LineReader(lambda left: port.read(port.in_waiting or int(left > 0.0)))


class _NearEnd:
    """Our end of a pseudo-terminal."""

    write_timeout: float | None = None

    def __init__(self) -> None:
        import tty

        # The far end stays open here too, so that a client may come and go.
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        self.device = os.ttyname(self._far)

    def fetch(self, patience: float) -> bytes:
        """Return the bytes that have come, after waiting for the first one [s]."""
        ready = select.select([self._near], [], [], patience)[0]
        return os.read(self._near, 4096) if ready else b""

    def write(self, data: bytes) -> None:
        """Write; what nobody reads is dropped, as on a bus."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._near, data)

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        """Close the terminal."""
        os.close(self._near)
        os.close(self._far)


def slcan_terminal() -> tuple[Any, str]:
    """Return a python-can bus behind a pseudo-terminal, and the device at which to open it.

    Whoever opens the device with python-can's slcan interface talks to this process; nothing leaves
    the computer. InputError where there are no pseudo-terminals.
    """
    if not hasattr(os, "openpty"):
        raise InputError("pseudo-terminals need a Unix system")
    from can.interfaces.slcan import slcanBus

    class Terminal(slcanBus):
        """Frames are the same text both ways; what sets an adapter up is passed over."""

        def _recv_internal(self, timeout: float | None) -> tuple[Any, bool]:
            # What a client that was killed left of its last line is no frame either.
            with contextlib.suppress(ValueError, IndexError):
                return super()._recv_internal(timeout)
            return None, False

    bus: Any = Terminal("loop://", sleep_after_open=0)
    line = _NearEnd()
    bus.serialPortOrig = line
    bus._read = _LineReader(line.fetch)
    return bus, line.device

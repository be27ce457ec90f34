"""The bus: time, the guard that every frame we send goes through, python-can, and its log."""

from __future__ import annotations

import contextlib
import errno
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from robot_sysid.damiao import serial_adapter
from robot_sysid.damiao.protocol.frames import BusTiming, Frame, refuse_harmful
from robot_sysid.errors import HardwareAbort, InputError, error_text
from robot_sysid.records.options import OptionRecord, option


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
    """Where the bus is."""

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
        """What messages and joint maps call each bus, and where it is; InputError for one twice."""
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


# A name before the place: not the "=" that ends an address such as spy://COM3?file=log.
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


def _driver_words(error: BaseException) -> str:
    return repr(error) if isinstance(error, SystemExit) else error_text(error)


def _message(can: Any, frame: Frame, **stamp: Any) -> Any:
    fd = {"is_fd": frame.fd, "bitrate_switch": frame.fd}
    flags = {"is_extended_id": False, "is_error_frame": frame.error, **fd}
    return can.Message(arbitration_id=frame.id, data=frame.data, **flags, **stamp)


# How often the watch looks [s], and after how many looks at the same call it says so, and ends.
# The longest watchdog that a run allows is 5 s: by then no motor drives any more.
_LOOK = 0.1
_LOOKS_TO_SAY = 10
_LOOKS_TO_END = 50
# What opening an adapter may take in addition: python-can's slcan sleeps for 2 s [looks].
_OPENING = 50
Told = Callable[[str, bool], None]


class DriverWatch:
    """Watches the calls of adapters' drivers, because one that does not return stops everything.

    ``tell`` is called from a thread of its own with what is happening, and whether it is the end:
    no more can be said or sent then, and whoever is told should end the program. Looks are counted
    and not seconds, so that a computer that was asleep accuses nobody.
    """

    def __init__(self, tell: Told | None = None) -> None:
        self._tell = tell
        # Each call is an object of its own, and one stands for none.
        self._no_call = object()
        self._call = self._no_call
        self._looks = 0
        self._closed = threading.Event()
        if tell is not None:
            threading.Thread(target=self._look, daemon=True).start()

    @contextlib.contextmanager
    def during(self, more_looks: int = 0) -> Iterator[None]:
        """Watch the call in the block, which may take so many looks more than a usual one."""
        self._call = object()
        self._looks = -more_looks
        try:
            yield
        finally:
            self._call = self._no_call

    def close(self) -> None:
        """Watch no more."""
        self._closed.set()

    def _look(self) -> None:
        assert self._tell is not None
        last_call = self._no_call
        while self._looks < _LOOKS_TO_END and not self._closed.wait(_LOOK):
            self._looks += self._call is last_call is not self._no_call
            last_call = self._call
            if last_call is not self._no_call and self._looks in (
                _LOOKS_TO_SAY,
                _LOOKS_TO_END,
            ):
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
        message = _message(self._can, frame)
        patience = self._clock.now() + _FULL_PATIENCE
        while True:
            try:
                with self._watch.during():
                    return self._buses[frame.bus].send(message, timeout=_SEND_TIMEOUT)
            except (Exception, SystemExit) as error:
                # Whatever a driver raises: the caller has to go on with the other motors.
                codes = (
                    getattr(error, "error_code", None),
                    getattr(error, "errno", None),
                )
                if errno.ENOBUFS not in codes:
                    reason = _driver_words(error)
                    raise LinkError(
                        f"the CAN bus does not take frames: {reason}"
                    ) from error
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
        while True:
            try:
                with self._watch.during():
                    message = bus.recv(max(until - self._clock.now(), 0.0))
            except (ValueError, IndexError) as error:
                self._note_garbled(error)
                message = None
            except (Exception, SystemExit) as error:
                raise LinkError(
                    f"the CAN bus cannot be read: {_driver_words(error)}"
                ) from error
            if message is None and self._clock.now() >= until:
                return None
            if message is not None and not message.is_extended_id:
                return message

    def _note_garbled(self, error: Exception) -> None:
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
        age = time.time() - message.timestamp
        # Where the adapter has another clock, a frame counts as just come.
        then = self._clock.now() - (age if 0.0 <= age < _PLAUSIBLE_AGE else 0.0)
        return Frame(
            message.arbitration_id,
            bytes(message.data),
            then,
            message.is_fd,
            message.is_error_frame,
            not message.is_rx,
            bus,
        )


def open_bus(
    address: BusAddress, timing: BusTiming, clock: SystemClock, tell: Told | None = None
) -> Link:
    """Open one CAN bus or several, or raise InputError; ``ip link`` sets the rates of socketcan.

    ``tell`` is told of a driver that does not return, see ``DriverWatch``.
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
    can = import_can()
    interface = address.interface
    options = _bus_options(can, interface, timing)
    for text in address.bus_option:
        name, equals, value = text.partition("=")
        if not equals or not name.isidentifier():
            raise InputError(f"--bus-option takes NAME=VALUE, got {text!r}")
        options[name] = _value(value)
    try:
        if interface == SERIAL_ADAPTER:
            return serial_adapter.DamiaoSerialBus(channel, **options)
        bus = can.Bus(
            channel=channel, interface=interface, ignore_config=True, **options
        )
        if interface == "slcan":
            serial_adapter.read_in_pieces(bus, len(address.buses) == 1, _SEND_TIMEOUT)
        return bus
    except (Exception, SystemExit) as error:
        # Each adapter's driver raises what it likes.
        reason = _driver_words(error)
        raise InputError(
            f"cannot open {interface} channel {channel}: {reason}"
        ) from error


def _value(text: str) -> Any:
    """Return a number, True or False where a text is one."""
    for number_type in (int, float):
        with contextlib.suppress(ValueError):
            return number_type(text)
    return {"true": True, "false": False}.get(text.lower(), text)


def _bus_options(can: Any, interface: str, timing: BusTiming) -> dict[str, Any]:
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


class RawFrameLog:
    """Observes a link in its block and writes all frames to a file, replacing one that is there.

    The format follows the file's suffix: .log (candump), .asc, .blf, .csv, .trc, ... Time stamps
    are seconds since 1970.
    """

    def __init__(self, path: Path, link: GuardedLink) -> None:
        self._can = import_can()
        self._link = link
        try:
            self._writer: Any = self._can.Logger(str(path))
        except ValueError as error:
            raise InputError(f"cannot log frames to {path}: {error}") from None
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror}") from None
        self._offset = time.time() - link.clock.now()
        self._waiting: list[tuple[Frame, bool]] = []

    def __enter__(self) -> RawFrameLog:
        self._link.observer = self
        return self

    def __exit__(self, *_: object) -> None:
        self._link.observer = None
        # What a recorder did not take: without one, everything; if there is room for it.
        with contextlib.suppress(Exception):
            self.write(self.take_frames())
        with contextlib.suppress(Exception):
            self._writer.stop()

    def __call__(self, frame: Frame, sent: bool) -> None:
        """Take a frame."""
        self._waiting.append((frame, sent))

    def take_frames(self) -> list[tuple[Frame, bool]]:
        """Return the frames that came since the last call, for ``write``."""
        frames = self._waiting
        self._waiting = []
        return frames

    def write(self, frames: list[tuple[Frame, bool]]) -> None:
        """Write frames in order of time; may be called from another thread than the rest."""
        for frame, sent in sorted(frames, key=lambda entry: entry[0].time):
            message = _message(
                self._can,
                frame,
                timestamp=frame.time + self._offset,
                is_rx=not sent,
                channel=self._link.channels[frame.bus],
            )
            self._writer.on_message_received(message)
        file: Any = getattr(self._writer, "file", None)
        if file is not None:
            file.flush()

"""What a bus has to offer, the guard that every frame we send goes through, and time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from robot_sysid.damiao.protocol.frames import Frame, refuse_harmful
from robot_sysid.errors import HardwareAbort


class Clock(Protocol):
    """A clock that never runs backwards; a live one moves by itself, whatever this program does."""

    live: bool

    def now(self) -> float:
        """Return the time [s]; only differences mean anything."""

    def sleep_until(self, moment: float) -> None:
        """Return at ``moment`` [s], or at once if it has passed."""


class SystemClock:
    """The computer's monotonic clock."""

    live = True

    def now(self) -> float:
        """Return the monotonic time [s]."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Sleep until ``moment`` [s]."""
        left = moment - time.monotonic()
        if left > 0.0:
            time.sleep(left)


class SimulatedClock:
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

    ``clock`` has the time of the link's frames; ``refuse`` raises for frames that must not be sent;
    ``channels`` are the names of the buses behind the link. The observer is called with every frame
    and whether it was sent; it must not raise.
    """

    def __init__(
        self,
        link: Link,
        clock: Clock,
        fd: bool = False,
        channels: Sequence[str] = ("",),
        refuse: Callable[[Frame], None] = refuse_harmful,
    ) -> None:
        self._refuse = refuse
        self._link, self.clock, self._fd, self.channels = link, clock, fd, tuple(channels)
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

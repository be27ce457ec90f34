"""What a bus has to offer, and the guard that every frame we send goes through."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from robot_sysid.damiao.protocol.frames import Frame, refuse_harmful
from robot_sysid.errors import HardwareAbort


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

    Args:
        link: the bus.
        now: returns the time that a sent frame is shown with [s].
        fd: send CAN-FD frames.
        channels: names of the buses behind the link.
        refuse: raises for frames that must not be sent.

    Attributes:
        channels: as given.
        observer: called with every frame sent or received, and whether it was sent; must not raise.
    """

    def __init__(
        self,
        link: Link,
        now: Callable[[], float],
        fd: bool = False,
        channels: Sequence[str] = ("",),
        refuse: Callable[[Frame], None] = refuse_harmful,
    ) -> None:
        self._refuse = refuse
        self._link, self._now, self._fd, self.channels = link, now, fd, tuple(channels)
        self.observer: Callable[[Frame, bool], None] | None = None

    def send(self, frame: Frame) -> None:
        """Send a frame that is not harmful."""
        self._refuse(frame)
        frame = frame._replace(fd=self._fd)
        self._link.send(frame)
        if self.observer:
            self.observer(frame._replace(time=self._now()), True)

    def receive(self, until: float) -> Frame | None:
        """Return the next frame or None at ``until`` [s]."""
        frame = self._link.receive(until)
        if frame is not None and self.observer and not frame.echo:
            self.observer(frame, False)
        return frame

    def drain(self) -> None:
        """Drop what has already arrived."""
        while self.receive(self._now()) is not None:
            pass

"""Several buses as one link: each frame knows which one it is on."""

from __future__ import annotations

from collections.abc import Sequence

from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.bus.link import Link
from robot_sysid.damiao.protocol.frames import Frame

# How long to leave all buses alone between two looks at them [s].
_PAUSE = 1e-4


class SeveralBuses:
    """Buses of one arm, or of two, behind one link.

    Args:
        links: the buses, in the order of ``Frame.bus``.
        clock: for waiting.
    """

    def __init__(self, links: Sequence[Link], clock: Clock) -> None:
        self._links, self._clock = tuple(links), clock

    def send(self, frame: Frame) -> None:
        """Send a frame on its bus, or raise LinkError."""
        self._links[frame.bus].send(frame._replace(bus=0))

    def receive(self, until: float) -> Frame | None:
        """Return the next frame of any bus, or None at ``until`` [s]."""
        while True:
            for bus, link in enumerate(self._links):
                frame = link.receive(min(self._clock.now(), until))
                if frame is not None:
                    return frame._replace(bus=bus)
            if self._clock.now() >= until:
                return None
            self._clock.sleep_until(min(self._clock.now() + _PAUSE, until))

    def close(self) -> None:
        """Release all buses."""
        for link in self._links:
            link.close()

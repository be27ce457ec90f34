"""What tests need around a bus: one that remembers its frames, and a thread that serves an arm."""

from __future__ import annotations

import contextlib
import sys
import threading

from robot_sysid.damiao.simulated.simulated_link import serve

SWITCH_INTERVAL = 2e-4


class RememberingLink:
    """Passes frames on and remembers them.

    Attributes:
        frames: (frame, whether it was sent) in order; sent ones carry the time of sending. Frames
            that the adapter reports back are not among them.
    """

    def __init__(self, link, clock):
        self._link, self._clock = link, clock
        self.frames = []

    @property
    def sent(self):
        """The frames that were sent."""
        return [frame for frame, sent in self.frames if sent]

    def send(self, frame):
        self._link.send(frame)
        self.frames.append((frame._replace(time=self._clock.now()), True))

    def receive(self, until):
        frame = self._link.receive(until)
        if frame is not None and not frame.echo:
            self.frames.append((frame, False))
        return frame

    def close(self):
        self._link.close()


@contextlib.contextmanager
def served_in_background(arm, link, clock, close=True):
    """Serve the arm in a thread for as long as the block runs, then, if asked, close its link."""
    leave = threading.Event()
    # Python hands over between busy threads every 5 ms by default: longer than a control cycle.
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    thread = threading.Thread(
        target=serve, args=(arm, link, clock, lambda: not leave.is_set()), daemon=True
    )
    thread.start()
    try:
        yield
    finally:
        leave.set()
        thread.join()
        sys.setswitchinterval(interval)
        if close:
            link.close()

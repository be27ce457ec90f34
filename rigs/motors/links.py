"""A link that remembers its frames."""

from __future__ import annotations


class RememberingLink:
    """Passes frames on and remembers them.

    Attributes:
        frames: (frame, whether it was sent) in order; sent ones carry the time of sending. Frames
            that the adapter reports back are not among them.
    """

    def __init__(self, link, clock):
        self._link = link
        self._clock = clock
        self.frames = []

    @property
    def sent(self):
        """The frames that were sent."""
        return [frame for frame, sent in self.frames if sent]

    @property
    def error_frames(self):
        """Number of error frames that the adapter has reported."""
        return self._link.error_frames

    def send(self, frame):
        self._link.send(frame)
        self.frames.append((frame._replace(time=self._clock.now()), True))

    def receive(self, until):
        frame = self._link.receive(until)
        if frame is not None and not frame.echo:
            self.frames.append((frame, False))
        return frame

    def close(self):
        pass

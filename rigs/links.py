"""Links as tests need them: one that remembers its frames, and one whose answers come late."""

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


class SlowAdapter:
    """Hands answers over so many seconds late as ``delay()`` says; none overtakes another."""

    def __init__(self, link, clock, delay=None):
        self._link = link
        self._clock = clock
        self.delay = delay
        self._held = []

    def send(self, frame):
        self._link.send(frame)

    def receive(self, until):
        if self.delay is None:
            return self._link.receive(until)
        while not self._held or self._held[0].time > self._clock.now():
            due = self._held[0].time if self._held else float("inf")
            frame = self._link.receive(min(until, due))
            if frame is None and due > until or frame is not None and frame.echo:
                return frame
            if frame is not None:
                last = self._held[-1].time if self._held else 0.0
                self._held.append(
                    frame._replace(time=max(frame.time + self.delay(), last))
                )
        return self._held.pop(0)

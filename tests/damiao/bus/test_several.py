"""Several buses behind one link."""

from __future__ import annotations

import pytest

from robot_sysid.damiao.bus.can_bus import SeveralBuses
from robot_sysid.damiao.bus.clock import SimulatedClock
from robot_sysid.damiao.protocol.frames import Frame


class OneBus:
    """Remembers what is sent, and delivers frames at their times."""

    def __init__(self, clock, *frames):
        self._clock, self._frames = clock, list(frames)
        self.sent, self.closed = [], False

    def send(self, frame):
        self.sent.append(frame)

    def receive(self, until):
        if self._frames and self._frames[0].time <= self._clock.now():
            return self._frames.pop(0)
        return None

    def close(self):
        self.closed = True


def test_frames_go_to_their_bus_and_come_back_with_its_number():
    clock = SimulatedClock()
    buses = [OneBus(clock, Frame(17, b"a", 0.2)), OneBus(clock, Frame(17, b"b", 0.1))]
    several = SeveralBuses(buses, clock)
    for bus in (0, 1, 1):
        several.send(Frame(1, bytes([bus]), bus=bus))
    assert [len(bus.sent) for bus in buses] == [1, 2]
    assert [frame.data[0] for frame in buses[1].sent] == [1, 1]
    received = [several.receive(1.0) for _ in range(2)]
    assert [(frame.bus, frame.data) for frame in received] == [(1, b"b"), (0, b"a")]
    assert clock.now() == pytest.approx(0.2, abs=2e-4)
    assert several.receive(0.5) is None and clock.now() == 0.5
    several.close()
    assert all(bus.closed for bus in buses)

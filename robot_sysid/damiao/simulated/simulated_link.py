"""A simulated arm on a bus: in simulated time, exact and without waiting, or in real time."""

from __future__ import annotations

import heapq
import itertools
from collections import defaultdict, deque
from collections.abc import Callable

from robot_sysid.damiao.bus.clock import Clock, SimulatedClock
from robot_sysid.damiao.bus.link import Link
from robot_sysid.damiao.protocol.bus_load import BusTiming
from robot_sysid.damiao.protocol.frames import Frame
from robot_sysid.damiao.simulated.arm import SimulatedArm

_TURNAROUND = 50e-6


class SimulatedLink:
    """Carries frames one after the other, each as long as its bits take.

    A burst of commands goes out before any reply, because commands have the lower ids.

    Args:
        clock: moved by waiting.
        arm: who answers.
        timing: bit rates; a classic host sees an error frame where a motor answers in CAN-FD.
        echo: report each sent frame back when it was on the bus, as SocketCAN does.
        adapter: how long the adapter takes to hand an answer over [s], asked for each one; answers
            never overtake one another.
    """

    def __init__(
        self,
        clock: SimulatedClock,
        arm: SimulatedArm,
        timing: BusTiming,
        echo: bool = False,
        adapter: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.clock, self.arm = clock, arm
        self._timing, self._echo, self.adapter = timing, echo, adapter
        self._handed_over: deque[Frame] = deque()
        self._free_at: defaultdict[int, float] = defaultdict(float)
        self._order = itertools.count()
        # In the order of their times, as the bus carries one frame after the other.
        self._echoes: deque[Frame] = deque()
        self._replies: list[tuple[float, int, int, Frame]] = []

    def send(self, frame: Frame) -> None:
        """Put a frame on the bus; the arm gets it when its last bit is through."""
        end = max(self.clock.now(), self._free_at[frame.bus]) + self._timing.frame_time
        self._free_at[frame.bus] = end
        if self._echo:
            self._echoes.append(frame._replace(time=end, echo=True))
        for reply in self.arm.handle(frame, end):
            ready = end + _TURNAROUND
            heapq.heappush(self._replies, (ready, reply.id, next(self._order), reply))

    def receive(self, until: float) -> Frame | None:
        """Return the next frame that is through by ``until`` [s], or None at that time."""
        while (answer := self._next_answer(until)) is not None:
            last = self._handed_over[-1].time if self._handed_over else 0.0
            ready = max(answer.time + self.adapter(), last)
            self._handed_over.append(answer._replace(time=ready))
        queues = [queue for queue in (self._echoes, self._handed_over) if queue]
        first = min(queues, key=lambda queue: queue[0].time, default=None)
        if first is None or first[0].time > until:
            self.clock.sleep_until(until)
            return None
        self.clock.sleep_until(first[0].time)
        return first.popleft()

    def _next_answer(self, until: float) -> Frame | None:
        """Take the next answer that is through on the wire by ``until`` [s]."""
        if not self._replies:
            return None
        bus = self._replies[0][-1].bus
        arrival = max(self._replies[0][0], self._free_at[bus]) + self._timing.frame_time
        if arrival > until:
            return None
        reply = heapq.heappop(self._replies)[-1]
        self._free_at[bus] = arrival
        unreadable = reply.fd and not self._timing.fd
        return reply._replace(
            time=arrival, error=unreadable, data=b"" if unreadable else reply.data
        )

    def close(self) -> None:
        """Nothing to release."""


_TICK = 1e-3
_MOST_BEHIND = 0.1


def serve(arm: SimulatedArm, link: Link, clock: Clock, running: Callable[[], bool]) -> float:
    """Let the arm live and answer until ``running`` says no; return the time it left out [s].

    A computer too slow for the physics makes the arm skip time rather than fall behind for ever.
    """
    start, left_out = clock.now() - arm.time, 0.0
    while running():
        frame = link.receive(clock.now() + _TICK)
        now = clock.now() - start
        if now - arm.time > _MOST_BEHIND:
            left_out += now - arm.time
            arm.skip_to(now)
        arm.advance(now)
        if frame is not None and not frame.echo:
            for reply in arm.handle(frame, now):
                link.send(reply)
    return left_out

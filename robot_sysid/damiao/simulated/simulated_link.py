"""A simulated arm on a bus: in simulated time, exact and without waiting, or in real time.

In real time it may sit behind a pseudo-terminal that acts as a serial CAN adapter. Whoever opens
its device (python-can's slcan interface, for instance) talks to this process; nothing leaves the
computer. Needs a Unix system.

The slcan protocol is lines of text that end with a carriage return: ``tIIILDD..`` is a classic
frame (id, length, data), ``d`` a CAN-FD frame, ``b`` one with bit-rate switch; O, L, C, S, Y, s set
the adapter up.
"""

from __future__ import annotations

import heapq
import itertools
import os
import re
import select
from collections import defaultdict, deque
from collections.abc import Callable

from robot_sysid.damiao.bus.link import Clock, Link, LinkError, SimulatedClock
from robot_sysid.damiao.protocol.frames import BusTiming, Frame
from robot_sysid.damiao.simulated.arm import SimulatedArm
from robot_sysid.errors import InputError

_TURNAROUND = 50e-6


class SimulatedLink:
    """Carries frames one after the other, each as long as its bits take.

    A burst of commands goes out before any reply, because commands have the lower ids. A classic
    host sees an error frame where a motor answers in CAN-FD. The clock is moved by waiting.

    With ``echo`` each sent frame is reported back when it was on the bus, as SocketCAN does.
    """

    def __init__(
        self, clock: SimulatedClock, arm: SimulatedArm, timing: BusTiming, echo: bool = False
    ) -> None:
        self.clock, self.arm = clock, arm
        self._timing, self._echo = timing, echo
        self._free_at: defaultdict[int, float] = defaultdict(float)
        self._order = itertools.count()
        # In the order of their times, as the bus carries one frame after the other.
        self._echoes: deque[Frame] = deque()
        self._answers: deque[Frame] = deque()
        self._replies: list[tuple[float, int, int, Frame]] = []

    def send(self, frame: Frame) -> None:
        """Put a frame on the bus; the arm gets it when its last bit is through."""
        end = max(self.clock.now(), self._free_at[frame.bus]) + self._timing.frame_time
        self._free_at[frame.bus] = end
        if self._echo:
            self._echoes.append(frame._replace(time=end, echo=True))
        for reply in self.arm.handle(frame, end):
            heapq.heappush(self._replies, (end + _TURNAROUND, reply.id, next(self._order), reply))

    def receive(self, until: float) -> Frame | None:
        """Return the next frame that is through by ``until`` [s], or None at that time."""
        while (answer := self._next_answer(until)) is not None:
            self._answers.append(answer)
        queues = [queue for queue in (self._echoes, self._answers) if queue]
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
        garbled = reply.fd and not self._timing.fd
        return reply._replace(time=arrival, error=garbled, data=b"" if garbled else reply.data)

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
            arm.time = now
        arm.advance(now)
        if frame is not None and not frame.echo:
            for reply in arm.handle(frame, now):
                link.send(reply)
    return left_out


class SlcanTerminal:
    """The adapter's end of the line, as a link; ``device`` is what to give to ``--channel``."""

    def __init__(self, clock: Clock) -> None:
        try:
            import tty
        except ImportError:
            raise InputError("pseudo-terminals need a Unix system") from None
        self._clock = clock
        # The far end stays open here too, so that a client may come and go.
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        self.device = os.ttyname(self._far)
        self._text = b""
        self._frames: list[Frame] = []

    def receive(self, until: float) -> Frame | None:
        """Return the next frame, or None at ``until`` [s]."""
        while not self._frames:
            left = max(until - self._clock.now(), 0.0)
            readable, _, _ = select.select([self._near], [], [], left)
            if not readable:
                return None
            self._take(os.read(self._near, 4096))
        return self._frames.pop(0)

    def send(self, frame: Frame) -> None:
        """Write a frame; one that nobody reads is dropped, as on a bus."""
        self._write(line_from_frame(frame).encode() + END)

    def close(self) -> None:
        """Close the terminal."""
        os.close(self._near)
        os.close(self._far)

    def _take(self, data: bytes) -> None:
        *lines, self._text = (self._text + data).split(END)
        for line in lines:
            frame = frame_from_line(line.decode("ascii", errors="replace"))
            if frame is None:
                self._write(END)
            else:
                self._frames.append(frame._replace(time=self._clock.now()))

    def _write(self, data: bytes) -> None:
        try:
            os.write(self._near, data)
        except BlockingIOError:
            return  # a full buffer: nobody has the terminal open
        except OSError as error:
            raise LinkError(f"the pseudo-terminal is closed: {error.strerror}") from error


END = b"\r"


def frame_from_line(line: str) -> Frame | None:
    """Return the frame that a line stands for, or None where it is a set-up command or broken."""
    parts = re.match("([tdb])([0-9A-Fa-f]{3})([0-8])([0-9A-Fa-f]*)", line)
    digits = parts[4][: 2 * int(parts[3])] if parts else ""
    if parts is None or len(digits) != 2 * int(parts[3]):
        return None
    return Frame(int(parts[2], 16), bytes.fromhex(digits), fd=parts[1] != "t")


def line_from_frame(frame: Frame) -> str:
    """Return the line for a frame of up to eight bytes."""
    kind = "b" if frame.fd else "t"
    return f"{kind}{frame.id:03X}{len(frame.data):X}{frame.data.hex().upper()}"

"""Running a simulated arm in real time behind any link."""

from __future__ import annotations

from collections.abc import Callable

from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.bus.link import Link
from robot_sysid.damiao.simulated.arm import SimulatedArm

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

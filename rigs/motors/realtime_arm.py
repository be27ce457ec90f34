"""A simulated arm in real time behind a pseudo-terminal that acts as a serial CAN adapter.

    python -m rigs.motors.realtime_arm TRAJECTORY --model MODEL [--joint NAME] [--watchdog S]

It prints ``--channel DEVICE`` for the program that plays on it, and when it is ended how timely it
was. With ``--truth FILE`` it is written where the arm was: rows of time, number of enabled motors
and positions.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import re
import select
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from robot_sysid.damiao.adapters import BusLink, read_in_pieces
from robot_sysid.damiao.bus import SystemClock, undisturbed_processor
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.simulated import SimulatedArm, simulated_motor
from robot_sysid.damiao.trajectory import read_damiao_trajectory
from robot_sysid.parser import load_robot_model
from robot_sysid.simulation.plant import ArmStepper

NEEDS_TERMINALS = pytest.mark.skipif(
    not hasattr(os, "openpty"), reason="needs pseudo-terminals"
)


class NearEnd:
    """A pseudo-terminal, used by python-can in place of a serial port.

    Attributes:
        device: path at which another program opens the far end.
    """

    timeout = write_timeout = 0.0
    in_waiting = 0

    def __init__(self):
        # Unix only.
        import tty

        # The far end stays open here too, so that a client may come and go.
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        self.device = os.ttyname(self._far)

    def read(self, size):
        """Return all bytes that have come; for a ``size`` of 1 wait for the first one."""
        ready = select.select([self._near], [], [], size * self.timeout)[0]
        return os.read(self._near, 4096) if ready else b""

    def write(self, data):
        """Write bytes, or drop them where the far end is full because nobody reads it."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._near, data)

    def flush(self):
        """Do nothing, because ``write`` holds nothing back."""

    def close(self):
        """Close both ends."""
        os.close(self._near)
        os.close(self._far)


def slcan_terminal():
    """Return a python-can bus behind a pseudo-terminal, and the path of its device.

    A program that opens the device with python-can's slcan interface exchanges frames with this
    bus.
    """
    from can.interfaces.slcan import slcanBus

    class Terminal(slcanBus):
        """The adapter's end of a line: frames are the same text both ways, commands are ignored."""

        def _recv_internal(self, timeout):
            """Return the next frame and False (not filtered); None as frame for half a line."""
            with contextlib.suppress(ValueError, IndexError):
                return super()._recv_internal(timeout)
            return None, False

    # python-can opens a serial port that leads nowhere, which the pseudo-terminal then replaces.
    bus = Terminal("loop://", sleep_after_open=0)
    line = NearEnd()
    bus.serialPortOrig = line
    read_in_pieces(bus)
    return bus, line.device


_TICK = 1e-3
"""Time to wait for a frame before the physics are advanced [s]: one step of the physics."""
_SAME_CYCLE = 2e-4
"""Time to wait for another frame of the same control cycle before the physics are advanced [s]."""
_LONGEST_CYCLE = 4e-3
"""Delay of the physics after which they are advanced even if more frames are waiting [s]."""
_MOST_BEHIND = 0.1
"""Delay of the physics after which time is skipped [s]: the watchdogs have expired by then."""


@dataclass
class ServiceReport:
    """How a simulated arm in real time kept up with the clock.

    Attributes:
        left_out: total time that was skipped because the simulation was too slow [s].
        longest_delay: longest time between two checks for a received frame [s].
    """

    left_out: float = 0.0
    longest_delay: float = 0.0


def serve(arm, link, clock, goes_on):
    """Simulate an arm in real time and answer the frames on a link; return how timely this was.

    A computer that is too slow makes the arm skip time instead of falling behind more and more.

    Args:
        arm: arm to simulate.
        link: link on which commands are received and answered.
        clock: clock of the link.
        goes_on: called in each cycle; the simulation ends when it returns False.
    """
    report = ServiceReport()
    step = arm.mechanism.timestep
    patience = _TICK
    with undisturbed_processor(clock.live):
        looked_at = clock.now()
        # Clock time at the arm's time zero; ``now`` is the clock time in the arm's time.
        start = looked_at - arm.time
        while goes_on():
            # The waiting time begins now, so that there is some even where the physics are too
            # slow: a block with real-time priority has to wait now and then.
            frame = link.receive(clock.now() + patience)
            moment = clock.now()
            report.longest_delay = max(report.longest_delay, moment - looked_at)
            looked_at = moment
            now = moment - start
            if now - arm.time > _MOST_BEHIND:
                report.left_out += now - arm.time
                arm.time = now
            if frame is None or now - arm.time > _LONGEST_CYCLE:
                # Only whole steps: advancing to the moment of each frame would need twice as many.
                arm.advance(arm.time + math.floor((now - arm.time) / step) * step)
            if frame is not None and not frame.echo:
                for reply in arm.answers(frame, now):
                    link.send(reply)
            patience = _TICK if frame is None else _SAME_CYCLE
    return report


@contextlib.contextmanager
def arm_process(arguments: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Start an arm behind a pseudo-terminal; yield its device and its closing lines."""
    command = [sys.executable, "-m", "rigs.motors.realtime_arm", *arguments]
    arm = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    output: list[str] = []
    try:
        device = None
        while device is None:
            line = arm.stdout.readline()
            if not line:
                raise SystemExit(f"no simulated arm: {' '.join(command)}")
            device = re.search(r"--channel (\S+)", line)
        yield device[1], output
    finally:
        arm.terminate()
        output += arm.communicate()[0].splitlines()


def main():
    """Serve the arm of a model that stands at a trajectory's first point until it is ended."""
    parser = argparse.ArgumentParser()
    parser.add_argument("trajectory", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--joint")
    parser.add_argument("--watchdog", type=float, default=0.1)
    parser.add_argument("--truth", type=Path)
    options, _ = parser.parse_known_args()
    played = read_damiao_trajectory(options.trajectory)
    robot = load_robot_model(options.model, joint=options.joint)
    motors = [simulated_motor(joint, options.watchdog) for joint in played.joints]
    arm = SimulatedArm(ArmStepper(robot, played.q[0], _TICK), motors)
    clock = SystemClock()
    terminal, device = slcan_terminal()
    stop = StopRequest()
    bus = BusLink(terminal, clock)
    truth = []

    def goes_on():
        enabled = sum(motor.drives for motor in motors)
        truth.append([clock.now(), enabled, *arm.mechanism.q])
        return not stop.reason

    with contextlib.closing(bus), stop.on_signals():
        print(f"--channel {device}", flush=True)
        report = serve(arm, bus, clock, goes_on)
    if options.truth is not None:
        np.savetxt(options.truth, truth)
    if report.left_out > 0.0:
        print(f"this computer was too slow by {report.left_out:.1f} s in all")
    print(f"kept commands waiting for up to {1e3 * report.longest_delay:.0f} ms")


if __name__ == "__main__":
    main()

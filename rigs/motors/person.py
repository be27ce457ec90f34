"""A person beside an arm on simulated motors, who does what the commands on motors ask for."""

from __future__ import annotations

import builtins
import contextlib
import re
import sys
import threading
import time
from collections.abc import Iterator
from unittest import mock

import numpy as np

from rigs.motors.damiao_rig import MotorBus
from robot_sysid.commands.motors import limp
from robot_sysid.commands.motors.stops import HELD_LOOKS
from robot_sysid.records import RobotModel

TURN = 0.5
"""Angle by which a person turns a joint to show it [rad]."""
STALE_TIME = 0.1
"""Time within which the last answers to a program come [s]."""


def wait_for_looks(bus: MotorBus) -> None:
    """Wait until all motors were looked at often enough at the same angles, or are not any more."""
    # Each look asks all motors; the first one may have begun before.
    enough = len(bus.wire.sent) + len(bus.motors) * (HELD_LOOKS + 2)
    while len(bus.wire.sent) < enough:
        if limp.FOLLOWER not in [thread.name for thread in threading.enumerate()]:
            return
        time.sleep(1e-3)


class Person:
    """Moves the arm on a bus, and types.

    Args:
        bus: with the motors.
        robot: model of the arm.
    """

    def __init__(self, bus: MotorBus, robot: RobotModel) -> None:
        self._bus = bus
        self._robot = robot
        self._mechanism = bus.arm.mechanism

    @contextlib.contextmanager
    def at_terminal(self) -> Iterator[None]:
        """Bring the arm into the model's own pose, support it, and answer what a block asks."""
        # A bus that is opened anew has no answers to the last program.
        while self._bus.wire.receive(self._bus.clock.now() + STALE_TIME) is not None:
            pass
        self._bus.arm.was_enabled = False
        self._rest()
        is_there = mock.patch.object(sys.stdin, "isatty", lambda: True)
        with is_there, mock.patch.object(builtins, "input", self.answer):
            yield

    def answer(self, prompt: str) -> str:
        """Do what a prompt asks for; return what is typed then."""
        names = list(self._robot.joint_names)
        turned = re.search(r"move joint (\S+) alone", prompt)
        if turned:
            return self._turn(names.index(turned[1]))
        pushed = re.match(r"push joint (\S+) slowly", prompt)
        if pushed:
            self._push(names.index(pushed[1]))
            return ""
        if prompt.startswith("put the arm into the model's own pose"):
            self._rest()
            return ""
        assert "ype yes" in prompt, prompt
        return "yes"

    def _rest(self) -> None:
        """Bring the arm to rest in the model's own pose."""
        self._mechanism.q = np.array(self._robot.reference)
        self._mechanism.qd = np.zeros(self._robot.n_joints)

    def _turn(self, joint: int) -> str:
        """Turn a joint, the opposite way where it stands at its upper end; return what to type."""
        q = self._mechanism.q
        if q[joint] + TURN <= self._robot.limits.upper[joint]:
            q[joint] += TURN
            return "yes"
        q[joint] -= TURN
        return "opposite"

    def _push(self, joint: int) -> None:
        """Push a joint to both its stops, and hold it there; then bring it back."""
        limits = self._robot.limits
        ends = limits.lower[joint], limits.upper[joint]
        for angle in (*ends, self._robot.reference[joint]):
            self._mechanism.q[joint] = angle
            wait_for_looks(self._bus)

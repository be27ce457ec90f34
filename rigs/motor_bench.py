"""Motors on a simulated bus and one program that talks to them, below the level of a run."""

from __future__ import annotations

import contextlib

import numpy as np

from rigs.clocks import ScriptedClock
from rigs.damiao_rig import Pendulums, motor
from rigs.links import RememberingLink
from robot_sysid.damiao.bus import GuardedLink, RegisterClient
from robot_sysid.damiao.joints import MOTORS, damiao_joints
from robot_sysid.damiao.protocol import BusTiming, MitCommand, Scaling
from robot_sysid.damiao.safety.guards import Replies
from robot_sysid.damiao.session import MotorSession
from robot_sysid.damiao.simulated import SimulatedArm, SimulatedLink
from robot_sysid.records import Limits

SPEC = MOTORS["DM4340"]


class Bench:
    """Motors of one type, and everything that talks to them."""

    def __init__(self, n=2, echo=False):
        joints = damiao_joints(["DM4340"] * n, n)
        self.motors = [motor(joint) for joint in joints]
        self.clock = ScriptedClock()
        self.arm = SimulatedArm(Pendulums(n), self.motors)
        bus = SimulatedLink(self.clock, self.arm, BusTiming(), echo)
        self.bus = RememberingLink(bus, self.clock)
        self.link = GuardedLink(self.bus, self.clock)
        self.client = RegisterClient(self.link)
        far = np.full(n, 99.0)
        anywhere = Limits(-far, far, far)
        scaling = Scaling([SPEC.limits] * n)
        self.session = MotorSession(self.link, joints, scaling, anywhere)

    @contextlib.contextmanager
    def enabled(self):
        """Enable the motors for a block."""
        with self.session:
            self.session.enable()
            yield

    def wait(self, seconds):
        """Let time [s] pass."""
        self.clock.sleep_until(self.clock.now() + seconds)

    def exchange(self, q=0.0, kp=20.0, seconds=0.004, joints=True):
        """Command joints, or all, to q [rad] and return their replies of so many seconds."""
        until = self.clock.now() + seconds
        driven = np.broadcast_to(joints, len(self.motors))
        return self.session.exchange(self.command(q, kp), until, driven, braking=False)

    def command(self, q=0.0, kp=20.0):
        n = len(self.motors)
        full = np.full(n, 1.0)
        return MitCommand(q * full, 0 * full, kp * full, full, 0 * full)


def undoubted(answered, time, feedback, requested, command=None):
    """Replies in a cycle in which nothing was doubted, surplus or foreign."""
    no_count = np.zeros(len(answered), int)
    counts = no_count != 0, 0.0 * no_count, no_count, no_count
    return Replies(answered, time, feedback, requested, command, *counts)

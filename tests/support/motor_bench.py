"""Motors on a simulated bus and one program that talks to them, below the level of a run."""

from __future__ import annotations

import numpy as np

from robot_sysid.damiao.bus.inspection import RegisterClient
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.exchange.session import MotorSession
from robot_sysid.damiao.protocol.codec import MitCommand, Scaling
from robot_sysid.damiao.protocol.frames import BusTiming
from robot_sysid.damiao.protocol.joints import damiao_joints
from robot_sysid.damiao.protocol.motors import MOTORS
from robot_sysid.damiao.simulated.arm import SimulatedArm, simulated_motor
from robot_sysid.damiao.simulated.simulated_link import SimulatedLink
from tests.support.clocks import ScriptedClock
from tests.support.damiao_rig import Pendulums
from tests.support.links import RememberingLink

SPEC = MOTORS["DM4340"]


class Bench:
    """Motors of one type, and everything that talks to them."""

    def __init__(self, n=2, echo=False):
        self.motors = [simulated_motor(SPEC, i + 1, i + 17) for i in range(n)]
        self.clock = ScriptedClock()
        self.arm = SimulatedArm(Pendulums(n), self.motors)
        bus = SimulatedLink(self.clock, self.arm, BusTiming(), echo)
        self.bus = RememberingLink(bus, self.clock)
        self.link = GuardedLink(self.bus, self.clock.now)
        self.client = RegisterClient(self.link, self.clock)
        self.session = MotorSession(
            self.link,
            self.clock,
            damiao_joints(["DM4340"] * n, n),
            Scaling.from_limits([SPEC.limits] * n),
            half_step=True,
        )

    def command(self, q=0.0, kp=20.0):
        n = len(self.motors)
        full = np.full(n, 1.0)
        return MitCommand(q * full, 0 * full, kp * full, full, 0 * full)

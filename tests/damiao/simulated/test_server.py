"""Serving a simulated arm, in simulated time."""

from __future__ import annotations

import pytest

from robot_sysid.damiao.bus.clock import SimulatedClock
from robot_sysid.damiao.protocol.frames import (
    Address,
    Frame,
    disable_frame,
    enable_frame,
    refresh_frame,
)
from robot_sysid.damiao.simulated.simulated_link import serve
from tests.support.damiao_rig import two_motor_arm


class FarEnd:
    """The arm's end of a bus: frames that come at given times, and what was answered."""

    def __init__(self, clock, *arrivals):
        self._clock, self._arrivals = clock, list(arrivals)
        self.answers = []

    def receive(self, until):
        if self._arrivals and self._arrivals[0][0] <= until:
            moment, frame = self._arrivals.pop(0)
            self._clock.sleep_until(moment)
            return frame
        self._clock.sleep_until(until)
        return None

    def send(self, frame):
        self.answers.append((self._clock.now(), frame.id))


def served(clock, far, arm, seconds):
    return serve(arm, far, clock, lambda: clock.now() < seconds)


def test_each_frame_is_answered_when_it_comes():
    clock, arm = SimulatedClock(), two_motor_arm()
    far = FarEnd(
        clock,
        (0.1, refresh_frame(Address(0, 1))),
        (0.2, refresh_frame(Address(0, 2))),
        (0.3, refresh_frame(Address(0, 3))),
    )
    assert served(clock, far, arm, 1.0) == 0.0
    assert far.answers == [(0.1, 17), (0.2, 18)]
    assert arm.time == pytest.approx(1.0, abs=2e-3)


def test_an_echo_is_no_question():
    clock, arm = SimulatedClock(), two_motor_arm()
    far = FarEnd(clock, (0.1, enable_frame(Address(0, 1))._replace(echo=True)))
    served(clock, far, arm, 1.0)
    assert far.answers == [] and not arm.motors[0].driving


def test_watchdogs_expire_while_nobody_talks():
    clock, arm = SimulatedClock(), two_motor_arm(watchdog=0.1)
    far = FarEnd(clock, (0.1, enable_frame(Address(0, 1))), (0.3, disable_frame(Address(0, 2))))
    served(clock, far, arm, 0.15)
    assert arm.motors[0].driving
    served(clock, far, arm, 0.3)
    assert not arm.motors[0].driving


def test_a_computer_that_falls_behind_leaves_time_out_instead_of_catching_up():
    clock, arm = SimulatedClock(), two_motor_arm()
    far = FarEnd(clock, (0.1, enable_frame(Address(0, 1))), (0.11, Frame(99, bytes(8))))
    ordinary, steps = far.receive, []
    arm.mechanism.step, step = lambda *law: steps.append(0) or step(*law), arm.mechanism.step

    def paused(until):
        if 0.5 < clock.now() < 0.6:
            clock.sleep_until(5.0)
        return ordinary(until)

    far.receive = paused
    assert served(clock, far, arm, 6.0) == pytest.approx(5.0 - 0.5, abs=5e-3)
    assert arm.time == pytest.approx(6.0, abs=2e-3)
    # Physics ran from enabling to the pause and after it, in steps of a millisecond.
    assert len(steps) == pytest.approx(1000 * (0.4 + 1.0), abs=10)

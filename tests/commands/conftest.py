"""What the tests of several commands share."""

from __future__ import annotations

import pytest

from rigs.clocks import ScriptedClock, heard_signals
from rigs.damiao_rig import two_motor_arm
from rigs.links import RememberingLink
from robot_sysid.damiao import execution
from robot_sysid.damiao.simulated import SimulatedLink
from robot_sysid.motion.prediction import limit_lines, motion_lines
from robot_sysid.pipeline import planning


@pytest.fixture
def without_prediction(monkeypatch):
    """Plans say what they do beside their limits, not what an estimate will know: that is slow."""

    def predict_plan(config, checked):
        motion = checked.problem, checked.plan, checked.check
        return None, [*limit_lines(*motion), *motion_lines(*motion)]

    monkeypatch.setattr(planning, "predict_plan", predict_plan)
    monkeypatch.setattr(planning, "_shortfall", lambda *_: "")


class SimulatedBus:
    """A bus with a simulated arm on it, which the command opens in place of a real one.

    Attributes:
        arm: who answers.
        clock: simulated time, also that of the command.
        wire: the frames of the last link that was opened, or None.
    """

    def __init__(self, monkeypatch):
        self.arm = two_motor_arm()
        self.clock = ScriptedClock()
        self.wire = None
        monkeypatch.setattr(execution, "SystemClock", lambda: self.clock)
        monkeypatch.setattr(execution, "open_bus", self.open_link)

    def open_link(self, address, timing, clock):
        link = SimulatedLink(self.clock, self.arm, timing, echo=True)
        self.wire = RememberingLink(link, self.clock)
        return self.wire

    @property
    def motors(self):
        return self.arm.motors


@pytest.fixture
def person(monkeypatch):
    """(what a person at the keyboard says, callables are called; what was asked)."""
    answers = []
    prompts = []

    def say(prompt):
        prompts.append(prompt)
        answer = answers.pop(0)
        return answer() or "" if callable(answer) else answer

    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", say)
    return answers, prompts


@pytest.fixture
def bus(monkeypatch):
    with heard_signals():
        yield SimulatedBus(monkeypatch)

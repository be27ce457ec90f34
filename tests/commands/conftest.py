"""What the tests of several commands share."""

from __future__ import annotations

import pytest

from rigs.arms import small_arms
from rigs.files.command_line import MotorsCommandLine
from rigs.motors.clocks import heard_signals
from rigs.motors.damiao_rig import MotorBus


@pytest.fixture
def model(arm_file):
    """A model of an arm of two joints."""
    return arm_file(small_arms.serial_arm((small_arms.Z, small_arms.Y)))


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
def bus():
    """Two motors."""
    with heard_signals():
        yield MotorBus(watchdog=0.5, echo=True)


@pytest.fixture
def motors(capsys, bus):
    """The commands on motors, which find those of the bus in place of real ones."""
    return MotorsCommandLine(capsys, bus.equipment)

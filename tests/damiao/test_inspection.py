"""Asking motors: registers, and who is there."""

from __future__ import annotations

import pytest

from robot_sysid.damiao.inspection import inspect_bus
from robot_sysid.damiao.protocol import frames
from robot_sysid.damiao.protocol.frames import DISABLED, REGISTER_ID, Address, Frame
from robot_sysid.errors import HardwareAbort
from tests.support.motor_bench import Bench


def test_inspection_reads_everything_and_changes_nothing():
    bench = Bench()
    before = [dict(m.registers) for m in bench.motors]
    found = inspect_bus(bench.link)
    assert sorted(found.motors) == [(0, 1), (0, 2)]
    assert set(found.motors[0, 1].registers) == set(frames.LOGGED)
    assert found.motors[0, 2].limits == (12.5, 10.0, 28.0)
    assert found.motors[0, 2].feedback.temperature_mos[0] == 31
    assert [m.registers for m in bench.motors] == before
    assert [m.status for m in bench.motors] == [DISABLED] * 2
    assert {frame.id for frame in bench.bus.sent} == {REGISTER_ID}


def test_a_refused_write_is_noticed():
    bench = Bench()
    with pytest.raises(HardwareAbort, match="motor 1 refused OC_Value = 0.5 and keeps 0.8"):
        bench.client.write(Address(0, 1), 3, 0.5)


def test_a_motor_that_is_not_there_does_not_answer():
    bench = Bench()
    assert bench.client.read(Address(0, 9), frames.PMAX) is None
    with pytest.raises(HardwareAbort, match="motor 9 did not answer to writing TIMEOUT"):
        bench.client.write(Address(0, 9), frames.TIMEOUT, 1.0)


def test_feedback_is_not_taken_for_a_register_reply():
    """A joint at -11.9 rad sends the bytes that begin some register's reply."""
    bench = Bench()
    ours = bench.arm.handle

    def with_feedback_first(frame, time):
        feedback = Frame(17, bytes([0x01, 0x00, 0x33, 0x07, 0x80, 0x00, 30, 30]))
        return [feedback, *ours(frame, time)]

    bench.arm.handle = with_feedback_first
    assert bench.client.read(Address(0, 1), frames.PMAX).value == 12.5

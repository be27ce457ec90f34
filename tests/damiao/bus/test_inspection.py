"""Inspecting motors has no effect on them."""

from __future__ import annotations

from robot_sysid.damiao.bus.inspection import inspect_bus
from robot_sysid.damiao.protocol import registers as reg
from robot_sysid.damiao.protocol.frames import REGISTER_ID
from robot_sysid.damiao.protocol.registers import DISABLED, ENABLED
from tests.support.motor_bench import Bench


def test_inspection_reads_everything_and_changes_nothing():
    bench = Bench()
    before = [dict(m.registers) for m in bench.motors]
    found = inspect_bus(bench.link, bench.clock)
    assert sorted(found.motors) == [(0, 1), (0, 2)]
    assert set(found.motors[0, 1].registers) == set(reg.LOGGED)
    assert found.motors[0, 2].limits == (12.5, 10.0, 28.0)
    assert found.motors[0, 2].feedback.temperature_mos[0] == 31
    assert [m.registers for m in bench.motors] == before
    assert [m.status for m in bench.motors] == [DISABLED] * 2
    assert {frame.id for frame in bench.bus.sent} == {REGISTER_ID}


def test_inspection_does_not_disturb_a_motor_that_somebody_uses():
    bench = Bench()
    bench.motors[0].status = ENABLED
    bench.motors[0].registers[reg.TIMEOUT] = 0.0
    inspect_bus(bench.link, bench.clock)
    assert bench.motors[0].status == ENABLED

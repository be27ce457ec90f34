"""The deadlines of control cycles."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.player import CycleTimer
from robot_sysid.errors import HardwareAbort
from tests.support.clocks import ScriptedClock


@given(st.lists(st.floats(0.0, 0.03), min_size=1, max_size=60))
def test_deadlines_stay_on_one_grid_and_lateness_does_not_add_up(delays):
    clock = ScriptedClock()
    timer = CycleTimer(clock, 0.004, 1.0)
    start = timer.next_deadline
    last = -1.0
    for delay in delays:
        deadline = timer.wait()
        cycle = (deadline - start) / 0.004
        assert cycle == pytest.approx(round(cycle), abs=1e-6)
        assert deadline > last and 0.0 <= clock.now() - deadline < 0.004 + 1e-9
        last = deadline
        clock.stall(delay)
    assert round((last - start) / 0.004) == len(delays) - 1 + timer.skipped


def test_too_late_stops_unless_told_otherwise():
    clock = ScriptedClock()
    timer = CycleTimer(clock, 0.004, 0.02)
    timer.wait()
    clock.stall(0.05)
    with pytest.raises(
        HardwareAbort, match="46.0 ms late for a control cycle, limit 20 ms"
    ):
        timer.wait()
    clock.stall(0.05)
    timer.wait(lenient=True)
    assert timer.lateness(100.0) == pytest.approx(0.048, abs=2.1e-3)

"""Time of the plant's closed loop: fifteen seconds of a seven-joint arm at 1 kHz."""

from __future__ import annotations

from tests.support import arms
from tests.support.closed_loop import ClosedLoop
from tests.support.closed_loop_proof import excitation, plant_from, record_run


def test_fifteen_seconds_of_seven_joints_at_1_khz(benchmark):
    robot = arms.robot_of(arms.serial_arm(arms.SEVEN_AXES))
    loop = ClosedLoop(plant_from(robot), excitation(robot), 1000.0)
    log = benchmark.pedantic(record_run, (loop,), rounds=3)
    assert len(log) == 15_001

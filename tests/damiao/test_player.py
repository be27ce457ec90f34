"""The cycle timer, requests to stop, and what is fed."""

from __future__ import annotations

import signal
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.arms.wrong_arms import resting_torque
from rigs.motors.clocks import ScriptedClock
from rigs.motors.fault_bench import BenchRun, SetUp
from rigs.motors.recordings import read_recording
from robot_sysid.damiao.player import CycleTimer, StopRequest
from robot_sysid.damiao.settings import RecordingOptions
from robot_sysid.errors import STOP_SIGNALS, SUSPENSION, HardwareAbort

NAMES = [number.name for number in (*STOP_SIGNALS, *SUSPENSION)]


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
    assert max(timer.lateness) == pytest.approx(0.048, abs=2.1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_signals_are_wishes_inside_the_block_only(name, heard):
    number = getattr(signal, name)
    stop = StopRequest()
    with stop.on_signals():
        signal.raise_signal(number)
        signal.raise_signal(number)
    assert signal.getsignal(number) is signal.default_int_handler
    assert (stop.reason, stop.insisted) == (f"stopped by {name}", False)


@pytest.mark.parametrize("name", NAMES)
def test_what_nohup_or_a_shell_makes_a_process_ignore_stays_ignored(name, heard):
    number = getattr(signal, name)
    stop = StopRequest()
    signal.signal(number, signal.SIG_IGN)
    with stop.on_signals():
        signal.raise_signal(number)
    assert stop.reason == "" and signal.getsignal(number) is signal.SIG_IGN


@pytest.mark.parametrize(("later", "insisted"), [(0.1, False), (0.3, True)])
def test_only_ctrl_c_again_insists_and_not_one_that_came_twice(later, insisted, heard):
    times = iter((5.0, 5.0 + later))
    stop = StopRequest(now=lambda: next(times))
    with stop.on_signals():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
    assert stop.insisted == insisted


def test_a_soft_arm_is_fed_the_weight_of_the_pose_in_which_it_is(tmp_path):
    """Fed that of the reference's pose, it would lose stiffness by what it weighs more there."""
    setup = SetUp(kp=60.0, stands=True, duration=1.0, rate=100.0)
    run = BenchRun(setup)
    path = tmp_path / "measured.csv"
    run.plan = replace(run.plan, recording=RecordingOptions(record=path))
    run.run()
    assert run.error is None
    log = read_recording(path)
    measured = log.joint_values("pos")[20:-1]
    fed = log.joint_values("cmd_tau")[21:]
    robot = setup.robot
    weight = resting_torque(robot, measured, robot.thetas)
    planned = resting_torque(robot, run.plan.trajectory.q[:1], robot.thetas)
    rounding = 0.06
    assert np.abs(fed - weight).max() < rounding
    assert np.abs(fed - planned).max() > 5.0 * rounding

"""What stops a run: a wish, a deadline, a sample out of order, numbers that mean something else."""

from __future__ import annotations

import signal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.player import CycleTimer
from robot_sysid.damiao.protocol.codec import Feedback, MitCommand
from robot_sysid.damiao.protocol.frames import BusTiming
from robot_sysid.damiao.protocol.joints import damiao_joints
from robot_sysid.damiao.session import NO_STATUS, Replies
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.damiao.supervision import (
    StopRequest,
    Supervisor,
    TorqueScalingCheck,
    VelocityScalingCheck,
)
from robot_sysid.errors import HardwareAbort
from robot_sysid.interrupts import STOPPING
from tests.support.clocks import ScriptedClock


@pytest.mark.parametrize("name", [number.name for number in STOPPING])
def test_signals_are_wishes_inside_the_block_only(name, heard):
    number, stop = getattr(signal, name), StopRequest()
    with stop.on_signals():
        signal.raise_signal(number)
        signal.raise_signal(number)
    assert signal.getsignal(number) is signal.default_int_handler
    assert (stop.count, stop.reason, stop.insisted) == (2, f"stopped by {name}", False)


@pytest.mark.parametrize("name", [number.name for number in STOPPING])
def test_what_nohup_or_a_shell_makes_a_process_ignore_stays_ignored(name, heard):
    number, stop = getattr(signal, name), StopRequest()
    signal.signal(number, signal.SIG_IGN)
    with stop.on_signals():
        signal.raise_signal(number)
    assert stop.count == 0 and signal.getsignal(number) is signal.SIG_IGN


@pytest.mark.parametrize(("later", "insisted"), [(0.1, False), (0.3, True)])
def test_only_ctrl_c_again_insists_and_not_one_that_came_twice(later, insisted, heard, monkeypatch):
    now = iter((5.0, 5.0 + later))
    monkeypatch.setattr("time.monotonic", lambda: next(now))
    stop = StopRequest()
    with stop.on_signals():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
    assert (stop.count, stop.insisted) == (2, insisted)


# --- deadlines ----------------------------------------------------------------------------------


@given(st.lists(st.floats(0.0, 0.03), min_size=1, max_size=60))
def test_deadlines_stay_on_one_grid_and_lateness_does_not_add_up(delays):
    clock = ScriptedClock()
    timer = CycleTimer(clock, 0.004, 1.0)
    start, last = timer.next_deadline, -1.0
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
    with pytest.raises(HardwareAbort, match="46.0 ms late for a control cycle, limit 20 ms"):
        timer.wait()
    clock.stall(0.05)
    timer.wait(lenient=True)
    assert timer.lateness(100.0) == pytest.approx(0.048, abs=2.1e-3)


# --- one sample after the other -----------------------------------------------------------------

JOINTS = damiao_joints(["DM4340"] * 2, 2)
STEP = np.array([0.1, 0.1])


def supervisor(**settings):
    settings = PlaySettings(max_torque_error=(5.0, 7.0), **settings)
    return Supervisor(JOINTS, settings.for_motors([j.spec for j in JOINTS], BusTiming()), STEP)


def sample(time=0.0, q=0.0, qd=0.0, tau=0.0, status=1, mos=30, rotor=30, answered=True):
    """What two joints answer: the first as it should, the second these values."""
    two = [np.array([usual, odd]) for usual, odd in ((0, q), (0, qd), (0, tau))]
    codes = [np.array([usual, odd]) for usual, odd in ((1, status), (30, mos), (30, rotor))]
    if not answered:
        for values in two:
            values[1] = np.nan
        codes[0][1] = NO_STATUS
    stamps = np.where([True, answered], time, np.nan)
    feedback = Feedback(np.array([1, 2]), codes[0], *two, *codes[1:])
    return Replies(np.array([True, answered]), stamps, feedback, np.ones(2, bool))


def told(*samples, asked=(0.0, 0.0, 0.0), how=(), **settings):
    """What a supervisor says to samples under one command of the second joint, or None."""
    watched = supervisor(**settings)
    p, v, t = (np.array([0.0, value]) for value in asked)
    try:
        for replies in samples:
            watched.update(replies)
            watched.check(replies, MitCommand(p, v, 0 * p, 0 * p, t), *how)
    except HardwareAbort as stopped:
        return str(stopped)
    return None


def test_while_gains_rise_a_new_load_is_judged_by_how_far_the_arm_sinks():
    """It swings about where it will settle; a rated 9 N m sink it by 0.05 rad, two stop it."""
    swings, sinks = sample(q=-0.09, tau=20.0), sample(q=-0.11, tau=5.0)
    assert told(swings, how=(True, True)) is None
    assert "N m off its torque, limit 7" in told(swings, how=(True,))
    assert "-0.110 rad off" in told(sinks, how=(True, True))


WITHIN = 1.0 - 1e-6
BEYOND = 1.0 + 1e-6
# Commanded values at which nothing but what is tested can be out of order.
LIMITS = (
    (lambda x: ([sample(q=0.2 * x)], (0.0, 0.0, 0.0)), "motor 2 is 0.200 rad off its path"),
    (lambda x: ([sample(q=-0.2 * x)], (0.0, 0.0, 0.0)), "motor 2 is 0.200 rad off its path"),
    # One rad/s and two steps of the velocity channel.
    (lambda x: ([sample(qd=2.0 + 1.2 * x)], (0.0, 2.0, 0.0)), "1.200 rad/s off its speed"),
    (lambda x: ([sample(qd=2.0 - 1.2 * x)], (0.0, 2.0, 0.0)), "1.200 rad/s off its speed"),
    (lambda x: ([sample(tau=3.0 + 7.0 * x)], (0.0, 0.0, 3.0)), "7.000 N m off its torque, limit 7"),
    (lambda x: ([sample(mos=80 + (x > 1.0))], (0.0, 0.0, 0.0)), "is at 81 deg C, limit 80"),
    (lambda x: ([sample(rotor=80 + (x > 1.0))], (0.0, 0.0, 0.0)), "is at 81 deg C, limit 80"),
    (lambda x: ([sample(status=1 if x < 1.0 else 0)], (0.0, 0.0, 0.0)), "reports status 0"),
    # Standing still: 0.05 rad, and half of 200 rad/s^2 over the time squared.
    (
        lambda x: ([sample(), sample(0.01, q=0.06 * x)], (0.0, 0.0, 0.0)),
        "motor 2 jumped by 0.060 rad",
    ),
    # From 1.1 rad/s to rest within 0.1 s: the way is 0.055 rad by the mean of both speeds, and half
    # of that, 0.05 rad and 1 rad from what the acceleration may be are left to it.
    (
        lambda x: (
            [sample(q=-0.6, qd=1.1), sample(0.1, q=-0.6 + 0.055 + (0.05 + 0.0275 + 1.0) * x)],
            (-0.6, 1.1, 0.0),
        ),
        "motor 2 jumped by 1.078 rad",
    ),
)


@pytest.mark.parametrize(("case", "words"), LIMITS)
def test_each_limit_holds_to_a_millionth(case, words):
    for share in (WITHIN, BEYOND):
        samples, asked = case(share)
        # Where a joint jumps, its path and its speed are not what is looked at.
        free = {"max_tracking_error": 9.0, "max_speed_error": 9.0} if "jump" in words else {}
        said = told(*samples, asked=asked, **free)
        assert (said is None) == (share < 1.0), said
    assert words in said
    assert said.startswith("motor 2")


@pytest.mark.parametrize(
    ("asked", "cycles", "words"),
    [(True, 3, "motor 2 did not answer in time for 3 cycles"), (False, 6, "in time for 6 cycles")],
)
def test_a_motor_may_be_silent_for_so_long_and_no_longer(asked, cycles, words):
    """Three commands without an answer, or six cycles where it was not commanded."""
    gap = sample(answered=False)
    gap = Replies(gap.answered, gap.time, gap.feedback, np.array([True, asked]))
    assert told(*[gap] * (cycles - 1)) is None
    assert told(*[gap] * (cycles - 1), sample(), *[gap] * (cycles - 1)) is None
    assert words in told(*[gap] * cycles)


def test_what_a_run_was_like_is_counted():
    watched, still = supervisor(), MitCommand(*[np.zeros(2)] * 5)
    for replies in (sample(q=0.1), sample(1, 0.04), sample(answered=False), sample(status=0xA)):
        watched.update(replies)
        if replies.feedback.status[1] != 0xA:
            watched.check(replies, still)
    np.testing.assert_allclose(watched.worst_tracking, [0.0, 0.1])
    assert watched.total_missed.tolist() == [0, 1] and watched.failed.tolist() == [False, True]


# --- scales -------------------------------------------------------------------------------------


def watched_swing(factor, noise=0.0, step=0.005, gone=0.0, fades=1e-6):
    """A check that has seen two joints swing for six seconds, with velocities of another scale."""
    rng = np.random.default_rng(0)
    check = VelocityScalingCheck(np.full(2, step), np.full(2, fades))
    for t in np.arange(0.0, 6.0, 0.004):
        time = t + np.array([0.0, 1e-4])
        time[:] = np.nan if t > 0.1 and rng.uniform() < gone else time
        qd = np.floor(2 * np.cos(2 * time) * factor / step) * step + 0.5 * step
        check.add(time, np.sin(2 * time), qd + noise * rng.uniform(-1, 1, 2))
    return check


@pytest.mark.parametrize("factor", [0.8, 0.95, 1.05, 1.25])
def test_a_wrong_velocity_scale_is_found(factor):
    joint, slope = watched_swing(factor).worst()
    assert slope == pytest.approx(1.0 / factor, abs=2e-3) and joint in (0, 1)


@pytest.mark.parametrize(
    "options",
    [
        *({"factor": factor, "noise": 0.02} for factor in (0.98, 1.0, 1.02)),
        {"factor": 1.0, "gone": 0.2},
        # Steps of 1 rad/s, as one motor type has them, at a peak speed of 2 rad/s.
        {"factor": 0.9, "step": 1.0},
    ],
)
def test_a_right_one_or_one_that_is_too_coarse_to_judge_is_left_alone(options):
    assert watched_swing(**options).worst() is None


@pytest.mark.parametrize("fades", [0.05, 0.2, 0.8, 1.5])
@pytest.mark.parametrize("lag", [0.02, 0.1, 0.5, 3.0])
def test_a_joint_that_slows_down_within_a_cycle_is_not_taken_for_one_of_another_scale(fades, lag):
    """One that is held to commands: dv/dt = (v_des + k (p_des - p) - v) / lag, seen at the end."""
    cycle = 0.01
    p, v, target, check = 0.0, 0.0, 0.0, VelocityScalingCheck(np.full(1, 1e-4), np.array([fades]))
    # Position and velocity behind the command after one cycle, by the exponential of the equation.
    rates = np.array([[0.0, 1.0], [-fades / lag, -1.0 / lag]]) / 400
    step = np.linalg.matrix_power(np.eye(2) + rates + rates @ rates / 2, 400)
    for n in range(600):
        speed = 1.0 + 0.5 * np.sin(0.02 * n)
        target += speed * cycle
        rest = target + speed * cycle / fades
        away = step @ [(p - rest) / cycle, v]
        p, v = rest + away[0] * cycle, away[1]
        check.add(np.full(1, n * cycle), np.full(1, p), np.full(1, v))
    assert check.worst() is None


@pytest.mark.parametrize("ratio", [0.8, 0.87, 1.13, 1.2, -1.0])
def test_a_motor_that_reports_another_torque_than_it_was_told_to_make_is_found(ratio):
    """By more than 15 %, from what it does slowly, and not before it is clear."""
    peak = np.array([27.0, 27.0])
    check, wrong = TorqueScalingCheck(0.01 * peak / 27, peak), abs(ratio - 1.0) > 0.15
    for k in range(30):
        tau = np.array([2.0, 5.0 + 0.1 * k])
        check.add(tau, tau * [1.0, ratio], np.zeros(2))
        # Fast, or beyond what the motor can do: says nothing.
        check.add(tau, 9 * tau, np.full(2, 0.11))
        check.add(20 * tau, tau, np.zeros(2))
        found = check.worst()
        assert (found is not None) == (wrong and k >= 24)
    assert found is None or (found[0] == 1 and found[1] == pytest.approx(ratio))

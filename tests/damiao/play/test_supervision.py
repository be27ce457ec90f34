"""References, deadlines, settings and the velocity check: the parts of a player."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.bus.clock import SimulatedClock, SystemClock
from robot_sysid.damiao.play.cycle_timer import Metronome
from robot_sysid.damiao.play.player import StopRequest
from robot_sysid.damiao.play.sampler import (
    Reference,
    TrajectorySampler,
    approach,
    come_to_rest,
    hold,
)
from robot_sysid.damiao.play.settings import PlaySettings, default_gains, per_joint
from robot_sysid.damiao.play.supervision import VelocityScalingCheck
from robot_sysid.damiao.protocol.motors import MOTORS
from robot_sysid.damiao.trajectory.csv_file import (
    export_damiao_trajectory,
    read_damiao_trajectory,
    scan_trajectory,
)
from robot_sysid.errors import HardwareAbort, InputError
from tests.support.damiao_rig import swing

ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=7)


def exported(tmp_path, motion):
    path = tmp_path / "t.csv"
    export_damiao_trajectory([motion], ["DM4340"] * motion[1].shape[1], path)
    return read_damiao_trajectory(path)


# --- references ---------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [1.0, 0.3])
def test_the_sampler_interpolates_and_scales_velocity_with_speed(tmp_path, speed):
    time, q, qd, tau = swing(3)
    sampler = TrajectorySampler(exported(tmp_path, (time, q, qd, tau)), speed)
    for moment in np.arange(0.0, 2.0 / speed, 0.0137):
        reference = sampler(moment)
        for got, wanted in zip(reference, (q, speed * qd, tau)):
            expected = [np.interp(moment * speed, time, column) for column in wanted.T]
            np.testing.assert_allclose(got, expected, rtol=0, atol=6e-5)


def test_the_sampler_holds_the_end(tmp_path):
    time, q, qd, tau = swing(2)
    sampler = TrajectorySampler(exported(tmp_path, (time, q, qd, tau)))
    np.testing.assert_allclose(sampler(5.0).position, q[-1], atol=6e-5)


@given(start=ANGLES, data=st.data(), speed=st.floats(0.05, 2.0), shortest=st.floats(0.1, 3.0))
def test_an_approach_goes_from_rest_to_rest_within_its_speed(start, data, speed, shortest):
    start = np.array(start)
    target = np.array([data.draw(st.floats(-3.0, 3.0)) for _ in start])
    tau = np.ones_like(start)
    path, duration = approach(start, Reference(target, 0 * start, tau), speed, shortest)
    assert duration >= shortest
    for moment, q in ((-1.0, start), (0.0, start), (duration, target), (duration + 1.0, target)):
        np.testing.assert_allclose(path(moment).position, q, atol=1e-12)
        np.testing.assert_allclose(path(moment).velocity, 0.0, atol=1e-12)
    times = np.linspace(0.0, duration, 201)
    q = np.array([path(t).position for t in times])
    qd = np.array([path(t).velocity for t in times])
    assert np.max(np.abs(qd)) <= speed * (1 + 1e-9)
    middle = 0.5 * (qd[1:] + qd[:-1])
    step = duration / 200
    np.testing.assert_allclose(np.diff(q, axis=0), middle * step, atol=1e-3 * speed * step + 1e-9)


@given(q=ANGLES, data=st.data(), deceleration=st.floats(0.5, 50.0))
def test_braking_is_continuous_and_ends_at_rest(q, data, deceleration):
    q = np.array(q)
    v = np.array([data.draw(st.floats(-3.0, 3.0)) for _ in q])
    path, duration = come_to_rest(Reference(q, v, 0 * q), deceleration)
    np.testing.assert_allclose(path(0.0).position, q, atol=1e-12)
    if duration > 0.0:
        np.testing.assert_allclose(path(0.0).velocity, v, atol=1e-12)
    end = path(duration + 1.0)
    np.testing.assert_allclose(end.velocity, 0.0, atol=1e-12)
    np.testing.assert_allclose(end.position, q + 0.5 * v * duration, atol=1e-9)
    assert duration == pytest.approx(np.max(np.abs(v)) / deceleration)


def test_holding_is_at_rest():
    still = hold(Reference(np.ones(2), np.ones(2), np.ones(2)))(3.0)
    assert still.velocity.tolist() == [0.0, 0.0] and still.position.tolist() == [1.0, 1.0]


# --- scan ---------------------------------------------------------------------------------------


@given(rows=st.integers(2, 30), seed=st.integers(0, 1000))
def test_a_scan_finds_the_extremes(rows, seed, tmp_path_factory):
    rng = np.random.default_rng(seed)
    q, qd, tau = np.round(rng.uniform(-5, 5, (3, rows, 2)), 4)
    scan = scan_trajectory(
        exported(tmp_path_factory.mktemp("scan"), (0.01 * np.arange(rows), q, qd, tau))
    )
    assert scan.samples == rows and scan.duration == pytest.approx(0.01 * (rows - 1))
    np.testing.assert_allclose(scan.first, q[0])
    np.testing.assert_allclose(scan.peak_position, np.abs(q).max(axis=0))
    np.testing.assert_allclose(scan.peak_velocity, np.abs(qd).max(axis=0))
    np.testing.assert_allclose(scan.peak_torque, np.abs(tau).max(axis=0))
    np.testing.assert_allclose(scan.peak_step, np.abs(np.diff(q, axis=0)).max(axis=0) / 0.01)
    np.testing.assert_allclose(scan.end_velocity, np.maximum(np.abs(qd[0]), np.abs(qd[-1])))


def test_a_scan_sees_jumps_between_its_pieces(tmp_path):
    rows = 4097
    q = np.zeros((rows, 1))
    q[4096] = 0.5
    scan = scan_trajectory(exported(tmp_path, (0.01 * np.arange(rows), q, 0 * q, 0 * q)))
    assert scan.peak_step[0] == pytest.approx(50.0)


def test_one_row_cannot_be_played(tmp_path):
    one = np.zeros((1, 1))
    with pytest.raises(InputError, match="at least two rows"):
        scan_trajectory(exported(tmp_path, (np.zeros(1), one, one, one)))


# --- deadlines ----------------------------------------------------------------------------------


@given(st.lists(st.floats(0.0, 0.03), min_size=1, max_size=60))
def test_deadlines_stay_on_one_grid_and_lateness_does_not_add_up(delays):
    clock = SimulatedClock()
    metronome = Metronome(clock, 0.004, 1.0)
    start, last = metronome.next_deadline, -1.0
    for delay in delays:
        deadline = metronome.wait()
        cycle = (deadline - start) / 0.004
        assert cycle == pytest.approx(round(cycle), abs=1e-6)
        assert deadline > last and 0.0 <= clock.now() - deadline < 0.004 + 1e-9
        last = deadline
        clock.stall(delay)
    assert round((last - start) / 0.004) == len(delays) - 1 + metronome.skipped


def test_too_late_stops_unless_told_otherwise():
    clock = SimulatedClock()
    metronome = Metronome(clock, 0.004, 0.02)
    metronome.wait()
    clock.stall(0.05)
    with pytest.raises(HardwareAbort, match="46.0 ms late for a control cycle, limit 20 ms"):
        metronome.wait()
    clock.stall(0.05)
    metronome.wait(lenient=True)
    assert metronome.lateness(100.0) == pytest.approx(0.048, abs=2.1e-3)


def test_callbacks_run_when_the_simulated_clock_passes_them():
    clock, seen = SimulatedClock(), []
    for moment in (0.3, 0.1, 0.2):
        clock.at(moment, lambda: seen.append(round(clock.now(), 6)))
    clock.sleep_until(0.25)
    assert seen == [0.1, 0.2] and clock.now() == 0.25


def test_the_system_clock_sleeps_until_the_moment():
    clock = SystemClock()
    start = clock.now()
    clock.sleep_until(start + 0.01)
    assert clock.now() - start >= 0.01
    clock.sleep_until(start)


# --- velocity check -----------------------------------------------------------------------------


def slopes(factor, seconds=6.0, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    check = VelocityScalingCheck(np.full(2, 0.005))
    for t in np.arange(0.0, seconds, 0.004):
        time = t + np.array([0.0, 1e-4])
        q, qd = np.sin(2 * time), 2 * np.cos(2 * time) * factor
        check.add(time, q, qd + noise * rng.uniform(-1, 1, 2) + 0.01)
    return check


@pytest.mark.parametrize("factor", [0.8, 0.95, 1.05, 1.25])
def test_a_wrong_velocity_scale_is_found(factor):
    joint, slope = slopes(factor).worst()
    assert slope == pytest.approx(1.0 / factor, abs=2e-3) and joint in (0, 1)


@pytest.mark.parametrize("factor", [0.98, 1.0, 1.02])
def test_a_right_one_is_left_alone(factor):
    assert slopes(factor, noise=0.02).worst() is None


def test_without_motion_nothing_is_judged():
    check = VelocityScalingCheck(np.full(1, 0.005))
    for t in np.arange(0.0, 5.0, 0.004):
        check.add(np.array([t]), np.zeros(1), np.full(1, 0.01))
    assert check.worst() is None


def test_a_velocity_channel_too_coarse_to_judge_is_left_alone():
    """Steps of 1 rad/s, as one motor type has them, at a peak speed of 2 rad/s."""
    check = VelocityScalingCheck(np.ones(1))
    for t in np.arange(0.0, 6.0, 0.004):
        check.add(np.array([t]), np.sin(2 * np.array([t])), np.floor(2 * np.cos([2 * t])) + 0.5)
    assert check.worst() is None


def test_missing_samples_do_not_spoil_the_check():
    rng = np.random.default_rng(0)
    check = VelocityScalingCheck(np.full(1, 0.005))
    for t in np.arange(0.0, 6.0, 0.004):
        gone = t > 0.1 and rng.uniform() < 0.2
        value = np.nan if gone else t
        check.add(
            np.array([value]), np.array([np.sin(2 * value)]), np.array([2 * np.cos(2 * value)])
        )
    assert check.slopes()[0][0] == pytest.approx(1.0, abs=1e-3)


# --- settings -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(MOTORS))
def test_default_gains_are_valid_for_every_type(name):
    kp, kd = default_gains([MOTORS[name]])
    PlaySettings(kp, kd)
    assert kp[0] > 0 and kd[0] > 0


@pytest.mark.parametrize(
    ("values", "expected"),
    [(None, [1.0, 2.0]), ([], [1.0, 2.0]), ([5.0], [5.0, 5.0]), ([5.0, 6.0], [5.0, 6.0])],
)
def test_gains_come_as_none_one_or_all(values, expected):
    assert per_joint(values, np.array([1.0, 2.0]), "--kp").tolist() == expected


@pytest.mark.parametrize("field", ["rate", "speed", "max_temperature", "max_lateness", "kp"])
@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_settings_that_are_no_positive_numbers_are_refused(field, bad):
    values = {"kp": np.ones(1), "kd": np.ones(1), field: bad}
    with pytest.raises(InputError, match="must be"):
        PlaySettings(**values)


def test_the_first_reason_to_stop_is_kept():
    stop = StopRequest()
    stop("first")
    stop("second")
    assert (stop.count, stop.reason) == (2, "first")

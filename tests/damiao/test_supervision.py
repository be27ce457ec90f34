"""What stops a run: a wish, or numbers that mean something else."""

from __future__ import annotations

import signal

import numpy as np
import pytest

from robot_sysid.damiao.supervision import StopRequest, VelocityScalingCheck

SIGNALS = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


def test_the_first_reason_to_stop_is_kept():
    stop = StopRequest()
    stop("first")
    stop("second")
    assert (stop.count, stop.reason) == (2, "first")


@pytest.mark.parametrize("name", SIGNALS)
def test_signals_are_wishes_inside_the_block_only(name):
    number, stop = getattr(signal, name), StopRequest()
    before = signal.getsignal(number)
    with stop.on_signals():
        signal.raise_signal(number)
        signal.raise_signal(number)
    assert signal.getsignal(number) is before
    assert (stop.count, stop.reason) == (2, f"stopped by {name}")


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

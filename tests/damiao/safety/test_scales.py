"""Whether velocities and torques are scaled as registers say."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.damiao.safety.guards import TorqueScalingCheck, VelocityScalingCheck


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
def test_a_joint_that_slows_down_within_a_cycle_is_not_taken_for_one_of_another_scale(
    fades, lag
):
    """One that is held to commands: dv/dt = (v_des + k (p_des - p) - v) / lag, seen at the end."""
    cycle = 0.01
    p = 0.0
    v = 0.0
    target = 0.0
    check = VelocityScalingCheck(np.full(1, 1e-4), np.array([fades]))
    # Position and velocity behind the command after one cycle, by the exponential of the equation.
    rates = np.array([[0.0, 1.0], [-fades / lag, -1.0 / lag]]) / 400
    step = np.linalg.matrix_power(np.eye(2) + rates + rates @ rates / 2, 400)
    for n in range(600):
        speed = 1.0 + 0.5 * np.sin(0.02 * n)
        target += speed * cycle
        last_speed = target + speed * cycle / fades
        away = step @ [(p - last_speed) / cycle, v]
        p = last_speed + away[0] * cycle
        v = away[1]
        check.add(np.full(1, n * cycle), np.full(1, p), np.full(1, v))
    assert check.worst() is None


@pytest.mark.parametrize("ratio", [0.8, 0.87, 1.13, 1.2, -1.0])
def test_a_motor_that_reports_another_torque_than_it_was_told_to_make_is_found(ratio):
    """By more than 15 %, from what it does slowly, and not before it is clear."""
    peak = np.array([27.0, 27.0])
    check = TorqueScalingCheck(0.01 * peak / 27, peak)
    is_wrong = abs(ratio - 1.0) > 0.15
    for k in range(30):
        tau = np.array([2.0, 5.0 + 0.1 * k])
        check.add(tau, tau * [1.0, ratio], np.zeros(2))
        # Fast, or beyond what the motor can do: says nothing.
        check.add(tau, 9 * tau, np.full(2, 0.11))
        check.add(20 * tau, tau, np.zeros(2))
        worst = check.worst()
        assert (worst is not None) == (is_wrong and k >= 24)
    assert worst is None or (worst[0] == 1 and worst[1] == pytest.approx(ratio))


@pytest.mark.parametrize("speed", [-0.3, 0.3])
@pytest.mark.parametrize("fades", [1e-6, 0.05])
def test_a_joint_that_slips_is_found_within_two_windows(speed, fades):
    check = VelocityScalingCheck(np.full(2, 0.005), np.full(2, fades))
    slips = []
    for t in np.arange(0.0, 0.4, 0.004):
        q = np.sin(2.0 * t) + np.array([0.0, speed * t])
        slips.append(check.add(np.full(2, t), q, np.full(2, 2.0 * np.cos(2.0 * t))))
    slip = next(slip for slip in slips if slip is not None)
    assert slip.joint == 1
    assert slip.speed == pytest.approx(speed, rel=0.3 if fades < 0.1 else 0.8)

"""Laws of mean torques: what held commands amount to at low frequencies."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.damiao.protocol import Feedback, MitCommand
from robot_sysid.damiao.recorder import Centring, SamplingRipple
from robot_sysid.damiao.session import Replies

PERIOD = 0.01


def replies_of(q, qd, time, command):
    """The answers of a cycle, in which the motors took a new command."""
    n = len(q)
    codes = np.zeros(n, int)
    nothing = np.zeros(n)
    answered = np.isfinite(q)
    feedback = Feedback(codes, codes, q, qd, nothing, codes, codes)
    return Replies(answered, time, feedback, answered, command)


def stiff(position, kp=100.0, kd=2.0):
    """A command to be at positions (n,)."""
    zero = np.zeros_like(position)
    return MitCommand(position, zero, zero + kp, zero + kd, zero)


def test_a_joint_that_holds_still_gets_the_mean_of_held_commands():
    """The fundamental of a held sine lags by half a period and is lower by sinc."""
    frequency = 5.0
    kp = 100.0
    count = 400
    angular = 2.0 * np.pi * frequency
    centring = Centring(PERIOD)
    zero = np.zeros(1)
    times = PERIOD * np.arange(count)
    positions = np.sin(angular * times)
    torques = [
        centring.torques(
            replies_of(zero, zero, zero + time, stiff(positions[k + 1 : k + 2], kp)),
            stiff(positions[k : k + 1], kp),
        )[1][0]
        + kp * positions[k]
        for k, time in enumerate(times[1:-1] + 0.0)
    ]
    # Row k was sampled when command k + 1 arrived.
    middles = times[1:-1] - 0.5 * PERIOD
    expected = kp * np.sinc(frequency * PERIOD) * np.sin(angular * middles)
    error = np.max(np.abs(np.array(torques) - expected)[2:]) / kp
    half_step_only = (angular * PERIOD) ** 2 / 12.0
    assert error < 0.25 * half_step_only


def one_period(mobility, stiffness, damping, torques, start):
    """Positions and velocities (2, n) after each short step of a period of held torques."""
    h = PERIOD / len(torques)
    n = len(start[0])
    resistance = 0.5 * h * mobility * (damping + 0.5 * h * stiffness)
    next_step = np.linalg.inv(np.eye(n) + resistance)
    previous_step = np.eye(n) - resistance
    q, v = start
    states = []
    for torque in torques:
        earlier = v
        v = next_step @ (previous_step @ v + h * mobility @ (torque - stiffness * q))
        q = q + 0.5 * h * (earlier + v)
        states.append((q, v))
    return np.array(states)


def sampled_ripple(mobility, stiffness, damping, step, growth, time):
    """Positions and velocities of the motion that sawteeth of torque make and that recurs."""
    fine = 2000
    n = len(step)
    share = ((np.arange(fine)[:, None] + 0.5) / fine - time / PERIOD) % 1.0
    torques = step * (0.5 - share) + 0.5 * growth * (share**2 - share + 1.0 / 6.0)
    arm = mobility, stiffness, damping
    from_rest = one_period(*arm, torques, np.zeros((2, n)))[-1].ravel()
    units = np.eye(2 * n).reshape(-1, 2, n)
    carried = np.array(
        [one_period(*arm, 0.0 * torques, unit)[-1].ravel() for unit in units]
    ).T
    start = np.linalg.lstsq(np.eye(2 * n) - carried, from_rest, rcond=1e-12)[0].reshape(
        2, n
    )
    states = one_period(*arm, torques, start)
    at = np.round(time / PERIOD * fine).astype(int) - 1
    sampled = states[at, :, np.arange(n)].T
    return sampled[0] - np.mean(states[:, 0], axis=0), sampled[1]


@pytest.mark.parametrize("stiffness", [0.0, 100.0, 1000.0])
@pytest.mark.parametrize("damping", [0.05, 1.0, 20.0])
def test_ripple_is_the_periodic_response_to_steps_at_their_moments(damping, stiffness):
    mobility = np.linalg.inv([[0.05, 0.01], [0.01, 0.008]])
    viscous = np.array([0.02, 0.3])
    kd = damping * np.array([1.0, 0.4])
    kp = stiffness * np.array([1.0, 0.6])
    step = np.array([0.7, -0.4])
    time = np.array([0.001, 0.0025])
    growth = np.array([0.1, 0.3])
    ripple = SamplingRipple(lambda q: mobility, viscous)
    expected = sampled_ripple(mobility, kp, kd + viscous, step, growth, time)
    command = MitCommand(*np.zeros((2, 2)), kp, kd, np.zeros(2))
    computed = ripple.motion(np.zeros(2), command, step, growth, time, PERIOD)
    for values, integrated in zip(computed, expected):
        np.testing.assert_allclose(
            values, integrated, atol=2e-3 * np.max(np.abs(values))
        )


def test_a_step_leaves_a_twelfth_of_its_impulse_where_nothing_damps():
    ripple = SamplingRipple(lambda q: np.array([[4.0]]), np.zeros(1))
    zero = np.zeros(1)
    free = stiff(zero, 0.0, 0.0)
    _, velocity = ripple.motion(zero, free, np.array([0.6]), zero, zero, PERIOD)
    assert velocity[0] == pytest.approx(-0.6 * PERIOD * 4.0 / 12.0, rel=1e-3)


def test_a_model_without_inertia_tells_nothing_of_ripple():
    ripple = SamplingRipple(lambda q: np.full((1, 1), np.inf), np.zeros(1))
    zero = np.zeros(1)
    command = stiff(np.zeros(1))
    motion = ripple.motion(zero, command, np.ones(1), zero, zero, PERIOD)
    np.testing.assert_array_equal(motion, 0.0)


def test_a_missing_answer_leaves_the_other_joints_torques_as_they_are():
    """A joint that is silent for a cycle, or from the first on, makes holes for itself alone."""
    ripple = SamplingRipple(lambda q: np.diag([20.0, 30.0]), np.zeros(2))
    time = np.array([0.0, 0.001])
    for silent_cycles in ({2}, {0}, {0, 1, 2, 3}):
        centring = Centring(PERIOD, ripple)
        for k in range(4):
            silent = np.array([False, k in silent_cycles])
            q = np.where(silent, np.nan, 0.0)
            stamps = np.where(silent, np.nan, time + k * PERIOD)
            acted = stiff(np.full(2, 0.01 * k))
            sent = stiff(np.full(2, 0.01 * (k + 1)))
            step, centre = centring.torques(replies_of(q, q, stamps, sent), acted)
            np.testing.assert_array_equal(np.isfinite(centre), ~silent)
            assert centre[0] == pytest.approx(0.5 * step[0], rel=0.2)


@pytest.mark.parametrize(("kp", "kd"), [(0.0, 0.0), (0.0, 2.0), (1.0, 4.0)])
def test_gains_that_leave_two_modes_in_one_spoil_no_sample(kp, kd):
    """None at all, or critical damping: kd^2 = 4 kp inertia."""
    ripple = SamplingRipple(lambda q: np.array([[0.25]]), np.zeros(1))
    one = np.ones(1)
    added = ripple.motion(
        0.0 * one, stiff(0.0 * one, kp, kd), one, one, 0.0 * one, PERIOD
    )
    assert np.all(np.isfinite(added)) and np.max(np.abs(added)) < 1e-3

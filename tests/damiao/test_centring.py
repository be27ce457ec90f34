"""Laws of mean torques: what held commands amount to at low frequencies."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.damiao.centring import Centring, SamplingRipple
from robot_sysid.damiao.protocol.codec import Feedback, MitCommand
from robot_sysid.damiao.session import Replies

PERIOD = 0.01


def replies_of(q, qd, time, command):
    """The answers of a cycle, in which the motors took a new command."""
    n = len(q)
    codes, nothing = np.zeros(n, int), np.zeros(n)
    answered = np.isfinite(q)
    feedback = Feedback(codes, codes, q, qd, nothing, codes, codes)
    return Replies(answered, time, feedback, answered, command)


def stiff(position, kp=100.0, kd=2.0):
    """A command to be at positions (n,)."""
    still = np.zeros_like(position)
    return MitCommand(position, still, still + kp, still + kd, still)


def test_a_joint_that_holds_still_gets_the_mean_of_held_commands():
    """The fundamental of a held sine lags by half a period and is lower by sinc."""
    frequency, kp, count = 5.0, 100.0, 400
    angular = 2.0 * np.pi * frequency
    centring, still = Centring(PERIOD), np.zeros(1)
    times = PERIOD * np.arange(count)
    positions = np.sin(angular * times)
    torques = [
        centring.torques(
            replies_of(still, still, still + time, stiff(positions[k + 1 : k + 2], kp)),
            stiff(positions[k : k + 1], kp),
        )[1][0]
        + kp * positions[k]
        for k, time in enumerate(times[1:-1] + 0.0)
    ]
    # Row k was sampled when command k + 1 arrived.
    after = times[1:-1] - 0.5 * PERIOD
    expected = kp * np.sinc(frequency * PERIOD) * np.sin(angular * after)
    error = np.max(np.abs(np.array(torques) - expected)[2:]) / kp
    half_step_only = (angular * PERIOD) ** 2 / 12.0
    assert error < 0.25 * half_step_only


def sampled_ripple(mobility, damping, step, time, period):
    """Positions and velocities by integration of sawteeth of torque, until they repeat."""
    fine = 2000
    h, n = period / fine, len(step)
    q, v, mean, sampled = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((2, n))
    at = np.round(time / h).astype(int)
    matrix = np.eye(n) + 0.5 * h * mobility * damping
    before = np.eye(n) - 0.5 * h * mobility * damping
    for k in range(12 * fine):
        share = ((k + 0.5) * h - time) / period % 1.0
        sampled = np.where(k % fine == at, [q, v], sampled)
        earlier = v
        v = np.linalg.solve(matrix, before @ v + h * mobility @ (step * (0.5 - share)))
        q = q + 0.5 * h * (earlier + v)
        mean = q / fine if k % fine == 0 else mean + q / fine
    return sampled[0] - mean, sampled[1]


@pytest.mark.parametrize("damping", [0.05, 1.0, 20.0])
def test_ripple_is_the_periodic_response_to_steps_at_their_moments(damping):
    mobility = np.linalg.inv([[0.05, 0.01], [0.01, 0.008]])
    viscous, kd = np.array([0.02, 0.3]), damping * np.array([1.0, 0.4])
    step, time = np.array([0.7, -0.4]), np.array([0.001, 0.0025])
    ripple = SamplingRipple(lambda q: mobility, viscous)
    expected = sampled_ripple(mobility, kd + viscous, step, time, PERIOD)
    # Slow modes take long to forget that the first sawtooth began from rest.
    decays = np.linalg.eigvals(mobility * (kd + viscous)).real * PERIOD
    tolerance = 2e-3 + np.exp(-12.0 * np.min(decays))
    computed = ripple.motion(np.zeros(2), kd, step, time, PERIOD)
    for values, integrated in zip(computed, expected):
        np.testing.assert_allclose(values, integrated, atol=tolerance * np.max(np.abs(values)))


def test_a_step_leaves_a_twelfth_of_its_impulse_where_nothing_damps():
    ripple = SamplingRipple(lambda q: np.array([[4.0]]), np.zeros(1))
    still = np.zeros(1)
    _, velocity = ripple.motion(still, still, np.array([0.6]), still, PERIOD)
    assert velocity[0] == pytest.approx(-0.6 * PERIOD * 4.0 / 12.0, rel=1e-3)


def test_a_model_without_inertia_tells_nothing_of_ripple():
    ripple = SamplingRipple(lambda q: np.full((1, 1), np.inf), np.zeros(1))
    motion = ripple.motion(np.zeros(1), np.ones(1), np.ones(1), np.zeros(1), PERIOD)
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
            acted, sent = stiff(np.full(2, 0.01 * k)), stiff(np.full(2, 0.01 * (k + 1)))
            step, centre = centring.torques(replies_of(q, q, stamps, sent), acted)
            np.testing.assert_array_equal(np.isfinite(centre), ~silent)
            assert centre[0] == pytest.approx(0.5 * step[0], rel=0.2)

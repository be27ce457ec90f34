"""Velocities of a trajectory file that agree with its positions, and velocities that do not."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rigs.arms import SEEDS
from rigs.damiao_rig import rest_to_rest, trajectory_of
from robot_sysid.damiao.trajectory import velocity_mismatch

RATES = st.sampled_from([50.0, 100.0, 250.0, 500.0, 1000.0])


def smooth_motion(rate, seed, seconds=3.0):
    """(time, q, qd) of two joints from rest to rest, with up to 2 Hz in it."""
    rng = np.random.default_rng(seed)
    amplitude = rng.uniform(0.1, 0.6, (3, 1, 2)) * rng.choice([-1.0, 1.0], (3, 1, 2))
    turns = rng.integers(1, 7, (3, 1, 2))
    time, *signals = rest_to_rest(amplitude, turns, seconds, rate)
    q, qd, _ = np.sum(signals, axis=1)
    return time, q, qd


def mismatch(time, q, qd):
    return velocity_mismatch(trajectory_of((time, np.round(q, 4), np.round(qd, 4), q)))


def differences(time, q, method):
    slope = np.diff(q, axis=0) / np.diff(time)[:, None]
    zero = np.zeros((1, q.shape[1]))
    return np.vstack([slope, zero] if method == "forward" else [zero, slope])


@given(rate=RATES, seed=SEEDS, gap=st.booleans())
def test_a_derivative_and_a_difference_quotient_are_left_alone(rate, seed, gap):
    time, q, qd = smooth_motion(rate, seed)
    # A pause of the clock at the turning point, where the joints stand.
    time = time + 5.0 * gap * (time > 2.9999)
    for velocity in (
        qd,
        differences(time, q, "forward"),
        differences(time, q, "backward"),
    ):
        assert mismatch(time, q, velocity) is None


@given(rate=RATES, seed=SEEDS, factor=st.sampled_from([-1.0, 0.0, 0.8, 1.25, 57.3]))
def test_another_scale_or_sign_is_found(rate, seed, factor):
    time, q, qd = smooth_motion(rate, seed)
    qd = qd * [1.0, factor]
    assert mismatch(time, q, qd)[1] == 1


@given(rate=RATES, seed=SEEDS, share=st.floats(0.2, 0.8))
def test_a_jump_of_the_positions_is_found(rate, seed, share):
    time, q, qd = smooth_motion(rate, seed)
    row = round(share * len(time))
    q[row:, 0] += 0.02 if rate > 200.0 else 0.15
    first, joint, _ = mismatch(time, q, qd)
    assert joint == 0 and abs(first - row) <= 0.2 * rate + 8

"""Velocities of a trajectory file that agree with its positions, and velocities that do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.trajectory import NO_LIMITS, join_arms, limit_excesses
from robot_sysid.damiao.velocity_check import velocity_mismatch
from tests.support.damiao_rig import swing, trajectory_file

RATES = st.sampled_from([50.0, 100.0, 250.0, 500.0, 1000.0])


def smooth_motion(rate, seed, seconds=3.0):
    """(time, q, qd) of two joints from rest to rest, with up to 2 Hz in it."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate) + 1) / rate
    w = 2.0 * np.pi / seconds * rng.integers(1, 7, (3, 1, 2))
    a = rng.uniform(0.05, 0.3, (3, 1, 2)) * rng.choice([-1.0, 1.0], (3, 1, 2))
    phase = w * time[:, None]
    return (
        time,
        (a * (1.0 - np.cos(phase))).sum(axis=0),
        (a * w * np.sin(phase)).sum(axis=0),
    )


def mismatch(time, q, qd):
    return velocity_mismatch(time, np.round(q, 4), np.round(qd, 4))


def differences(time, q, method):
    slope = np.diff(q, axis=0) / np.diff(time)[:, None]
    zero = np.zeros((1, q.shape[1]))
    return np.vstack([slope, zero] if method == "forward" else [zero, slope])


@given(rate=RATES, seed=st.integers(0, 10**6), gap=st.booleans())
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


@given(
    rate=RATES,
    seed=st.integers(0, 10**6),
    factor=st.sampled_from([-1.0, 0.0, 0.8, 1.25, 57.3]),
)
def test_another_scale_or_sign_is_found(rate, seed, factor):
    time, q, qd = smooth_motion(rate, seed)
    qd = qd * [1.0, factor]
    assert mismatch(time, q, qd).joint == 1


@given(rate=RATES, seed=st.integers(0, 10**6), share=st.floats(0.2, 0.8))
def test_a_jump_of_the_positions_is_found(rate, seed, share):
    time, q, qd = smooth_motion(rate, seed)
    row = round(share * len(time))
    q[row:, 0] += 0.02 if rate > 200.0 else 0.15
    result = mismatch(time, q, qd)
    assert result.joint == 0 and abs(result.row - row) <= 0.2 * rate + 8


def test_velocities_of_a_joint_that_stands_are_found_with_their_row():
    time = np.arange(400) / 250.0
    q = np.zeros((400, 1))
    qd = np.zeros((400, 1))
    qd[100:200] = 9.0
    result = mismatch(time, q, qd)
    assert (result.row, result.joint, result.stated, result.slope) == (100, 0, 9.0, 0.0)


@pytest.mark.parametrize("start", [0.0, 0.5, 0.1233])
def test_what_is_wrong_in_one_of_two_files_is_found_whenever_its_time_begins(
    start, tmp_path
):
    """Moments that only rounding keeps apart would allow any slope, and any acceleration."""
    first = trajectory_file(tmp_path, swing(1))
    second = replace(first, time=first.time + start, qd=1.3 * first.qd)
    both = join_arms(first, second)
    np.testing.assert_allclose(both.time, first.time, atol=1e-12)
    np.testing.assert_allclose(both.q, np.hstack([first.q] * 2), atol=1e-12)
    assert velocity_mismatch(both.time, both.q, both.qd).joint == 1
    limits = replace(NO_LIMITS, max_acceleration=1.0)
    assert len([*limit_excesses(both, 1.0, limits)]) == 2
    slower = swing(1, 1.0, rate=110.0)
    mixed = join_arms(first, trajectory_file(tmp_path, slower))
    assert np.diff(mixed.time).min() > 0.0019 and mixed.time[-1] == 2.0
    assert velocity_mismatch(mixed.time, mixed.q, mixed.qd) is None

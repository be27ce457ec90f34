"""A velocity column that does not belong to its positions is found, one that does is left alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.trajectory.velocity_column import VelocityColumns

RATES = st.sampled_from([50.0, 100.0, 250.0, 500.0, 1000.0])


def motion(rate, seed, seconds=3.0):
    """(time, q, qd) of two joints from rest to rest, with up to 2 Hz in it."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate) + 1) / rate
    w = 2.0 * np.pi / seconds * rng.integers(1, 7, (3, 1, 2))
    a = rng.uniform(0.05, 0.3, (3, 1, 2)) * rng.choice([-1.0, 1.0], (3, 1, 2))
    phase = w * time[:, None]
    return time, (a * (1.0 - np.cos(phase))).sum(axis=0), (a * w * np.sin(phase)).sum(axis=0)


def mismatch(time, q, qd, pieces=1):
    columns = VelocityColumns()
    for rows in np.array_split(np.arange(len(time)), pieces):
        columns.add(time[rows], np.round(q[rows], 4), np.round(qd[rows], 4))
    return columns.mismatch


def differences(time, q, how):
    slope = np.diff(q, axis=0) / np.diff(time)[:, None]
    still = np.zeros((1, q.shape[1]))
    return np.vstack([slope, still] if how == "forward" else [still, slope])


@given(rate=RATES, seed=st.integers(0, 10**6), pieces=st.integers(1, 9))
def test_a_derivative_is_left_alone_however_the_file_is_read(rate, seed, pieces):
    assert mismatch(*motion(rate, seed), pieces) is None


@given(rate=RATES, seed=st.integers(0, 10**6), how=st.sampled_from(["forward", "backward"]))
def test_a_difference_quotient_is_left_alone(rate, seed, how):
    time, q, _ = motion(rate, seed)
    assert mismatch(time, q, differences(time, q, how)) is None


@given(rate=RATES, seed=st.integers(0, 10**6), factor=st.sampled_from([-1.0, 0.0, 0.8, 1.25, 57.3]))
def test_another_scale_or_sign_is_found(rate, seed, factor):
    time, q, qd = motion(rate, seed)
    qd = qd * [1.0, factor]
    assert mismatch(time, q, qd).joint == 1


@given(rate=RATES, seed=st.integers(0, 10**6), place=st.floats(0.2, 0.8), pieces=st.integers(1, 9))
def test_a_jump_of_the_positions_is_found(rate, seed, place, pieces):
    time, q, qd = motion(rate, seed)
    row = round(place * len(time))
    q[row:, 0] += 0.02 if rate > 200.0 else 0.15
    found = mismatch(time, q, qd, pieces)
    assert found.joint == 0 and abs(found.line - row) <= 0.2 * rate + 8


@pytest.mark.parametrize("pieces", [1, 3])
def test_velocities_of_a_joint_that_stands_are_found_with_their_line(pieces):
    time, q, qd = np.arange(400) / 250.0, np.zeros((400, 1)), np.zeros((400, 1))
    qd[100:200] = 9.0
    found = mismatch(time, q, qd, pieces)
    assert (found.line, found.joint, found.stated, found.shown) == (101, 0, 9.0, 0.0)

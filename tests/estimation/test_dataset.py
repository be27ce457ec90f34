"""Recordings: their blocks, their delay, and poses at which the arm rests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import (
    BLOCKS,
    LONGEST_STRETCH,
    Dataset,
    RestingPoses,
    block_masks,
)
from robot_sysid.records import Measurement
from tests.estimation.test_samples import random_samples
from tests.support.payload_logs import TrueArm, exact_recording, four_joint_arm, wide_motion

ROBOT = four_joint_arm()


@given(st.integers(BLOCKS, 500), st.integers(0, 100), st.floats(0.01, 5.0))
def test_blocks_are_apart_alike_in_size_and_short(count, seed, step):
    log = replace(random_samples(seed, count), time=step * np.arange(float(count)))
    used = np.any(np.isfinite(log.tau), axis=0)
    if np.count_nonzero(used) < BLOCKS:
        return
    masks = list(block_masks(log))
    assert len(masks) == BLOCKS
    np.testing.assert_array_equal(np.sum(masks, axis=0), used)
    sizes = [np.count_nonzero(mask) for mask in masks]
    rows, rounds = np.count_nonzero(used), np.count_nonzero(np.diff(masks[0].astype(int)) == 1) + 1
    assert max(sizes) - min(sizes) <= rounds
    longest = log.time[-1] / min(rounds * BLOCKS, rows)
    assert longest < LONGEST_STRETCH or rows < 2 * BLOCKS * rounds + BLOCKS


def smooth_recording():
    """A recording whose torque is smooth, with its motion."""
    motion = wide_motion(1)
    return motion, exact_recording(motion, 3.0 * motion.q + motion.qd, False)


def test_a_delay_is_taken_out():
    motion, late = smooth_recording()
    made = late.delayed(0.02)
    at = np.isclose(motion.time[:, None], made.source.time).any(axis=1)
    later = np.interp(made.source.time + 0.02, motion.time, late.torque[:, 0])
    np.testing.assert_allclose(made.torque[:, 0], later, atol=1e-3)
    np.testing.assert_allclose(made.source.q, motion.q[at])
    assert late.delayed(0.0) is late


def test_the_truth_solves_the_equations_of_resting_poses():
    arm, count = TrueArm(ROBOT, 2), 12
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (count, 4))
    still = np.zeros_like(q)
    tau = arm.torque(replace(wide_motion(0), time=np.arange(12.0), q=q, qd=still, qdd=still), True)
    used = np.arange(count)[:, None] != np.arange(4)
    poses = RestingPoses(Measurement(np.arange(12.0), q, still, tau, still), used)
    recording = Dataset("poses", poses, is_loaded=True)
    assert recording.signals is None
    assert recording.delayed(0.1) is recording
    columns = Columns(ROBOT, [recording])
    (samples,) = columns.samples(columns.start())
    truth = arm.values(columns)
    for rows, right, places, ok in zip(samples.rows, samples.tau, samples.columns, used.T):
        np.testing.assert_array_equal(np.isfinite(right), ok)
        np.testing.assert_allclose(rows[ok] @ truth[places], right[ok], atol=1e-9)

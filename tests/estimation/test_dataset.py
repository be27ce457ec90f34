"""Recordings as equations: filtered alike on both sides, cut in blocks, delayed, or at rest."""

from __future__ import annotations

import pickle
import tempfile
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal, assert_array_less

from robot_sysid.errors import InputError
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import (
    BLOCKS,
    LONGEST_STRETCH,
    Dataset,
    DecimatedSamples,
    RestingPoses,
    RowsBeside,
    block_masks,
    decimated_equations,
    store_rows,
)
from robot_sysid.records import Measurement
from robot_sysid.signals.process import process
from tests.support.measured_logs import CUTOFF, equations_of, log_of
from tests.support.payload_logs import (
    TrueArm,
    exact_recording,
    four_joint_arm,
    wide_motion,
)

ROBOT = four_joint_arm()


@pytest.fixture(scope="module")
def signals(plant):
    return process(log_of(plant), plant.joint_names, CUTOFF)


def random_samples(seed, count=40):
    """Two joints that share their first two of five parameters."""
    rng = np.random.default_rng(seed)
    tau = rng.normal(size=(2, count))
    tau[rng.random((2, count)) < 0.3] = np.nan
    return DecimatedSamples(
        names=("a", "b", "c", "d", "e"),
        joints=("one", "two"),
        columns=(np.array([0, 1, 2]), np.array([0, 1, 3, 4])),
        time=np.arange(float(count)),
        rows=(rng.normal(size=(count, 3)), rng.normal(size=(count, 4))),
        tau=tuple(tau),
        measured=tuple(rng.normal(size=(2, count))),
    )


def test_rows_stand_at_the_decimated_instants_and_masked_ones_stay_in_place(
    plant, signals
):
    samples = decimated_equations(equations_of(plant), signals)
    assert_array_equal(samples.time, signals.decimated_time())
    for tau, usable in zip(samples.tau, signals.usable().T):
        assert_array_equal(np.isfinite(tau), usable)
    still = replace(signals, deadband=np.full(3, 1e3))
    with pytest.raises(
        InputError, match="faster than its velocity deadband for long enough"
    ):
        decimated_equations(equations_of(plant), still)


@pytest.mark.parametrize("torques", ["chain", "terminal"])
def test_rows_are_those_of_all_samples_that_passed_the_low_pass(
    plant, signals, torques
):
    """Bodies from fewer samples within 1e-7, friction and torque to rounding."""
    equations = equations_of(plant, torques)
    whole = Measurement(signals.time, signals.q, signals.qd, signals.tau, signals.qdd)
    samples = decimated_equations(equations, replace(signals, deadband=np.zeros(3)))
    assert signals.low_pass.stride > 1
    for joint, (rows, tau) in enumerate(equations.rows(whole)):
        used = np.isfinite(samples.tau[joint])
        assert np.mean(used) > 0.5
        exact = signals.low_pass.decimated(np.column_stack((rows, tau)))[used]
        found = np.column_stack((samples.rows[joint], samples.tau[joint]))[used]
        size = np.sqrt(np.mean(exact**2, axis=0))
        assert_array_less(
            np.sqrt(np.mean((found - exact) ** 2, 0)), 1e-7 * size + 1e-12
        )
        friction = slice(10, 14)
        assert_allclose(found[:, friction], exact[:, friction], rtol=0.0, atol=1e-10)


@given(st.integers(BLOCKS, 500), st.integers(0, 100), st.floats(0.01, 5.0))
def test_blocks_are_apart_alike_in_size_and_short(count, seed, step):
    log = replace(random_samples(seed, count), time=step * np.arange(float(count)))
    used = np.any(np.isfinite(log.tau), axis=0)
    if np.count_nonzero(used) < BLOCKS:
        return
    masks = list(block_masks(log))
    assert len(masks) == BLOCKS
    assert_array_equal(np.sum(masks, axis=0), used)
    sizes = [np.count_nonzero(mask) for mask in masks]
    rows = np.count_nonzero(used)
    rounds = np.count_nonzero(np.diff(masks[0].astype(int)) == 1) + 1
    assert max(sizes) - min(sizes) <= rounds
    longest = log.time[-1] / min(rounds * BLOCKS, rows)
    assert longest < LONGEST_STRETCH or rows < 2 * BLOCKS * rounds + BLOCKS


def test_a_delay_is_taken_out():
    motion = wide_motion(1)
    late = exact_recording(motion, 3.0 * motion.q + motion.qd, False)
    made = late.remove_delay(0.02)
    at = np.isclose(motion.time[:, None], made.source.time).any(axis=1)
    later = np.interp(made.source.time + 0.02, motion.time, late.torque[:, 0])
    assert_allclose(made.torque[:, 0], later, atol=1e-3)
    assert_allclose(made.source.q, motion.q[at])
    assert late.remove_delay(0.0) is late


def test_the_truth_solves_the_equations_of_resting_poses():
    arm = TrueArm(ROBOT, 2)
    count = 12
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (count, 4))
    still = np.zeros_like(q)
    tau = arm.torque(
        replace(wide_motion(0), time=np.arange(12.0), q=q, qd=still, qdd=still), True
    )
    used = np.arange(count)[:, None] != np.arange(4)
    poses = RestingPoses(Measurement(np.arange(12.0), q, still, tau, still), used)
    recording = Dataset("poses", poses, is_loaded=True)
    assert recording.signals is None
    assert recording.remove_delay(0.1) is recording
    columns = Columns(ROBOT, [recording])
    (samples,) = columns.samples(columns.start())
    truth = arm.values(columns)
    for rows, right, places, ok in zip(
        samples.rows, samples.tau, samples.columns, used.T
    ):
        assert_array_equal(np.isfinite(right), ok)
        assert_allclose(rows[ok] @ truth[places], right[ok], atol=1e-9)


def test_rows_in_a_file_are_the_rows(monkeypatch):
    """Also after a pickle, and where nothing can be written; short ones stay in memory."""
    samples = [random_samples(seed, 40 + seed) for seed in (0, 1, 2)]
    found = store_rows(samples, sum(rows.size for rows in samples[0].rows))
    assert [isinstance(each.rows, tuple) for each in found] == [True, False, False]
    for some in (found, pickle.loads(pickle.dumps(found))):
        for each, plain in zip(some, samples):
            assert len(each.rows) == 2
            assert all(map(np.array_equal, each.rows, plain.rows))

    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    assert all(each is plain for each, plain in zip(store_rows(samples, 0), samples))


@given(st.integers(0, 100))
def test_rows_put_together_are_those_beside_each_other(seed):
    samples = random_samples(seed)
    factor = np.array([2.0, 0.0, -1.0])
    beside = np.random.default_rng(seed).normal(size=(40, 2))
    rows = RowsBeside(
        samples.rows, [((slice(None), factor), (beside, 0.5), (slice(1), 3.0))]
    )
    first = samples.rows[0]
    whole = np.hstack((first * factor, 0.5 * beside, 3.0 * first[:, :1]))
    assert_array_equal(rows[0], whole)
    used = np.isfinite(samples.tau[0])
    some, tau = replace(samples, rows=rows).in_use(0)
    assert_array_equal(some, whole[used])
    assert_array_equal(tau, samples.tau[0][used])

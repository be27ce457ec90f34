"""Recordings as equations: low-passed on both sides, cut into blocks, delayed, or at rest."""

from __future__ import annotations

import pickle
import tempfile
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal, assert_array_less

from robot_sysid.errors import InputError
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import (
    BLOCKS,
    LONGEST_STRETCH,
    AssembledRows,
    Dataset,
    DecimatedSamples,
    RestingPoses,
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
    """Return samples of two joints that share the first two of five parameters."""
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


def test_rows_are_at_the_decimated_instants_and_unusable_ones_are_masked(
    plant, signals
):
    equations = equations_of(plant)
    samples = decimated_equations(equations, signals)
    assert_array_equal(samples.time, signals.decimated_time())
    assert_array_equal(np.isfinite(samples.tau), signals.usable().T)
    at_rest = replace(signals, deadband=np.full(3, 1e3))
    with pytest.raises(InputError, match="velocity deadband for long enough"):
        decimated_equations(equations, at_rest)
    without_samples = replace(signals, bridged=np.ones_like(signals.bridged))
    with pytest.raises(InputError, match="free of lost samples"):
        decimated_equations(equations, without_samples)


@pytest.mark.parametrize("torques", ["chain", "terminal"])
def test_decimated_rows_are_the_low_passed_rows_of_all_samples(plant, signals, torques):
    """Columns of bodies, made from fewer samples, agree within 1e-7, friction to rounding."""
    equations = equations_of(plant, torques)
    series = signals.time, signals.q, signals.qd, signals.tau, signals.qdd
    samples = decimated_equations(equations, replace(signals, deadband=np.zeros(3)))
    assert signals.low_pass.stride > 1
    for joint, (rows, tau) in enumerate(equations.rows(Measurement(*series))):
        finite = np.isfinite(samples.tau[joint])
        assert np.mean(finite) > 0.5
        expected = signals.low_pass.decimate(np.column_stack((rows, tau)))[finite]
        decimated = np.column_stack((samples.rows[joint], samples.tau[joint]))[finite]
        size = np.sqrt(np.mean(expected**2, axis=0))
        error = np.sqrt(np.mean((decimated - expected) ** 2, axis=0))
        assert_array_less(error, 1e-7 * size + 1e-12)
        friction = slice(10, 14)
        assert_allclose(
            decimated[:, friction], expected[:, friction], rtol=0.0, atol=1e-10
        )


@given(st.integers(BLOCKS, 500), st.integers(0, 100), st.floats(0.01, 5.0))
def test_blocks_are_disjoint_of_equal_size_and_short(count, seed, step):
    log = replace(random_samples(seed, count), time=step * np.arange(float(count)))
    has_torque = np.any(np.isfinite(log.tau), axis=0)
    n_rows = np.count_nonzero(has_torque)
    assume(n_rows >= BLOCKS)
    masks = list(block_masks(log))
    assert len(masks) == BLOCKS
    assert_array_equal(np.sum(masks, axis=0), has_torque)
    sizes = [np.count_nonzero(mask) for mask in masks]
    rounds = np.count_nonzero(np.diff(masks[0].astype(int)) == 1) + 1
    assert max(sizes) - min(sizes) <= rounds
    longest = log.time[-1] / min(rounds * BLOCKS, n_rows)
    assert longest < LONGEST_STRETCH or n_rows < 2 * BLOCKS * rounds + BLOCKS


def test_a_delay_is_removed():
    motion = wide_motion(1)
    late = exact_recording(motion, 3.0 * motion.q + motion.qd, False)
    aligned = late.remove_delay(0.02)
    time = aligned.source.time
    expected = np.interp(time + 0.02, motion.time, late.torque[:, 0])
    assert_allclose(aligned.torque[:, 0], expected, atol=1e-3)
    shared = np.isclose(motion.time[:, None], time).any(axis=1)
    assert_allclose(aligned.source.q, motion.q[shared])
    assert late.remove_delay(0.0) is late


def test_the_truth_solves_the_equations_of_resting_poses():
    arm = TrueArm(ROBOT, 2)
    time = np.arange(12.0)
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 4))
    zero = np.zeros_like(q)
    tau = arm.torque(Measurement(time, q, zero, zero, zero), True)
    used = np.arange(12)[:, None] != np.arange(4)
    poses = RestingPoses(Measurement(time, q, zero, tau, zero), used)
    recording = Dataset("poses", poses, is_loaded=True)
    assert recording.signals is None
    assert recording.remove_delay(0.1) is recording
    columns = Columns(ROBOT, [recording])
    (samples,) = columns.samples(columns.start())
    assert_array_equal(np.isfinite(samples.tau), used.T)
    truth = arm.values(columns)
    for joint, rows in enumerate(samples.rows):
        error = rows @ truth[samples.columns[joint]] - samples.tau[joint]
        assert_allclose(error[used[:, joint]], 0.0, atol=1e-9)


def test_rows_in_a_file_equal_those_in_memory(monkeypatch):
    """Also after pickling, and where nothing can be written; short ones stay in memory."""
    samples = [random_samples(seed, 40 + seed) for seed in (0, 1, 2)]
    stored = store_rows(samples, sum(rows.size for rows in samples[0].rows))
    assert [isinstance(log.rows, tuple) for log in stored] == [True, False, False]
    for copies in (stored, pickle.loads(pickle.dumps(stored))):
        for log, plain in zip(copies, samples):
            assert len(log.rows) == 2
            assert all(map(np.array_equal, log.rows, plain.rows))

    def no_space(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", no_space)
    for log, plain in zip(store_rows(samples, 0), samples):
        assert log is plain


@given(st.integers(0, 100))
def test_rows_of_several_factors_are_the_columns_beside_each_other(seed):
    samples = random_samples(seed)
    factor = np.array([2.0, 0.0, -1.0])
    block = np.random.default_rng(seed).normal(size=(40, 2))
    factors = [(slice(None), factor), (block, 0.5), (slice(1), 3.0)]
    rows = AssembledRows(samples.rows, [factors])
    first = samples.rows[0]
    expected = np.hstack((first * factor, 0.5 * block, 3.0 * first[:, :1]))
    assert_array_equal(rows[0], expected)
    finite = np.isfinite(samples.tau[0])
    used_rows, tau = replace(samples, rows=rows).in_use(0)
    assert_array_equal(used_rows, expected[finite])
    assert_array_equal(tau, samples.tau[0][finite])

"""Sums of rows: as of all rows at once, in any chunks and order, of used rows alone."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms.small_arms import SEEDS
from rigs.logs.payload_logs import TrueArm, four_joint_arm, wide_motion
from robot_sysid.dynamics.inverse_dynamics import gravity_vector
from robot_sysid.errors import InputError
from robot_sysid.estimate.rows import block_numbers, row_chunks
from robot_sysid.estimate.terms import ArmTerms

ROBOT = four_joint_arm()
ARM = ArmTerms(ROBOT, loaded=True)
POINT = ARM.start()
JOINTS = range(len(ARM.joints))


def logs_of(seed, counts=(30, 20), name="log"):
    """Return an empty and a loaded recording of rows, of which some are not used."""
    rng = np.random.default_rng(seed)
    arm = TrueArm(ROBOT, seed)
    recordings = []
    for k, count in enumerate(counts):
        motion = wide_motion([seed, k], 4, count / 50.0)
        recording = arm.recording(motion, k > 0, name=f"{name}{k}")
        recording = recording.using(rng.random(motion.q.shape) < 0.8)
        recordings.append(recording)
    return recordings


def test_a_joint_without_torque_has_no_equations():
    arm = TrueArm(ROBOT, 0)
    recording = arm.recording(wide_motion([0], 4, 1.0), False)
    no_motor = recording.tau * [1.0, 0.0, 1.0, 1.0]
    silent = replace(recording, tau=no_motor)
    assert np.any(recording.is_used, axis=0).tolist() == [True] * 4
    assert np.any(silent.is_used, axis=0).tolist() == [True, False, True, True]


def dense_rows(recordings, joint):
    """Return the rows [A b] (K, p + 1) of a joint that are used."""
    found = []
    for recording in recordings:
        (rows,) = row_chunks(recording, 1)
        columns = [term.columns(rows, POINT)[:, joint] for term in ARM.terms.values()]
        tau = recording.torque[:, joint] - ARM.known(rows)[:, joint]
        found.append(np.column_stack((*columns, tau))[recording.is_used[:, joint]])
    return np.concatenate(found)


def successive_products(recordings, joint):
    """Return the products of successive rows [A b] of a joint that lie in one block."""
    numbers, _ = block_numbers(recordings)
    is_used = [recording.is_used[:, joint] for recording in recordings]
    blocks = np.concatenate([own[rows] for own, rows in zip(numbers, is_used)])
    rows = dense_rows(recordings, joint)
    is_next = blocks[1:] == blocks[:-1]
    products = rows[:-1][is_next].T @ rows[1:][is_next]
    return 0.5 * (products + products.T)


@settings(max_examples=2)
@given(SEEDS)
def test_sums_are_those_of_all_rows_in_use(seed):
    """Weighted by joint, of residuals, and of successive rows; a torque that is not used may be
    anything.
    """
    recordings = logs_of(seed)
    for recording in recordings:
        recording.torque[~recording.is_used] = np.nan
    sums = ARM.sums(recordings, POINT)
    values = np.random.default_rng(seed).normal(size=len(sums.names))
    expected = 0.0
    squares = []
    for joint in JOINTS:
        rows = dense_rows(recordings, joint)
        expected = expected + rows.T @ rows
        squares.append(np.sum((rows @ np.append(-values, 1.0)) ** 2))
        assert np.sum(sums.counts[:, joint]) == len(rows)
        successive = successive_products(recordings, joint)
        at = sums.columns[joint]
        for found, products in (
            (sums.totals, rows.T @ rows),
            (sums.lagged_totals, successive),
        ):
            size = np.max(np.abs(products))
            assert_allclose(found[joint], products[np.ix_(at, at)], atol=1e-12 * size)
    assert_allclose(sums.squared_residuals(values), squares, rtol=1e-9)
    is_rounding = np.sum(sums.squares, axis=0) == 0.0
    left_out = np.diag(expected)[:-1][is_rounding]
    assert np.all(left_out <= 1e-20 * np.max(expected))


@settings(max_examples=2)
@given(SEEDS, st.integers(2, 20))
def test_neither_chunks_nor_the_order_of_recordings_change_the_sums(seed, size):
    recordings = logs_of(seed)
    expected = ARM.sums(recordings, POINT)
    numbers, logs = block_numbers(recordings)
    array_size = size * (len(ARM.names) + 1) * len(JOINTS)
    cut = zip(logs_of(seed), numbers)
    chunked = ARM.add_up(cut, logs, POINT, array_size=array_size)
    of_all = expected.totals + expected.lagged_totals
    for sums in (chunked, ARM.sums(recordings[::-1], POINT)):
        for found, products in zip(sums.totals + sums.lagged_totals, of_all):
            assert_allclose(found, products, atol=1e-12 * np.max(np.abs(products)))
    assert_array_equal(chunked.counts, expected.counts)


def test_the_torque_of_links_over_a_long_log_is_that_of_its_parts():
    recording, _ = logs_of(1, (8000, 1))
    gravity = gravity_vector(ROBOT)
    thetas = POINT.carried_links(False)
    (rows,) = row_chunks(recording, 1)
    assert len([*row_chunks(recording, 36 * ROBOT.n_joints)]) > 1
    torque = rows.links_torque(ROBOT, gravity, thetas)
    expected = rows.moves(ROBOT, gravity).torque(thetas)
    assert_allclose(torque, expected, atol=1e-12 * np.max(np.abs(expected)))


@given(SEEDS, st.sampled_from([1, 2, 5]))
def test_blocks_are_equal_stretches_of_one_log_that_add_up(seed, n_logs):
    recordings = []
    for k in range(n_logs):
        recordings += logs_of(seed + k, (70, 50), f"log{k}, ")
    recordings = [replace(r, name=r.name.partition(",")[0]) for r in recordings]
    numbers, logs = block_numbers(recordings)
    assert len(logs) == max(3 * n_logs, 10)
    assert list(dict.fromkeys(logs)) == [f"log{k}" for k in range(n_logs)]
    for name in dict.fromkeys(logs):
        of_log = []
        for recording, blocks in zip(recordings, numbers):
            if recording.name == name:
                of_log.append(blocks[np.any(recording.is_used, axis=1)])
        joined = np.concatenate(of_log)
        assert np.all(np.diff(joined) >= 0)
        sizes = np.unique(joined, return_counts=True)[1]
        assert len(sizes) == logs.count(name) and np.ptp(sizes) <= 1


def test_rows_that_are_cut_out_do_not_count_and_those_of_others_stay():
    recording, other = logs_of(2)
    before = recording.is_used.copy()
    time = recording.motion.time
    inside = ((time >= 0.1) & (time <= 0.2)) | (time >= 0.5)
    cut = recording.only(~inside)
    assert_array_equal(cut.is_used, before & ~inside[:, None])
    assert_array_equal(recording.only(~before).is_used, False & before)
    assert_array_equal(recording.is_used, before)
    cut.torque[inside] = 1e9
    sums = ARM.sums([cut, other], POINT)
    assert np.all(sums.rms_torque < 1e9)
    with pytest.raises(InputError, match="velocity deadband for long enough"):
        ARM.sums([recording.only(time < 0.0)], POINT)


@settings(max_examples=2)
@given(SEEDS)
def test_sums_of_mixed_columns_are_those_of_their_mixture(seed):
    """Each joint may have a mixture of its own, such as a share of all links' torque."""
    sums = ARM.sums(logs_of(seed), POINT)
    rng = np.random.default_rng(seed)
    mix = rng.normal(size=(len(JOINTS), len(sums.names), 3))
    mix *= rng.random(mix.shape) < 0.5
    mixed = sums.mixed(("a", "b", "c"), mix)
    values = rng.normal(size=3)
    apart = [sums.squared_residuals(mix[j] @ values)[j] for j in JOINTS]
    assert_allclose(mixed.squared_residuals(values), apart, rtol=1e-9)
    assert_allclose(mixed.rms_torque, sums.rms_torque)
    apart = [sums.successive(mix[j] @ values)[j] for j in JOINTS]
    assert_allclose(mixed.successive(values), apart, rtol=1e-9, atol=1e-9)

"""report_data.npz: small whatever the log, read back as it was, refused where it is not ours."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.records import JointLimits
from robot_sysid.records.data import Traces
from robot_sysid.report.runs import (
    DATA_NAME,
    MOST,
    autocorrelation,
    by_speed,
    data_bytes,
    histogram,
    load_data,
    report_data,
)
from tests.support.arms import SEEDS


def traces(count=500, joints=2):
    rng = np.random.default_rng(0)
    table = rng.normal(size=(count, joints))
    measured = table.copy()
    measured[count // 2] = np.nan
    full = np.full(joints, np.inf)
    limits = JointLimits(-full, full, np.ones(joints), full)
    names, time = tuple(f"j{k}" for k in range(joints)), np.arange(count) * 0.01
    slides = (False,) * joints
    return Traces(names, slides, time, table, table, measured, 0.9 * table, table, table, limits)


def test_what_is_written_is_read(tmp_path):
    made = report_data(traces(), "hash")
    (tmp_path / DATA_NAME).write_bytes(data_bytes(made))
    again = load_data(tmp_path / DATA_NAME)
    for each in fields(made):
        ours, theirs = getattr(made, each.name), getattr(again, each.name)
        if isinstance(ours, np.ndarray):
            np.testing.assert_array_equal(ours, theirs)
        else:
            assert ours == theirs
    assert data_bytes(made) == data_bytes(report_data(traces(), "hash"))


def test_a_huge_log_is_thinned_and_says_so():
    made = report_data(traces(50_000))
    assert len(made.time) == MOST and made.n_samples == 50_000
    assert made.drawn.startswith(f"drawn: {MOST} of 50000 instants")
    assert np.all(np.sum(made.counts, axis=1) == 49_999)
    assert len(data_bytes(made)) < 500_000
    assert report_data(traces(500)).drawn == ""


def test_logs_follow_one_another():
    two = traces(10)
    time = np.concatenate((two.time[:5], two.time[:5]))
    made = report_data(Traces(**{**vars(two), "time": time}))
    assert np.all(np.diff(made.time) > 0.0)


def _spoiled(tmp_path, **changes):
    content = dict(np.load((tmp_path / "good.npz"), allow_pickle=False))
    content.update(changes)
    np.savez(tmp_path / DATA_NAME, **{k: v for k, v in content.items() if v is not None})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"version": np.array(99)}, "another version"),
        ({"version": None}, "another version"),
        ({"measured": None}, "damaged"),
        ({"measured": np.zeros((3, 7))}, "damaged"),
        ({"truth": np.zeros(3)}, "damaged"),
        ({"q": np.array(["a"])}, "damaged"),
        ({"q": np.array([{}], dtype=object)}, "cannot read"),
    ],
)
def test_a_file_that_is_not_ours_is_refused(tmp_path, changes, words):
    (tmp_path / "good.npz").write_bytes(data_bytes(report_data(traces())))
    _spoiled(tmp_path, **changes)
    with pytest.raises(InputError, match=words):
        load_data(tmp_path / DATA_NAME)


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 cut"])
def test_what_is_no_archive_is_refused(tmp_path, content):
    (tmp_path / DATA_NAME).write_bytes(content)
    with pytest.raises(InputError, match="identify again"):
        load_data(tmp_path / DATA_NAME)


def test_a_missing_file_says_what_would_write_it(tmp_path):
    with pytest.raises(InputError, match="there is no .*identify again"):
        load_data(tmp_path / DATA_NAME)


@pytest.mark.parametrize(("place", "value"), [(8, 99), (60, 0xFF)])
def test_a_file_whose_packing_is_broken_is_refused(tmp_path, place, value):
    """Another method of compression in its heads, or bytes in the middle that are none of it."""
    content = bytearray(data_bytes(report_data(traces())))
    if place == 8:
        central = content.index(b"PK\x01\x02")
        content[place] = content[central + 10] = value
    else:
        content[place : place + 40] = bytes([value]) * 40
    (tmp_path / DATA_NAME).write_bytes(content)
    with pytest.raises(InputError, match="cannot read .*identify again"):
        load_data(tmp_path / DATA_NAME)


@given(seed=SEEDS, count=st.integers(1, 300), missing=st.floats(0.0, 1.0))
def test_every_sample_in_use_is_counted_once(seed, count, missing):
    rng = np.random.default_rng(seed)
    residual = rng.standard_t(2.0, (count, 2))
    residual[rng.random((count, 2)) < missing] = np.nan
    edges, counts = histogram(residual).values()
    np.testing.assert_array_equal(np.sum(counts, axis=1), np.sum(np.isfinite(residual), axis=0))
    assert np.all(np.diff(edges, axis=1) > 0.0)


@given(seed=SEEDS)
def test_noise_without_memory_stays_in_its_band(seed):
    noise = np.random.default_rng(seed).normal(size=(2000, 2))
    noise[100:140, 0] = np.nan
    lags, found, band = autocorrelation(np.arange(2000) * 0.01, noise).values()
    np.testing.assert_allclose(found[:, 0], 1.0)
    assert np.mean(np.abs(found[:, 1:]) > band[:, None]) < 0.2
    assert lags[0] == 0.0 and lags[-1] <= 2.0


def test_slow_residuals_have_the_memory_that_they_have():
    rng, slow = np.random.default_rng(0), np.zeros((20000, 1))
    for k in range(1, len(slow)):
        slow[k] = 0.9 * slow[k - 1] + rng.normal()
    lags, found, _ = autocorrelation(np.arange(20000) * 0.1, slow).values()
    np.testing.assert_allclose(found[0], 0.9 ** (lags / 0.1), atol=0.05)


def test_means_by_speed_are_those_of_the_samples_in_use():
    qd = np.linspace(-2.0, 2.0, 4001)[:, None]
    torque = 3.0 * qd + 1.0
    torque[qd > 1.0] = np.nan
    speed, mean, spread, *_ = by_speed(qd, torque, qd).values()
    known = np.isfinite(speed)
    np.testing.assert_allclose(mean[known], 3.0 * speed[known] + 1.0, atol=1e-9)
    assert np.nanmax(speed) <= 1.0 and np.all(spread[known] < 0.3)


def test_nothing_at_all_is_no_reason_to_fail():
    nothing = np.full((3, 1), np.nan)
    histogram(nothing)
    autocorrelation(np.zeros(3), nothing)
    assert np.all(np.isnan(by_speed(nothing, nothing, nothing)["speed"]))

"""report_data.npz: small whatever the log, read back as it was, refused where it is not ours."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.records import JointLimits
from robot_sysid.records.traces import Traces
from robot_sysid.report.saved import DATA_NAME, MOST, data_bytes, load_data, report_data


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

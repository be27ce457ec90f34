"""Rows that cannot be used are left out and counted, and positions that wrap are unwrapped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from rigs.files.refusals import refused
from rigs.logs.log_files import (
    JOINTS,
    TITLES,
    assert_refused,
    assert_samples,
    motion,
    notes_of,
    read_measurements,
    read_table,
    table,
    write,
)
from robot_sysid.logs.table import ROWS, make_table
from robot_sysid.signals.resampling import split_at_gaps


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sets(st.integers(1, 397), min_size=1, max_size=4),
    st.sampled_from(["", "nan", "NULL", "1e30", "-1e8", "x" * 200_000, "oops"]),
)
def test_rows_with_holes_or_rubbish_are_left_out_and_counted(tmp_path, rows_hit, cell):
    data = motion()
    rows = table(data).tolist()
    for k in rows_hit:
        rows[k][4] = cell
    log = read_table(tmp_path, rows)
    usable = np.setdiff1d(np.arange(len(data)), list(rows_hit))
    assert_samples(data[usable], log, ("time", "tau"))
    assert f": {len(rows_hit)} (first: line {min(rows_hit) + 2}" in notes_of(log)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(3.5, 12.0), st.floats(-20.0, 20.0))
def test_wrapped_positions_are_unwrapped(tmp_path, amplitude, offset):
    data = motion()
    rows = table(data)
    true = offset + amplitude * data.q[:, 0]
    rows[:, 1] = np.angle(np.exp(1j * true))
    log = read_table(tmp_path, rows, units="rad")
    q = log.q[:, 0]
    turns = np.round((true - q) / (2.0 * np.pi))[0]
    assert_allclose(q + 2.0 * np.pi * turns, true, rtol=0.0, atol=1e-12)


def test_a_slide_has_no_full_turn_and_no_degrees(tmp_path):
    slide = (True, False, False)
    rows = table(motion())
    rows[200:, 1] += 2.0 * np.pi
    with refused("joint base jumps at line 202"):
        read_table(tmp_path, rows, is_slide=slide)
    rows[:200, 1] += 2.0 * np.pi
    rows[:, 1] += 10.0
    with refused("look like degrees"):
        read_table(tmp_path, rows)
    assert len(read_table(tmp_path, rows, units="rad")) == 400
    assert len(read_table(tmp_path, rows, is_slide=slide)) == 400


@pytest.mark.parametrize("header", [0, 1])
def test_recordings_that_follow_each_other_in_a_file_are_read_as_pieces(
    tmp_path, header
):
    # Rows that are the same in all columns would be one.
    recordings = [table(motion(1000)) for _ in range(3)]
    for offset, rows in enumerate(recordings):
        rows[:, 4:] += offset
    path = write(tmp_path / "log.csv", recordings[0])
    lines = path.read_text().splitlines()
    for rows, start in zip(recordings[1:], (1 - header, 1)):
        write(tmp_path / "further.csv", rows)
        lines += (tmp_path / "further.csv").read_text().splitlines()[start:]
    path.write_text("\n".join(lines) + "\n")
    log = read_measurements(path, JOINTS)
    assert (
        f"time starts again at line {1002 + header} and 1 more: 3 recordings"
        in notes_of(log)
    )
    assert np.all(np.diff(log.time) > 0.0)
    pieces = split_at_gaps(log)
    assert len(pieces) == 3
    assert log.duration == pytest.approx(3.0 * pieces[0].duration, rel=1e-6)
    for piece, rows in zip(pieces, recordings):
        np.testing.assert_array_equal(piece.tau, rows[:, 4:])


@pytest.mark.parametrize("every", [1, 10])
def test_rows_that_are_appended_once_more_are_no_second_recording(tmp_path, every):
    rows = table(motion(1000))
    path = write(tmp_path / "log.csv", np.vstack((rows, rows[::every])))
    log = read_measurements(path, JOINTS)
    np.testing.assert_array_equal(table(log), rows)
    assert "written twice" in notes_of(log) and "starts again" not in notes_of(log)


def test_a_time_in_two_units_is_not_added_to_itself(tmp_path):
    rows = table(motion(1000))
    cells = np.column_stack((rows[:, 0], 1e9 * rows))
    cells[:, 2:] = rows[:, 1:]
    titles = ["time_sec", "time_nsec", *TITLES[1:]]
    path = write(tmp_path / "log.csv", cells, titles)
    log = read_measurements(path, JOINTS, columns="time = time_sec")
    np.testing.assert_allclose(log.time, rows[:, 0])


@pytest.mark.parametrize(
    ("seconds", "nanoseconds"),
    [
        ("header.stamp.secs", "header.stamp.nsecs"),
        ("sec", "nanosec"),
        ("time_seconds", "time_nanoseconds"),
        ("base/sec", "base/nanosec"),
    ],
)
def test_a_time_in_two_columns_is_one(tmp_path, seconds, nanoseconds):
    """A tenth of the rows is there twice, as a bag has it that two programs recorded."""
    rows = table(motion(1000))
    rows = rows[np.sort([*range(1000), *range(0, 1000, 10)])]
    time = 1_700_000_000 + rows[:, 0]
    stamps = np.stack((np.floor(time), np.round(time % 1.0 * 1e9)))
    cells = [[*map(int, s), *row] for s, row in zip(stamps.T, rows[:, 1:].tolist())]
    titles = [seconds, nanoseconds, *TITLES[1:]]
    log = read_measurements(write(tmp_path / "log.csv", cells, titles), JOINTS)
    np.testing.assert_allclose(np.diff(log.time), 0.005, atol=1e-6)
    np.testing.assert_array_equal(log.tau, motion(1000).tau)


def test_time_that_goes_back_a_little_or_again_and_again_is_refused(tmp_path):
    rows = table(motion())
    rows[200:, 0] -= 0.5
    assert_refused("run backwards in time", write(tmp_path / "log.csv", rows))
    rows = table(motion())
    rows[::7, 0] = 0.0
    assert_refused("run backwards in time", write(tmp_path / "log.csv", rows))


@given(
    st.lists(st.integers(1, 3), min_size=1, max_size=5),
    st.sampled_from([3, ROWS, ROWS + 1]),
    st.data(),
)
def test_arrays_are_columns_with_a_title_each_in_any_order(widths, count, data):
    """Whatever their widths are, and however many rows are read at a time."""
    cells = np.arange(float(count * sum(widths))).reshape(count, -1)
    parts = np.split(cells, np.cumsum(widths)[:-1], axis=1)
    named = []
    titles = []
    for k, (width, part) in enumerate(zip(widths, parts)):
        named.append((f"x{k}", part))
        of_joints = [f"{joint}/x{k}" for joint in JOINTS]
        titles += {1: [f"x{k}"], 2: [f"x{k}[0]", f"x{k}[1]"], 3: of_joints}[width]
    table_of_arrays = make_table(Path("log"), "", named, {3: JOINTS})
    assert list(table_of_arrays.titles) == titles
    order = data.draw(st.permutations(range(len(titles))))
    assert_array_equal(table_of_arrays.cells(order), cells[:, order])

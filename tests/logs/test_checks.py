"""Each thing that can be wrong with a log is found and notes, with its first line and a remedy."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from rigs.files.refusals import refused
from rigs.logs.log_files import (
    JOINTS,
    TITLES,
    limits,
    motion,
    notes_of,
    read_measurements,
    read_table,
    table,
    write,
)

# Rows in which something is put that is no row of numbers; row k stands in line k + 2.
RUBBISH = (9, 20, 31, 42, 53)


def rows_with(spoil):
    """A fault that makes some rows no rows of numbers."""
    return lambda rows: [
        spoil(row) if k in RUBBISH else row for k, row in enumerate(rows.tolist())
    ]


def changing(index, change):
    """A fault that changes some cells of the table."""

    def fault(rows):
        rows[index] = change(rows[index])
        return rows

    return fault


def separate_joints(rows):
    """Joints in messages of their own."""
    rows[::2, [1, 4]] = np.nan
    rows[1::2, [2, 3, 5, 6]] = np.nan
    return rows


TIME = np.s_[:, 0]
Q = np.s_[:, 1:4]
# Each fault changes the table and is an error that says the fragments.
ERRORS: dict[str, tuple[Callable, str]] = {
    "text cells": (
        rows_with(lambda row: [*row[:2], "oops", *row[3:]]),
        "5 of 400 rows.*1 %.*line 11, column 'q2': 'oops' is not a number",
    ),
    "short rows": (
        rows_with(lambda row: row[:5]),
        "5 of 400 rows.*line 11: 5 cells instead of 7",
    ),
    "absurd cells": (
        changing((list(RUBBISH), 4), lambda tau: np.full(len(tau), 1e30)),
        r"5 of 400 rows.*first: line 11\)",
    ),
    "backwards": (
        changing(([20, 21], 0), lambda time: time[::-1].copy()),
        r"log.csv: .*backwards in time.*first: line 23\)",
    ),
    "many holes": (
        changing(np.s_[::10, 2], lambda q: np.nan * q),
        "40 of 400 rows.*5 %.*line 2",
    ),
    "coarse time": (
        changing(TIME, lambda time: np.floor(time * 50) / 50),
        "repeat the time stamp.*more digits",
    ),
    "milliseconds": (
        changing(TIME, lambda t: 1e3 * t),
        "time steps of 5 s.*--units ms, us or ns",
    ),
    "tiny time": (changing(TIME, lambda t: 1e-3 * t), r"5e-06 s.*60 \* TITLE"),
    "stamps of arrival": (
        changing((slice(10, None, 9), 0), lambda t: t - 4.99e-3),
        r"of when rows were written \(joint base would reach.*'rate = 200'",
    ),
    "whole seconds": (
        changing(TIME, np.floor),
        "398 of 400 rows repeat the time stamp.*'rate = HZ' in --columns",
    ),
    "minutes": (
        changing(TIME, lambda t: t / 60.0),
        "another unit.*joint base would reach 0.9 rad and 169.6 rad/s",
    ),
    "no effort": (
        changing(np.s_[:, [4, 6]], lambda tau: np.nan * tau),
        "columns tau1, tau3.*--columns FILE",
    ),
    "memory never written": (
        changing(np.s_[:, 4:7], lambda tau: 1e-308 * tau),
        "the torque of joint .* is zero in every row",
    ),
    "separate joints": (
        separate_joints,
        "first: line 2, columns q1, tau1.*record all joints",
    ),
    "degrees": (changing(Q, np.degrees), "look like degrees.*--units deg"),
    "at rest": (changing(Q, lambda q: 0.3 + 1e-3 * q), "at rest.*no joint moves"),
    "spike": (
        changing((33, 3), lambda q: q + 2.0),
        "joint wrist.*jumps at line 35 and 1 more",
    ),
    "too few": (lambda rows: rows[:5], "only 5 usable rows"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_a_log_that_cannot_be_used_is_refused(tmp_path, name):
    fault, words = ERRORS[name]
    with refused(words) as caught:
        read_table(tmp_path, fault(table(motion())))
    of_angles = ("degrees", "minutes", "stamps of arrival")
    assert ("degrees" in str(caught.value)) == (name in of_angles)


@pytest.mark.parametrize("name", ["stamps of arrival", "whole seconds"])
def test_the_remedy_for_a_clock_is_one(tmp_path, name):
    log = read_table(tmp_path, ERRORS[name][0](table(motion())), columns="rate = 200")
    np.testing.assert_allclose(log.time, motion().time, atol=1e-12)


# Each of these is a note, none an error.
NOTES: dict[str, tuple[Callable, str]] = {
    "nothing": (lambda rows: rows, "^$"),
    "repeated": (
        changing((50, 0), lambda time: time - 0.005),
        r"left out rows that repeat the time stamp before them: 1 \(first: line 52\)",
    ),
    "gap": (
        lambda rows: np.delete(rows, slice(100, 120), axis=0),
        "samples are missing before line 102.*105 ms where 5 ms is usual",
    ),
    "uneven": (
        lambda rows: rows[np.random.default_rng(0).random(len(rows)) < 0.7],
        "samples are missing before line",
    ),
    "cut off": (
        lambda rows: [*rows[:-1].tolist(), rows[-1, :4].tolist()],
        r"left out rows that are no rows of numbers: 1 \(first: line 401: 4 cells instead of 7\)",
    ),
    "one at rest": (
        changing(np.s_[:, 2], lambda q: 0.0 * q),
        "do not move in this log: elbow",
    ),
    "no motor": (
        changing(np.s_[:, 5], lambda tau: 0.0 * tau),
        "joints without torque in this log.*friction is the model's: elbow",
    ),
    "motor's memory never written": (
        changing(np.s_[:, 5], lambda tau: 1e-308 * tau),
        "joints without torque in this log.*friction is the model's: elbow",
    ),
}


@pytest.mark.parametrize("name", NOTES)
def test_what_is_odd_about_a_log_is_said(tmp_path, name):
    fault, words = NOTES[name]
    assert re.search(words, notes_of(read_table(tmp_path, fault(table(motion())))))


def test_own_time_stamps_are_kept_unless_of_another_clock_or_backwards(tmp_path):
    titles = (*TITLES, *(f"{joint}_time" for joint in JOINTS))
    rows = table(motion())
    stamps = rows[:, :1] + np.array([0.0, 1e-3, 2e-3])
    log = read_table(tmp_path, np.hstack((rows, stamps)), titles)
    np.testing.assert_array_equal(log.joint_time, stamps)
    with refused(r"5 s off.*joint_time = none"):
        read_table(tmp_path, np.hstack((rows, stamps + 5.0)), titles)
    stamps[7, 1] -= 0.05
    with refused("run backwards"):
        read_table(tmp_path, np.hstack((rows, stamps)), titles)


def test_own_time_stamps_that_are_dates_have_one_clock(tmp_path):
    """Each column of dates counts from its own first one, which is not that of the others."""
    titles = (*TITLES, *(f"{joint}_time" for joint in JOINTS))
    time, *values = table(motion()).T
    stamps = time[:, None] + np.array([0.0, 1e-3, 2e-3])
    nanoseconds = np.round(1e9 * np.column_stack((time, stamps))).astype("m8[ns]")
    dates, *own = (np.datetime64("2024-05-01T12:00:00", "ns") + nanoseconds).T.astype(
        str
    )
    log = read_table(tmp_path, [*zip(dates, *values, *own)], titles)
    np.testing.assert_allclose(log.time, time, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(log.joint_time, stamps, rtol=0.0, atol=1e-9)


def test_velocities_that_are_missing_are_left_out_and_no_row(tmp_path):
    data = motion()
    rows = np.column_stack((table(data), data.qd))
    titles = (*TITLES, "qd1", "qd2", "qd3")
    for share, is_used in ((0.02, True), (0.3, False)):
        count = round(share * len(rows))
        rows[:count, 8] = np.nan
        log = read_table(tmp_path, rows, titles)
        assert (log.qd is not None) == is_used
        assert len(log) == len(rows) - is_used * count
        note = f"recorded velocities are not used, and not needed: {count} rows"
        assert (note in notes_of(log)) == (not is_used)
        assert is_used or log.columns.velocity == ()


def test_a_slide_in_millimetres_is_told_by_its_range(tmp_path):
    data = motion()
    rows = table(data)
    rows[:, 2] = 400.0 * data.q[:, 1]
    path = write(tmp_path / "log.csv", rows)
    arm = {"limits": limits(0.5), "is_slide": (False, True, False)}
    with refused("positions look like millimetres.*--units mm") as caught:
        read_measurements(path, JOINTS, **arm)
    assert caught.value.options == (("--units", "mm"), ("--units", "m"))
    log = read_measurements(path, JOINTS, **arm, units="mm")
    np.testing.assert_allclose(log.q[:, 1], 0.4 * data.q[:, 1])
    np.testing.assert_allclose(log.q[:, 0], data.q[:, 0])


def test_counts_are_offered_for_what_is_too_much_for_degrees(tmp_path):
    data = motion()
    rows = table(data)
    rows[:, 1:4] = 2048.0 + 652.0 * data.q
    message = "hundredths of them .--units cdeg. or counts .* .--units 4096/rev"
    with refused(message) as caught:
        read_table(tmp_path, rows)
    assert caught.value.options == ()
    log = read_table(tmp_path, rows, columns="zero = 2048", units="4096/rev")
    np.testing.assert_allclose(log.q, 652.0 * 2.0 * np.pi / 4096.0 * data.q)

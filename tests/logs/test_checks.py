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
from robot_sysid.signals.resampling import split_at_gaps

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


def in_any_order(rows):
    """Postures in any order, 20 s apart."""
    order = np.random.default_rng(0).permutation(len(rows))
    return np.column_stack([20.0 * np.arange(len(rows)), rows[order, 1:]])


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
    "milliseconds": (
        changing(TIME, lambda t: 1e3 * t),
        "time steps of 5 s.*: they fit ms; pass --units ms",
    ),
    "postures": (
        in_any_order,
        "time steps of 20 s.*they are postures.*record while the arm",
    ),
    "tiny time": (changing(TIME, lambda t: 1e-3 * t), r"5e-06 s.*60 \* TITLE"),
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
    "zero set": (
        changing(np.s_[200:, 3], lambda q: q + 2.0),
        "joint wrist jumps at line 202 and stays there.*use the part of the log before",
    ),
    "too few": (lambda rows: rows[:5], "only 5 usable rows"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_a_log_that_cannot_be_used_is_refused(tmp_path, name):
    fault, words = ERRORS[name]
    with refused(words) as caught:
        read_table(tmp_path, fault(table(motion())))
    of_angles = ("degrees", "minutes")
    assert ("degrees" in str(caught.value)) == (name in of_angles)


def test_the_remedy_for_a_clock_is_one(tmp_path):
    rows = ERRORS["whole seconds"][0](table(motion()))
    log = read_table(tmp_path, rows, columns="rate = 200")
    np.testing.assert_allclose(log.time, motion().time, atol=1e-12)


def in_file_order(order):
    """A fault that writes the rows in another order, or some of them twice."""
    return lambda rows: rows[order(len(rows))]


def exchanged_blocks(count):
    """Return rows of which two stretches are exchanged."""
    rows = np.arange(count)
    return np.r_[rows[:150], rows[180:210], rows[150:180], rows[210:]]


ORDERS = {
    "twice": lambda n: np.sort([*range(n), *range(0, n, 10)]),
    "a stretch twice": lambda n: np.r_[0:200, 150:n],
    "neighbours exchanged": lambda n: np.arange(n) ^ (np.arange(n) % 20 < 2),
    "stretches exchanged": exchanged_blocks,
    "shuffled": lambda n: np.random.default_rng(0).permutation(n),
    "backwards": lambda n: np.arange(n)[::-1],
    "shuffled, a tenth twice": lambda n: np.random.default_rng(1).permutation(
        [*range(n), *range(0, n, 10)]
    ),
}
"""How rows lie in the file that are one recording all the same."""


@pytest.mark.parametrize("name", ORDERS)
def test_rows_in_any_order_or_twice_are_the_recording(tmp_path, name):
    log = read_table(tmp_path, in_file_order(ORDERS[name])(table(motion())))
    np.testing.assert_array_equal(table(log), table(motion()))
    assert re.search("written twice|sorted by time", notes_of(log))


@pytest.mark.parametrize(
    "stamped",
    [
        lambda time: np.floor(time * 50) / 50,
        lambda time: np.round(time, 2),
        lambda time: time + np.random.default_rng(0).uniform(0.0, 5e-3, len(time)),
        lambda time: time - 4.99e-3 * (np.arange(len(time)) % 9 == 8),
        # Rows of a sixteenth of a second arrive together.
        lambda time: np.ceil(time * 16) / 16,
        lambda time: np.ceil(time * 7) / 7,
    ],
    ids=["floor", "round", "late", "early", "bursts", "long bursts"],
)
def test_even_rows_with_other_stamps_are_at_even_instants(tmp_path, stamped):
    rows = table(motion(2000))
    rows[:, 0] = stamped(motion(2000).time)
    log = read_table(tmp_path, rows)
    assert "positions show that rows are evenly spaced" in notes_of(log)
    assert len(log) == 2000
    np.testing.assert_allclose(np.diff(log.time), 5e-3, rtol=2e-3)


@pytest.mark.parametrize(
    "copied",
    [lambda n: np.arange(0, n - 1, 7), lambda n: np.arange(n - 1)],
    ids=["some", "polled twice as fast"],
)
def test_rows_that_repeat_between_two_samples_are_left_out(tmp_path, copied):
    data = motion()
    copies = table(data)[copied(len(data))]
    copies[:, 0] += 2e-3
    rows = np.concatenate((table(data), copies))
    log = read_table(tmp_path, rows[np.argsort(rows[:, 0])])
    np.testing.assert_array_equal(table(log), table(data))
    assert f"between two samples: {len(copies)} (first: line 3)" in notes_of(log)


@pytest.mark.parametrize("each", [1, 3])
def test_rows_of_a_program_that_knows_no_torque_are_left_out(tmp_path, each):
    """It sends one row behind each, or every third one, of the driver's."""
    data = motion()
    others = table(data)[::each].copy()
    others[:, 0] += 2e-3
    others[:, 4:7] = 0.0
    rows = np.concatenate((table(data), others))
    log = read_table(tmp_path, rows[np.argsort(rows[:, 0])])
    np.testing.assert_array_equal(table(log), table(data))
    assert f"another program sends them: {len(others)} of {len(rows)}" in notes_of(log)


@pytest.mark.parametrize("factor", [0.5, 1.5])
def test_torques_of_two_programs_that_alternate_are_refused(tmp_path, factor):
    rows = table(motion())
    rows[1::2, 4:7] *= factor
    with refused("alternate from row to row between two values"):
        read_table(tmp_path, rows)


def test_noise_does_not_alternate(tmp_path):
    rows = table(motion())
    rows[:, 4:7] += np.random.default_rng(0).standard_normal((len(rows), 3))
    assert len(read_table(tmp_path, rows)) == len(rows)


@pytest.mark.parametrize("rows", [np.s_[100:200], np.s_[40:60:4]])
def test_torques_of_zero_that_do_not_lie_between_others_stay(tmp_path, rows):
    """As of an arm on its brakes, or by chance."""
    numbers = table(motion())
    numbers[rows, 4:7] = 0.0
    log = read_table(tmp_path, numbers)
    assert len(log) == len(numbers) and "another program" not in notes_of(log)


@pytest.mark.parametrize(
    "repeated", [np.r_[40:80], np.r_[40, 41, 60, 90:95, 120]], ids=["at rest", "stale"]
)
def test_rows_that_repeat_in_place_of_samples_stay(tmp_path, repeated):
    rows = table(motion())
    for row in repeated:
        rows[row, 1:] = rows[row - 1, 1:]
    log = read_table(tmp_path, rows)
    np.testing.assert_array_equal(log.time, motion().time)
    assert "between two samples" not in notes_of(log)


@pytest.mark.parametrize("first", [900, 1000, 1130])
@pytest.mark.parametrize("count", [20, 200])
def test_a_log_is_cut_where_rows_are_missing_behind_a_counted_time(
    tmp_path, first, count
):
    data = motion(2600)
    rows = np.delete(table(data), slice(first, first + count), axis=0)
    rows[:, 0] = data.time[: len(rows)]
    log = read_table(tmp_path, rows)
    assert f"rows are missing before line {first + 2} that the time" in notes_of(log)
    before, after = split_at_gaps(log)
    np.testing.assert_array_equal(before.q, data.q[:first])
    np.testing.assert_array_equal(after.q, data.q[first + count :])
    # Of one joint that jumps alone, the zero may have been set.
    rows = table(data)
    rows[first:, 2] += 0.3
    assert "missing" not in notes_of(read_table(tmp_path, rows))


@pytest.mark.parametrize("seed", range(3))
def test_uneven_rows_keep_their_stamps(tmp_path, seed):
    """Also where rows are missing, and the stamps that are left jitter."""
    random = np.random.default_rng(seed)
    data = motion(2000)
    time = np.sort(data.time + random.uniform(0.0, 4e-3, len(data)))
    uneven = table(data)
    uneven[:, 0] = time
    for k in range(3):
        uneven[:, 1 + k] = np.interp(time, data.time, data.q[:, k])
    late = table(data)
    late[:, 0] = time
    for rows in (uneven, np.delete(late, 900, axis=0)):
        log = read_table(tmp_path, rows)
        assert "evenly spaced" not in notes_of(log)
        np.testing.assert_array_equal(log.time, rows[:, 0])


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
    "a stamp ahead": (
        changing((200, 0), lambda time: time + 100.0),
        "time starts again at line 203",
    ),
    "spike": (
        changing((33, 3), lambda q: q + 2.0),
        r"left out rows in which a position jumps and is back: 1 \(first: line 35\)",
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


def test_positions_whole_turns_outside_of_the_limits_are_noted(tmp_path):
    """The line that takes the turns off does so."""
    rows = table(motion())
    rows[:, 1:4] = np.degrees(rows[:, 1:4])
    rows[:, 2] -= 720.0
    titles = [f"{t} [deg]" if t.startswith("q") else t for t in TITLES]
    path = write(tmp_path / "turned.csv", rows, titles)
    said = notes_of(read_measurements(path, JOINTS, limits(1.5)))
    assert "whole turns outside of the joints' limits" in said
    line = re.search("'(zero.elbow = -720)' in --columns|'(zero.*?)' in columns", said)
    assert line
    right = read_measurements(
        path, JOINTS, limits(1.5), columns=next(filter(None, line.groups()))
    )
    np.testing.assert_allclose(right.q, motion().q, atol=1e-9)
    assert "whole turns" not in notes_of(right)


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


SERVO_TITLES = (*TITLES[:4], "action_1", "action_2", "action_3", *TITLES[4:])


@pytest.mark.parametrize("share", [0.02, 0.3])
def test_torques_beside_commands_are_read_and_cost_no_row(tmp_path, share):
    """Where many are missing, none is used; positions and commands are read all the same."""
    data = motion()
    rows = np.column_stack((data.time, data.q, data.q + 0.01, data.tau))
    count = round(share * len(rows))
    rows[:count, 8] = np.nan
    path = write(tmp_path / "log.csv", rows, SERVO_TITLES)
    log = read_measurements(path, JOINTS, commanded=True)
    is_used = share < 0.1
    kept = rows[count if is_used else 0 :]
    np.testing.assert_array_equal(log.command, kept[:, 4:7])
    note = (
        f"recorded motor torques are not used, and not needed: {count} rows lack them"
    )
    assert (note in notes_of(log)) == (not is_used)
    if is_used:
        np.testing.assert_array_equal(log.motor_torque, kept[:, 7:])
        np.testing.assert_array_equal(log[5:9].motor_torque, kept[5:9, 7:])
    else:
        assert log.motor_torque is None


def test_a_log_of_servos_is_read_alike_with_torques_and_without(tmp_path):
    data = motion()
    rows = np.column_stack((data.time, data.q, data.q + 0.01, data.tau))
    logs = []
    for name, width in (("with", 10), ("without", 7)):
        path = write(tmp_path / name, rows[:, :width], SERVO_TITLES[:width])
        logs.append(read_measurements(path, JOINTS, commanded=True))
    own, other = (log.arrays() for log in logs)
    np.testing.assert_array_equal(own.pop("motor_torque"), data.tau)
    assert own.keys() == other.keys()
    for name, values in other.items():
        np.testing.assert_array_equal(own[name], values)


def test_a_slide_in_millimetres_is_told_by_its_range(tmp_path):
    data = motion()
    rows = table(data)
    rows[:, 2] = 400.0 * data.q[:, 1]
    path = write(tmp_path / "log.csv", rows)
    arm = {"limits": limits(0.5), "is_slide": (False, True, False)}
    with refused("positions look like millimetres.*--units mm") as caught:
        read_measurements(path, JOINTS, **arm)
    assert caught.value.options == (("--units", "mm"),)
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

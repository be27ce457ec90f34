"""Lists in cells and a row per signal: every way of writing them reads the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rigs.logs import recorded
from rigs.logs.log_files import (
    JOINTS,
    TITLES,
    assert_read,
    assert_refused,
    motion,
    notes_of,
    table,
    write,
)
from robot_sysid.logs.documents import dialect_table
from robot_sysid.logs.text import read_dialect

DATA = motion(60)
ORDER = [2, 0, 1]
NAMES = [JOINTS[k] for k in ORDER]
SAMPLES = [*zip(DATA.time.tolist(), DATA.q, DATA.tau)]


def write_lists(folder, text_of, separator=","):
    """Write the log with a list in a cell, as a function of an array writes it."""
    rows = [[time, text_of(q), text_of(tau)] for time, q, tau in SAMPLES]
    return write(folder / "log.csv", rows, ("time", "q", "tau"), separator)


def of_numpy(array: np.ndarray) -> str:
    with np.printoptions(precision=17):
        return f'"{array}"'


def plain(array: np.ndarray) -> str:
    return str(array.tolist())


@pytest.mark.parametrize(
    ("text_of", "separator"),
    [
        (of_numpy, ","),
        (lambda array: of_numpy(array).replace(" ", "\n ", 1), ","),
        (lambda array: f'"{list(array)}"', ","),
        (lambda array: f'"{tuple(array.tolist())}"', ","),
        (plain, ","),
        (plain, ";"),
        (lambda array: plain(array).replace(" ", ""), " "),
    ],
)
@pytest.mark.parametrize("size", [40, 1_000_000])
def test_a_list_in_a_cell_is_a_column_each(tmp_path, text_of, separator, size):
    path = write_lists(tmp_path, text_of, separator)
    dialect = replace(read_dialect(path), chunk_size=size)
    assert_read(dialect_table(dialect, JOINTS), DATA, ("time", "q", "tau"), atol=1e-14)


def test_lists_of_other_lengths_are_left_out_or_refused(tmp_path):
    path = write_lists(tmp_path, plain)
    first, *lines = path.read_text().splitlines()
    short = [line.rpartition(",")[0] + "]" for line in lines]
    path.write_text("\n".join([first, short[0], *lines[1:]]))
    log = assert_read(path, DATA[1:])
    assert "columns tau[2]" in notes_of(log)
    path.write_text("\n".join([first, *short]))
    assert_refused("needs one torque column", path)


@pytest.mark.parametrize("key", ["name", "which"])
def test_lists_beside_a_list_of_names_are_read_by_name(tmp_path, key):
    rows = []
    for time, q, tau in SAMPLES:
        lists = (NAMES, q[ORDER].tolist(), tau[ORDER].tolist())
        rows.append([time, *map('"{}"'.format, lists)])
    path = write(tmp_path / "log.csv", rows, ("time", key, "q", "tau"))
    assert_read(path, DATA)


def test_numbered_columns_beside_a_list_of_names_are_read_by_name(tmp_path):
    titles = [f"{name}{k}" for name in ("position", "effort") for k in range(3)]
    names = f"[{' '.join(NAMES)}]"
    rows = [[names, time, *q[ORDER], *tau[ORDER]] for time, q, tau in SAMPLES]
    path = write(tmp_path / "log.csv", rows, ["name", "time", *titles])
    assert_read(path, DATA)


def joint_rows(step: float = 0.0, names=JOINTS) -> list[list[object]]:
    """A row per joint and instant; each joint is read a step of time [s] after the one before."""
    rows = []
    for time, *values in SAMPLES:
        for k, name in enumerate(names):
            rows.append([time + k * step, name, *(array[k] for array in values)])
    return rows


def write_joints(folder, rows):
    titles = ("time", "joint", "position", "torque")
    return write(folder / "log.csv", rows, titles)


@pytest.mark.parametrize("names", [JOINTS, (1, 2, 3)])
def test_joints_that_are_read_in_turn_keep_their_own_times(tmp_path, names):
    path = write_joints(tmp_path, joint_rows(1e-4, names))
    log = assert_read(path, DATA, ("time", "q"))
    stamps = DATA.time[:, None] + 1e-4 * np.arange(3)
    np.testing.assert_array_equal(log.joint_time, stamps)


def test_rows_of_joints_whose_end_or_middle_is_missing_are_read(tmp_path):
    rows = joint_rows()[:-1]
    del rows[30]
    kept = np.delete(np.arange(59), 10)
    assert_read(write_joints(tmp_path, rows), DATA[kept])


def test_rows_of_joints_that_are_written_twice_are_one(tmp_path):
    for step in (0.0, 1e-4):
        rows = joint_rows(step)
        path = write_joints(tmp_path, [*rows, *rows[::10]])
        log = assert_read(path, DATA, ("time", "q", "tau"))
        assert "written twice: 18" in notes_of(log)


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        (
            [*joint_rows(), *([*row[:3], 9.0] for row in joint_rows())],
            "180 rows repeat the time and name of another one",
        ),
        ([["never", "base", 0.1, 0.2]], "holds no numbers in states"),
    ],
)
def test_rows_of_joints_that_make_no_recording_are_refused(tmp_path, rows, fault):
    assert_refused(fault, write_joints(tmp_path, rows))


def test_a_word_that_changes_in_a_table_with_a_row_per_instant_is_left_out(tmp_path):
    rows = [["ab"[k // 40], *row] for k, row in enumerate(table(DATA))]
    assert_read(write(tmp_path / "log.csv", rows, ["label", *TITLES]), DATA)


def test_other_lines_of_printed_messages_are_passed_over(tmp_path):
    path = recorded.echo(tmp_path, DATA, csv=True)
    lines = path.read_text().splitlines()
    gripper = lines[0].split(",")[:3] + ["finger", "0.1", "0.2", "0.3"]
    path.write_text("\n".join([",".join(gripper), "", *lines])[:-30])
    assert_read(path, DATA[:-1])


def write_series(folder, names=TITLES, separator=","):
    """Write the log with a row per signal, its name in front."""
    rows = [[name, *numbers] for name, numbers in zip(names, table(DATA).T)]
    return write(folder / "log.csv", rows, (), separator)


@pytest.mark.parametrize("separator", [",", ";"])
def test_a_row_per_signal_with_its_samples_is_read(tmp_path, separator):
    log = assert_read(
        write_series(tmp_path, separator=separator), DATA, ("time", "q", "tau")
    )
    assert log.notes[0].startswith("a row per signal, 7 signals: ")


def test_a_signal_that_is_there_twice_is_refused(tmp_path):
    names = (*TITLES[:-1], "q1")
    assert_refused(
        "a row per signal, of which 'q1' is there twice", write_series(tmp_path, names)
    )


def test_rows_of_positions_and_rows_of_torques_in_one_table_are_joined(tmp_path):
    """As a program exports two topics: torques lie a little later."""
    data = motion(400)
    rows = []
    for time, q, tau in zip(data.time, data.q, data.tau):
        rows.append([time, *q, "", "", ""])
        rows.append([time + 1e-3, "", "", "", *tau])
    log = assert_read(write(tmp_path / "log.csv", rows), data[1:], ("q",))
    assert "in rows of their own, and are joined by time" in notes_of(log)
    expected = motion(400).tau[1:]
    assert np.max(np.abs(log.tau - expected)) < 0.05

"""Lists in cells and a row per signal: every way of writing them reads the same."""

from __future__ import annotations

import numpy as np
import pytest

from rigs import recorded
from rigs.log_files import (
    JOINTS,
    assert_refused,
    motion,
    notes_of,
    read_measurements,
    table,
    write,
)

DATA = motion(60)


def write_lists(folder, text_of, separator=","):
    """Write the log with a list in a cell, as a function of an array writes it."""
    lines = [separator.join(("time", "q", "tau"))]
    for time, q, tau in zip(DATA.time.tolist(), DATA.q, DATA.tau):
        lines.append(separator.join((str(time), text_of(q), text_of(tau))))
    path = folder / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def of_numpy(array: np.ndarray) -> str:
    with np.printoptions(precision=17):
        return f'"{array}"'


@pytest.mark.parametrize(
    ("text_of", "separator"),
    [
        (of_numpy, ","),
        (lambda array: of_numpy(array).replace(" ", "\n ", 1), ","),
        (lambda array: f'"{list(array)}"', ","),
        (lambda array: f'"{tuple(array.tolist())}"', ","),
        (lambda array: str(array.tolist()), ","),
        (lambda array: str(array.tolist()), ";"),
        (lambda array: str(array.tolist()).replace(" ", ""), " "),
    ],
    ids=[
        "NumPy",
        "in lines",
        "np.float64",
        "tuple",
        "no quotes",
        "semicolon",
        "blanks",
    ],
)
@pytest.mark.parametrize("size", [40, 1_000_000])
def test_a_list_in_a_cell_is_a_column_each(
    tmp_path, monkeypatch, text_of, separator, size
):
    monkeypatch.setattr("robot_sysid.logs.text.CHUNK", size)
    log = read_measurements(write_lists(tmp_path, text_of, separator), JOINTS)
    np.testing.assert_array_equal(log.time, DATA.time)
    np.testing.assert_allclose(log.q, DATA.q, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(log.tau, DATA.tau, rtol=0.0, atol=1e-14)


def test_lists_of_other_lengths_are_left_out_or_refused(tmp_path):
    path = write_lists(tmp_path, lambda array: str(array.tolist()))
    first, *lines = path.read_text().splitlines()
    lines[10] = lines[10].rpartition(",")[0] + "]"
    path.write_text("\n".join([first, *lines]))
    log = read_measurements(path, JOINTS)
    assert len(log) == 59 and "columns tau[2]" in notes_of(log)
    path.write_text(
        "\n".join([first, *(line.rpartition(",")[0] + "]" for line in lines)])
    )
    assert_refused("needs one torque column", path)


@pytest.mark.parametrize("key", ["name", "which"])
def test_lists_beside_a_list_of_names_are_read_by_name(tmp_path, key):
    order = [2, 0, 1]
    lines = [f"time,{key},q,tau"]
    names = [JOINTS[k] for k in order]
    for time, q, tau in zip(DATA.time.tolist(), DATA.q, DATA.tau):
        lists = (names, q[order].tolist(), tau[order].tolist())
        lines.append(",".join([str(time), *(f'"{cell}"' for cell in lists)]))
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    log = read_measurements(path, JOINTS)
    np.testing.assert_array_equal(log.q, DATA.q)
    np.testing.assert_array_equal(log.tau, DATA.tau)


def test_numbered_columns_beside_a_list_of_names_are_read_by_name(tmp_path):
    order = [2, 0, 1]
    names = "[" + " ".join(JOINTS[k] for k in order) + "]"
    cells = np.column_stack((DATA.time, DATA.q[:, order], DATA.tau[:, order]))
    titles = [
        "name",
        "time",
        *(f"{n}{k}" for n in ("position", "effort") for k in range(3)),
    ]
    rows = [[names, *row] for row in cells.tolist()]
    log = read_measurements(write(tmp_path / "log.csv", rows, titles), JOINTS)
    np.testing.assert_array_equal(log.q, DATA.q)
    np.testing.assert_array_equal(log.tau, DATA.tau)


def joint_lines(step: float = 0.0, names=JOINTS) -> list[str]:
    """A row per joint and instant; each joint is read a step of time [s] after the one before."""
    lines = []
    for time, q, tau in zip(DATA.time.tolist(), DATA.q.tolist(), DATA.tau.tolist()):
        for k, name in enumerate(names):
            lines.append(f"{time + k * step},{name},{q[k]},{tau[k]}")
    return lines


def write_joints(folder, lines):
    path = folder / "log.csv"
    path.write_text("\n".join(["time,joint,position,torque", *lines]) + "\n")
    return path


@pytest.mark.parametrize("names", [JOINTS, (1, 2, 3)])
def test_joints_that_are_read_in_turn_keep_their_own_times(tmp_path, names):
    step = 1e-4
    log = read_measurements(write_joints(tmp_path, joint_lines(step, names)), JOINTS)
    np.testing.assert_array_equal(log.q, DATA.q)
    np.testing.assert_array_equal(log.time, DATA.time)
    stamps = DATA.time[:, None] + step * np.arange(3)
    np.testing.assert_array_equal(log.joint_time, stamps)


def test_rows_of_joints_whose_end_or_middle_is_missing_are_read(tmp_path):
    lines = joint_lines()
    del lines[30]
    log = read_measurements(write_joints(tmp_path, lines[:-1]), JOINTS)
    assert len(log) == 58
    np.testing.assert_array_equal(log.q[20:], DATA.q[21:-1])


def test_two_recordings_with_a_row_per_joint_are_refused(tmp_path):
    path = write_joints(tmp_path, 2 * joint_lines())
    assert_refused("180 rows repeat the time and name of another one", path)


def test_rows_of_joints_without_a_number_are_refused(tmp_path):
    path = write_joints(tmp_path, ["never,base,0.1,0.2", ""])
    assert_refused("holds no numbers in states", path)


def test_a_word_that_changes_in_a_table_with_a_row_per_instant_is_left_out(tmp_path):
    rows = [["ab"[k // 40], *row] for k, row in enumerate(table(DATA).tolist())]
    titles = ["label", "time", "q1", "q2", "q3", "tau1", "tau2", "tau3"]
    log = read_measurements(write(tmp_path / "log.csv", rows, titles), JOINTS)
    np.testing.assert_array_equal(log.q, DATA.q)


def test_other_lines_of_printed_messages_are_passed_over(tmp_path):
    path = recorded.echo(tmp_path, DATA, csv=True)
    lines = path.read_text().splitlines()
    gripper = lines[0].split(",")[:3] + ["finger", "0.1", "0.2", "0.3"]
    path.write_text("\n".join([",".join(gripper), "", *lines])[:-30])
    log = read_measurements(path, JOINTS)
    np.testing.assert_array_equal(log.tau, DATA.tau[:-1])

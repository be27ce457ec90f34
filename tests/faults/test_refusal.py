"""What a refused log is put right with: options, or the lines of a columns file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.logs.log_files import titles_alone
from robot_sysid.errors import ColumnsError
from robot_sysid.faults import Finding
from robot_sysid.faults.readings import mistakes
from robot_sysid.faults.refusal import refuse_for
from robot_sysid.logs.column_map import ColumnFinder
from robot_sysid.logs.declarations import read_columns
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.messages import Level

ROBOT = small_arms.robot_of(small_arms.serial_arm(small_arms.SEVEN_AXES[:3]))
NAMES = tuple(ROBOT.joint_names)
QUANTITIES = ("position", "velocity", "torque")
PLAIN = [f"{name} {quantity}" for quantity in QUANTITIES for name in NAMES]
ODD = ["q [deg]", "none", "-x", "2 * y", "k = v", "w # z", "a, b", "tau?", "tau?"]
"""Titles that a columns file cannot state as they are, one with a unit, one that occurs twice."""
NUMBERS = [f"#{number}" for number in range(2, 11)]
FILE = (
    "# mine\ntime = #1\nposition = #2, #3, #4\nvelocity = #5, #6, #7\n"
    "torque = #8, #9, #10\ntorque.joint1 = 0.5 * #9\n"
)
CORRECTIONS = [
    s.reading.columns
    for s in mistakes(ROBOT, range(3), np.ones(3))
    if s.text and s.reading.columns is not None
]
QUARTER = 0.5 * np.pi
ZEROS = [
    replace(CORRECTIONS[k], zeros=zeros)
    for k, zeros in ((0, (0.0, QUARTER, -QUARTER)), (-1, (np.pi, 0.0, 0.0)))
]


def columns_of(titles, path):
    choices = read_columns(path, NAMES)
    return ColumnFinder(titles_alone(["time", *titles]), ROBOT, choices).find_all()


def refusal(
    titles, correction, folder, text="", payload=(), is_line=False, **attributes
):
    """Return the error that refuses a log which was read with a columns file of this text.

    ``payload`` are options of that command; the text stands in for the file with ``is_line``.
    """
    path = folder / "mine.txt"
    path.write_text(text)
    columns = SimpleNamespace(**{**vars(columns_of(titles, path)), **attributes})
    log = SimpleNamespace(
        name="run.csv",
        columns=columns,
        joint_names=NAMES,
        options={"columns": text if is_line else path if text else None},
    )
    finding = Finding(
        Level.REFUSES, "order", "it is wrong", "", payload, "payload", correction
    )
    return refuse_for([log], [finding])


def signals(columns, quantity):
    """Return what joints would get of a log whose column k holds the number k."""
    return [c.factor * (c.index - c.zero) for c in getattr(columns, quantity)]


@pytest.mark.parametrize(
    ("titles", "text"),
    [
        (PLAIN, ""),
        (PLAIN, FILE),
        (ODD, FILE),
        (NUMBERS, FILE),
        (PLAIN, FILE + "zero = 5, 6, 7\n"),
    ],
)
@pytest.mark.parametrize("correction", CORRECTIONS + ZEROS)
def test_the_file_corrects_what_was_read(
    titles, text, correction, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    error = refusal(titles, correction, tmp_path, text)
    assert isinstance(error, ColumnsError)
    assert error.options == (("--columns", "run_columns.txt"),)
    before = columns_of(titles, tmp_path / "mine.txt")
    Path(error.name).write_text(error.draft)
    after = columns_of(titles, Path(error.name))
    for quantity in QUANTITIES:
        source = "position" if quantity == "velocity" else quantity
        order, factors = zip(*getattr(correction, source))
        expected = np.array(signals(before, quantity))[list(order)] * factors
        if quantity == "position" and correction.zeros:
            expected += correction.zeros
        np.testing.assert_allclose(signals(after, quantity), expected)


def test_a_line_becomes_the_lines_of_the_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = "time = #1, position = * position, torque = #8..#10"
    error = refusal(PLAIN, CORRECTIONS[0], tmp_path, line, is_line=True)
    assert error.draft.startswith(line.replace(", ", "\n"))
    assert len(error.draft.splitlines()) > 4


def test_a_file_of_another_text_is_not_suggested(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("run_columns.txt").write_text("torque = a, b, c\n")
    Path("run_columns_2.txt").mkdir()
    error = refusal(PLAIN, CORRECTIONS[0], tmp_path)
    assert error.name == "run_columns_3.txt"
    Path(error.name).write_text(error.draft)
    assert refusal(PLAIN, CORRECTIONS[0], tmp_path).name == error.name


def test_a_joint_without_a_column_gets_no_other_zero(tmp_path):
    """Its number is the user's."""
    text = "position.joint1 = 0.3\ntorque.joint1 = none\n"
    error = refusal(PLAIN, ZEROS[0], tmp_path, text)
    assert not isinstance(error, ColumnsError) and error.options == ()


@pytest.mark.parametrize("attribute", ["commanded", "joint_time"])
def test_no_file_is_suggested_that_would_not_put_the_log_right(attribute, tmp_path):
    error = refusal(PLAIN, CORRECTIONS[0], tmp_path, **{attribute: True})
    assert not isinstance(error, ColumnsError) and error.options == ()


def test_a_weighing_takes_the_file_that_turns_signs_round(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scales = ("--torque-scale", "0.1,0.2,0.3")
    error = refusal(PLAIN, CORRECTIONS[0], tmp_path, payload=(scales,))
    assert error.command == "payload"
    assert error.options == ((*scales, "--columns", "run_columns.txt"),)


@pytest.mark.parametrize("is_declared", [False, True])
def test_an_option_is_suggested_that_no_title_contradicts(is_declared):
    log = SimpleNamespace(
        name="run.csv", columns=SimpleNamespace(angle_declared=is_declared)
    )
    option = ("--units", "deg")
    finding = Finding(Level.REFUSES, FaultName.ANGLE_UNIT, "degrees", options=(option,))
    error = refuse_for([log], [finding])
    assert error.options == (() if is_declared else (option,))

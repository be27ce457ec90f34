"""Logs and settings with characters that nobody sees, and numbers of thousands of digits."""

from __future__ import annotations

import json

import pytest

from rigs.arms import small_arms
from rigs.files.refusals import refused
from rigs.logs.log_files import TITLES, motion, table, write
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import open_logs
from robot_sysid.records.file_access import read_json, read_toml
from robot_sysid.records.messages import printable, shell_line, visible

AXES = (small_arms.Z, small_arms.Y, small_arms.Y)
DIGITS = "1" * 5000


@pytest.fixture(scope="module")
def robot():
    return small_arms.robot_of(small_arms.serial_arm(AXES, joint='range="-3 3"'))


@pytest.mark.parametrize("mark", ["\u200b", "\ufeff", "\xad", "\u200d", "\u202e"])
def test_characters_that_nobody_sees_are_no_part_of_a_title(tmp_path, robot, mark):
    titles = [f"{title[0]}{mark}{title[1:]}" for title in TITLES]
    path = write(tmp_path / "log.csv", table(motion()), titles)
    (log,) = open_logs(robot, [path], LogOptions())
    assert log.columns.time.title == "time"
    assert any("characters that nobody sees" in str(note) for note in log.notes)
    # A title that is copied from the file into a line has them, too.
    columns = f"position = q{mark}*"
    (stated,) = open_logs(robot, [path], LogOptions(columns=columns))
    assert stated.columns.position == log.columns.position


def test_what_nobody_sees_is_printed_by_its_code():
    text = "q\u200b1 \x1b[31m\u202e"
    assert printable(text) == "q\\u200b1 ?[31m?"
    assert shell_line([text]) == "$'q\\u200b1 \\x1b[31m\\u202e'"
    assert visible("q\u200b1") == "q1"


def test_an_integer_of_thousands_of_digits_is_refused_in_own_words(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(f"duration = {DIGITS}\n")
    with refused("c.toml: an integer has 5000 digits; correct it$"):
        read_toml(path)
    path.write_text(f'a = "{DIGITS}"\nb = [\n')
    with refused("Invalid|Unclosed|at end"):
        read_toml(path)
    path.write_text(f'{{"a": {DIGITS}}}')
    assert read_json(path, "")["a"] == float("inf")


def test_such_an_integer_spoils_the_column_alone_that_it_is_in(tmp_path, robot):
    states = [
        {"t": t, "q": q.tolist(), "tau": tau.tolist(), "n": 7}
        for t, q, tau in zip(motion().time, motion().q, motion().tau)
    ]
    path = tmp_path / "log.json"
    lines = [json.dumps(state).replace("7}", f"{DIGITS}}}") for state in states]
    path.write_text("\n".join(lines))
    (log,) = open_logs(robot, [path], LogOptions())
    assert len(log) == len(states)

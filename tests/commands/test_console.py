"""What the console shows, and to whom."""

from __future__ import annotations

import io
import json
import re
import sys
import time
from pathlib import Path

import pytest

from robot_sysid.commands import Console, print_line
from robot_sysid.records.messages import Detail


@pytest.mark.parametrize(("verbose", "count"), [(False, 1), (True, 2)])
def test_details_are_printed_where_they_are_asked_for_alone(capsys, verbose, count):
    console = Console(verbose=verbose)
    for tell in (console.stage, console.note):
        tell("what is found")
        tell(Detail("how"))
    printed = capsys.readouterr()
    assert len(printed.out.splitlines()) == len(printed.err.splitlines()) == count


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self):
        return True


LONG = "Usable: " + " ".join(["torque"] * 30)


@pytest.mark.parametrize(
    ("name", "value"), [("NO_COLOR", "1"), ("TERM", "dumb"), ("TERM", "xterm")]
)
def test_a_terminal_gets_lines_that_fit_in_colour_unless_it_is_forbidden(
    monkeypatch, name, value
):
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv(name, value)
    printed = Terminal()
    print_line(LONG, printed)
    coloured = printed.getvalue().startswith("\x1b[32mUsable\x1b[0m: ")
    assert coloured is (value == "xterm")
    plain = re.sub(r"\x1b\[\d+m", "", printed.getvalue())
    assert max(map(len, plain.splitlines())) <= 60 and plain.split() == LONG.split()


@pytest.mark.parametrize(
    ("stream", "line"),
    [
        (io.StringIO, LONG),
        (Terminal, f"{LONG[8:]}  kg"),
        (Terminal, f"robot-sysid identify {LONG[8:]}"),
    ],
)
def test_a_pipe_a_command_and_the_row_of_a_table_get_what_is_said(
    monkeypatch, stream, line
):
    monkeypatch.setenv("COLUMNS", "60")
    printed = stream()
    print_line(line, printed)
    assert printed.getvalue() == f"{line}\n"


def test_a_result_as_json_has_standard_output_for_itself(capsys):
    for as_json in (True, False):
        console = Console(json=as_json)
        console.stage("a stage")
        console.note("a note")
        console.result({"value": float("nan"), "at": Path("x").name})
        printed = capsys.readouterr()
        if as_json:
            assert json.loads(printed.out) == {"value": None, "at": "x"}
            assert printed.err == "a stage\nnote: a note\n" and console.json_lines == [
                "a stage"
            ]
        else:
            assert (printed.out, printed.err) == ("a stage\n", "note: a note\n")


def test_a_bar_tells_the_time_left_until_a_line_takes_its_place(monkeypatch):
    monkeypatch.setattr("sys.stderr", Terminal())
    monkeypatch.setattr("sys.stdout", Terminal())
    console = Console()
    for done in range(1, 4):
        time.sleep(0.3)
        console.advance("Identifying", done, 10, "")
        console.stage(Detail("nobody sees this"))
    assert re.search(r"Identifying: +30%.*\[00:0\d<00:0\d\]", sys.stderr.getvalue())
    console.stage("a line")
    assert sys.stdout.getvalue() == "a line\n"
    assert sys.stderr.getvalue().endswith("\r")


def test_a_log_file_is_told_now_and_then_that_something_long_lives(monkeypatch, capsys):
    monkeypatch.setattr("time.monotonic", lambda: 1.0)
    console = Console()
    for done, now in enumerate((11.1, 11.2, 12.0, 12.1)):
        monkeypatch.setattr("time.monotonic", lambda now=now: now)
        console.advance("Designing", done, 4, "mass ± 1 kg")
        console.advance("Playing", done, 4, "")
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "Designing: 25 %, mass ± 1 kg\n")

"""What a whole run does to the machine: files where it was told to, no network, no code of others;
and which test holds each line of docs/security.md: a hostile file is tested where it is read.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rigs.arms.small_arms import serial_arm
from rigs.files.places import ROOT

DOCUMENTS = "mjcf/test_documents.py::"
ARRAYS = "logs/test_arrays.py::"
SPECIAL = "commands/test_special_files.py::test_no_path_leads_to_a_pipe_or_a_device"
HELD = {
    "XML entities": f"{DOCUMENTS}test_what_is_no_model_is_refused_in_one_line",
    "a `<!DOCTYPE>`": f"{DOCUMENTS}test_a_doctype_in_another_file_is_not_opened",
    "an `<include>`": f"{DOCUMENTS}test_nothing_of_a_file_that_is_no_model_is_shown",
    "a model that includes itself": f"{DOCUMENTS}test_includes_that_fail_are_one_line",
    "a model of more than": "mjcf/test_size.py::"
    "test_what_no_arm_has_is_refused_by_its_size",
    "comments that": f"{DOCUMENTS}test_marks_that_never_end_take_no_longer_than_their_length",
    "elements nested": f"{DOCUMENTS}test_what_is_no_model_is_refused_in_one_line",
    "a pipe or a device in place of a model": SPECIAL,
    "a mesh": "mjcf/test_assets.py::test_a_pipe_in_the_place_of_a_mesh_is_not_waited_for",
    "or a log": SPECIAL,
    "any other path": SPECIAL,
    "a pickled": f"{ARRAYS}test_a_pickled_object_is_never_loaded",
    "JSON nested": "records/test_file_access.py::test_what_is_no_json_is_refused_in_one_line",
    "settings or results": "records/test_file_access.py::"
    "test_toml_without_end_or_with_a_character_zero_is_refused_in_one_line",
    "a character zero": "records/test_file_access.py::"
    "test_toml_without_end_or_with_a_character_zero_is_refused_in_one_line",
    "a params.json with": "results/test_schema.py::test_what_is_missing_is_named",
    "an integer": "records/test_file_access.py::test_an_integer_beyond_all_floats_is_infinite",
    "names and titles": "test_cli.py::test_of_a_long_name_beginning_and_end_are_shown",
    "control characters": "test_cli.py::test_names_cannot_steer_the_terminal",
    "column titles": "commands/test_log.py::test_titles_cannot_steer_the_terminal",
    "ends of lines": "test_cli.py::test_names_do_not_break_the_lines_of_what_is_written",
    "state no option": "test_cli.py::"
    "test_the_name_of_a_folder_states_no_option_and_no_command",
    "a command in a title": "test_cli.py::"
    "test_no_title_of_a_log_becomes_a_command_below_an_error",
    "so in the report": "report/test_page.py::test_a_page_has_no_control_characters",
    "and in cards": "results/test_cards.py::"
    "test_the_name_of_a_frame_begins_no_line_of_a_card",
    "texts of a params.json": "report/test_page.py::"
    "test_no_text_of_a_result_becomes_a_command_or_a_file_of_another_folder",
    "names with HTML": "report/test_page.py::"
    "test_every_tag_is_closed_names_are_text_and_nothing_is_loaded_from_elsewhere",
    "a xacro, which": "mjcf/test_xacro_files.py::test_a_strangers_xacro_does_no_harm",
    "numbers such as": "model/test_compilation.py::"
    "test_what_mujoco_refuses_is_one_line_with_the_file",
    "as an option": "test_config.py::"
    "test_what_means_nothing_or_excludes_each_other_is_refused",
    "counted in a log": "logs/test_table.py::"
    "test_rows_with_holes_or_rubbish_are_left_out_and_counted",
    "Nothing is written": "test_security.py::"
    "test_files_are_written_where_a_command_says_and_no_network_is_opened",
    "A run that would": "test_config.py::"
    "test_what_means_nothing_or_excludes_each_other_is_refused",
    "Files appear whole": "records/test_file_access.py::"
    "test_an_error_at_any_instant_leaves_whole_files_and_nothing_else",
    "What a killed run": "records/test_drafts.py::"
    "test_of_a_living_run_all_stays_and_of_a_killed_one_nothing",
    "No network": "test_security.py::"
    "test_files_are_written_where_a_command_says_and_no_network_is_opened",
}
"""Words of the page to the test that holds them."""


def test_each_line_of_the_page_has_its_test():
    page = " ".join((ROOT / "docs" / "security.md").read_text(encoding="utf-8").split())
    rows = (
        page.partition("| --- | --- |")[2]
        .partition("Nothing is written")[0]
        .split(" | | ")
    )
    for row in rows:
        assert any(words in row for words in HELD), row
    for words, test in HELD.items():
        path, _, name = test.partition("::")
        assert words in page, words
        assert f"def {name}(" in (ROOT / "tests" / path).read_text(encoding="utf-8"), (
            test
        )


WATCHED = """
import json, os, sys

seen = []
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGES = {"os.rename": 1, "os.link": 1, "os.symlink": 1, "os.mkdir": 0, "os.remove": 0}
REFUSED = ("socket.connect", "socket.bind", "socket.getaddrinfo", "urllib", "os.system", "pickle")

def watch(event, arguments):
    if event == "open" and isinstance(arguments[0], (str, bytes)) and arguments[2] & WRITES:
        seen.append(("write", os.path.abspath(os.fsdecode(arguments[0]))))
    elif event in CHANGES:
        seen.append(("write", os.path.abspath(os.fsdecode(arguments[CHANGES[event]]))))
    elif event.startswith(REFUSED):
        seen.append((event, str(arguments)))

sys.addaudithook(watch)
from robot_sysid.cli import main

codes = [main(line.split()) for line in sys.argv[1:]]
print(json.dumps([codes, seen]))
"""
JOINT = 'range="-2.5 2.5" frictionloss=".4" damping=".2" actuatorfrcrange="-60 60"'
RATE = "--duration 6 --sample-rate 200 --seed 1"
LINES = (
    f"arm.xml {RATE} --plant-model arm.xml --noise-torque 0.01 --save-measurements out/log.csv "
    "--output-dir out",
    "identify arm.xml out/log.csv --report --output-dir out",
    f"plan arm.xml {RATE} --excitation sines --save-trajectory out/plan.json --output-dir out ",
)


@pytest.mark.slow
def test_files_are_written_where_a_command_says_and_no_network_is_opened(tmp_path):
    pytest.importorskip("matplotlib")
    (tmp_path / "arm.xml").write_text(serial_arm(joint=JOINT))
    home = tmp_path / "home"
    temporary = tmp_path / "temporary"
    home.mkdir()
    temporary.mkdir()
    cache = home / "cache"
    folders = {"HOME": str(home), "TMPDIR": str(temporary)}
    settings = {
        "MPLCONFIGDIR": str(cache),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONPATH": str(ROOT),
    }
    call = [sys.executable, "-c", WATCHED, *LINES]
    done = subprocess.run(
        call,
        cwd=tmp_path,
        env={**os.environ, **folders, **settings},
        capture_output=True,
        text=True,
    )
    codes, events = json.loads(done.stdout.splitlines()[-1])
    assert set(codes) <= {0, 1}, done.stderr
    assert [event for event in events if event[0] != "write"] == []
    written = {Path(path) for _, path in events} - {Path(os.devnull)}
    allowed_folders = {tmp_path / "out", cache, temporary}
    assert {
        path for path in written if not allowed_folders & {path, *path.parents}
    } == set()
    assert tmp_path / "out" / "report.html" in written
    assert list(temporary.iterdir()) == [] and list(home.iterdir()) == [cache]

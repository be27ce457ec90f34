"""Every state's command is one that its parser takes, and the last lines name what was written."""

from pathlib import Path

import mujoco
import pytest

from rigs.files import results as made
from rigs.files.command_line import COMMANDS
from robot_sysid.pipeline.next_steps import STEPS, step_after
from robot_sysid.records.messages import NextStep
from robot_sysid.results.content import content_of
from robot_sysid.results.lines import last_lines, load_lines

WORDS = {
    "log": ["first log.csv", "b.csv"],
    "weight": "weight.csv",
    "scales": "1.1",
    "trajectory": "damiao_trajectory.csv",
    "folder": Path("out"),
    "now": "13 %",
    "expected": "3 %",
    "share": "30 %",
    "plan_options": ["--duration", "60"],
    "mass": "0.2",
    "place": "0 0 0.1",
    "body": "hand",
    "joints": "lift",
    "after": "5 %",
}


@pytest.mark.parametrize("state", STEPS)
def test_the_command_of_every_state_is_taken(state):
    values = {"path": "an arm.xml", "joint": "j6", "keyframe": "home"}
    step = step_after(state, values, **WORDS)
    program, name, *words = step.command
    assert program == "robot-sysid" and "{" not in step.sentence
    if name == "motors":
        name = f"motors {words.pop(0)}"
    assert COMMANDS[name].parse(words)[0]["joint"] == "j6"
    assert ("b.csv" in words) == ("{log}" in STEPS[state].command)


@pytest.mark.parametrize(
    "name, ending",
    [("run.csv", ".csv"), ("run.mcap", ".mcap"), ("2026.10.01", ""), ("data", "")],
)
def test_a_new_recording_has_the_form_of_the_log(tmp_path, name, ending):
    log = tmp_path / name
    if not ending:
        log.mkdir()
    new_ones = {
        "part bolted on": tmp_path / f"empty{ending}",
        "part not seen": tmp_path / f"empty{ending}",
        "servo sizes unknown": Path("out", f"weight{ending}"),
    }
    for state, new in new_ones.items():
        step = step_after(state, {"path": "arm.xml"}, **{**WORDS, "log": [log]})
        recording = str(new)
        assert recording in step.command and recording in step.sentence
    held = step_after("part bolted on", {"path": "arm.xml"}, **{**WORDS, "log": 1.0})
    assert "empty.csv" in held.command
    # No recording that is there is proposed to be replaced.
    (tmp_path / f"empty{ending}").touch()
    step = step_after("part bolted on", {"path": "a.xml"}, **{**WORDS, "log": [log]})
    assert str(tmp_path / f"empty1{ending}") in step.command


def test_the_last_lines_name_the_files_that_were_written():
    step = NextStep("Next, plan", ("robot-sysid", "plan", "it's.xml"))
    found = content_of(made.found())
    verdict, mass, *lines = last_lines(found, [Path("o ut/updated_model.urdf")], step)
    assert verdict == "Usable: o ut/updated_model.urdf"
    assert mass.startswith("link6 weighs ")
    assert lines == [
        '  mujoco.MjModel.from_xml_path("o ut/updated_model.urdf")',
        f"It loads in MuJoCo {mujoco.__version__} (tested); others from 3.0 on load it if they "
        "load your model",
        "Next, plan:",
        "  robot-sysid plan 'it'\"'\"'s.xml'",
    ]
    *_, card = last_lines(
        content_of(made.payload()), [Path("out/payload_card.txt")], None
    )
    frame = "in the frame of site 'flange'"
    assert card == f"Copy into the controller, {frame}: out/payload_card.txt"
    refused = content_of(made.found(), failure="the disk is gone")
    refused = last_lines(refused, [Path("a.xml")], step)
    assert refused == ["Not usable: the disk is gone"]


def test_a_path_with_quotes_is_python_too():
    load, _ = load_lines(Path('a "b".xml'))
    assert load == '  mujoco.MjModel.from_xml_path("a \\"b\\".xml")'

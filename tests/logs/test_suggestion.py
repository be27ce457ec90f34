"""The command that a refusal prints, and units of slides; examples of lines: heads.txt."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.wrong_arms import truth_of
from rigs.files.command_line import OUT, CommandLine
from rigs.files.refusals import refused
from rigs.logs.log_files import (
    JOINTS,
    arm_of,
    limits,
    motion,
    open_log,
    write,
    write_signals,
)
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.wording import in_python

ARM = small_arms.serial_arm(small_arms.SEVEN_AXES[:4], joint='range="-2.5 2.5"')


@pytest.fixture(scope="module")
def truth():
    """An arm of four joints, joint0 to joint3, and a log of it."""
    return truth_of(small_arms.robot_of(ARM), 2)


def test_in_python_the_line_is_an_argument(truth, tmp_path):
    signals = {"zeit": "ms", "w{}": "deg", "m{}_torque_x": "tau"}
    path = write_signals(tmp_path / "log.csv", truth.log, signals)
    options = LogOptions("position = w*, units = deg")
    with in_python(), refused(r'give columns="position = w\*, units'):
        open_log(truth.robot, path, options)


def test_slides_have_units_of_their_own(tmp_path):
    log = motion()
    robot = arm_of(JOINTS, limits(1.0), (False, True, False))
    shown = replace(log, q=log.q * np.degrees([1.0, np.radians(1e3), 1.0]))
    signals = {"time": "t", "x{}_pos_y": "q", "tau{}": "tau"}
    path = write_signals(tmp_path / "log.csv", shown, signals)
    line = "position = x*_pos_y, units = deg, mm"
    with pytest.raises(InputError) as caught:
        open_log(robot, path)
    assert caught.value.options == (("--columns", line),)
    found = open_log(robot, path, LogOptions(columns=line))
    np.testing.assert_allclose(found.q, log.q, atol=1e-12)


def test_rows_of_postures_have_no_unit_of_time(truth, tmp_path):
    log = truth.log
    order = np.random.default_rng(0).permutation(len(log))[:60]
    postures = replace(log[:60], q=log.q[order], qd=log.qd[order], tau=log.tau[order])
    postures = replace(postures, time=20.0 * np.arange(60.0))
    signals = {"time": "t", "w{}_pos_y": "q", "tau{}": "tau"}
    path = write_signals(tmp_path / "log.csv", postures, signals)
    with pytest.raises(InputError) as caught:
        open_log(truth.robot, path)
    assert caught.value.options == (("--columns", "position = w*_pos_y"),)


@pytest.mark.parametrize("form", ["q{}", "joint{}_pos"])
def test_a_joint_without_columns_is_asked_for(truth, tmp_path, form):
    """A joint that stands still has a number in the place of a column."""
    log = truth.log
    moving = [0, 1, 3]
    names = ["time", *map(form.format, moving), *map("tau{}".format, moving)]
    rows = np.column_stack((log.time, log.q[:, moving], log.tau[:, moving]))
    path = write(tmp_path / "log.csv", rows, names)
    line = "position.joint2 = ?, torque.joint2 = none"
    with refused("if joint2 stood still") as caught:
        open_log(truth.robot, path)
    assert caught.value.options == (("--columns", line),)
    found = open_log(truth.robot, path, LogOptions(line.replace("?", "0.7")))
    np.testing.assert_array_equal(found.q[:, moving], log.q[:, moving])
    np.testing.assert_array_equal(found.q[:, 2], 0.7)
    assert any(
        "joints that do not move in this log: joint2" in note for note in found.notes
    )


def test_columns_that_are_left_over_are_those_of_the_joint_without(truth, tmp_path):
    """A joint that is called otherwise in the log did not stand still."""
    log = truth.log
    log_names = ("joint0", "joint1", "shoulder", "joint3")
    titles = [f"{name}_{of}" for of in ("position", "torque") for name in log_names]
    rows = np.column_stack((log.time, log.q, log.tau))
    path = write(tmp_path / "log.csv", rows, ["time", *titles])
    with refused(
        "shoulder_position and shoulder_torque are left over, for joint2"
    ) as caught:
        open_log(truth.robot, path)
    ((_, line),) = caught.value.options
    found = open_log(truth.robot, path, LogOptions(line))
    np.testing.assert_array_equal(found.q, log.q)
    np.testing.assert_array_equal(found.tau, log.tau)


def test_hundreds_of_columns_are_not_listed(truth, tmp_path):
    """A table with a column per sample, or of another machine."""
    titles = ["time", *map("x{}".format, range(600))]
    path = write(
        tmp_path / "log.csv", np.random.default_rng(1).normal(size=(50, 601)), titles
    )
    with refused("x22, 577 more") as caught:
        open_log(truth.robot, path)
    assert len(str(caught.value)) < 1000


TWINS = {
    "actuators": {
        "frame_time_ms": "ms",
        "actuators[{}].position": "deg",
        "actuators[{}].torque": "tau",
    },
    "German": {
        "Zeit": "t",
        "Ist-Position_A{}": "deg",
        "Soll-Position_A{}": "soll",
        "Ist-Moment_A{}": "tau",
    },
    "no titles": {"": "t", "#q{}": "q", "#qd{}": "qd", "#tau{}": "tau"},
}
"""Title to signal of a log, "{}" for the joint's number."""


@pytest.mark.slow
@pytest.mark.parametrize("name", TWINS)
def test_the_printed_command_gives_the_result_of_plain_titles(
    truth, tmp_path, monkeypatch, capsys, name
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(ARM)
    command = CommandLine(tmp_path, capsys)
    identify = ["identify", "arm.xml", "log.csv"]
    quantities = []
    for twin in ({"time": "t", "q{}": "q", "tau{}": "tau"}, TWINS[name]):
        write_signals(tmp_path / "log.csv", truth.log, twin)
        words = identify
        if quantities:
            printed = command.run(*identify, code=2).err.splitlines()[-1]
            assert printed.startswith(f"  robot-sysid {' '.join(identify)} --columns ")
            # Words with blanks stay one.
            words = [*map(Path, shlex.split(printed)[1:])]
        command.run(*words)
        quantities.append(json.loads((OUT / "params.json").read_text())["quantities"])
    for expected, found in zip(*quantities):
        assert (found["name"], found["of"]) == (expected["name"], expected["of"])
        assert found["value"] == pytest.approx(expected["value"], rel=1e-4, abs=1e-8)


SERVOS = small_arms.robot_of(
    small_arms.serial_arm(small_arms.SEVEN_AXES[:3], joint='range="-2.5 2.5"')
    .replace("joint0", "shoulder_pan")
    .replace("joint1", "elbow_flex")
    .replace("joint2", "wrist_roll")
)
POSITIONS = (
    "{}.pos",
    "{}_position",
    "observation.{}.pos",
    "observation.state.{}",
    "observation.state.{}.pos",
    "observation.state/{}.pos",
    "Present_Position.{}",
    "{} Winkel",
    "q{}",
    "observation.state[{}]",
)
COMMANDS = (
    "action.{}.pos",
    "action.{}",
    "action/main_{}.pos",
    "{}_goal",
    "{}.Goal_Position",
    "{}_target_position",
    "{} [deg] cmd",
    "{} Sollwert",
    "q_des{}",
    "action[{}]",
)
NUMBERED = ("q{}", "observation.state[{}]", "q_des{}", "action[{}]")


@pytest.mark.parametrize("goal", COMMANDS)
@pytest.mark.parametrize("place", POSITIONS)
def test_what_is_printed_for_a_log_of_servos_reads_it(tmp_path, place, goal):
    """Whatever its titles are, and with a gripper's columns and their states beside, in degrees."""
    time = np.arange(600) / 30.0
    command = 40.0 * np.sin(np.outer(time, [0.7, 1.1, 1.6]))
    q = np.vstack((command[:1].repeat(2, axis=0), command[:-2]))
    titles = ["timestamp"]
    for form in (place, goal):
        names = range(3) if form in NUMBERED else SERVOS.joint_names
        titles += map(form.format, names)
    titles += [
        "gripper_open",
        *(f"{name}_torque_enable" for name in SERVOS.joint_names),
    ]
    rows = np.column_stack((time, q, command, q[:, 0], np.ones((len(q), 3))))
    path = tmp_path / "log.csv"
    np.savetxt(path, rows, "%.6f", ",", header=",".join(titles), comments="")
    with pytest.raises(InputError) as caught:
        open_log(SERVOS, path)
    assert caught.value.command == "identify"
    (words,) = caught.value.options
    stated = dict(zip(words[::2], words[1::2]))
    assert stated.pop("--torque-from") == "position-error"
    given = {key.strip("-"): value for key, value in stated.items()}
    log = open_log(SERVOS, path, LogOptions(commanded=True, **given))
    np.testing.assert_allclose(log.q, np.radians(q), atol=1e-7)
    np.testing.assert_allclose(log.command, np.radians(command), atol=1e-7)

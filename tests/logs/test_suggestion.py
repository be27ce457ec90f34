"""The line that a refusal prints reads the log as if it had plain titles, or has a blank."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rigs import arms
from rigs.command_line import OUT, CommandLine
from rigs.log_files import (
    JOINTS,
    arm_of,
    assert_samples,
    limits,
    motion,
    open_log,
    write,
)
from rigs.refusals import refused
from rigs.wrong_arms import truth_of
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.wording import in_python

ARM = arms.serial_arm(arms.SEVEN_AXES[:4], joint='range="-2.5 2.5"')
TURN = 4096 / (2.0 * np.pi)


@pytest.fixture(scope="module")
def truth():
    """An arm of four joints, joint0 to joint3, and a log of it."""
    return truth_of(arms.robot_of(ARM), 2)


def signals_of(log) -> dict[str, np.ndarray]:
    """What logs hold, in SI units and in others."""
    return {
        "t": log.time[:, None],
        "ms": 1e3 * log.time[:, None],
        "row": np.arange(len(log.time))[:, None],
        "q": log.q,
        "qd": log.qd,
        "tau": log.tau,
        "deg": np.degrees(log.q),
        "deg/s": np.degrees(log.qd),
        "cdeg": 100.0 * np.degrees(log.q) + 1e-3,
        "ticks": 2048.0 + np.round(TURN * log.q),
        "heat": log.tau + 40.0,
        "warm": 0.0 * log.tau + 40.0 * np.eye(log.tau.shape[1])[1],
        "zeros": 0.0 * log.tau,
        "soll": np.degrees(log.q) + 0.01,
    }


TWINS = {
    "actuators": (
        {
            "frame_time_ms": "ms",
            "actuators[{}].position": "deg",
            "actuators[{}].torque": "tau",
        },
        "time = frame_time_ms, position = actuators[*].position, torque = actuators[*].torque, "
        "units = deg",
    ),
    "German": (
        {
            "Zeit": "t",
            "Ist-Position_A{}": "deg",
            "Soll-Position_A{}": "soll",
            "Ist-Moment_A{}": "tau",
        },
        "time = Zeit, position = Ist-Position_A*, torque = Ist-Moment_A*, units = deg",
    ),
    "units by numbers": (
        {
            "frame_time": "ms",
            "mot{}_pos_x": "deg",
            "mot{}_vel_x": "deg/s",
            "mot{}_trq_x": "tau",
        },
        "time = frame_time, position = mot*_pos_x, velocity = mot*_vel_x, torque = mot*_trq_x, "
        "units = ms, deg",
    ),
    "names that say nothing": (
        {"row": "row", "zeit": "t", "a{}": "q", "b{}": "qd", "c{}": "tau"},
        "time = zeit, position = a*, velocity = b*, torque = c*",
    ),
    "by name": (
        {
            "clock_x": "t",
            "{name}/winkel": "q",
            "{name}/x": "qd",
            "{name}/moment": "tau",
        },
        "time = clock_x, position = joint*/winkel, velocity = joint*/x",
    ),
    "no titles": (
        {"": "t", "#q{}": "q", "#qd{}": "qd", "#tau{}": "tau"},
        "time = #1, position = #2..#5, velocity = #6..#9, torque = #10..#13",
    ),
    "no titles and no time": (
        {"#q{}": "q", "#qd{}": "qd", "#tau{}": "tau"},
        "rate = 250, position = #1..#4, velocity = #5..#8, torque = #9..#12",
    ),
    "hundredths of degrees": (
        {"time": "t", "angle_meas_x_{}": "cdeg", "torque_{}": "tau"},
        "position = angle_meas_x_*, units = cdeg",
    ),
    "commanded torques": (
        {"time": "t", "q{}": "q", "tau_cmd{}": "tau", "tau_model{}": "tau"},
        "torque = tau_cmd*",
    ),
}
"""Title to signal of a log, "{}" for the joint's number, and the line that is expected."""


def write_twin(path, log, columns):
    """Write a log with these titles, from 1; without titles where one is empty or has a #."""
    signals = signals_of(log)
    titles = []
    for title, signal in columns.items():
        for joint in range(signals[signal].shape[1]):
            titles.append(title.format(joint + 1, name=f"joint{joint}"))
    rows = np.hstack([signals[name] for name in columns.values()])
    return write(path, rows, () if "#q1" in titles else titles)


def suggested(truth, folder, signals, robot=None, **options):
    """Return a log's path, and the options that remedy its refusal."""
    path = write_twin(folder / "log.csv", truth.log, signals)
    with pytest.raises(InputError) as caught:
        open_log(robot or truth.robot, path, LogOptions(**options))
    ((flag, *remedy),) = caught.value.options
    assert flag == "--columns"
    return path, *remedy


@pytest.mark.parametrize("name", TWINS)
def test_the_line_reads_a_twin_as_the_log_with_plain_titles(truth, tmp_path, name):
    columns, expected = TWINS[name]
    path, line = suggested(truth, tmp_path, columns)
    assert line == expected
    log = open_log(truth.robot, path, LogOptions(columns=line))
    log = replace(log, time=log.time - log.time[0])
    assert_samples(truth.log, log, ("time", "q", "tau"), atol=2e-5)


BLANKS = {
    "two angles": (
        {"time": "t", "a_pos_x{}": "q", "b_pos_x{}": "q", "tau{}": "tau"},
        "position",
    ),
    "swapped words": (
        {"time": "t", "x_vel{}": "q", "x_pos{}": "qd", "tau{}": "tau"},
        "position",
    ),
    "counts": ({"time": "t", "servo[{}].ticks": "ticks", "tau{}": "tau"}, "units"),
    "two clocks": (
        {"clock_x": "t", "clock_y": "ms", "q{}": "q", "tau{}": "tau"},
        "time",
    ),
    "computed torques": ({"time": "t", "q{}": "q", "tau_model{}": "tau"}, "torque"),
    "speeds": ({"time": "t", "q{}": "q", "x{}": "deg/s"}, "torque"),
    "heat": ({"time": "t", "q{}": "q", "x{}": "heat"}, "torque"),
    "constants": ({"time": "t", "q{}": "q", "x{}": "warm"}, "torque"),
    "zeros": ({"time": "t", "q{}": "q", "x{}_tau_y": "zeros"}, "torque"),
}
"""Title to signal of a log, and the key that cannot be told."""


@pytest.mark.parametrize("name", BLANKS)
def test_what_cannot_be_told_is_a_blank_and_refused(truth, tmp_path, name):
    columns, key = BLANKS[name]
    path, line = suggested(truth, tmp_path, columns)
    assert f"{key} = ?" in line
    with refused(f"{key} = .* is a blank"):
        open_log(truth.robot, path, LogOptions(columns=line))


def test_torques_of_the_other_arm_are_not_proposed(truth, tmp_path):
    columns = {"time": "t", "right_j{}_pos_x": "q", "left_j{}_trq_x": "tau"}
    given = "position = right_j*_pos_x"
    for side, torque in (("left", "left_j*_trq_x"), ("right", "?")):
        names = tuple(f"{side}_j{k}" for k in range(1, 5))
        robot = replace(truth.robot, joint_names=names)
        _, line = suggested(truth, tmp_path, columns, robot, columns=given)
        assert line == f"{given}, torque = {torque}"


def test_what_was_declared_stays_in_the_line(truth, tmp_path):
    columns = {"zeit": "ms", "w{}": "deg", "m{}_torque_x": "tau"}
    given = "position = w*, units = deg"
    path, line = suggested(truth, tmp_path, columns, columns=given)
    assert line == f"{given}, ms, time = zeit, torque = m*_torque_x"
    with in_python(), refused(r'give columns="position = w\*, units'):
        open_log(truth.robot, path, LogOptions(columns=given))


@pytest.mark.parametrize(
    ("title", "line"), [("Takt_ms", "time = Takt_ms"), ("Takt", "rate")]
)
def test_a_column_that_counts_is_a_clock_where_it_has_a_unit(
    truth, tmp_path, title, line
):
    columns = {title: "row", "Ist-Position_A{}": "deg", "Ist-Moment_A{}": "tau"}
    assert suggested(truth, tmp_path, columns)[1].startswith(line)


def test_slides_have_units_of_their_own(tmp_path):
    log = motion()
    robot = arm_of(JOINTS, limits(1.0), (False, True, False))
    shown = replace(log, q=log.q * np.degrees([1.0, np.radians(1e3), 1.0]))
    columns = {"time": "t", "x{}_pos_y": "q", "tau{}": "tau"}
    path, line = suggested(SimpleNamespace(robot=robot, log=shown), tmp_path, columns)
    assert line == "position = x*_pos_y, units = deg, mm"
    found = open_log(robot, path, LogOptions(columns=line))
    np.testing.assert_allclose(found.q, log.q, atol=1e-12)


def test_currents_come_with_their_constants(truth, tmp_path):
    columns = {"zeit": "t", "w{}_pos_x": "q", "x{}_current": "tau"}
    line = "time = zeit, position = w*_pos_x, torque = x*_current"
    _, *remedy = suggested(truth, tmp_path, columns)
    assert remedy == [line, "--torque-constants", "1"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["actuators", "German", "no titles"])
def test_the_printed_command_gives_the_result_of_plain_titles(
    truth, tmp_path, monkeypatch, capsys, name
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(ARM)
    command = CommandLine(tmp_path, capsys)
    identify = ["identify", "arm.xml", "log.csv"]
    quantities = []
    for twin in ({"time": "t", "q{}": "q", "tau{}": "tau"}, TWINS[name][0]):
        write_twin(tmp_path / "log.csv", truth.log, twin)
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

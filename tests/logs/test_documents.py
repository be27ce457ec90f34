"""JSON, Excel, printed messages and MCAP: what may be odd in them, and is read or refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.small_arms import Y, robot_of, serial_arm
from rigs.files.refusals import refused
from rigs.logs import recorded
from rigs.logs.log_files import (
    JOINTS,
    assert_read,
    assert_refused,
    motion,
    notes_of,
    read_measurements,
)
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions, reader
from robot_sysid.logs.reader import open_logs, with_settings
from robot_sysid.records.servo_setting import UNKNOWN, ServoSetting

DATA = motion(60)
STATES = [
    {"t": t, "q": q, "tau": tau}
    for t, q, tau in zip(DATA.time.tolist(), DATA.q.tolist(), DATA.tau.tolist())
]
LINES = "\n".join(map(json.dumps, STATES)) + "\n"


def write_text(folder, content):
    """Write a text, or an object as JSON."""
    path = folder / "log.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ({}, "no list of states"),
        ([], "no list of states"),
        (STATES[:1], "only 1 usable row"),
        (STATES[0], "one position column"),
        (json.dumps(STATES)[:-30], "as JSON: .*damaged"),
        ("[1, a remark\non the log\n", "as JSON: .*damaged"),
    ],
)
def test_json_without_samples_is_refused(tmp_path, content, fault):
    assert_refused(fault, write_text(tmp_path, content))


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (LINES[:-20], "no rows of numbers: 1 (first: state 60)"),
        ([*STATES[:59], {**STATES[59], "q": [0.1, 0.2]}], "cells: 1 (first: state 60"),
    ],
)
def test_a_state_that_is_not_whole_is_left_out_and_said(tmp_path, content, fault):
    log = assert_read(write_text(tmp_path, content), DATA[:-1])
    assert fault in notes_of(log)


def arrays_of(order=...):
    """Return the samples as lists by their names, with joints in another order."""
    values = {"time": DATA.time, "q": DATA.q[:, order], "tau": DATA.tau[:, order]}
    return {name: array.tolist() for name, array in values.items()}


def texts_of(values):
    return np.array(values).astype(str).tolist()


def columns_of_pandas():
    """A data frame as pandas writes it: columns of rows by their numbers."""
    columns = {"time": DATA.time}
    for k in range(3):
        columns[f"q{k}"] = DATA.q[:, k]
        columns[f"tau{k}"] = DATA.tau[:, k]
    return {t: dict(enumerate(values.tolist())) for t, values in columns.items()}


ORDER = [2, 0, 1]
NAMES = [JOINTS[k] for k in ORDER]
BY_NAME = arrays_of(ORDER)


@pytest.mark.parametrize(
    "content",
    [
        [{key: texts_of(values) for key, values in s.items()} for s in STATES],
        columns_of_pandas(),
        {**arrays_of(), "q": DATA.q.T.tolist(), "tau": DATA.tau.T.tolist()},
        {
            "joint_names": NAMES,
            "states": [dict(zip(BY_NAME, row)) for row in zip(*BY_NAME.values())],
        },
        {
            "run": {
                "joint_names": NAMES,
                **BY_NAME,
                "time": texts_of(DATA.time),
                "gains": [1.0, 2.0],
            },
            "rate": 100,
        },
    ],
    ids=["texts", "pandas", "a list per joint", "names of all states", "and of arrays"],
)
def test_numbers_in_json_are_found_in_any_arrangement(tmp_path, content):
    assert_read(write_text(tmp_path, content), DATA, ("time", "q", "tau"))


def test_dates_and_missing_numbers_in_arrays_of_json_are_read(tmp_path):
    dates = np.datetime64("2024-05-01") + (DATA.time * 1e9).round().astype("m8[ns]")
    content = {**arrays_of(), "time": dates.astype(str).tolist()}
    content["tau"][30][1] = None
    kept = DATA[np.delete(np.arange(len(DATA)), 30)]
    log = assert_read(write_text(tmp_path, content), kept)
    np.testing.assert_allclose(log.time - log.time[0], kept.time, atol=1e-6)


def test_what_an_interrupted_echo_prints_is_read_but_for_its_last_message(tmp_path):
    """ROS 1 prints other words for the time."""
    path = recorded.echo(tmp_path, DATA)
    text = path.read_text().replace("nanosec:", "nsecs: ").replace(" sec:", " secs:")
    lost = "---\nA message was lost!!!\n\ttotal count change:1\n---\n"
    path.write_text(text.replace("---\n", lost, 1)[:-60])
    log = assert_read(path, DATA[:-1])
    np.testing.assert_allclose(log.time - log.time[0], DATA.time[:-1], atol=5e-7)


def test_other_sheets_of_a_workbook_are_named(tmp_path):
    log = read_measurements(recorded.excel(tmp_path, DATA), JOINTS)
    assert "sheet 'run 1' is read, not Sheet" in notes_of(log)


def test_a_sheet_without_titles_and_one_with_a_title_twice_are_refused(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    path = tmp_path / "log.xlsx"
    book = openpyxl.Workbook()
    for row in np.column_stack((DATA.time, DATA.q)).tolist():
        book.active.append(row)
    book.save(path)
    assert_refused("no row of numbers below a row of titles", path)
    book.active.insert_rows(1)
    for column, title in enumerate(["time", "q1", "q1", "q2"], start=1):
        book.active.cell(1, column, title)
    book.save(path)
    assert_refused("two columns 'q1'", path)


def test_topics_of_positions_and_of_torques_in_an_mcap_file_are_joined(tmp_path):
    """Of two topics of torques, the one that is chosen."""
    samples = [*zip(DATA.time.tolist(), DATA.q.tolist(), DATA.tau.tolist())]
    messages: list[tuple[str, int, object]] = []
    for time, q, tau in samples:
        stamp = 1_700_000_000 * 10**9 + round(1e9 * time)
        messages.append(("/state", stamp, {"q": q}))
        messages.append(("/command", stamp, {"tau": [0.0, *tau[1:]]}))
        messages.append(("/torque", stamp, {"tau": tau}))
    path = recorded.write_json_mcap(tmp_path / "log.mcap", messages)
    log = assert_read(path, DATA)
    assert "state and torques of" in notes_of(log)
    messages += [("/raw", s, each) for topic, s, each in messages if topic == "/torque"]
    messages.sort(key=lambda message: message[1])
    path = recorded.write_json_mcap(tmp_path / "two.mcap", messages)
    with refused("no topic has positions and torques.*--topic") as caught:
        read_measurements(path, JOINTS)
    assert ("--topic", "/torque") in caught.value.options
    assert_read(path, DATA, topic="/torque")


def test_topics_of_an_mcap_file_are_listed_where_none_or_several_fit(tmp_path):
    messages = [
        (topic, count * 5_000_000, state)
        for topic in ("/left", "/right")
        for count, state in enumerate(STATES)
    ]
    path = recorded.write_json_mcap(tmp_path / "log.mcap", messages)
    assert_refused("several topics have positions and torques: /left, /right", path)
    options = LogOptions(topic="/left")
    assert reader.open_table(path, JOINTS, options).layout == "MCAP, topic /left"
    assert_refused("no topic has .*: /left, /right", path, topic="/middle")


def test_joint_states_of_ros_beside_json_are_named(tmp_path):
    """One library reads messages of ROS, and fails at a file with others."""
    path = recorded.write_mixed_mcap(tmp_path / "mixed.mcap", DATA)
    assert_refused(
        "joint states of ROS .*/joint_states.* beside messages of JSON", path
    )


PENDULUM = serial_arm((Y,))


def bam_file(folder, kp, **changes):
    """Write a recording of a pendulum as BAM does, the servo switched off at its end."""
    time = np.arange(400) / 200.0
    goal = 0.5 * np.sin(3.0 * time)
    entries = [
        {
            "position": goal[max(0, k - 4)],
            "speed": 0.0,
            "load": 65527,
            "input_volts": 7.3,
            "temp": 29,
            "timestamp": t,
            "goal_position": goal[k],
            "torque_enable": k < 300,
        }
        for k, t in enumerate(time.tolist())
    ]
    content = {"mass": 0.49, "length": 0.1, "kp": kp, "vin": 7.4, "motor": "xl330"}
    path = folder / f"kp{kp}.json"
    path.write_text(json.dumps({**content, **changes, "entries": entries}))
    return path


def test_json_of_bam_says_what_its_servo_was_recorded_with(tmp_path):
    """Its numbers are radians, and what hangs on a servo that is off is none of its motion."""
    robot = robot_of(PENDULUM)
    paths = [bam_file(tmp_path, kp) for kp in (400, 100)]
    logs = open_logs(robot, paths, LogOptions(commanded=True))
    pendulum = ServoSetting(None, 7.4, 0.49, load_distance=0.1, is_whole_link=True)
    for log, register in zip(logs, (400.0, 100.0)):
        assert log.setting == replace(pendulum, register=register)
        assert len(log) == 300 and np.ptp(log.command) > 0.9
        assert "left out rows with torque_enable false: 100" in log.notes
        assert log.columns.angle_declared
    stated = ServoSetting(register=200.0)
    settings = [each.setting for each in with_settings(logs, [stated])]
    assert settings == [replace(pendulum, register=200.0)] * 2
    both = with_settings(logs, [stated, UNKNOWN])
    assert [each.setting.register for each in both] == [200.0, 100.0]
    assert with_settings(logs, ())[0].setting == logs[0].setting
    with pytest.raises(InputError, match="given 3 times for 2 logs"):
        with_settings(logs, [stated] * 3)


def test_json_of_bam_that_cannot_be_is_refused_by_its_name(tmp_path):
    path = bam_file(tmp_path, 400, vin=-7.4)
    with pytest.raises(InputError, match=r"kp400.json: .*voltage must be positive"):
        open_logs(robot_of(PENDULUM), [path], LogOptions(commanded=True))

"""JSON, Excel, printed messages and MCAP: what may be odd in them, and is read or refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rigs import recorded
from rigs.log_files import JOINTS, assert_refused, motion, notes_of, read_measurements
from robot_sysid.logs import LogOptions, reader

DATA = motion(60)
STATES = [
    {"t": t, "q": q, "tau": tau}
    for t, q, tau in zip(DATA.time.tolist(), DATA.q.tolist(), DATA.tau.tolist())
]
LINES = "\n".join(map(json.dumps, STATES)) + "\n"


def read(tmp_path, text: str):
    path = tmp_path / "log.json"
    path.write_text(text)
    return read_measurements(path, JOINTS)


def test_a_line_of_json_that_is_cut_off_is_left_out_and_said(tmp_path):
    log = read(tmp_path, LINES[:-20])
    np.testing.assert_array_equal(log.q, DATA.q[:-1])
    assert "no rows of numbers: 1 (first: state 60)" in notes_of(log)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("{}", "no list of states"),
        ("[]", "no list of states"),
        (json.dumps(STATES[:1]), "only 1 usable row"),
        (json.dumps(STATES[0]), "one position column"),
        (json.dumps(STATES)[:-30], "as JSON: .*damaged"),
        ("[1, a remark\non the log\n", "as JSON: .*damaged"),
    ],
)
def test_json_without_samples_is_refused(tmp_path, text, fault):
    path = tmp_path / "log.json"
    path.write_text(text)
    assert_refused(fault, path)


def columns_of_pandas() -> dict:
    """A data frame as pandas writes it: columns of rows by their numbers."""
    columns = {"time": DATA.time}
    for k in range(3):
        columns[f"q{k}"] = DATA.q[:, k]
        columns[f"tau{k}"] = DATA.tau[:, k]
    frame = {}
    for title, values in columns.items():
        frame[title] = {str(row): value for row, value in enumerate(values.tolist())}
    return frame


ORDER = [2, 0, 1]


@pytest.mark.parametrize(
    "content",
    [
        [
            {key: np.array(v).astype(str).tolist() for key, v in s.items()}
            for s in STATES
        ],
        columns_of_pandas(),
        {
            "time": DATA.time.tolist(),
            "q": DATA.q.T.tolist(),
            "tau": DATA.tau.T.tolist(),
        },
        {
            "joint_names": [JOINTS[k] for k in ORDER],
            "states": [
                {
                    "t": s["t"],
                    "q": [s["q"][k] for k in ORDER],
                    "tau": [s["tau"][k] for k in ORDER],
                }
                for s in STATES
            ],
        },
        {
            "run": {
                "joint_names": [JOINTS[k] for k in ORDER],
                "time": DATA.time.astype(str).tolist(),
                "q": DATA.q[:, ORDER].tolist(),
                "tau": DATA.tau[:, ORDER].tolist(),
                "gains": [1.0, 2.0],
            },
            "rate": 100,
        },
    ],
    ids=["texts", "pandas", "a list per joint", "names of all states", "and of arrays"],
)
def test_numbers_in_json_are_found_in_any_arrangement(tmp_path, content):
    log = read(tmp_path, json.dumps(content))
    np.testing.assert_array_equal(log.time, DATA.time)
    np.testing.assert_array_equal(log.q, DATA.q)
    np.testing.assert_array_equal(log.tau, DATA.tau)


def test_dates_and_missing_numbers_in_arrays_of_json_are_read(tmp_path):
    dates = np.datetime64("2024-05-01") + (DATA.time * 1e9).round().astype("m8[ns]")
    tau = DATA.tau.tolist()
    tau[30][1] = None
    content = {"time": dates.astype(str).tolist(), "q": DATA.q.tolist(), "tau": tau}
    log = read(tmp_path, json.dumps(content))
    kept = np.delete(np.arange(len(DATA)), 30)
    np.testing.assert_allclose(log.time - log.time[0], DATA.time[kept], atol=1e-6)
    np.testing.assert_array_equal(log.tau, DATA.tau[kept])


def test_a_state_in_which_a_joint_is_missing_is_left_out(tmp_path):
    states = [*STATES]
    states[30] = {**states[30], "q": states[30]["q"][:2]}
    log = read(tmp_path, json.dumps(states))
    assert len(log) == 59 and "empty or NaN cells: 1 (first: state 31" in notes_of(log)


def test_what_an_interrupted_echo_prints_is_read_but_for_its_last_message(tmp_path):
    path = recorded.echo(tmp_path, DATA)
    text = path.read_text()
    lost = "---\nA message was lost!!!\n\ttotal count change:1\n---\n"
    path.write_text(text.replace("---\n", lost, 1)[:-60])
    log = read_measurements(path, JOINTS)
    np.testing.assert_array_equal(log.tau, DATA.tau[:-1])


def test_ros_1_prints_other_words_for_the_time(tmp_path):
    path = recorded.echo(tmp_path, DATA)
    text = path.read_text().replace("nanosec:", "nsecs: ").replace(" sec:", " secs:")
    path.write_text(text)
    log = read_measurements(path, JOINTS)
    np.testing.assert_allclose(np.ptp(log.time), np.ptp(DATA.time), atol=5e-7)


def test_other_sheets_of_a_workbook_are_named(tmp_path):
    path = recorded.excel(tmp_path, DATA)
    assert "sheet 'run 1' is read, not Sheet" in notes_of(
        read_measurements(path, JOINTS)
    )


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


def test_topics_of_an_mcap_file_are_listed_where_none_or_several_fit(tmp_path):
    writer_class = pytest.importorskip("mcap.writer").Writer
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = writer_class(stream)
        writer.start()
        for topic in ("/left", "/right"):
            channel = writer.register_channel(topic, "json", 0)
            for count, state in enumerate(STATES):
                stamp = count * 5_000_000
                writer.add_message(channel, stamp, json.dumps(state).encode(), stamp)
        writer.finish()
    assert_refused("several topics have positions and torques: /left, /right", path)
    options = LogOptions(topic="/left")
    assert reader.open_table(path, JOINTS, options).layout == "MCAP, topic /left"
    assert_refused("no topic has .*: /left, /right", path, topic="/middle")

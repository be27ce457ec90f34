"""Logs are read as they are written, torque scaled, and written back without losing a digit."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.logs.formats import table as formats_table
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.reader import earlier_logs, torque_factor, write_measurement_csv
from robot_sysid.records import Measurement
from tests.support.log_files import JOINTS, TITLES, motion, read_measurements, table, write
from tests.support.measured_logs import true_arm
from tests.support.places import DATA

QUANTITIES = ("time", "q", "qd", "tau", "qdd", "joint_time")


def assert_same(first: Measurement, second: Measurement, tolerance: float = 0.0) -> None:
    for name in QUANTITIES:
        expected, got = getattr(first, name), getattr(second, name)
        if expected is None:
            assert got is None, name
        else:
            np.testing.assert_allclose(got, expected, rtol=0.0, atol=tolerance, err_msg=name)


NAMES = st.lists(
    st.text("abcXYZ019_-. #/", min_size=1, max_size=8).map(str.strip).filter(bool),
    min_size=2,
    max_size=4,
    unique=True,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**32), st.sets(st.sampled_from(QUANTITIES[4:] + ("qd",))), st.data())
def test_what_is_written_reads_back_to_the_last_bit(tmp_path, seed, optional, data):
    rng = np.random.default_rng(seed)
    n = 3
    time = 0.1 + np.cumsum(rng.uniform(0.8e-3, 1.2e-3, 40))
    shape = (len(time), n)
    q = np.sin(time[:, None] * rng.uniform(10.0, 25.0, n))
    extra = {"qd": rng.normal(size=shape), "qdd": rng.normal(size=shape)}
    extra["joint_time"] = time[:, None] + np.array([0.0, 1e-4, 2e-4])
    kept = {name: extra[name] if name in optional else None for name in extra}
    written = Measurement(time=time, q=q, tau=rng.normal(size=shape) * 1e3, **kept)
    cuts = sorted(data.draw(st.sets(st.integers(1, len(time) - 1), max_size=3)))
    chunks = [part(written, a, b) for a, b in zip([0, *cuts], [*cuts, len(time)])]
    write_measurement_csv(tmp_path / "log.csv", JOINTS, chunks, ["two\nlines", "more"])
    assert_same(written, read_measurements(tmp_path / "log.csv", JOINTS).samples)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(NAMES)
def test_any_joint_names_survive_the_round_trip(tmp_path, names):
    full = motion(20)
    picked = [0, 1, 2, 0][: len(names)]
    written = Measurement(full.time, full.q[:, picked], None, full.tau[:, picked])
    write_measurement_csv(tmp_path / "log.csv", names, [written])
    assert_same(written, read_measurements(tmp_path / "log.csv", names).samples)


def part(data: Measurement, start: int, stop: int) -> Measurement:
    values = {name: getattr(data, name) for name in QUANTITIES}
    return Measurement(**{k: None if v is None else v[start:stop] for k, v in values.items()})


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(1, 500))
def test_the_size_of_the_batches_changes_nothing(tmp_path, size):
    path = tmp_path / "log.csv"
    if not path.exists():
        write(path, wrapped_and_holed())
        path.write_text(path.read_text()[:-40])
    whole = read_measurements(path, JOINTS)
    assert "cut off (line 401)" in " ".join(whole.notes)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(formats_table, "BLOCK", size)
        pieces = read_measurements(path, JOINTS)
    assert_same(whole.samples, pieces.samples)
    assert whole.notes == pieces.notes


@pytest.mark.parametrize("size", [5, 9, 10, 11, 400])
def test_only_the_last_row_of_the_file_may_be_cut_off(tmp_path, monkeypatch, size):
    short = [row[:5] if k == 9 else row for k, row in enumerate(table(motion()).tolist())]
    path = write(tmp_path / "log.csv", short)
    monkeypatch.setattr(formats_table, "BLOCK", size)
    said = " ".join(read_measurements(path, JOINTS).notes)
    assert "no rows of numbers (line 11)" in said and "cut off" not in said


def wrapped_and_holed() -> np.ndarray:
    cells = table(motion())
    cells[:, 1] = np.angle(np.exp(1j * (cells[:, 1] * 4.0)))
    cells[[17, 203], 4] = np.nan
    return cells


@pytest.mark.parametrize(
    "style",
    ["comma", "semicolon", "tab", "bar", "blanks", "crlf", "bom", "quoted", "utf16",
     "decimal comma", "comments", "savetxt", "trailing separator", "blank lines",
     "no final newline"],
)  # fmt: skip
def test_every_layout_reads_the_same(tmp_path, style):
    data = motion(50)
    path = tmp_path / "log.csv"
    write(path, table(data))
    text = path.read_text()
    path.write_bytes(restyled(text, style))
    log = read_measurements(path, JOINTS)
    assert_same(replace(data, qd=None), log.samples)


def restyled(text: str, style: str) -> bytes:
    lines = text.splitlines()
    changed = {
        "semicolon": text.replace(",", ";"),
        "tab": text.replace(",", "\t"),
        "bar": text.replace(",", "|"),
        "blanks": "\n".join("  " + line.replace(",", "   ") for line in lines),
        "crlf": text.replace("\n", "\r\n"),
        "bom": "\ufeff" + text,
        "quoted": "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in lines),
        "decimal comma": text.replace(",", ";").replace(".", ","),
        "comments": "# made by us\n#\n" + text.replace("\n", "\n# between\n"),
        "savetxt": "# " + text,
        "trailing separator": text.replace("\n", ",\n"),
        "blank lines": text.replace("\n", "\n\n"),
        "no final newline": text.rstrip("\n"),
    }.get(style, text)
    return changed.encode("utf-16" if style == "utf16" else "utf-8")


def test_degrees_and_milliseconds_are_converted_when_declared(tmp_path):
    data = motion(60)
    rows = table(data)
    rows[:, 0] *= 1e3
    rows[:, 1:4] = np.degrees(rows[:, 1:4])
    log = read_measurements(write(tmp_path / "log.csv", rows), JOINTS, units="deg,ms")
    assert_same(replace(data, qd=None), log.samples, tolerance=1e-14)


def test_a_log_without_titles_needs_a_columns_file(tmp_path):
    data = motion(30)
    path = write(tmp_path / "log.csv", table(data), titles=())
    with pytest.raises(InputError, match="no column titles.*7 columns.*--columns"):
        read_measurements(path, JOINTS)
    columns = tmp_path / "columns.txt"
    columns.write_text("time = #1\nposition = #2, #3, #4\ntorque = #5, #6, #7\n")
    assert_same(replace(data, qd=None), read_measurements(path, JOINTS, columns=columns).samples)


def test_a_declared_rate_stands_in_for_time(tmp_path):
    data = motion(30)
    path = write(tmp_path / "log.csv", table(data)[:, 1:], TITLES[1:])
    columns = tmp_path / "columns.txt"
    columns.write_text("rate = 200\n")
    log = read_measurements(path, JOINTS, columns=columns)
    np.testing.assert_allclose(log.samples.time, data.time, rtol=0.0, atol=1e-15)


def test_text_columns_that_are_not_used_do_not_matter(tmp_path):
    data = motion(30)
    rows = [[*row, "ok, fine" if k % 2 else "nan"] for k, row in enumerate(table(data).tolist())]
    quoted = [[*row[:-1], f'"{row[-1]}"'] for row in rows]
    log = read_measurements(write(tmp_path / "l.csv", quoted, (*TITLES, "status")), JOINTS)
    assert_same(replace(data, qd=None), log.samples)
    assert any("not used: status" in note for note in log.notes)


def test_notes_say_which_columns_were_used(tmp_path):
    said = " ".join(read_measurements(write(tmp_path / "l.csv", table(motion())), JOINTS).notes)
    assert "time from 'time'" in said and "'tau1', 'tau2', 'tau3'" in said


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "holds no rows"),
        (b"# only\n# comments\n", "holds no rows"),
        (b"time,q1,q2,q3,tau1,tau2,tau3\n", "header but no rows"),
        (b"\x00\x01\x02binary", "not a text file"),
    ],
)
def test_files_without_a_table_are_refused(tmp_path, content, words):
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_measurements(path, JOINTS)


def test_a_file_that_is_not_there_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="cannot read the log"):
        read_measurements(tmp_path / "none.csv", JOINTS)


def test_a_failed_write_leaves_nothing_behind(tmp_path):
    def failing():
        yield motion(10)
        raise InputError("stop")

    with pytest.raises(InputError, match="stop"):
        write_measurement_csv(tmp_path / "log.csv", JOINTS, failing())
    with pytest.raises(InputError, match="no samples"):
        write_measurement_csv(tmp_path / "log.csv", JOINTS, [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "n_joints", "count", "duration"),
    [("tx40/tx40_500Hz.csv", 6, 4450, 8.898), ("kuka_lwr4/lwr4_hw3_200Hz.csv", 7, 5026, 25.125)],
)
def test_logs_of_real_arms(tmp_path, name, n_joints, count, duration):
    if not (DATA / name).exists():
        pytest.skip("the logs of real arms are not here")
    joints = [f"joint_{k}" for k in range(n_joints)]
    log = read_measurements(DATA / name, joints)
    assert (len(log.samples), log.duration) == (count, duration)
    write_measurement_csv(tmp_path / "copy.csv", joints, [log.samples])
    assert_same(log.samples, read_measurements(tmp_path / "copy.csv", joints).samples)


POSITIVE = st.lists(st.floats(1e-2, 1e2), min_size=3, max_size=3).map(tuple)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(scale=POSITIVE, constants=POSITIVE)
def test_torque_is_divided_by_scale_and_multiplied_with_constants(tmp_path, scale, constants):
    path = tmp_path / "log.csv"
    if not path.exists():
        write(path, table(motion(20)))
    log = read_measurements(path, JOINTS, torque_scale=scale, torque_constants=constants)
    expected = motion(20).tau * constants / np.array(scale)
    np.testing.assert_allclose(log.samples.tau, expected, rtol=1e-14)
    np.testing.assert_array_equal(log.samples.q, motion(20).q)


def test_without_options_there_is_no_factor_and_with_one_it_is_said(tmp_path):
    np.testing.assert_array_equal(torque_factor(LogOptions(), JOINTS), np.ones(len(JOINTS)))
    path = write(tmp_path / "log.csv", table(motion(20)))
    notes = " ".join(read_measurements(path, JOINTS, torque_scale=2.0).notes)
    assert "'tau1', 'tau2', 'tau3' (each x 0.5)" in notes


@pytest.mark.parametrize("option", ["torque_scale", "torque_constants"])
def test_what_cannot_be_a_factor_is_refused(option):
    from robot_sysid.errors import InputError

    for wrong in (0.0, -1.0, float("nan"), (1.0, float("inf"))):
        with pytest.raises(InputError, match="must be positive"):
            LogOptions(**{option: wrong})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, None),
        ({"logs": []}, "no identification from logs"),
        ({"logs": ["/nowhere/log.csv"]}, "/nowhere/log.csv is no longer there"),
        ({"model": {"sha256": "00"}}, "was made with another model"),
        (None, "holds no names and values"),
    ],
)
def test_a_run_is_continued_with_the_logs_it_names(tmp_path, change, words):
    robot = true_arm()
    log, params = tmp_path / "log.csv", tmp_path / "params.json"
    log.touch()
    good = {"logs": [str(log)], "model": {"sha256": robot.sha256}}
    params.write_text(json.dumps([] if change is None else {**good, **change}))
    if words is None:
        assert earlier_logs(params, robot) == (log,)
    else:
        with pytest.raises(InputError, match=words):
            earlier_logs(params, robot)

"""Logs are read as they are written, torque scaled, and written back without losing a digit."""

from __future__ import annotations

import io
import os
import sys
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.logs import reader
from robot_sysid.logs import text as formats_text
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.records import Measurement
from tests.support.log_files import (
    JOINTS,
    TITLES,
    motion,
    read_measurements,
    table,
    write,
)

QUANTITIES = ("time", "q", "qd", "tau", "qdd", "joint_time")


def assert_same(
    first: Measurement, second: Measurement, tolerance: float = 0.0
) -> None:
    for name in QUANTITIES:
        expected = getattr(first, name)
        got = getattr(second, name)
        if expected is None:
            assert got is None, name
        else:
            np.testing.assert_allclose(
                got, expected, rtol=0.0, atol=tolerance, err_msg=name
            )


def part(data: Measurement, start: int, stop: int) -> Measurement:
    values = {name: getattr(data, name) for name in QUANTITIES}
    return Measurement(
        **{k: None if v is None else v[start:stop] for k, v in values.items()}
    )


NAMES = st.lists(
    st.text("abcXYZ019_-. #/", min_size=1, max_size=8).map(str.strip).filter(bool),
    min_size=3,
    max_size=3,
    unique=True,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    NAMES,
    st.sets(st.sampled_from(("qd", "qdd", "joint_time"))),
    st.sets(st.integers(1, 39)),
)
def test_what_is_written_reads_back_to_the_last_bit(tmp_path, names, optional, cuts):
    """Whatever the joints' names, what else is there, and the chunks it comes in; nobody needs
    accelerations.
    """
    rng = np.random.default_rng(len(cuts))
    time = 0.1 + np.cumsum(rng.uniform(0.8e-3, 1.2e-3, 40))
    q = np.sin(time[:, None] * rng.uniform(10.0, 25.0, 3))
    extra = {"qd": rng.normal(size=q.shape), "qdd": rng.normal(size=q.shape)}
    extra["joint_time"] = time[:, None] + np.array([0.0, 1e-4, 2e-4])
    kept = {name: extra[name] if name in optional else None for name in extra}
    written = Measurement(time=time, q=q, tau=rng.normal(size=q.shape) * 1e3, **kept)
    edges = [0, *sorted(cuts), len(time)]
    chunks = [part(written, a, b) for a, b in zip(edges, edges[1:])]
    write_measurement_csv(tmp_path / "log.csv", names, chunks)
    assert_same(
        replace(written, qdd=None),
        read_measurements(tmp_path / "log.csv", names).samples,
    )


@pytest.mark.parametrize("size", [1, 700, 40_000])
def test_the_size_of_the_batches_changes_nothing(tmp_path, monkeypatch, size):
    cells = table(motion())
    cells[:, 1] = np.angle(np.exp(1j * (cells[:, 1] * 4.0)))
    cells[[17, 203], 4] = np.nan
    path = write(tmp_path / "log.csv", cells)
    path.write_text(path.read_text()[:-40])
    whole = read_measurements(path, JOINTS)
    said = " ".join(whole.notes)
    assert "line 401" in said and "full turn" in said and "empty" in said
    monkeypatch.setattr(formats_text, "CHUNK", size)
    pieces = read_measurements(path, JOINTS)
    assert_same(whole.samples, pieces.samples)
    assert whole.notes == pieces.notes


@pytest.mark.parametrize(
    "style",
    ["semicolon", "tab", "bar", "blanks", "crlf", "bom", "quoted", "utf16", "decimal comma",
     "comments", "savetxt", "trailing separator", "blank lines", "no final newline"],
)  # fmt: skip
def test_every_layout_reads_the_same(tmp_path, style):
    data = motion(50)
    path = write(tmp_path / "log.csv", table(data))
    path.write_bytes(restyled(path.read_text(), style))
    assert_same(replace(data, qd=None), read_measurements(path, JOINTS).samples)


def restyled(text: str, style: str) -> bytes:
    lines = text.splitlines()
    changed = {
        "semicolon": text.replace(",", ";"),
        "tab": text.replace(",", "\t"),
        "bar": text.replace(",", "|"),
        "blanks": "\n".join("  " + line.replace(",", "   ") for line in lines),
        "crlf": text.replace("\n", "\r\n"),
        "bom": "\ufeff" + text,
        "quoted": "\n".join(
            ",".join(f'"{cell}"' for cell in line.split(",")) for line in lines
        ),
        "utf16": text,
        "decimal comma": text.replace(",", ";").replace(".", ","),
        "comments": "# made by us\n#\n" + text.replace("\n", "\n# between\n"),
        "savetxt": "# " + text,
        "trailing separator": text.replace("\n", ",\n"),
        "blank lines": text.replace("\n", "\n\n"),
        "no final newline": text.rstrip("\n"),
    }[style]
    return changed.encode("utf-16" if style == "utf16" else "utf-8")


@pytest.mark.parametrize(
    "form",
    ["{day}T{clock}", "{day} {clock}Z", "{day}T{clock}+05:30", "{clock}", '"{clock}"'],
)
def test_dates_are_times_from_the_first(tmp_path, form):
    data = motion(50)
    rows = table(data).tolist()
    for row in rows:
        clock = f"23:15:{row[0]:012.9f}"
        row[0] = form.format(day="2024-05-01", clock=clock)
    log = read_measurements(write(tmp_path / "log.csv", rows), JOINTS)
    assert_same(replace(data, qd=None), log.samples, tolerance=1e-12)
    assert "time in dates" in log.notes[0]


def test_a_decimal_comma_need_not_be_in_the_first_row_nor_unquoted(tmp_path):
    data = motion(50)
    data = replace(data, q=data.q - data.q[0], tau=data.tau - data.tau[0], qd=None)
    rows = [
        [str(cell).replace(".", ",") for cell in row] for row in table(data).tolist()
    ]
    rows[0] = ["0"] * 7
    for cells, separator in (
        (rows, ";"),
        ([[f'"{c}"' for c in row] for row in rows], ","),
    ):
        log = read_measurements(
            write(tmp_path / "l.csv", cells, separator=separator), JOINTS
        )
        assert_same(data, log.samples)


def test_dates_go_on_over_a_change_of_the_clock(tmp_path):
    rows = table(motion(40)).tolist()
    for row, second in zip(rows, range(40)):
        day, hour = ("02", "01") if second < 20 else ("01", "22")
        ahead = "+02:00" if second < 20 else "-01:00"
        row[0] = f"2024-05-{day}T{hour}:59:{30 + second * 0.02:06.3f}{ahead}"
    log = read_measurements(write(tmp_path / "log.csv", rows), JOINTS)
    np.testing.assert_allclose(log.samples.time, 0.02 * np.arange(40), atol=1e-12)


def test_a_log_without_titles_needs_a_columns_file_and_one_without_time_a_rate(
    tmp_path,
):
    data = motion(30)
    path = write(tmp_path / "log.csv", table(data), titles=())
    with pytest.raises(InputError, match="no column titles.*7 columns.*--columns"):
        read_measurements(path, JOINTS)
    columns = tmp_path / "columns.txt"
    columns.write_text("rate = 200\nposition = #2-4\ntorque = #5, #6 - #7\n")
    log = read_measurements(path, JOINTS, columns=columns)
    assert_same(replace(data, qd=None), log.samples, tolerance=1e-15)


def test_text_columns_that_are_not_used_do_not_matter(tmp_path):
    data = motion(30)
    rows = [
        [*row, '"ok, fine"' if k % 2 else "nan"]
        for k, row in enumerate(table(data).tolist())
    ]
    log = read_measurements(
        write(tmp_path / "l.csv", rows, (*TITLES, "status")), JOINTS
    )
    assert_same(replace(data, qd=None), log.samples)
    assert any("not used: status" in note for note in log.notes)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot read the log"),
        (b"# only\n# comments\n", "holds no rows"),
        (b"time,q1,q2,q3,tau1,tau2,tau3\n", "header but no rows"),
        (b"\x00\x01\x02binary", "not a text file"),
    ],
)
def test_files_without_a_table_are_refused(tmp_path, content, words):
    path = tmp_path / "log.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_measurements(path, JOINTS)


@pytest.mark.skipif(sys.platform == "win32", reason="needs named pipes")
def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "log.csv")
    with pytest.raises(InputError, match="log.csv is a pipe or a device"):
        read_measurements(tmp_path / "log.csv", JOINTS)


def test_a_log_is_read_from_a_pipe(tmp_path, monkeypatch):
    path = write(tmp_path / "log.csv", table(motion(50)))
    for content in (path.read_bytes(), None):
        reader._piped_file.cache_clear()
        pipe = io.BytesIO(content or b"")
        stdin = SimpleNamespace(buffer=pipe, isatty=partial(bool, content is None))
        monkeypatch.setattr(sys, "stdin", stdin)
        if content is None:
            with pytest.raises(
                InputError, match="a log that is piped in, and nothing is"
            ):
                read_measurements("-", JOINTS)
        else:
            whole = read_measurements(path, JOINTS)
            for _ in range(2):
                piped = read_measurements("-", JOINTS)
                assert_same(piped.samples, whole.samples)
            assert reader.origin_of([whole, piped]).files == (str(path), "-")


def test_a_failed_write_leaves_nothing_behind(tmp_path):
    def failing():
        yield motion(10)
        raise InputError("stop")

    with pytest.raises(InputError, match="stop"):
        write_measurement_csv(tmp_path / "log.csv", JOINTS, failing())
    assert list(tmp_path.iterdir()) == []


POSITIVE = st.lists(st.floats(1e-2, 1e2), min_size=3, max_size=3).map(tuple)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(scale=POSITIVE, constants=POSITIVE)
def test_torque_is_divided_by_scale_and_multiplied_with_constants(
    tmp_path, scale, constants
):
    path = write(tmp_path / "log.csv", table(motion(20)))
    log = read_measurements(
        path, JOINTS, torque_scale=scale, torque_constants=constants
    )
    expected = motion(20).tau * constants / np.array(scale)
    np.testing.assert_allclose(log.samples.tau, expected, rtol=1e-14)
    np.testing.assert_array_equal(log.samples.q, motion(20).q)
    np.testing.assert_array_equal(log.torque_scale, scale)
    notes = " ".join(read_measurements(path, JOINTS, torque_scale=2.0).notes)
    assert "'tau1', 'tau2', 'tau3' (each x 0.5)" in notes

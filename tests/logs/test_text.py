"""Every layout of a text log reads the same, and what is written reads back to the last digit."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rigs.files.refusals import refused
from rigs.logs.log_files import (
    JOINTS,
    TITLES,
    assert_read,
    assert_samples,
    motion,
    read_measurements,
    read_table,
    table,
    write,
)
from robot_sysid.errors import InputError
from robot_sysid.logs.text import plain_table, read_dialect, write_measurement_csv
from robot_sysid.records import Recording

DATA = replace(motion(50), qd=None)
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
def test_a_written_log_reads_back_to_the_last_bit(tmp_path, names, optional, cuts):
    """Whatever the joints' names, the other quantities, and the chunks it comes in; accelerations
    are not read.
    """
    rng = np.random.default_rng(len(cuts))
    time = 0.1 + np.cumsum(rng.uniform(0.8e-3, 1.2e-3, 40))
    q = np.sin(time[:, None] * rng.uniform(10.0, 25.0, 3))
    values = {name: rng.normal(size=q.shape) for name in ("qd", "qdd")}
    values["joint_time"] = time[:, None] + np.array([0.0, 1e-4, 2e-4])
    values = {name: values[name] for name in optional}
    data = Recording(
        time, q, **{"qd": None, **values}, tau=1e3 * rng.normal(size=q.shape)
    )
    edges = [0, *sorted(cuts), len(time)]
    chunks = [data[start:end] for start, end in zip(edges, edges[1:])]
    path = tmp_path / "log.csv"
    write_measurement_csv(path, names, chunks)
    assert_samples(replace(data, qdd=None), read_measurements(path, names))


@pytest.mark.parametrize("size", [1, 700, 40_000])
def test_the_size_of_the_chunks_changes_nothing(tmp_path, size):
    cells = table(motion())
    cells[:, 1] = np.angle(np.exp(1j * (cells[:, 1] * 4.0)))
    cells[[17, 203], 4] = np.nan
    path = write(tmp_path / "log.csv", cells)
    path.write_text(path.read_text()[:-40])
    expected = read_measurements(path, JOINTS)
    notes = " ".join(expected.notes)
    assert "line 401" in notes and "empty" in notes
    dialect = replace(read_dialect(path), chunk_size=size)
    log = read_measurements(plain_table(dialect), JOINTS)
    assert_samples(expected, log)
    assert expected.notes == log.notes


STYLES = {
    "semicolon": lambda log: log.replace(",", ";"),
    "tab": lambda log: log.replace(",", "\t"),
    "bar": lambda log: log.replace(",", "|"),
    "blanks": lambda log: "  " + log.replace(",", "   ").replace("\n", "\n  "),
    "crlf": lambda log: log.replace("\n", "\r\n"),
    "bom": lambda log: "\ufeff" + log,
    "quoted": lambda log: re.sub(r"[^,\n]+", r'"\g<0>"', log),
    "utf16": lambda log: log.encode("utf-16"),
    "decimal comma": lambda log: log.replace(",", ";").replace(".", ","),
    "comments": lambda log: "# by us\n#\n" + log.replace("\n", "\n# between\n"),
    "savetxt": lambda log: "# " + log,
    "trailing separator": lambda log: log.replace("\n", ",\n"),
    "blank lines": lambda log: log.replace("\n", "\n\n"),
    "no final newline": lambda log: log.rstrip("\n"),
}


@pytest.mark.parametrize("style", STYLES)
def test_every_layout_reads_the_same(tmp_path, style):
    path = write(tmp_path / "log.csv", table(DATA))
    content = STYLES[style](path.read_text())
    path.write_bytes(content if style == "utf16" else content.encode())
    assert_read(path, DATA, ("time", "q", "qd", "tau"))


@pytest.mark.parametrize(
    "form",
    ["{day}T{clock}", "{day} {clock}Z", "{day}T{clock}+05:30", "{clock}", '"{clock}"'],
)
def test_dates_are_times_from_the_first(tmp_path, form):
    rows = table(DATA).tolist()
    for row in rows:
        clock = f"23:15:{row[0]:012.9f}"
        row[0] = form.format(day="2024-05-01", clock=clock)
    assert_samples(DATA, read_table(tmp_path, rows), atol=1e-12)


@pytest.mark.parametrize(("separator", "mark"), [(";", ""), (",", '"')])
def test_a_decimal_comma_need_not_be_in_the_first_row_nor_unquoted(
    tmp_path, separator, mark
):
    data = replace(DATA, q=DATA.q - DATA.q[0], tau=DATA.tau - DATA.tau[0])
    rows = [["0"] * 7]
    for row in table(data).tolist()[1:]:
        rows.append([f"{mark}{cell!r}{mark}".replace(".", ",") for cell in row])
    assert_read(write(tmp_path / "log.csv", rows, separator=separator), data)


def test_text_columns_that_are_not_used_do_not_matter(tmp_path):
    words = ["nan", '"ok, fine"'] * 25
    rows = [[*row, word] for row, word in zip(table(DATA), words)]
    log = read_table(tmp_path, rows, (*TITLES, "status"))
    assert_samples(DATA, log)
    assert any("not used: status" in note for note in log.notes)


def test_a_failed_write_leaves_nothing_behind(tmp_path):
    def failing():
        yield motion(10)
        raise InputError("stop")

    with refused("stop"):
        write_measurement_csv(tmp_path / "log.csv", JOINTS, failing())
    assert list(tmp_path.iterdir()) == []

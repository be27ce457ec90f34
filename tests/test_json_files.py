"""JSON of others: whatever is wrong with it is one error; no number escapes a check."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(VALUES)
def test_what_was_written_is_read(tmp_path, value):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(value), encoding="utf-8")
    assert read_json(path, "") == value


@pytest.mark.parametrize("text", [b"{", b"[" * 100_000, b"\xff", b"", b"9" * 100_000 + b"x"])
def test_what_is_no_json_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_bytes(text)
    with pytest.raises(InputError, match="a.json: it is not JSON.*; do this") as caught:
        read_json(path, "do this")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["none.json", "a" * 5000])
def test_a_file_that_is_not_there_is_named(tmp_path, name):
    with pytest.raises(InputError, match="cannot read .*; do this"):
        read_json(tmp_path / name, "do this")


def test_an_integer_beyond_all_floats_is_infinite(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("[1" + "0" * 400 + ", 3]")
    assert read_json(path, "") == [math.inf, 3]

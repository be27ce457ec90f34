"""JSON of others: whatever is wrong with it is one error; no number escapes a check."""

from __future__ import annotations

import math

import pytest

from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json


@pytest.mark.parametrize(
    "text", [None, b"{", b"[" * 100_000, b"\xff", b"", b"9" * 100_000 + b"x"]
)
def test_what_is_no_json_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "a.json"
    if text is not None:
        path.write_bytes(text)
    with pytest.raises(InputError, match="cannot read .*a.json: .*; do this") as caught:
        read_json(path, "do this")
    assert "\n" not in str(caught.value)


def test_what_is_too_large_is_not_read(tmp_path):
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(5 * 10**9)
    with pytest.raises(InputError, match="larger than 30 MB; do this"):
        read_json(tmp_path / "a.json", "do this")


def test_an_integer_beyond_all_floats_is_infinite(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("\ufeff[1" + "0" * 400 + ', 3, {"a": null}]', encoding="utf-8")
    assert read_json(path, "") == [math.inf, 3, {"a": None}]

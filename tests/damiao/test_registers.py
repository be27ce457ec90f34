"""Register values in their four bytes, and status codes in words."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.protocol import frames
from robot_sysid.damiao.protocol.frames import describe, is_fault


@pytest.mark.parametrize("number", sorted(frames.NAMES))
@given(data=st.data())
def test_register_values_survive_their_four_bytes(number, data):
    whole = number in frames.INTEGERS
    values = st.integers(0, 2**32 - 1) if whole else st.floats(width=32, allow_nan=False)
    value = data.draw(values)
    assert frames.value_from_bytes(number, frames.bytes_from_value(number, value)) == value


@pytest.mark.parametrize("code", range(16))
def test_every_code_has_words_and_all_but_two_are_faults(code):
    assert describe(code).startswith(f"status {code:X}: ")
    assert is_fault(code) is (code not in (0, 1))

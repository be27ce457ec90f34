"""What is and is not sent, and how much of a bus it takes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.protocol import (
    INTEGERS,
    NAMES,
    REGISTER_ID,
    BusTiming,
    Frame,
    bus_load,
    bytes_from_value,
    default_rate,
    is_fault,
    refuse_harmful,
    status_text,
    suggested_rate,
    value_from_bytes,
)
from robot_sysid.errors import SysidError

# Typed from the maker's protocol description.
SET_ZERO = 0xFE
CLEAR_ERROR = 0xFB
STORE = 0xAA


@pytest.mark.parametrize("code", [SET_ZERO, CLEAR_ERROR, 0x00, 0xFF])
def test_harmful_special_frames_are_refused(code):
    with pytest.raises(SysidError, match="refused to send"):
        refuse_harmful(Frame(1, b"\xff" * 7 + bytes([code])))


@pytest.mark.parametrize("operation", [STORE, 0x00, 0xFF])
def test_harmful_register_operations_are_refused(operation):
    with pytest.raises(SysidError, match="refused to send"):
        refuse_harmful(Frame(REGISTER_ID, bytes([1, 0, operation, 1, 0, 0, 0, 0])))


CLASSIC = BusTiming()
FD = BusTiming(fd=True)


@pytest.mark.parametrize(
    ("motors", "classic", "fast"),
    [(4, 648, 1546), (6, 432, 1031), (7, 370, 883), (14, 185, 442)],
)
def test_rates_at_seventy_percent_are_those_of_the_manual(motors, classic, fast):
    assert bus_load(motors, classic, CLASSIC) == pytest.approx(0.7, abs=1e-3)
    assert bus_load(motors, fast, FD) == pytest.approx(0.7, abs=1e-3)


def test_frame_times():
    assert CLASSIC.frame_time == pytest.approx(135e-6)
    assert FD.frame_time == pytest.approx(56.6e-6)
    assert BusTiming(True, 1e6, 2e6).frame_time == pytest.approx(90.5e-6)
    assert BusTiming(True, 1e6, 1e6).frame_time == pytest.approx(147e-6)


def test_defaults_fit_the_bus():
    assert default_rate(7, CLASSIC) == 250.0
    assert default_rate(7, FD) == 500.0
    for motors in range(1, 16):
        for timing in (CLASSIC, FD):
            assert bus_load(motors, default_rate(motors, timing), timing) <= 0.7
            assert bus_load(motors, suggested_rate(motors, timing), timing) <= 0.7


@given(number=st.sampled_from(sorted(NAMES)), data=st.data())
def test_register_values_survive_their_four_bytes(number, data):
    is_integer = number in INTEGERS
    values = (
        st.integers(0, 2**32 - 1)
        if is_integer
        else st.floats(width=32, allow_nan=False)
    )
    value = data.draw(values)
    assert value_from_bytes(number, bytes_from_value(number, value)) == value


def test_every_code_has_words_and_all_but_two_are_faults():
    assert [
        status_text(code).startswith(f"status {code:X}: ") for code in range(16)
    ] == [True] * 16
    assert [code for code in range(16) if not is_fault(code)] == [0, 1]

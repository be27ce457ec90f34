"""What is and is not sent, and how much of a bus it takes."""

from __future__ import annotations

import pytest

from robot_sysid.damiao.protocol.frames import (
    REGISTER_ID,
    Address,
    BusTiming,
    Frame,
    bus_load,
    default_rate,
    disable_frame,
    enable_frame,
    highest_rate,
    read_frame,
    refresh_frame,
    refuse_harmful,
    suggested_rate,
    write_frame,
)
from robot_sysid.errors import SysidError

# Typed from the maker's protocol description.
MOTOR = Address(0, 1)
ENABLE, DISABLE, SET_ZERO, CLEAR_ERROR, STORE = 0xFC, 0xFD, 0xFE, 0xFB, 0xAA


@pytest.mark.parametrize("code", [SET_ZERO, CLEAR_ERROR, 0x00, 0xFF])
def test_harmful_special_frames_are_refused(code):
    with pytest.raises(SysidError, match="refused to send"):
        refuse_harmful(Frame(1, b"\xff" * 7 + bytes([code])))


@pytest.mark.parametrize("operation", [STORE, 0x00, 0xFF])
def test_harmful_register_operations_are_refused(operation):
    with pytest.raises(SysidError, match="refused to send"):
        refuse_harmful(Frame(REGISTER_ID, bytes([1, 0, operation, 1, 0, 0, 0, 0])))


def test_what_is_needed_is_not_refused():
    frames = [enable_frame(MOTOR), disable_frame(MOTOR), read_frame(MOTOR, 7), refresh_frame(MOTOR)]
    for frame in [*frames, write_frame(MOTOR, 9, bytes(4)), Frame(1, bytes(8))]:
        refuse_harmful(frame)
    assert enable_frame(MOTOR).data[7] == ENABLE and disable_frame(MOTOR).data[7] == DISABLE


CLASSIC, FD = BusTiming(), BusTiming(fd=True)


@pytest.mark.parametrize(
    ("motors", "classic", "fast"),
    [(1, 2593, 6184), (4, 648, 1546), (6, 432, 1031), (7, 370, 883), (8, 324, 773), (14, 185, 442)],
)
def test_highest_rates_at_seventy_percent(motors, classic, fast):
    assert highest_rate(motors, CLASSIC) == pytest.approx(classic, abs=0.6)
    assert highest_rate(motors, FD) == pytest.approx(fast, abs=0.6)


def test_frame_times():
    assert CLASSIC.frame_time == pytest.approx(135e-6)
    assert FD.frame_time == pytest.approx(56.6e-6)
    assert BusTiming(True, 1e6, 2e6).frame_time == pytest.approx(90.5e-6)
    assert BusTiming(True, 1e6, 1e6).frame_time == pytest.approx(147e-6)


def test_load_of_seven_motors():
    assert bus_load(7, 250.0, CLASSIC) == pytest.approx(0.4725)
    assert bus_load(7, 500.0, CLASSIC) == pytest.approx(0.945)
    assert bus_load(7, 500.0, FD) == pytest.approx(0.396, abs=5e-4)


def test_load_at_the_highest_rate_is_the_limit():
    for motors in range(1, 16):
        assert bus_load(motors, highest_rate(motors, FD), FD) == pytest.approx(0.7)


def test_defaults_fit_the_bus():
    assert default_rate(7, CLASSIC) == 250.0
    assert default_rate(7, FD) == 500.0
    for motors in range(1, 16):
        for timing in (CLASSIC, FD):
            assert bus_load(motors, default_rate(motors, timing), timing) <= 0.7
            assert bus_load(motors, suggested_rate(motors, timing), timing) <= 0.7

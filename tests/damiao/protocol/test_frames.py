"""What may be sent, and what never is."""

from __future__ import annotations

import pytest

from robot_sysid.damiao.protocol.frames import (
    REGISTER_ID,
    Address,
    Frame,
    disable_frame,
    enable_frame,
    read_frame,
    refresh_frame,
    refuse_harmful,
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

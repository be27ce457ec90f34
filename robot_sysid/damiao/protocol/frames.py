"""Frames on the bus: special commands, register requests, and what must never be sent."""

from __future__ import annotations

from typing import NamedTuple

from robot_sysid.errors import SysidError

REGISTER_ID = 0x7FF
READ, WRITE, REFRESH, STORE = 0x33, 0x55, 0xCC, 0xAA
ENABLE, DISABLE, CLEAR_ERROR, SET_ZERO = 0xFC, 0xFD, 0xFB, 0xFE
_SPECIAL = b"\xff" * 7


class Frame(NamedTuple):
    """One CAN frame.

    Attributes:
        id: 11-bit arbitration id.
        data: up to 8 bytes.
        time: when it was on the bus, in the link's clock [s].
        fd: whether it is a CAN-FD frame.
        error: whether it is an error frame, which carries no data.
        echo: whether it is one of our own, reported back when it was on the bus.
        bus: number of the bus it is on, from 0.
    """

    id: int
    data: bytes
    time: float = 0.0
    fd: bool = False
    error: bool = False
    echo: bool = False
    bus: int = 0


class Address(NamedTuple):
    """Where a motor is: number of its bus, from 0, and the id it listens to."""

    bus: int
    can_id: int


def enable_frame(motor: Address) -> Frame:
    """Return the frame that enables a motor in MIT mode."""
    return command_frame(motor, _SPECIAL + bytes([ENABLE]))


def disable_frame(motor: Address) -> Frame:
    """Return the frame that disables a motor in MIT mode."""
    return command_frame(motor, _SPECIAL + bytes([DISABLE]))


def clear_error_frame(motor: Address) -> Frame:
    """Return the frame that clears a motor's error."""
    return command_frame(motor, _SPECIAL + bytes([CLEAR_ERROR]))


def set_zero_frame(motor: Address) -> Frame:
    """Return the frame that makes where a motor stands its zero, for good."""
    return command_frame(motor, _SPECIAL + bytes([SET_ZERO]))


def store_frame(motor: Address) -> Frame:
    """Return the request to keep all registers when the power goes off."""
    return _request(motor, STORE, 1)


def command_frame(motor: Address, data: bytes) -> Frame:
    """Return the frame that carries eight bytes to a motor in MIT mode."""
    return Frame(motor.can_id, data, bus=motor.bus)


def refresh_frame(motor: Address) -> Frame:
    """Return the request for one feedback frame without any effect on the motor."""
    return _request(motor, REFRESH, 0)


def read_frame(motor: Address, register: int) -> Frame:
    """Return the request for a register's value."""
    return _request(motor, READ, register)


def write_frame(motor: Address, register: int, value: bytes) -> Frame:
    """Return the request that writes four bytes to a register; lost at power-off."""
    return _request(motor, WRITE, register, value)


def _request(motor: Address, operation: int, register: int, value: bytes = bytes(4)) -> Frame:
    head = bytes([motor.can_id & 0xFF, motor.can_id >> 8, operation, register])
    return Frame(REGISTER_ID, head + value, bus=motor.bus)


def is_special(data: bytes) -> bool:
    """Tell whether data starts with seven bytes 0xFF, which makes its last byte a command."""
    return len(data) == 8 and data[:7] == _SPECIAL


def refuse_harmful(frame: Frame) -> None:
    """Raise SysidError for a frame that no run ever sends.

    That is: storing a new zero position, clearing an error (an operator has to find its cause
    first), any other special frame but enable and disable, and storing registers to flash.
    """
    if frame.id == REGISTER_ID:
        harmful = len(frame.data) < 4 or frame.data[2] not in (READ, WRITE, REFRESH)
    else:
        harmful = is_special(frame.data) and frame.data[7] not in (ENABLE, DISABLE)
    if harmful:
        raise SysidError(f"refused to send {frame.data.hex(' ')} to {frame.id:#x}")


def refuse_motion(frame: Frame) -> None:
    """Raise SysidError for a frame that setting a motor up never sends: anything that drives it."""
    on_registers = frame.id == REGISTER_ID
    if not on_registers and not (is_special(frame.data) and frame.data[7] != ENABLE):
        raise SysidError(f"refused to send {frame.data.hex(' ')} to {frame.id:#x}")

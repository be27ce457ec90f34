"""What a Damiao motor holds: its registers with their four bytes each, and its status code."""

from __future__ import annotations

import struct

from robot_sysid.errors import InputError

MST_ID, ESC_ID, TIMEOUT, CTRL_MODE = 7, 8, 9, 10
GR, PMAX, VMAX, TMAX, CAN_BR = 20, 21, 22, 23, 35

TIMEOUT_UNIT = 50e-6
"""Seconds per unit of the watchdog register."""
MIT_MODE = 1
MODES = {1: "MIT", 2: "POS_VEL", 3: "VEL", 4: "POS_FORCE"}
FD_BITRATE_CODES_ABOVE = 4
_KBIT = (125, 200, 250, 500, 1000, 2000, 2500, 3200, 4000, 5000)
BIT_RATES = {1000 * rate: code for code, rate in enumerate(_KBIT)}
"""Bit rate [bit/s] to the code of register can_br; codes above 4 make the motor speak CAN-FD."""


NAMES = {
    0: "UV_Value", 1: "KT_Value", 2: "OT_Value", 3: "OC_Value", MST_ID: "MST_ID", ESC_ID: "ESC_ID",
    TIMEOUT: "TIMEOUT", CTRL_MODE: "CTRL_MODE", 11: "Damp", 12: "Inertia", 14: "sw_ver", 16: "NPP",
    17: "Rs", 19: "Flux", GR: "Gr", PMAX: "PMAX", VMAX: "VMAX", TMAX: "TMAX", 29: "OV_Value",
    30: "GREF", CAN_BR: "can_br",
}  # fmt: skip
INTEGERS = (MST_ID, ESC_ID, TIMEOUT, CTRL_MODE, 14, 16, CAN_BR)
"""Registers that hold an unsigned integer; the others hold a float."""
SCALING = (PMAX, VMAX, TMAX)
REQUIRED = (MST_ID, ESC_ID, TIMEOUT, CTRL_MODE, *SCALING)
"""Without these nothing is played."""
WRITABLE = (*REQUIRED, CAN_BR)
LOGGED = (*REQUIRED, GR, 2, 3, 0, 29, 1, 30, 11, 12, 14, 16, 17, 19)
"""Read before playing and written into the recording's header."""


def value_from_bytes(number: int, raw: bytes) -> float:
    """Return a register's value from its four little-endian bytes."""
    return float(struct.unpack("<I" if number in INTEGERS else "<f", raw)[0])


def bytes_from_value(number: int, value: float) -> bytes:
    """Return the four little-endian bytes of a register's value, or raise InputError."""
    try:
        return struct.pack("<I", int(value)) if number in INTEGERS else struct.pack("<f", value)
    except (struct.error, OverflowError, ValueError):
        raise InputError(f"{NAMES[number]} = {value:g} does not fit into its register") from None


def text_of(number: int, value: float) -> str:
    """Return NAME=value as written into a recording's header."""
    return f"{NAMES[number]}={int(value) if number in INTEGERS else format(value, '.9g')}"


DISABLED, ENABLED = 0, 1
LOST_COMMUNICATION = 0xD

_MEANINGS = {
    DISABLED: "disabled",
    ENABLED: "enabled",
    0x2: "encoder error",
    0x3: "output-shaft calibration error",
    0x4: "sensor output error",
    0x5: "calibration data error",
    0x6: "motor parameters could not be read",
    0x7: "sensor could not be read",
    0x8: "over-voltage",
    0x9: "under-voltage",
    0xA: "over-current",
    0xB: "power stage too hot",
    0xC: "winding too hot",
    LOST_COMMUNICATION: "communication lost (watchdog expired)",
    0xE: "overload",
}


def describe(code: int) -> str:
    """Return a status code in words."""
    return f"status {code:X}: {_MEANINGS.get(code, 'not documented')}"


def is_fault(code: int) -> bool:
    """Tell whether a code is a fault; every fault makes the motor leave the enabled state."""
    return code not in (DISABLED, ENABLED)

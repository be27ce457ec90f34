"""Frames on the bus: special commands, registers, status codes, what must never be sent, bus load.

Every control cycle puts two frames of eight bytes on the bus per motor: the command and its reply.
An 8-byte standard frame has 44 + 64 bits of frame and 3 bits of gap, and at worst one stuff bit for
every four of the 34 + 64 bits that are stuffed. CAN-FD sends the arbitration part at the nominal
and the rest at the data bit rate.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from robot_sysid.errors import InputError, SysidError
from robot_sysid.records.options import OptionRecord, option

REGISTER_ID = 0x7FF
READ = 0x33
WRITE = 0x55
REFRESH = 0xCC
STORE = 0xAA
ENABLE = 0xFC
DISABLE = 0xFD
CLEAR_ERROR = 0xFB
SET_ZERO = 0xFE
_SPECIAL = b"\xff" * 7


class Frame(NamedTuple):
    """One CAN frame.

    It has an 11-bit id and up to 8 bytes, none in an error frame. ``time`` is when it was on the
    bus, in the link's clock [s]; an ``echo`` is one of our own, reported back then.
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


def _special_frame(code: int, motor: Address) -> Frame:
    return Frame(motor.can_id, _SPECIAL + bytes([code]), bus=motor.bus)


enable_frame = partial(_special_frame, ENABLE)
disable_frame = partial(_special_frame, DISABLE)
clear_error_frame = partial(_special_frame, CLEAR_ERROR)
set_zero_frame = partial(_special_frame, SET_ZERO)
"""Makes where a motor stands its zero, for good."""


def _request(
    operation: int, motor: Address, register: int, value: bytes = bytes(4)
) -> Frame:
    head = bytes([motor.can_id & 0xFF, motor.can_id >> 8, operation, register])
    return Frame(REGISTER_ID, head + value, bus=motor.bus)


read_frame = partial(_request, READ)
write_frame = partial(_request, WRITE)
"""Writes four bytes to a register; lost at power-off."""
refresh_frame = partial(_request, REFRESH, register=0)
"""Asks for one feedback frame without any effect on the motor."""
store_frame = partial(_request, STORE, register=1)
"""Keeps all registers when the power goes off."""


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
    if frame.id != REGISTER_ID and not (
        is_special(frame.data) and frame.data[7] != ENABLE
    ):
        raise SysidError(f"refused to send {frame.data.hex(' ')} to {frame.id:#x}")


MST_ID = 7
ESC_ID = 8
TIMEOUT = 9
CTRL_MODE = 10
GR = 20
PMAX = 21
VMAX = 22
TMAX = 23
CAN_BR = 35

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
        return (
            struct.pack("<I", int(value))
            if number in INTEGERS
            else struct.pack("<f", value)
        )
    except (struct.error, OverflowError, ValueError):
        raise InputError(
            f"{NAMES[number]} = {value:g} does not fit into its register"
        ) from None


def text_of(number: int, value: float) -> str:
    """Return NAME=value as written into a recording's header."""
    return (
        f"{NAMES[number]}={int(value) if number in INTEGERS else format(value, '.9g')}"
    )


DISABLED = 0
ENABLED = 1
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


# A judgement: room for error frames and for one frame in three that is sent again.
PLANNING_LIMIT = 0.70
HANDY_RATES = (1000.0, 500.0, 250.0, 200.0, 125.0, 100.0, 50.0, 40.0, 25.0, 20.0, 10.0)
"""Cycle rates to propose [Hz], highest first."""
_FRAMES_PER_CYCLE = 2
_CLASSIC_BITS = 111 + 24
_FD_NOMINAL_BITS = 30 + 4
_FD_DATA_BITS = 96 + 17
_CLASSIC_RATE_HZ = 250.0
_FD_RATE_HZ = 500.0
_BIT_RATE = "RATE [bit/s] > 0"


@dataclass(frozen=True)
class BusTiming(OptionRecord):
    """Bit rates of a bus."""

    fd: bool = option(False, "use CAN-FD frames")
    bitrate: float = option(1e6, "nominal bit rate", _BIT_RATE, usual="1000000")
    data_bitrate: float = option(
        5e6, "bit rate of the data part of CAN-FD frames", _BIT_RATE, usual="5000000"
    )

    @property
    def frame_time(self) -> float:
        """Longest time one 8-byte frame occupies the bus [s]."""
        if not self.fd:
            return _CLASSIC_BITS / self.bitrate
        return _FD_NOMINAL_BITS / self.bitrate + _FD_DATA_BITS / self.data_bitrate


def bus_load(n_motors: int, rate: float, timing: BusTiming) -> float:
    """Return the worst-case share of the bus that n motors at ``rate`` [Hz] take (1 = full)."""
    return n_motors * _FRAMES_PER_CYCLE * timing.frame_time * rate


def default_rate(n_motors: int, timing: BusTiming) -> float:
    """Return the cycle rate to use [Hz]: 250 (classic) or 500 (FD), less where it does not fit."""
    return suggested_rate(
        n_motors, timing, _FD_RATE_HZ if timing.fd else _CLASSIC_RATE_HZ
    )


def suggested_rate(n_motors: int, timing: BusTiming, most: float = math.inf) -> float:
    """Return the highest handy rate [Hz] up to ``most`` that loads the bus to 70 % or less."""
    top = PLANNING_LIMIT / bus_load(n_motors, 1.0, timing)
    return next((rate for rate in HANDY_RATES if rate <= min(top, most)), top)

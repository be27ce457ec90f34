"""Frames on the bus: special commands, register requests, what must never be sent, and bus load.

Every control cycle puts two frames of eight bytes on the bus per motor: the command and its reply.
An 8-byte standard frame has 44 + 64 bits of frame and 3 bits of gap, and at worst one stuff bit for
every four of the 34 + 64 bits that are stuffed. CAN-FD sends the arbitration part at the nominal
and the rest at the data bit rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from robot_sysid.errors import SysidError
from robot_sysid.records.options import OptionRecord, option

REGISTER_ID = 0x7FF
READ, WRITE, REFRESH, STORE = 0x33, 0x55, 0xCC, 0xAA
ENABLE, DISABLE, CLEAR_ERROR, SET_ZERO = 0xFC, 0xFD, 0xFB, 0xFE
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


def _request(operation: int, motor: Address, register: int, value: bytes = bytes(4)) -> Frame:
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
    if frame.id != REGISTER_ID and not (is_special(frame.data) and frame.data[7] != ENABLE):
        raise SysidError(f"refused to send {frame.data.hex(' ')} to {frame.id:#x}")


PLANNING_LIMIT = 0.70
HANDY_RATES = (1000.0, 500.0, 250.0, 200.0, 125.0, 100.0, 50.0, 40.0, 25.0, 20.0, 10.0)
"""Cycle rates to propose [Hz], highest first."""
_FRAMES_PER_CYCLE = 2
_CLASSIC_BITS, _FD_NOMINAL_BITS, _FD_DATA_BITS = 111 + 24, 30 + 4, 96 + 17
_CLASSIC_RATE_HZ, _FD_RATE_HZ = 250.0, 500.0
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

    @property
    def name(self) -> str:
        """How messages call this bus."""
        return "CAN-FD" if self.fd else "classic CAN"


def bus_load(n_motors: int, rate: float, timing: BusTiming) -> float:
    """Return the worst-case share of the bus that n motors at ``rate`` [Hz] take (1 = full)."""
    return n_motors * _FRAMES_PER_CYCLE * timing.frame_time * rate


def highest_rate(n_motors: int, timing: BusTiming) -> float:
    """Return the highest cycle rate [Hz] that keeps the bus load at or below 70 %."""
    return PLANNING_LIMIT / (n_motors * _FRAMES_PER_CYCLE * timing.frame_time)


def default_rate(n_motors: int, timing: BusTiming) -> float:
    """Return the cycle rate to use [Hz]: 250 (classic) or 500 (FD), less where it does not fit."""
    return suggested_rate(n_motors, timing, _FD_RATE_HZ if timing.fd else _CLASSIC_RATE_HZ)


def suggested_rate(n_motors: int, timing: BusTiming, most: float = math.inf) -> float:
    """Return the highest handy rate [Hz] up to ``most`` that the bus can carry for n motors."""
    top = highest_rate(n_motors, timing)
    return next((rate for rate in HANDY_RATES if rate <= min(top, most)), top)

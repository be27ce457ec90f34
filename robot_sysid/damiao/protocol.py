"""CAN frames of Damiao motors: MIT commands, feedback, registers, status codes and bus load.

MIT command, 64 bits, most significant first: position 16, velocity 12, kp 12, kd 12, torque 12.
Feedback: status 4, id 4, position 16, velocity 12, torque 12, two temperature bytes. A quantity in
[lo, hi] is the integer u = (x - lo) (2^bits - 1) / (hi - lo): no code stands for exactly zero.
Arrays are (..., n): any leading shape, n joints last; frames are (..., n, 8) bytes.

Every control cycle puts two frames of eight bytes on the bus per motor: the command and its reply.
An 8-byte standard frame has 44 + 64 bits and is followed by a gap of 3 bits; at worst there is one
stuff bit for every four of the 34 + 64 bits that are subject to bit stuffing. CAN-FD sends the
arbitration part at the nominal bit rate and the rest of the frame at the data bit rate.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array
from robot_sysid.records.option_fields import OptionRecord, option

Bytes = NDArray[np.uint8]
"""Frames as an array (..., n, 8)."""
Codes = NDArray[np.int64]
"""Status codes or temperatures of motors."""

KP_MAX = 500.0
"""The greatest stiffness that a command frame can carry [N m/rad]."""
KD_MAX = 5.0
"""The greatest damping that a command frame can carry [N m s/rad]."""
KD_STEP = KD_MAX / 0xFFF
"""The least damping above zero that a command frame can carry [N m s/rad]."""

_NIBBLE_END = 15.0
"""Greatest code of a field of four bits: status, and lower half of the CAN id."""
_BYTE_END = 255.0
"""Greatest code of a field of a byte: each of the two temperatures [degC]."""


# Why a command is refused.
_UNSTABLE = f"has kp > 0, which needs kd of at least {KD_STEP:.2g}"
_SPECIAL_FRAME = "would read as a special frame; lower its gains or torque"
# Fraction of a step that is added to each field of feedback, see ``decode_feedback``.
_HALVES = np.array([0.0, 0.0, 0.5, 0.5, 0.5, 0.0, 0.0])


class _Codec:
    """Converts F quantities to the bit fields of 64-bit frames, most significant first, and back.

    Args:
        bits: number of bits of each field; their sum is 64.
        low: least value (n, F) of each motor's quantities.
        high: greatest value (n, F).

    Attributes:
        steps: one quantisation step (n, F) of each quantity.
    """

    def __init__(self, bits: tuple[int, ...], low: Array, high: Array) -> None:
        self._low = low
        self._max_codes = (1 << np.array(bits)) - 1
        self._shifts = 64 - np.cumsum(bits)
        self._places = 1 << self._shifts
        self._codes_per_unit = self._max_codes / (high - low)
        self.steps = (high - low) / self._max_codes

    def encode(self, values: Array, rounding: float) -> Bytes:
        """Return frames (..., n, 8) of quantities (..., n, F), limited to their ranges.

        ``rounding`` is 0.5 for the nearest code, 0 for the one below.
        """
        scaled = (values - self._low) * self._codes_per_unit
        # floor(x + 1/2): numpy's rint rounds halves to even, which differs in the last bit.
        codes = np.minimum(np.maximum(np.floor(scaled + rounding), 0), self._max_codes)
        integers = codes.astype(np.int64) @ self._places
        return integers.astype(">i8")[..., None].view(np.uint8)

    def decode(self, frames: Bytes, fraction: Array | float = 0.0) -> list[Array]:
        """Return the F quantities (..., n) in frames (..., n, 8), plus a fraction of a step."""
        big_endian = np.ascontiguousarray(frames, dtype=np.uint8).view(">i8")
        codes = (big_endian.astype(np.int64) >> self._shifts) & self._max_codes
        values = (codes + fraction) * self.steps + self._low
        return [values[..., field] for field in range(len(self._shifts))]


class Scaling:
    """Ranges of the quantities in the frames of n motors.

    Args:
        limits: PMAX [rad], VMAX [rad/s] and TMAX [N m] of each motor; InputError unless all are
            positive.

    Attributes:
        limits: the limits as an array (n, 3) [rad, rad/s, N m].
        low, high: range (n, 5) of position, velocity, kp, kd and torque in commands.
        command: codec of these five.
        feedback: codec of status, CAN id, position, velocity, torque and two temperatures.
    """

    def __init__(self, limits: Iterable[Sequence[float]]) -> None:
        self.limits: Array = np.array(list(limits), dtype=float).reshape(-1, 3)
        if not np.all(np.isfinite(self.limits) & (self.limits > 0.0)):
            raise InputError(
                f"PMAX, VMAX and TMAX must be positive, got {self.limits.tolist()}"
            )
        self.high = np.insert(self.limits, [2, 2], (KP_MAX, KD_MAX), axis=1)
        # Stiffness and damping begin at zero.
        self.low = self.high * (-1.0, -1.0, 0.0, 0.0, -1.0)
        # A register holds float32: a limit of 12.566 comes back as 12.5659999..., and a command of
        # 12.566 must still be accepted.
        slack = 1e-6 * self.high
        self._accepted = self.low - slack, self.high + slack
        self.command = _Codec((16, 12, 12, 12, 12), self.low, self.high)
        # Status, id and temperatures are their own codes.
        low = np.insert(-self.limits, [0, 0, 3, 3], 0.0, axis=1)
        ends = (_NIBBLE_END, _NIBBLE_END, _BYTE_END, _BYTE_END)
        high = np.insert(self.limits, [0, 0, 3, 3], ends, axis=1)
        self.feedback = _Codec((4, 4, 16, 12, 12, 8, 8), low, high)

    def accepts(self, values: Array) -> NDArray[np.bool_]:
        """Return which quantities (..., n, 5) of commands are in their ranges; NaN is not."""
        lowest, highest = self._accepted
        return (values >= lowest) & (values <= highest)

    @property
    def steps(self) -> tuple[Array, ...]:
        """Quantisation steps of position [rad], velocity [rad/s] and torque [N m], (n,) each."""
        return tuple(self.feedback.steps.T[2:5])


class MitCommand(NamedTuple):
    """One MIT command of n motors (or joints); each field is (..., n).

    A motor at position q and velocity qd delivers kp (position - q) + kd (velocity - qd) + torque.

    Attributes:
        position: target position [rad].
        velocity: target velocity [rad/s].
        kp: stiffness [N m/rad], 0 to 500.
        kd: damping [N m s/rad], 0 to 5.
        torque: feed-forward torque [N m].
    """

    position: Array
    velocity: Array
    kp: Array
    kd: Array
    torque: Array

    def motor_torque(self, q: Array, qd: Array) -> Array:
        """Return the commanded torque (..., n) [N m] at q (..., n) [rad], qd (..., n) [rad/s]."""
        position, velocity, kp, kd, torque = self
        return kp * (position - q) + kd * (velocity - qd) + torque


@dataclass(frozen=True)
class Feedback:
    """Feedback of n motors; each field is (..., n), quantities are at the output shaft.

    Attributes:
        status: 0 disabled, 1 enabled, else a fault; see ``status_text``.
        position: measured position [rad].
        velocity: measured velocity [rad/s].
        torque: torque estimated from the motor current [N m].
        temperature_mos: temperature of the power stage [deg C].
        temperature_rotor: temperature of the winding [deg C].
    """

    status: Codes
    position: Array
    velocity: Array
    torque: Array
    temperature_mos: Codes
    temperature_rotor: Codes

    @property
    def temperature(self) -> Codes:
        """The higher one of both temperatures (..., n) [deg C]."""
        return np.maximum(self.temperature_mos, self.temperature_rotor)


def encode_mit(command: MitCommand, scaling: Scaling) -> Bytes:
    """Return the MIT command frames (..., n, 8), each value rounded to the nearest code.

    Raises:
        InputError: a value is not finite or outside its range (nothing is clamped), kp > 0 without
            kd > 0 in its frame (the motor would oscillate), or a frame's first seven bytes would
            all be 0xFF (the motor would take it for enable, disable, zero or clear).
    """
    values = np.stack(command, axis=-1)
    inside = scaling.accepts(values)
    if not inside.all():
        *_, motor, field = np.argwhere(~inside)[0]
        raise InputError(
            f"{MitCommand._fields[field]} {values[~inside][0]:g} of motor number {motor + 1} "
            f"is outside its range, limit {scaling.high[motor, field]:g}"
        )
    frames = scaling.command.encode(values, rounding=0.5)
    is_unstable = (command.kp > 0.0) & (command.kd < 0.5 * KD_STEP)
    is_special_frame = np.minimum.reduce(frames[..., :7], axis=-1) == 0xFF
    for mask, text in ((is_unstable, _UNSTABLE), (is_special_frame, _SPECIAL_FRAME)):
        if mask.any():
            *_, motor = np.argwhere(mask)[0]
            raise InputError(f"the command of motor number {motor + 1} {text}")
    return frames


def decode_mit(frames: Bytes, scaling: Scaling) -> MitCommand:
    """Return the command, fields (..., n), that n motors read from MIT frames (..., n, 8)."""
    return MitCommand(*scaling.command.decode(frames))


def decode_feedback(frames: Bytes, scaling: Scaling) -> Feedback:
    """Return the feedback, fields (..., n), in frames (..., n, 8).

    Half a quantisation step is added to position, velocity and torque: a motor truncates when it
    packs a value, so that received values are half a step too low on average.
    """
    status, _, position, velocity, torque, mos, rotor = scaling.feedback.decode(
        frames, _HALVES
    )
    return Feedback(
        status.astype(int),
        position,
        velocity,
        torque,
        mos.astype(int),
        rotor.astype(int),
    )


def encode_feedback(fields: Array, scaling: Scaling) -> Bytes:
    """Return the frames (..., n, 8) of feedback, as motors pack it.

    ``fields`` (..., n, 7) are status, CAN id, position, velocity, torque and two temperatures.
    Quantities are rounded down and limited to their ranges.
    """
    return scaling.feedback.encode(fields, rounding=0.0)


REGISTER_ID = 0x7FF
"""Arbitration id of frames with a register operation; bytes 0 and 1 hold the motor's CAN id."""
READ = 0x33
"""Register operation: read a register."""
WRITE = 0x55
"""Register operation: write a register; lost at power-off."""
REFRESH = 0xCC
"""Register operation: ask for one feedback frame."""
STORE = 0xAA
"""Register operation: store all registers in flash."""
ENABLE = 0xFC
"""Special command: enable the motor, so that it follows commands."""
DISABLE = 0xFD
"""Special command: disable the motor."""
CLEAR_ERROR = 0xFB
"""Special command: leave a fault, to the disabled state."""
# First seven bytes of a special frame; the eighth is the special command.
_SPECIAL = b"\xff" * 7


class CanFrame(NamedTuple):
    """One CAN frame.

    Attributes:
        id: 11-bit arbitration id.
        data: up to 8 bytes.
        time: time at which the frame was on the bus, in the link's clock [s].
        fd: whether this is a CAN-FD frame.
        echo: whether this program sent the frame and the adapter reports that it was on the bus.
    """

    id: int
    data: bytes
    time: float = 0.0
    fd: bool = False
    echo: bool = False


def special_frame(code: int, can_id: int) -> CanFrame:
    """Return the frame of a special command (code), such as ENABLE, to a motor."""
    return CanFrame(can_id, _SPECIAL + bytes([code]))


def register_frame(
    operation: int, can_id: int, register: int = 0, value: bytes = bytes(4)
) -> CanFrame:
    """Return the frame that requests an operation on a motor's register.

    Args:
        operation: READ, WRITE, REFRESH or STORE; REFRESH has no other effect than its answer.
        can_id: CAN id of the motor.
        register: number of the register; 1 to STORE all.
        value: four little-endian bytes to write (``bytes_from_value``); zeros for other operations.
    """
    head = bytes([can_id & 0xFF, can_id >> 8, operation, register])
    return CanFrame(REGISTER_ID, head + value)


def is_special(data: bytes) -> bool:
    """Tell whether data are seven bytes 0xFF and one more, which is then a special command."""
    return len(data) == 8 and data[:7] == _SPECIAL


def is_harmful(frame: CanFrame) -> bool:
    """Tell whether a frame must never be sent while an arm is played or checked.

    Harmful frames store a new zero position, clear an error (an operator has to find its cause
    first), write or store registers, or have an unknown special command or register operation.
    """
    if frame.id == REGISTER_ID:
        return len(frame.data) < 4 or frame.data[2] not in (READ, REFRESH)
    return is_special(frame.data) and frame.data[7] not in (ENABLE, DISABLE)


def is_motion(frame: CanFrame) -> bool:
    """Tell whether a frame would drive a motor: setting up a motor never sends one.

    Register operations and clearing an error do not.
    """
    is_harmless = is_special(frame.data) and frame.data[7] == CLEAR_ERROR
    return frame.id != REGISTER_ID and not is_harmless


class Register(IntEnum):
    """Numbers of a motor's registers, by the maker's names.

    All of them have to be known before anything is played; a recording's head has them.
    """

    # Master id, the arbitration id of the motor's replies.
    MST_ID = 7
    # CAN id of frames to the motor.
    ESC_ID = 8
    # Time without a command after which the watchdog stops the motor, in TIMEOUT_UNIT.
    TIMEOUT = 9
    # Control mode, a key of ``MODES``.
    CTRL_MODE = 10
    # Scaling limits of position [rad], velocity [rad/s] and torque [N m].
    PMAX = 21
    VMAX = 22
    TMAX = 23


SCALING = (Register.PMAX, Register.VMAX, Register.TMAX)
"""Registers of the scaling limits, in the order of ``Scaling.limits``; they hold a float, all other
registers an unsigned integer."""
TIMEOUT_UNIT = 50e-6
"""Time of one unit of the watchdog register TIMEOUT [s]."""
MIT_MODE = 1
"""Value of CTRL_MODE in which a motor follows MIT commands."""
MODES = {1: "MIT", 2: "POS_VEL", 3: "VEL", 4: "POS_FORCE"}
"""Name of each control mode, by the value of register CTRL_MODE."""


def value_from_bytes(number: int, raw: bytes) -> float:
    """Return the value of register ``number`` from its four little-endian bytes ``raw``."""
    return float(struct.unpack("<f" if number in SCALING else "<I", raw)[0])


def bytes_from_value(number: int, value: float) -> bytes:
    """Return the four little-endian bytes of a value of register ``number``.

    InputError where the value does not fit into the register.
    """
    try:
        if number in SCALING:
            return struct.pack("<f", value)
        return struct.pack("<I", int(value))
    except (struct.error, OverflowError, ValueError):
        raise InputError(
            f"{Register(number).name} = {value:g} does not fit into its register"
        ) from None


def register_text(number: int, value: float) -> str:
    """Return "NAME=value" of register ``number``, as written into a recording's header."""
    return f"{Register(number).name}={value:.9g}"


DISABLED = 0
"""Status code of a motor that follows no commands."""
ENABLED = 1
"""Status code of a motor that follows commands."""
LOST_COMMUNICATION = 0xD
"""Status code of a motor that its watchdog stopped because commands stayed away."""

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


def status_text(code: int) -> str:
    """Return "status CODE: meaning" of a motor's status code, for messages."""
    return f"status {code:X}: {_MEANINGS.get(code, 'not documented')}"


def is_fault(code: int) -> bool:
    """Return whether a status code is a fault; a motor with a fault is no longer enabled."""
    return code not in (DISABLED, ENABLED)


PLANNING_LIMIT = 0.70
"""Largest share of the bus that a plan may take (1 = full).

A judgement: the rest is for error frames and for sending one frame in three again.
"""
CLASSIC_RATE = 250.0
"""Default control cycles per second on classic CAN [Hz]: seven motors take less than half of such
a bus."""
FD_RATE = 500.0
"""The same on CAN-FD [Hz]: seven motors take less than half of it, too."""
# Placeholder and condition of the bit rate options in the help text.
_BIT_RATE = "RATE [bit/s] > 0"


@dataclass(frozen=True)
class BusTiming(OptionRecord):
    """Frame format and bit rates [bit/s] of a CAN bus."""

    fd: bool = option(False, "use CAN-FD frames")
    bitrate: float = option(1e6, "nominal bit rate", _BIT_RATE, default_text="1000000")
    data_bitrate: float = option(
        5e6,
        "bit rate of the data part of CAN-FD frames",
        _BIT_RATE,
        default_text="5000000",
    )

    @property
    def frame_time(self) -> float:
        """Longest time for which one 8-byte frame occupies the bus [s]."""
        # Bits of the frame, with the gap behind a classic one, and the stuff bits at worst.
        if not self.fd:
            return (111 + 24) / self.bitrate
        return (30 + 4) / self.bitrate + (96 + 17) / self.data_bitrate


def bus_load(n_motors: int, rate: float, timing: BusTiming) -> float:
    """Return the share of a bus's time (1 = full) that motors' frames take at worst.

    Args:
        n_motors: number of motors on the bus.
        rate: control cycles per second [Hz].
        timing: frame format and bit rates of the bus.
    """
    # In each cycle a command and its reply.
    return 2.0 * n_motors * timing.frame_time * rate


def default_rate(n_motors: int, timing: BusTiming) -> float:
    """Return the default cycle rate [Hz] of n motors on a bus.

    It is that of the frame format, or less where that would load the bus beyond ``PLANNING_LIMIT``.
    """
    max_rate = FD_RATE if timing.fd else CLASSIC_RATE
    full_rate = PLANNING_LIMIT / bus_load(n_motors, rate=1.0, timing=timing)
    return handy_rate(min(full_rate, max_rate))


def handy_rate(max_rate: float) -> float:
    """Return the highest multiple of 10 Hz up to ``max_rate`` [Hz], or this where it is less."""
    return 10.0 * (max_rate // 10.0) if max_rate > 10.0 else max_rate
